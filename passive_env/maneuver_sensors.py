"""Azimuths of one target from stations that move: tape row and geometry to one labelled bearing per station."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from passive_env.belief import Received
from passive_env.maneuver_metrics import HARDEST_M_S2
from passive_env.maneuver_tape import ManeuverTape
from trackers.angles import wrap_scalar
from trackers.compiled import kernel
from trackers.fix_contract import BearingScan, ManeuverUpdate
from trackers.position_fix import PositionFix, fix_bearings


class ManeuverSighting(NamedTuple):
    """A scan, and what only the world knows about it.

    Attributes:
        scan: what the tracker gets.
        truth: [e, m, 4] true target states at this instant.
        acceleration: [e, m, 2] true accelerations [m/s²].
    """

    scan: BearingScan
    truth: Any
    acceleration: Any


class ManeuverReports(NamedTuple):
    """What the last scan brought, as an operator sees it; fields as in `passive_env.belief.Belief`, and besides:

    Attributes:
        fixed: [e, m] bool, whether the azimuths crossed well enough for a position fix.
        fix: the crossing itself, position [e, 2] m and covariance [e, 2, 2] m², 0 where there is none.
        true_acceleration: [e, m, 2] m/s², for the figures of merit only.
        received: the scan itself.
    """

    assigned: Any
    returns: Any
    missed: Any
    available: Any
    model_probability: Any
    detected: Any
    acceleration: Any
    fixed: Any
    fix: PositionFix
    true_acceleration: Any
    received: Received


@kernel("(k,m,x),(k,m,p),(k,s),(k,s),(),(s,x),(),()->(s),(s),(m,x),(m,p)", "FFFBiFffFBFF")
def _sense(targets, accelerations, noise, detected, k, platforms, std, fastest, bearings, valid, truth, acceleration):
    truth[:] = targets[k]
    acceleration[:] = accelerations[k]
    for s in range(platforms.shape[0]):
        valid[s] = detected[k, s] and math.hypot(platforms[s, 2], platforms[s, 3]) <= fastest
        bearings[s] = 0.0
        if valid[s]:
            direction = math.atan2(truth[0, 1] - platforms[s, 1], truth[0, 0] - platforms[s, 0])
            bearings[s] = wrap_scalar(direction + std * noise[k, s])


class AzimuthSensors:
    """All stations' direction finders; each sees the one target, and nothing else.

    Args:
        tracker: tells its model probabilities and accelerations.
        bearing_std: [] rad.
        fastest: speed [m/s] above which a station does not measure; infinite for none.
    """

    def __init__(self, tracker: Any, bearing_std: float, fastest: float):
        self._tracker, self._std, self._fastest = tracker, bearing_std, fastest

    def acquire(self, tape: ManeuverTape) -> tuple[ManeuverTape, ManeuverSighting]:
        """The first scan, in which every station stands and sees the target."""
        return tape, self.sense(tape, np.zeros(len(tape.platforms), dtype=np.int64), tape.platforms, None)

    def sense(self, tape: ManeuverTape, step, platforms, predicted: Any) -> ManeuverSighting:
        """The scan of an instant: steps [e], platforms [e, s, 4]; nothing in it depends on the predicted track."""
        bearings, valid, truth, acceleration = _sense(
            tape.targets, tape.accelerations, tape.noise, tape.detected, step, platforms, self._std, self._fastest
        )
        std = np.broadcast_to(self._std, bearings.shape)
        return ManeuverSighting(BearingScan(bearings, valid, platforms[..., :2], std), truth, acceleration)

    def acquired(self, sighting: ManeuverSighting, state: Any) -> ManeuverReports:
        """What the first scan brought: a track from every station's azimuth; no model is likelier than another."""
        shape = (*sighting.truth.shape[:2], self._tracker.models)
        even, none = np.full(shape, 1.0 / shape[-1]), np.zeros(shape, dtype=bool)
        return self._reports(sighting, state, even, none, None)

    def report(self, sighting: ManeuverSighting, update: ManeuverUpdate) -> ManeuverReports:
        """What a scan brought, by the tracker's own account.

        Raises:
            ValueError: probabilities or detections of other shapes than the tracker's number of models makes them.
        """
        wanted = (*sighting.truth.shape[:2], self._tracker.models)
        for name in ("model_probability", "detected"):
            found = np.shape(getattr(update, name))
            if found != wanted:
                owner = type(self._tracker).__name__
                raise ValueError(f"tracker {owner}: update() gave {name} of shape {found}, must be {wanted}")
        return self._reports(sighting, update.posterior, update.model_probability, update.detected, update.fixed)

    def info(self, reports: ManeuverReports) -> dict[str, Any]:
        """What the tracker makes of the target's maneuvers; a diverged one's NaN reads 0."""
        acceleration = np.clip(np.nan_to_num(reports.acceleration), -HARDEST_M_S2, HARDEST_M_S2)
        return {
            "model_probability": np.nan_to_num(reports.model_probability), "detected": reports.detected,
            "acceleration": acceleration, "fixed": reports.fixed,
        }  # fmt: skip

    def _reports(self, sighting: ManeuverSighting, state, probability, detected, fixed) -> ManeuverReports:
        valid, fix = sighting.scan.valid, fix_bearings(*sighting.scan)
        e, m, _ = sighting.truth.shape
        fixed = np.broadcast_to(fix.fixed[:, None], (e, m)) if fixed is None else fixed
        return ManeuverReports(
            valid[:, None] & fixed[..., None], np.add.reduce(valid, axis=-1), np.empty((e, m, 0)),
            np.empty((e, 0, 2), dtype=bool), probability, detected, self._tracker.acceleration(state).mean, fixed,
            fix, sighting.acceleration, Received(sighting.scan.bearings[..., None, None], valid[..., None]),
        )  # fmt: skip
