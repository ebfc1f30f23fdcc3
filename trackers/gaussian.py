"""The Gaussian every tracker speaks, and its mixture."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np


class Gaussian(NamedTuple):
    """A normal density.

    Attributes:
        mean: [..., d].
        cov: [..., d, d], symmetric positive definite.
    """

    mean: Any
    cov: Any


def moment_match(weights, mean, cov) -> Gaussian:
    """Mean and covariance of a Gaussian mixture.

        x̂ = Σ w_i x_i        P̂ = Σ w_i [P_i + (x_i − x̂)(x_i − x̂)ᵀ]

    Args:
        weights: [..., n], sum 1.
        mean: [..., n, d].
        cov: [..., n, d, d].
    Returns:
        Gaussian of mean [..., d] and cov [..., d, d].
    Source: Xiu et al. (2002), eqs 37–38.
    """
    w = np.asarray(weights)
    x = (w[..., None] * mean).sum(-2)
    dx = mean - x[..., None, :]
    spread = cov + dx[..., :, None] * dx[..., None, :]
    return Gaussian(x, (w[..., None, None] * spread).sum(-3))
