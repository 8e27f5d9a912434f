"""Association: which candidates are the body's balls, by geometry."""

from measure.measuring.association.associate import Association, associate, second_body, warm_up
from measure.measuring.association.reflection import Reflection
from measure.measuring.association.second_body import SecondBodyFlag

__all__ = ["Association", "Reflection", "SecondBodyFlag", "associate", "second_body", "warm_up"]
