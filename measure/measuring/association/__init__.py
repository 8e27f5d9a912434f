"""Which candidate is which ball: the body found among candidates of all cameras, by geometry."""

from measure.measuring.association.associate import Association, associate
from measure.measuring.association.settings import AssociationSettings

__all__ = ["Association", "AssociationSettings", "associate"]
