"""Passive-sensor trackers: arrays in, arrays out; usable without any environment."""

from trackers.adaptive_rp_ekf import AdaptiveRpEkf, ModelBank
from trackers.angle_contract import AngleScan, AngleTracker, AngleUpdate
from trackers.angle_ekf import AngleEkf
from trackers.angle_filter import AngleFilter
from trackers.angle_pdaf import AngleNearestNeighbour, AnglePdaf, AnglePdafSequential
from trackers.contract import Scan, Tracker, Update
from trackers.converted_fusion import ConvertedFusion, PolarScan
from trackers.converted_measurement import Layout
from trackers.fix_contract import BearingScan, ManeuverTracker, ManeuverUpdate
from trackers.fix_tracker import FixTracker
from trackers.fused_ekf import FusedEkf
from trackers.gaussian import Gaussian
from trackers.imm import Imm3
from trackers.imm_mie import ImmMie, InputEstimation, Mie
from trackers.range_sum_contract import RangeSumScan, RangeSumTrack, RangeSumTracker, RangeSumUpdate
from trackers.range_sum_ekf import RangeSumEkf, RangeSumEkfLiteral, RangeSumEkfSecondOrder
from trackers.rp_ekf import Bank, RpEkf
from trackers.scan_fusion import FusedScan, ScanFusion

DISTRIBUTION = "passive-env"
"""Tells this package from another distribution's of the same name."""

TRACKERS: dict[str, type[RpEkf]] = {"rp_ekf": RpEkf, "fused_ekf": FusedEkf, "rp_ekf_adaptive": AdaptiveRpEkf}
"""Trackers an environment takes by name."""

ANGLE_TRACKERS: dict[str, type[AngleFilter]] = {
    "angle_ekf": AngleEkf,
    "angle_pdaf": AnglePdaf,
    "angle_nn": AngleNearestNeighbour,
    "angle_pdaf_sequential": AnglePdafSequential,
}
"""Trackers on azimuth and elevation an environment takes by name."""

MANEUVER_TRACKERS: dict[str, type[FixTracker]] = {
    "imm_mie": ImmMie,
    "imm3": Imm3,
    "mie": Mie,
    "ie": InputEstimation,
}
"""Trackers of a maneuvering target on bearings that cross, by name."""

RANGE_SUM_TRACKERS: dict[str, type[RangeSumEkf]] = {
    "ekf": RangeSumEkf, "ekf_second_order": RangeSumEkfSecondOrder, "ekf_literal": RangeSumEkfLiteral,
}  # fmt: skip
"""Trackers on bistatic range sums, by name."""

__all__ = [
    "ANGLE_TRACKERS",
    "MANEUVER_TRACKERS",
    "RANGE_SUM_TRACKERS",
    "TRACKERS",
    "AdaptiveRpEkf",
    "AngleEkf",
    "AngleFilter",
    "AngleNearestNeighbour",
    "AnglePdaf",
    "AnglePdafSequential",
    "AngleScan",
    "AngleTracker",
    "AngleUpdate",
    "Bank",
    "BearingScan",
    "ConvertedFusion",
    "FixTracker",
    "FusedEkf",
    "FusedScan",
    "Gaussian",
    "Imm3",
    "ImmMie",
    "InputEstimation",
    "Layout",
    "ManeuverTracker",
    "ManeuverUpdate",
    "Mie",
    "ModelBank",
    "PolarScan",
    "RangeSumEkf",
    "RangeSumEkfLiteral",
    "RangeSumEkfSecondOrder",
    "RangeSumScan",
    "RangeSumTrack",
    "RangeSumTracker",
    "RangeSumUpdate",
    "RpEkf",
    "Scan",
    "ScanFusion",
    "Tracker",
    "Update",
]
