"""Association: which candidates are the body's balls, by geometry."""

from measure.measuring.association.associate import (
    Association,
    AssociationSettings,
    associate,
    warm_up,
)

__all__ = ["Association", "AssociationSettings", "associate", "warm_up"]
