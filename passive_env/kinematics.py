"""How platforms and targets move: exact arcs at constant turn rate and constant acceleration.

Frame: east x, north y, up z [m]; states [x, y, vx, vy], in space [x, y, z, vx, vy, vz]; turn rates counter-clockwise
positive [rad/s].
"""

from __future__ import annotations

import math

import numpy as np

from trackers.angles import wrap_scalar
from trackers.compiled import helper, kernel


@helper
def arc(speed, acceleration, turn_rate, h):
    """Displacement (forward, left) [m] in the starting heading's frame after h seconds.

        ∫₀ʰ (v + a t) e^{iωt} dt = (v + a h) e^{iωh}/(iω) − v/(iω) + a (e^{iωh} − 1)/ω²

    A series is used where |ωh| is too small for the closed form's differences.
    """
    turned = turn_rate * h
    straight = abs(turned) < 1e-4
    w = 1.0 if straight else turn_rate  # compiled code may compute both branches: no 0/0, not even one thrown away
    if straight:
        forward = speed * h + 0.5 * acceleration * h * h
        return forward, turn_rate * h * h * (0.5 * speed + acceleration * h / 3.0)
    c, s = math.cos(turned), math.sin(turned)
    end = speed + acceleration * h
    return (
        end * s / w + acceleration * (c - 1.0) / (w * w),
        (speed - end * c) / w + acceleration * s / (w * w),
    )


@helper
def advance_in_place(state, acceleration, turn_rate, h):
    """Move a state [x, y, vx, vy] along an arc of h seconds."""
    speed = math.hypot(state[2], state[3])
    per_speed = 1.0 / max(speed, 1e-300)
    c, s = (state[2] * per_speed, state[3] * per_speed) if speed > 0.0 else (1.0, 0.0)
    forward, left = arc(speed, acceleration, turn_rate, h)
    state[0] += c * forward - s * left
    state[1] += s * forward + c * left
    turned, end = turn_rate * h, speed + acceleration * h
    along, across = end * math.cos(turned), end * math.sin(turned)
    state[2], state[3] = c * along - s * across, s * along + c * across


@kernel("(s,x),(s),()->(s,x)", "FFfF")
def _turn(states, turn_rate, step_s, out):
    out[:] = states
    for i in range(states.shape[0]):
        advance_in_place(out[i], 0.0, turn_rate[i], step_s)


def turn(states, turn_rate, step_s):
    """Fly each platform for one step at constant speed and turn rate.

    Args:
        states: [..., s, 4] m, m/s; turn_rate: [..., s] rad/s; step_s: s.
    Returns:
        [..., s, 4].
    """
    return _turn(states, turn_rate, step_s)


STANDING_M_S = 1e-6
"""A platform that stands has its heading as the direction of a velocity this small, 0.1 mm in a hundred seconds."""


@kernel("(s,x),(s),(s),()->(s,x)", "FFFfF")
def _drive(states, turn_rate, speed, step_s, out):
    for i in range(states.shape[0]):
        vx, vy = states[i, 2], states[i, 3]
        gain = max(speed[i], STANDING_M_S) / max(math.hypot(vx, vy), 1e-300)
        out[i, 0], out[i, 1], out[i, 2], out[i, 3] = states[i, 0], states[i, 1], gain * vx, gain * vy
        advance_in_place(out[i], 0.0, turn_rate[i], step_s)


def drive(states, turn_rate, speed, step_s):
    """Move each platform for one step at a speed and turn rate of its own; one that stands turns on the spot.

    Args:
        states: [..., s, 4] m, m/s, of at least `STANDING_M_S`; turn_rate: [..., s] rad/s; speed: [..., s] m/s, from the
            step's beginning on; step_s: s.
    Returns:
        [..., s, 4].
    """
    return _drive(states, turn_rate, speed, step_s)


@helper
def turned_by(turned, T):
    """Cosine and sine of a turn by `turned` rad in T seconds, and the arc's reach along and across the start course
    [s], to be multiplied by the speed (as `arc`)."""
    c, s = math.cos(turned), math.sin(turned)
    if abs(turned) > 1e-9:
        return c, s, T * s / turned, T * (1.0 - c) / turned
    return c, s, T, 0.0


@helper
def turned_at_most(turned, T, limit, straight, hardest):
    """`turned_by` of a turn of at most `limit` rad either way, given those of none, `straight`, and of the limit.

    Nearly all steps of a plan are straight or turn at the limit: those arcs are computed once.
    """
    if abs(turned) <= 1e-9:
        return straight
    if abs(turned) < limit:
        return turned_by(turned, T)
    c, s, along, across = hardest
    return (c, s, along, across) if turned > 0.0 else (c, -s, along, -across)


@helper
def fly_legs(level, controls, ends, steps, T, limit, turns, flight):
    """Places flight [k, 2] of a platform `level` [x, y, vx, vy] after each of k steps of T seconds.

    Leg g of the plan lasts until step ends[g], the last one to the end. Its control is a heading [rad] to turn to by
    at most `limit` rad a step, or, with `turns`, a share of the limit to turn by.
    """
    x, y, vx, vy = level[0], level[1], level[2], level[3]
    heading, leg = math.atan2(vy, vx), 0
    straight, hardest = turned_by(0.0, T), turned_by(limit, T)
    for k in range(steps):
        while leg < ends.shape[0] - 1 and k >= ends[leg]:
            leg += 1
        turned = controls[leg] * limit if turns else wrap_scalar(controls[leg] - heading)
        turned = min(max(turned, -limit), limit)
        heading += turned
        c, s, along, across = turned_at_most(turned, T, limit, straight, hardest)
        x, y = x + along * vx - across * vy, y + along * vy + across * vx
        vx, vy = c * vx - s * vy, s * vx + c * vy
        flight[k, 0], flight[k, 1] = x, y


@kernel("(s,x6),(s),(s),(),(h)->(s,x6)", "FFFfFF")
def _turn_and_climb(states, turn_rate, climb, step_s, limits, out):
    level = np.empty(4)
    for i in range(states.shape[0]):
        level[0], level[1], level[2], level[3] = states[i, 0], states[i, 1], states[i, 3], states[i, 4]
        advance_in_place(level, 0.0, turn_rate[i], step_s)
        out[i, 0], out[i, 1], out[i, 3], out[i, 4] = level[0], level[1], level[2], level[3]
        out[i, 2] = min(max(states[i, 2] + climb[i] * step_s, limits[0]), limits[1])
        out[i, 5] = (out[i, 2] - states[i, 2]) / step_s


def turn_and_climb(states, turn_rate, climb, step_s, altitudes):
    """Fly each platform for one step at constant level speed, turn rate and climb.

    Args:
        states: [..., s, 6] m, m/s; turn_rate: [..., s] rad/s; climb: [..., s] m/s; step_s: s.
        altitudes: [2] m, lowest and highest; a platform that would leave them stops there.
    Returns:
        [..., s, 6]; the vertical velocity is that of the step flown.
    """
    return _turn_and_climb(states, turn_rate, climb, step_s, altitudes)


def plan_view(states):
    """x, y, vx, vy [..., 4] of states in the plane [..., 4], as they are, or in space [..., 6]."""
    return states if states.shape[-1] == 4 else states[..., [0, 1, 3, 4]]


def in_dimensions(states, d: int):
    """States [..., 2d] of states in space [..., 6]: in the plane (d = 2) their plan view, in space as they are."""
    return plan_view(states) if d == 2 else states


@helper
def _fly(state, t, end, turn_rate, turn_window, acceleration, acceleration_window):
    """Move a state from time t to end, exact over pieces between the instants at which a window opens or closes."""
    while t < end:
        until = end
        for edge in (turn_window[0], turn_window[1], acceleration_window[0], acceleration_window[1]):
            if t < edge < until:
                until = edge
        middle = 0.5 * (t + until)
        rate = turn_rate if turn_window[0] <= middle < turn_window[1] else 0.0
        a = acceleration if acceleration_window[0] <= middle < acceleration_window[1] else 0.0
        advance_in_place(state, a, rate, until - t)
        t = until


@kernel("(x),(),(w),(),(w),(),(k)->(k,x)")
def _maneuver(start, turn_rate, turn_window, acceleration, acceleration_window, step_s, like, path):
    state = start.copy()
    path[0] = start
    for k in range(1, like.shape[0]):
        _fly(state, (k - 1) * step_s, k * step_s, turn_rate, turn_window, acceleration, acceleration_window)
        path[k] = state


def maneuver(start, turn_rate, turn_window, acceleration, acceleration_window, step_s, steps_axis):
    """Path of a target that turns during one window of time and accelerates along its course during another.

    Args:
        start: [..., 4] m, m/s.
        turn_rate: [...] rad/s; turn_window: [..., 2] s, from and to.
        acceleration: [...] m/s²; acceleration_window: [..., 2] s.
        step_s: s; steps_axis: [k + 1] any array of the path's length.
    Returns:
        [..., k + 1, 4] exact states at multiples of the step.
    """
    return _maneuver(start, turn_rate, turn_window, acceleration, acceleration_window, step_s, steps_axis)


MANEUVER_UNIFORMS = 5
"""Uniform numbers of a leg of `random_maneuvers`: quiet time, kind, acceleration, duration or new speed, sense."""


@helper
def _stage(u, quiet, speed, limits):
    """Duration [s], acceleration along the course [m/s²] and turn rate [rad/s] of a leg's quiet part or maneuver."""
    if quiet:
        return limits[0] + (limits[1] - limits[0]) * u[0], 0.0, 0.0
    size = limits[4] + (limits[5] - limits[4]) * u[2]
    if u[1] < limits[9]:
        rate = min(size / max(speed, 1e-3), limits[6])
        return limits[2] + (limits[3] - limits[2]) * u[3], 0.0, rate if u[4] < 0.5 else -rate
    gain = limits[7] + (limits[8] - limits[7]) * u[3] - speed
    return min(abs(gain) / size, limits[3]), size if gain > 0.0 else -size, 0.0


@kernel("(x),(n,q),(l),(),(k),(p)->(k,x),(k,p)")
def _random_maneuvers(start, u, limits, step_s, like, like_p, path, acceleration):
    state = start.copy()
    stage, t, until, a, w = 0, 0.0, 0.0, 0.0, 0.0
    for k in range(like.shape[0]):
        while until <= k * step_s:
            advance_in_place(state, a, w, until - t)
            t = until
            leg = min(stage // 2, u.shape[0] - 1)
            duration, a, w = _stage(u[leg], stage % 2 == 0, math.hypot(state[2], state[3]), limits)
            until += duration
            stage += 1
        advance_in_place(state, a, w, k * step_s - t)
        t = k * step_s
        path[k] = state
        along = a / max(math.hypot(state[2], state[3]), 1e-300)
        acceleration[k, 0] = along * state[2] - w * state[3]
        acceleration[k, 1] = along * state[3] + w * state[2]


def random_maneuvers(start, uniforms, limits, step_s, steps_axis):
    """Path of a target that flies straight, turns or changes its speed, flies straight, …, and its acceleration.

    A turn has a lateral acceleration and a duration, or a slower rate where the acceleration would turn it faster
    than the largest one; a change of speed an acceleration and a new speed, until it has this or the longest
    maneuver is over.

    Args:
        start: [..., 4] m, m/s.
        uniforms: [..., n, 5] (`MANEUVER_UNIFORMS`), one row per leg; the last one repeats.
        limits: [10] shortest and longest quiet time [s], shortest and longest maneuver [s], smallest and largest
            acceleration [m/s²], largest turn rate [rad/s], smallest and largest speed [m/s], share of turns.
        step_s: s; steps_axis: [k + 1] any array of the path's length.
    Returns:
        [..., k + 1, 4] exact states at multiples of the step; [..., k + 1, 2] m/s², the accelerations there (of what
        begins, where one ends and another begins).
    """
    return _random_maneuvers(start, uniforms, limits, step_s, steps_axis, np.empty(2))


@kernel("(x),(t),(t,w),(),(k)->(k,x)")
def _weave(start, turn_rates, turn_windows, step_s, like, path):
    state = start.copy()
    path[0] = start
    i, last, never = 0, turn_rates.shape[0] - 1, (0.0, 0.0)
    for k in range(1, like.shape[0]):
        t, end = (k - 1) * step_s, k * step_s
        while i < last and turn_windows[i, 1] <= end:
            _fly(state, t, turn_windows[i, 1], turn_rates[i], turn_windows[i], 0.0, never)
            t = turn_windows[i, 1]
            i += 1
        _fly(state, t, end, turn_rates[i], turn_windows[i], 0.0, never)
        path[k] = state


def weave(start, turn_rates, turn_windows, step_s, steps_axis):
    """Path of a target that turns in several windows of time and flies straight between them, at constant speed.

    Args:
        start: [..., 4] m, m/s.
        turn_rates: [..., t] rad/s, t >= 1.
        turn_windows: [..., t, 2] s, from and to, in order of time and without overlap.
        step_s: s; steps_axis: [k + 1] any array of the path's length.
    Returns:
        [..., k + 1, 4] exact states at multiples of the step.
    """
    return _weave(start, turn_rates, turn_windows, step_s, steps_axis)
