"""Transforms, rays, cones and covariances: pure mathematics, no cameras, no pictures, no files."""

from measure.geometry.alignment import align_points
from measure.geometry.chi_square import chi_square_quantile
from measure.geometry.cone import Cone, fit_cone, tangent_cone
from measure.geometry.covariance import UncertainTransform, propagate, squared_mahalanobis
from measure.geometry.rays import Rays, common_perpendicular, nearest_point
from measure.geometry.transform import RigidTransform, skew

__all__ = [
    "Cone",
    "Rays",
    "RigidTransform",
    "UncertainTransform",
    "align_points",
    "chi_square_quantile",
    "common_perpendicular",
    "fit_cone",
    "nearest_point",
    "propagate",
    "skew",
    "squared_mahalanobis",
    "tangent_cone",
]
