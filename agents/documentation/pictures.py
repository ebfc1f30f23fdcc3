"""Pictures of the documentation: why geometry decides, and a moment of every environment.

``python -m agents.documentation --pictures`` writes them; all come from the package's own trackers and drawing.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import imsave
from matplotlib.patches import Ellipse

from agents.documentation.environments import page_name
from agents.files import save_figure
from agents.pretrained import load_pretrained
from passive_env.catalogue import SCENARIOS, environment_id
from passive_env.env import PassiveEnv
from passive_env.palette import BLUE, INK, MUTED, VERMILION
from trackers.angles import wrap
from trackers.bounds import fisher_information
from trackers.linalg import psd_inverse
from trackers.measurement import bearing

STD_DEG = 0.5
"""Bearing noise of the pictures."""
TARGET_M = np.array([0.0, 60e3])
BASELINES_M = (5e3, 15e3, 45e3)

LEG_S, STEP_S, SPEED_M_S = 120.0, 10.0, 250.0
TWIN = 1.7
"""How many times as far off as the target its twin is."""

EPISODE_SEED = 4
SHARE_FLOWN = 0.6
"""Share of an episode after which an environment's picture is taken; of sensors that are placed, the whole."""


def write_pictures(docs: Path) -> list[Path]:
    """Write all of them below a folder docs/; returns the files."""
    files = [
        save_figure(docs / "idea" / "crossing.png", crossing_figure()),
        save_figure(docs / "idea" / "twins.png", twins_figure()),
    ]
    for name in SCENARIOS:
        path = docs / "environments" / page_name(name).replace(".md", ".png")
        imsave(path, moment(name))
        files.append(path)
    return files


def crossing_figure() -> Figure:
    """Two bearing lines that cross at ever larger angles; below, magnified, the 2σ ellipse that one scan leaves."""
    figure = Figure(figsize=(10.5, 8.0), dpi=110, layout="constrained")
    maps, details = figure.subplots(2, len(BASELINES_M), height_ratios=(1.15, 1.0))
    for axes, detail, baseline in zip(maps, details, BASELINES_M, strict=True):
        stations = np.array([[-0.5 * baseline, 0.0], [0.5 * baseline, 0.0]])
        cov = psd_inverse(fisher_information(TARGET_M, stations, math.radians(STD_DEG)))
        for each in (axes, detail):
            _draw_wedges(each, stations)
            each.plot(*TARGET_M / 1e3, "o", color=VERMILION, markersize=4, zorder=3)
        detail.add_patch(_ellipse(TARGET_M, cov))
        axes.plot(*stations.T / 1e3, "s", color=INK, clip_on=False)
        axes.set_title(f"baseline {baseline / 1e3:.0f} km: range ± {math.sqrt(cov[1, 1]) / 1e3:.1f} km", fontsize=11)
        axes.set(xlim=(-45, 45), ylim=(-4, 90), aspect="equal")
        detail.set(xlim=(-4, 4), ylim=(36, 84), xlabel="east [km]")
    for axes in (maps[0], details[0]):
        axes.set_ylabel("north [km]")
    return figure


def twins_figure() -> Figure:
    """A target and its twin, which share all bearings of a straight flight and part at the platform's turn."""
    figure = Figure(figsize=(10.5, 4.8), dpi=110, layout="constrained")
    maps = figure.subplots(1, 3, width_ratios=(1.0, 1.0, 1.1))
    for axes, turned, title in ((maps[0], False, "straight on"), (maps[1], True, "one turn")):
        platform, target, twin = twin_paths(turned)
        for i in range(0, len(platform), 6):
            axes.plot(*np.array([platform[i], twin[i]]).T / 1e3, color=MUTED, linewidth=0.6)
        axes.plot(*platform.T / 1e3, color=INK, linewidth=2.0, label="platform")
        axes.plot(*target.T / 1e3, color=VERMILION, linewidth=2.0, label="target")
        axes.plot(*twin.T / 1e3, color=BLUE, linewidth=2.0, linestyle=(0, (4, 2)), label="twin")
        axes.set(title=title, aspect="equal", xlabel="east [km]", xlim=(-6, 66), ylim=(-34, 74))
    maps[0].set_ylabel("north [km]")
    maps[0].legend(loc="upper right", fontsize=9)
    for turned, style in ((False, "-"), (True, "--")):
        platform, target, twin = twin_paths(turned)
        apart = np.degrees(wrap(bearing(twin, platform) - bearing(target, platform)))
        time = np.arange(len(apart)) * STEP_S
        maps[2].plot(time, np.abs(apart), style, color=INK, label="one turn" if turned else "straight on")
    maps[2].axhline(STD_DEG, color=MUTED, linewidth=0.8)
    maps[2].text(2.0, STD_DEG + 0.05, "noise of one bearing", color=MUTED, fontsize=9)
    maps[2].set(title="bearings of target and twin differ by [°]", xlabel="time [s]")
    maps[2].legend(loc="upper left", fontsize=9, bbox_to_anchor=(0.0, 0.92))
    return figure


def twin_paths(turned: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Platform, target and twin, each [k, 2] m, over two legs; `turned`: the second one at right angles to the first.

    The twin's place and velocity relative to the first leg are those of the target, stretched by `TWIN`.
    """
    time = np.arange(0.0, 2.0 * LEG_S + STEP_S, STEP_S)[:, None]
    first, second = np.array([SPEED_M_S, 0.0]), np.array([0.0, -SPEED_M_S] if turned else [SPEED_M_S, 0.0])
    platform = first * np.minimum(time, LEG_S) + second * np.maximum(time - LEG_S, 0.0)
    start, velocity = np.array([10e3, 40e3]), np.array([60.0, -40.0])
    return platform, start + velocity * time, TWIN * start + (first + TWIN * (velocity - first)) * time


def moment(name: str) -> np.ndarray:
    """Picture [800, 800, 3] of an environment some way into an episode that its pretrained policy flies."""
    env = PassiveEnv(name, render_mode="rgb_array")
    policy = load_pretrained(environment_id(name))
    observation, _ = env.reset(seed=EPISODE_SEED)
    policy.reset(env.belief())
    placed_once = env.scenario.steps < 10
    env.render()
    for _ in range(env.scenario.steps if placed_once else round(SHARE_FLOWN * env.scenario.steps)):
        belief = env.belief()
        command = policy.act(belief, observation[None])
        observation, *_ = env.step(env.simulation.actions.encode(command, belief)[0])
        picture: Any = env.render()
    return picture


def _draw_wedges(axes: Axes, stations: np.ndarray) -> None:
    """Lines of sight from stations [s, 2] m past the target, with one standard deviation to either side."""
    for station in stations:
        angle = bearing(TARGET_M, station)
        for off, width in ((-1.0, 0.5), (0.0, 1.2), (1.0, 0.5)):
            direction = angle + off * math.radians(STD_DEG)
            end = station + 140e3 * np.array([math.cos(direction), math.sin(direction)])
            axes.plot(*np.array([station, end]).T / 1e3, color=BLUE, linewidth=width)


def _ellipse(center: np.ndarray, cov: np.ndarray) -> Ellipse:
    """2σ ellipse of a position [2] m with covariance [2, 2] m², on axes in km."""
    values, vectors = np.linalg.eigh(cov)
    width, height = 4.0 * np.sqrt(values) / 1e3
    angle = math.degrees(math.atan2(vectors[1, 0], vectors[0, 0]))
    return Ellipse(tuple(center / 1e3), width, height, angle=angle, facecolor=VERMILION, alpha=0.35, edgecolor="none")
