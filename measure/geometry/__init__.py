"""Transforms, rays, cones and covariances: pure mathematics, no cameras, no pictures, no files."""

from measure.geometry.covariance import (
    UncertainTransform,
    chi_square_quantile,
    propagate,
    squared_mahalanobis,
)
from measure.geometry.rays import Cone, Rays, fit_cone, nearest_point, tangent_cone, usable_pairs
from measure.geometry.transform import RigidTransform, align_points, chart_jacobian, skew

__all__ = [
    "Cone", "Rays", "RigidTransform", "UncertainTransform", "align_points", "chart_jacobian",
    "chi_square_quantile", "fit_cone", "nearest_point", "propagate", "skew", "squared_mahalanobis",
    "tangent_cone", "usable_pairs",
]  # fmt: skip
