"""Which candidate is which ball: the body found among candidates of all cameras, by geometry."""

from measure.measuring.association.associate import Association, AssociationSettings, associate

__all__ = ["Association", "AssociationSettings", "associate"]
