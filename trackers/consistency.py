"""Is a tracker honest about its errors? NEES, NIS and their chi-square bands."""

from __future__ import annotations

import numpy as np
from scipy.stats import chi2

from trackers.angles import wrap
from trackers.linalg import mahalanobis_squared


def nees(mean, cov, truth):
    """Normalised estimation error squared (x̂ − x)ᵀP⁻¹(x̂ − x), [...]; χ² with d degrees of freedom if honest.

    Args:
        mean, truth: [..., d]; cov: [..., d, d].
    """
    return mahalanobis_squared(np.asarray(mean) - np.asarray(truth), cov)


def nis(innovation, innovation_var):
    """Normalised innovation squared ν²/S [...] of a scalar angle; χ² with one degree of freedom if honest."""
    return wrap(innovation) ** 2 / innovation_var


def mean_band(degrees: int, samples: int, level: float = 0.999) -> tuple[float, float]:
    """Two-sided band for the mean of `samples` independent χ² variables of `degrees` degrees of freedom."""
    tail = 0.5 * (1.0 - level)
    low, high = chi2.ppf([tail, 1.0 - tail], df=degrees * samples) / samples
    return float(low), float(high)
