"""Passive-sensor trackers: arrays in, arrays out; usable without any environment."""

from trackers.contract import Scan, Tracker, Update
from trackers.fused_ekf import FusedEkf
from trackers.gaussian import Gaussian
from trackers.rp_ekf import Bank, RpEkf

DISTRIBUTION = "passive-env"
"""Tells this package from another distribution's of the same name."""

TRACKERS: dict[str, type[RpEkf]] = {"rp_ekf": RpEkf, "fused_ekf": FusedEkf}
"""Trackers an environment takes by name."""

__all__ = ["TRACKERS", "Bank", "FusedEkf", "Gaussian", "RpEkf", "Scan", "Tracker", "Update"]
