"""Transforms, rays, cones and covariances: pure mathematics, no cameras, no pictures, no files."""

from measure.geometry.alignment import align_points
from measure.geometry.chi_square import chi_square_quantile
from measure.geometry.cone import Cone, fit_cone, tangent_cone
from measure.geometry.conic import Ellipse, ellipse_of_conic
from measure.geometry.covariance import UncertainTransform, propagate, squared_mahalanobis
from measure.geometry.midpoint import Midpoints, midpoints, usable_pairs
from measure.geometry.rays import Rays, common_perpendicular, nearest_point
from measure.geometry.transform import RigidTransform, skew

__all__ = [
    "Cone",
    "Ellipse",
    "Midpoints",
    "Rays",
    "RigidTransform",
    "UncertainTransform",
    "align_points",
    "chi_square_quantile",
    "common_perpendicular",
    "ellipse_of_conic",
    "fit_cone",
    "midpoints",
    "nearest_point",
    "propagate",
    "skew",
    "squared_mahalanobis",
    "tangent_cone",
    "usable_pairs",
]
