"""Association: which candidates are the body's balls, by geometry."""

from measure.measuring.association.associate import (
    Association,
    AssociationSettings,
    associate,
    second_body,
    warm_up,
)

__all__ = ["Association", "AssociationSettings", "associate", "second_body", "warm_up"]
