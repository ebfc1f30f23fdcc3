"""What a tracker on bistatic range sums takes and returns: echoes of one target from transmitters of opportunity.

The verbs are those of `trackers.contract.Tracker` (`initiate`, `predict`, `update`, `estimate`). A scan speaks of the
whole pool of n transmitters; `valid` says which of them answered, so that echoes may come and go. d = 2 in the plane
(states [x, y, vx, vy]), 3 in space ([x, y, z, vx, vy, vz], z up), in metres and metres per second, absolute.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from trackers.gaussian import Gaussian
from trackers.range_sum import check_std


class RangeSumScan(NamedTuple):
    """Range sums |p − R| + |p − Tᵢ| of one instant and one target.

    Attributes:
        range_sums: [..., n] m; 0 where not valid.
        valid: [..., n] bool; a scan may hold no echo at all.
        transmitters: [..., n, d] m, Tᵢ.
        receiver: [..., d] m, R at the scan's instant.
        std: [..., n] m.
    """

    range_sums: Any
    valid: Any
    transmitters: Any
    receiver: Any
    std: Any

    def check(self) -> None:
        """Refuse what would spread through every number.

        Raises:
            ValueError: shapes that do not belong together, entries that are not finite, a standard deviation that is
                not positive and finite, a mask that is neither True nor False.
        """
        sums, valid, sites, receiver, std = map(np.shape, self)
        if not (sites and sites[-1] in (2, 3) and receiver[-1:] == sites[-1:] and sites[-2:-1] == sums[-1:]):
            shapes = f"range_sums {sums}, transmitters {sites}, receiver {receiver}"
            raise ValueError(f"scan: {shapes}: must be [..., n], [..., n, d] and [..., d] with d = 2 or 3")
        for name, shape in (("valid", valid), ("std", std)):
            if shape[-1:] != sums[-1:]:
                raise ValueError(
                    f"scan.{name} {shape}: must be [..., {sums[-1]}], one for each of the range sums {sums}"
                )
        try:
            np.broadcast_shapes(sums[:-1], valid[:-1], sites[:-2], receiver[:-1], std[:-1])
        except ValueError as error:
            shapes = ", ".join(f"{name} {np.shape(part)}" for name, part in zip(self._fields, self, strict=True))
            raise ValueError(f"scan: {shapes}: the leading axes must broadcast") from error
        mask = np.asarray(self.valid)
        if mask.dtype != bool and not ((mask == 0) | (mask == 1)).all():
            at = tuple(int(i) for i in np.argwhere(~((mask == 0) | (mask == 1)))[0])
            raise ValueError(f"scan.valid{list(at)} is {mask[at]}: must be True or False")
        for name in ("range_sums", "transmitters", "receiver"):
            part = np.asarray(getattr(self, name))
            if not np.isfinite(part).all():
                at = tuple(int(i) for i in np.argwhere(~np.isfinite(part))[0])
                raise ValueError(f"scan.{name}{list(at)} is {part[at]}: must be finite (0 where an echo is missing)")
        check_std("scan.std", self.std)


class RangeSumTrack(NamedTuple):
    """State of a tracker on range sums.

    Attributes:
        mean: [..., 2d] m, m/s.
        cov: [..., 2d, 2d].
        step_s: [...] s, of the last prediction, which a maneuver test may repeat with more noise.
    """

    mean: Any
    cov: Any
    step_s: Any


class RangeSumUpdate(NamedTuple):
    """What an update returns.

    Attributes:
        posterior: the tracker's state after the scan.
        innovation: [..., n] m, range sum minus the predicted one; 0 where not used.
        innovation_var: [..., n] m², its variance under the prediction; σ² where not used.
        log_likelihood: [...] of all used sums under the prediction; 0 where the track coasted.
        statistic: [...] J of the maneuver test, χ² with as many degrees of freedom as sums were used; 0 if none.
        maneuver: [...] bool, whether the test fired.
        used: [..., n] bool.
    """

    posterior: Any
    innovation: Any
    innovation_var: Any
    log_likelihood: Any
    statistic: Any
    maneuver: Any
    used: Any


@runtime_checkable
class RangeSumTracker(Protocol):
    """Follows one target by its range sums (see `trackers.contract.Tracker`)."""

    def initiate(self, scans: RangeSumScan, guess: Gaussian, times_s: Any) -> Any:
        """A track at the last of t scans, from an operator's coarse guess at time 0.

        Args:
            scans: with an axis for time: range_sums [..., t, n], transmitters [..., t, n, d], receiver [..., t, d]; t
                is 1 or more, axes of length 1 broadcast.
            guess: mean [..., 2d] and cov [..., 2d, 2d] at time 0.
            times_s: [t] s, ascending, not before 0.
        """
        ...

    def predict(self, state: Any, step_s: float) -> Any:
        """Propagate all tracks by one step."""
        ...

    def update(self, state: Any, scan: RangeSumScan) -> RangeSumUpdate:
        """Condition all tracks on one scan; without an echo they coast."""
        ...

    def estimate(self, state: Any) -> Gaussian:
        """Mean [..., 1, 2d] and covariance [..., 1, 2d, 2d]."""
        ...
