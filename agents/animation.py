"""A replay as an animation: the pictures of `passive_env.render` of several policies side by side, as GIF or MP4."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import animation
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from agents.replay_record import Flight
from passive_env.palette import INK
from passive_env.render import Viewer

PANEL_IN, TITLE_IN, DPI = 4.8, 0.35, 120
"""Width and height of one policy's picture, height of its name, dots per inch."""
FPS = 8
HOLD = 8
"""Frames for which the last picture stands still."""
WRITERS = {".gif": "pillow", ".mp4": "ffmpeg"}
GET_FFMPEG = "install it (Debian, Ubuntu: apt-get install ffmpeg; macOS: brew install ffmpeg), or use --gif"


def check_animation(path: str | Path) -> None:
    """Refuse what cannot be written, before anything is flown.

    Raises:
        ValueError: another suffix than .gif or .mp4; OSError: MP4 without ffmpeg.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in WRITERS:
        raise ValueError(f"{path}: must end in {' or '.join(WRITERS)}")
    if not animation.writers.is_available(WRITERS[suffix]):
        raise OSError(f"{path}: an MP4 file needs the program ffmpeg, which is not found: {GET_FFMPEG}")


def write_animation(path: str | Path, scenario: Any, flights: Mapping[str, Flight]) -> Path:
    """Write an animation of several policies' flights on the same tape; it appears whole or not at all.

    Raises:
        ValueError, OSError: as `check_animation`; or no policy.
    """
    check_animation(path)
    if not flights:
        raise ValueError("flights: needs at least one policy")
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    neighbour = path.with_name(f".{os.getpid()}.{path.name}")
    figure, images = _figure(list(flights))
    writer = animation.writers[WRITERS[path.suffix.lower()]](fps=FPS)
    try:
        with writer.saving(figure, str(neighbour), DPI):
            for pictures in _frames(scenario, flights):
                for image, picture in zip(images, pictures, strict=True):
                    image.set_data(picture)
                writer.grab_frame()
        os.replace(neighbour, path)
    finally:
        neighbour.unlink(missing_ok=True)
    return path


def _frames(scenario: Any, flights: Mapping[str, Flight]) -> Iterator[list[Any]]:
    """Pictures of all policies, instant by instant; the last ones are repeated."""
    viewers = [Viewer(scenario.make_simulation(), "rgb_array") for _ in flights]
    pictures: list[Any] = []
    for worlds in zip(*(flight.worlds for flight in flights.values()), strict=True):
        pictures = [viewer.draw(world) for viewer, world in zip(viewers, worlds, strict=True)]
        yield pictures
    for _ in range(HOLD):
        yield pictures


def _figure(names: list[str]) -> tuple[Figure, list[Any]]:
    """A figure with one image per policy, named above."""
    height = PANEL_IN + TITLE_IN
    figure = Figure(figsize=(PANEL_IN * len(names), height), dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    images = []
    for i, name in enumerate(names):
        axes = figure.add_axes((i / len(names), 0.0, 1.0 / len(names), PANEL_IN / height))
        axes.set_axis_off()
        axes.set_title(name, fontsize=12, fontweight="bold", color=INK, pad=4)
        images.append(axes.imshow(np.full((2, 2, 3), 255, dtype=np.uint8)))
    return figure, images
