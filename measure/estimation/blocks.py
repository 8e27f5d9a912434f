"""Linear least squares over named blocks of unknowns, with what is known of them beforehand."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from measure.arrays import Floats
from measure.geometry.covariance import posterior_covariance


@dataclass(frozen=True, eq=False)
class BlockFit:
    """Values of the blocks, and what they leave."""

    values: dict[str, Floats]  # of every block (k,)
    covariances: dict[str, Floats]  # of every block (k, k)
    residuals: Floats  # (n, m)


def fit_blocks(
    residuals: Floats,
    blocks: Mapping[str, Floats],
    weights: Floats,
    known: Mapping[str, Floats] | None = None,
) -> BlockFit:
    """Fit all blocks at once; what neither data nor priors determine stays zero.

    Args:
        residuals: (n, m) measured minus predicted.
        blocks: of every name the derivatives (n, m, k) of the predicted.
        weights: (m, m) or (n, m, m) inverse covariances of the residuals.
        known: of some blocks (k,) inverse variances of their values about zero.
    """
    slopes = np.concatenate(list(blocks.values()), axis=2)
    sizes = {name: block.shape[2] for name, block in blocks.items()}
    precision = [(known or {}).get(name, np.zeros(size)) for name, size in sizes.items()]
    weighted = (weights @ slopes).reshape(residuals.size, -1).T
    normal = weighted @ slopes.reshape(residuals.size, -1)
    covariance = posterior_covariance(normal, np.concatenate(precision))
    x = covariance @ (weighted @ residuals.ravel())
    ends = np.cumsum(list(sizes.values()))
    at = {name: slice(end - sizes[name], end) for name, end in zip(sizes, ends, strict=True)}
    return BlockFit(
        {name: x[rows] for name, rows in at.items()},
        {name: covariance[rows, rows] for name, rows in at.items()},
        residuals - slopes @ x,
    )
