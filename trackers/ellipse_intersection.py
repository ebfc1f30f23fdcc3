"""Where d range sums fix a point: two ellipses in the plane, three ellipsoids in space, in closed form with both roots.

Relative to the receiver, with tᵢ = Tᵢ − R, Lᵢ = |tᵢ| and r = |x|, squaring ρᵢ − r = |x − tᵢ| gives d equations that
are linear in the d + 1 unknowns (x, r),

    tᵢ · x − ρᵢ r = (Lᵢ² − ρᵢ²)/2,

whose solutions form a line (x₀, r₀) + s (n, m). On it |x|² = r² is a quadratic in s: two roots. This needs neither
sites in general position nor, in space, sites that are not level: for level sites the line is vertical and the roots
are mirror images. Only sites from which no line follows are refused: coincident ones, in space also collinear ones.

The two roots differ in the sign of det H, H the rows ∂ρᵢ/∂p: in the plane they lie on opposite sides of the ray from T₁
away from T₂, the segments T₁R and RT₂ and the ray from T₂ away from T₁. A filter that starts on one side mostly stays
there: the ghost rule. `pick_root` chooses by what else is known.
Source: Xu and Wang (2009), eq 1 and section 3.4, where the nearer root to the start is said to win.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from trackers.compiled import helper, kernel
from trackers.range_sum import range_sum, range_sum_jacobian, range_sum_row

SINGULAR = 1e-9
"""Distance of a site, in units of the largest, from the span of the others at which no line follows."""

DECISIVE = 9.0
"""Difference of two roots' χ² misfits, each after the best small move, from which on the fit decides, not the side."""

IMPOSSIBLE = 1e300
"""Misfit of a root that is none."""


class Intersections(NamedTuple):
    """The two points with given range sums.

    Attributes:
        position: [..., 2, d] m; det H is positive at the first, negative at the second; 0 where not valid.
        valid: [..., 2] bool.
    """

    position: Any
    valid: Any


def intersect(range_sums, transmitters, receiver, floor_m: float = -math.inf) -> Intersections:
    """Points with range sums [..., d] m to transmitters [..., d, d] m and a receiver [..., d] m.

    Sums that no point has (shorter than the baseline, ellipses that miss each other) leave roots that are not valid,
    and so are, in space, roots below `floor_m`, the height of the ground.

    Raises:
        ValueError: shapes that do not belong together, entries that are not finite, coincident transmitters or, in
            space, collinear sites, a floor that is no number.
    """
    if not floor_m < math.inf:
        raise ValueError(f"intersect: floor_m = {floor_m!r}: must be a height [m], or -inf for no ground")
    sums, sites, site = (np.asarray(part, dtype=float) for part in (range_sums, transmitters, receiver))
    d = site.shape[-1] if site.ndim else 0
    if d not in (2, 3) or sums.shape[-1:] != (d,) or sites.shape[-2:] != (d, d):
        shapes = f"range_sums {sums.shape}, transmitters {sites.shape}, receiver {site.shape}"
        raise ValueError(f"intersect: {shapes}: must be [..., d], [..., d, d] and [..., d] with d = 2 or 3")
    for name, part in (("range_sums", sums), ("transmitters", sites), ("receiver", site)):
        if not np.isfinite(part).all():
            raise ValueError(f"intersect: {name} must be finite")
    roots, singular = _both_roots(sums, sites, site)
    if np.any(singular):
        at = tuple(int(i) for i in np.argwhere(singular)[0])
        words = "coincide" if d == 2 else "coincide or lie on one line with the receiver"
        raise ValueError(f"intersect: transmitters{list(at) or ''} {words}: their range sums fix no point")
    return above_ground(roots, floor_m)


def solutions(range_sums, transmitters, receiver) -> Intersections:
    """As `intersect`, for what has been checked before: sites that fix no point leave no valid root."""
    return _both_roots(range_sums, transmitters, receiver)[0]


def above_ground(roots: Intersections, floor_m: float) -> Intersections:
    """The roots with those below the ground, in space, marked as not valid and set to 0."""
    if roots.position.shape[-1] == 2:
        return roots
    valid = roots.valid & (roots.position[..., 2] >= floor_m)
    return Intersections(np.where(valid[..., None], roots.position, 0.0), valid)


def _both_roots(sums, sites, site) -> tuple[Intersections, Any]:
    first, second, good, also, singular = _intersect(sums, sites, site)
    return Intersections(np.stack([first, second], axis=-2), np.stack([good, also], axis=-1)), singular


def branch(position, transmitters, receiver):
    """Sign of det H [...], +1 or −1 (0 on the border), which tells a target from its ghost.

    Args:
        position: [..., d] m; transmitters: [..., d, d] m; receiver: [..., d] m.
    """
    return np.sign(np.linalg.det(range_sum_jacobian(position, receiver, transmitters)))


def pick_root(roots: Intersections, scan, side):
    """Which root is the target's: the one that fits further echoes, or on the given side where there are none.

    Args:
        roots: of some of the scan's sums.
        scan: `trackers.range_sum_contract.RangeSumScan` of the whole pool [..., n].
        side: [...] sign of det H, such as that of a point in the antenna's beam (`branch`).
    Returns:
        index [...] of the root, 0 or 1, and whether there is one [...].
    """
    sums, valid, transmitters, receiver, std = map(np.asarray, scan)
    sites, site = transmitters[..., None, :, :], receiver[..., None, :]
    weight = np.where(valid, 1.0 / std, 0.0)[..., None, :]
    miss = weight * (range_sum(roots.position, site, sites) - sums[..., None, :])
    H = weight[..., None] * range_sum_jacobian(roots.position, site, sites)
    misfit = np.where(roots.valid, _left_over(miss, H), IMPOSSIBLE)
    undecided = np.abs(misfit[..., 1] - misfit[..., 0]) < DECISIVE
    return np.where(undecided, np.where(np.asarray(side) >= 0.0, 0, 1), misfit.argmin(-1)), roots.valid.any(-1)


def _left_over(miss, H):
    """Squared length [...] of misses [..., n] that no small move of slopes H [..., n, d] takes away.

    A root is as uncertain as the sums it comes from, more so where they hardly cross: what its move explains is no
    reason against it.
    """
    g = np.einsum("...ni,...n->...i", H, miss)
    N = np.swapaxes(H, -1, -2) @ H
    N = N + (1e-12 * np.trace(N, axis1=-2, axis2=-1) + 1e-300)[..., None, None] * np.eye(H.shape[-1])
    explained = (g * np.linalg.solve(N, g[..., None])[..., 0]).sum(-1)
    return np.maximum(np.square(miss).sum(-1) - explained, 0.0)


@helper
def _orthonormal_rows(A, b, d):
    """Make rows A [d, d + 1] orthonormal, b [d] their right sides, in place.

    Returns the least share of a row's length that the rows before it leave.
    """
    least = 1.0
    for i in range(d):
        before = 0.0
        for c in range(d + 1):
            before += A[i, c] * A[i, c]
        for _ in range(2):  # once more against what rounding left
            for j in range(i):
                share = 0.0
                for c in range(d + 1):
                    share += A[i, c] * A[j, c]
                for c in range(d + 1):
                    A[i, c] -= share * A[j, c]
                b[i] -= share * b[j]
        after = 0.0
        for c in range(d + 1):
            after += A[i, c] * A[i, c]
        length = math.sqrt(max(after, 1e-300))
        least = min(least, length / math.sqrt(max(before, 1e-300)))
        for c in range(d + 1):
            A[i, c] /= length
        b[i] /= length
    return least


@helper
def _normal_into(A, d, n):
    """Unit vector n [d + 1] orthogonal to the orthonormal rows A [d, d + 1], from the axis they span least."""
    axis, most = 0, -1.0
    for c in range(d + 1):
        left = 1.0
        for i in range(d):
            left -= A[i, c] * A[i, c]
        if left > most:
            axis, most = c, left
    for c in range(d + 1):
        n[c] = 1.0 if c == axis else 0.0
    for _ in range(2):
        for i in range(d):
            share = 0.0
            for c in range(d + 1):
                share += n[c] * A[i, c]
            for c in range(d + 1):
                n[c] -= share * A[i, c]
    length = 0.0
    for c in range(d + 1):
        length += n[c] * n[c]
    for c in range(d + 1):
        n[c] /= math.sqrt(length)


@helper
def _roots(a, b, c):
    """Roots of a s² + 2 b s + c = 0 without cancellation, and whether there are any; a may be 0 (one root, twice)."""
    discriminant = b * b - a * c
    if discriminant < 0.0:
        return 0.0, 0.0, False
    q = -(b + math.copysign(math.sqrt(discriminant), b))
    if q == 0.0:
        return 0.0, 0.0, True
    second = c / q
    return (q / a if abs(a) > 1e-14 else second), second, True


@helper
def _determinant(H, d):
    if d == 2:
        return H[0, 0] * H[1, 1] - H[0, 1] * H[1, 0]
    return (
        H[0, 0] * (H[1, 1] * H[2, 2] - H[1, 2] * H[2, 1])
        - H[0, 1] * (H[1, 0] * H[2, 2] - H[1, 2] * H[2, 0])
        + H[0, 2] * (H[1, 0] * H[2, 1] - H[1, 1] * H[2, 0])
    )


@helper
def _try_root(s, base, normal, sums, sites, receiver, scale, H, d, position):
    """Position [d] m at parameter s; returns whether it has the sums, and det H there."""
    r = base[d] + s * normal[d]
    for i in range(d):
        position[i] = receiver[i] + scale * (base[i] + s * normal[i])
    valid = r > 0.0
    for i in range(d):
        valid = valid and sums[i] - scale * r > 0.0
        range_sum_row(position, receiver, sites[i], H[i], d)
    return valid, _determinant(H, d)


@kernel("(d),(d,d),(d)->(d),(d),(),(),()", "FFFFFbbb")
def _intersect(sums, sites, receiver, first, second, first_valid, second_valid, singular):
    d = receiver.shape[0]
    A, b, H = np.empty((d, d + 1)), np.empty(d), np.empty((d, d))
    base, normal = np.zeros(d + 1), np.empty(d + 1)
    scale = 1e-300
    for i in range(d):
        scale = max(scale, abs(sums[i]))
        for j in range(d):
            scale = max(scale, abs(sites[i, j] - receiver[j]))
    for i in range(d):
        # the baseline squared minus the sum squared, as a product that keeps its digits
        squared = 0.0
        for j in range(d):
            A[i, j] = (sites[i, j] - receiver[j]) / scale
            squared += A[i, j] * A[i, j]
        A[i, d] = -sums[i] / scale
        baseline = math.sqrt(squared)
        b[i] = 0.5 * (baseline + A[i, d]) * (baseline - A[i, d])
    first[:] = 0.0
    second[:] = 0.0
    first_valid[0] = second_valid[0] = False
    singular[0] = _orthonormal_rows(A, b, d) < SINGULAR
    if singular[0]:
        return
    _normal_into(A, d, normal)
    for i in range(d):
        for c in range(d + 1):
            base[c] += b[i] * A[i, c]
    nn, bn, bb = -normal[d] * normal[d], -base[d] * normal[d], -base[d] * base[d]
    for c in range(d):
        nn, bn, bb = nn + normal[c] * normal[c], bn + base[c] * normal[c], bb + base[c] * base[c]
    one, other, real = _roots(nn, bn, bb)
    if not real:
        return
    first_valid[0], turn = _try_root(one, base, normal, sums, sites, receiver, scale, H, d, first)
    second_valid[0], turned = _try_root(other, base, normal, sums, sites, receiver, scale, H, d, second)
    if turn < turned:
        for i in range(d):
            first[i], second[i] = second[i], first[i]
        first_valid[0], second_valid[0] = second_valid[0], first_valid[0]
    for i in range(d):
        first[i] = first[i] if first_valid[0] else 0.0
        second[i] = second[i] if second_valid[0] else 0.0
