"""Trackers for tests that give sound estimates at first and spoil them later."""

from typing import Any

import numpy as np

from trackers.gaussian import Gaussian


def _one_velocity(mean, cov):
    spoilt = mean.copy()
    spoilt[..., -2] = np.nan
    return Gaussian(spoilt, cov)


SPOILT = {
    "mean": lambda mean, cov: Gaussian(mean * np.nan, cov),
    "covariance": lambda mean, cov: Gaussian(mean, cov * np.nan),
    "infinite": lambda mean, cov: Gaussian(mean + np.inf, cov * np.inf),
    "one velocity": _one_velocity,
    "negative": lambda mean, cov: Gaussian(mean, -cov),
    "huge": lambda mean, cov: Gaussian(mean * 1e300, cov * 1e300),
}
"""What may become of mean and covariance of an estimate, or of an acceleration."""


def spoilt_later(family: Any, spoil: Any) -> Any:
    """A tracker of a class with its default settings, sound for three estimates only; `asked` counts them."""

    class Later(family):
        def __init__(self):
            super().__init__()
            object.__setattr__(self, "asked", 0)  # trackers may be frozen

        def estimate(self, state):
            object.__setattr__(self, "asked", self.asked + 1)
            return self._told(super().estimate(state))

        def acceleration(self, state):
            return self._told(super().acceleration(state))

        def _told(self, sound):
            return sound if self.asked <= 3 else spoil(*sound)

    return Later()
