"""Which candidate is which ball: the body found among candidates of all cameras, by geometry."""

from measure.measuring.association.associate import Association, associate
from measure.measuring.association.settings import AssociationSettings
from measure.measuring.association.warm_up import warm_up

__all__ = ["Association", "AssociationSettings", "associate", "warm_up"]
