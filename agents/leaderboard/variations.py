"""Circumstances that learned policies were not trained in: fields of scenarios to change, one by one."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Variation:
    """An environment with other circumstances than those it is registered with.

    Attributes:
        name: of the environment.
        title: in tables.
        fields: what is changed.
        flights: whether targets fly held-out recorded traffic.
    """

    name: str
    title: str
    fields: dict[str, Any] = field(default_factory=dict)
    flights: bool = False


def _bearings(name: str) -> list[Variation]:
    """Other bearing noise than the 0.5° of training."""
    return [Variation(name, f"bearings of {std:g}°", {"bearing_std_deg": std}) for std in (0.25, 1.0, 2.0)]


def _angles(name: str) -> list[Variation]:
    """Other noise of azimuth and elevation than the 0.5° of training."""
    return [
        Variation(name, f"angles of {std:g}°", {"azimuth_std_deg": std, "elevation_std_deg": std})
        for std in (0.25, 1.0, 2.0)
    ]


def _range_sums(name: str) -> list[Variation]:
    """Other noise of range sums than the 200 m of training."""
    return [Variation(name, f"range sums of {std:g} m", {"range_sum_std_m": std}) for std in (100.0, 400.0)]


def _horizons(name: str, *steps: int) -> list[Variation]:
    return [Variation(name, f"{count} steps", {"steps": count}) for count in steps]


def _flights(name: str, **fields: Any) -> Variation:
    changed = "".join(f", {key} {value}" for key, value in fields.items())
    return Variation(name, f"held-out recorded flights{changed}", fields, flights=True)


VARIATIONS: tuple[Variation, ...] = (
    *_bearings("TwoStation"),
    *_horizons("TwoStation", 30, 70),
    Variation("TwoStation", "one echo in ten missed", {"detection_probability": 0.9}),
    Variation("TwoStation", "one false bearing per scan", {"false_bearings_mean": 1.0}),
    Variation("TwoStation", "farther targets", {"range_min_m": 80e3, "range_max_m": 120e3}),
    _flights("TwoStation"),
    *_bearings("Ownship"),
    *_horizons("Ownship", 40, 90),
    Variation("Ownship", "targets that turn", {"maneuvering": True}),
    Variation("Ownship", "targets that turn, adaptive tracker", {"maneuvering": True, "tracker": "rp_ekf_adaptive"}),
    _flights("Ownship"),
    _flights("Ownship", tracker="rp_ekf_adaptive"),
    *_bearings("OwnshipManeuvering"),
    *_horizons("OwnshipManeuvering", 40, 90),
    Variation("OwnshipManeuvering", "targets that fly straight", {"maneuvering": False}),
    _flights("OwnshipManeuvering"),
    *_bearings("OwnshipMulti"),
    *_horizons("OwnshipMulti", 40, 90),
    Variation("OwnshipMulti", "targets that turn", {"maneuvering": True}),
    _flights("OwnshipMulti"),
    *_angles("AngleFusion"),
    *_horizons("AngleFusion", 25, 60),
    Variation("AngleFusion", "clutter", {"clutter_mean": 4.0}),
    _flights("AngleFusion"),
    *_angles("AngleFusionClutter"),
    *_horizons("AngleFusionClutter", 25, 60),
    Variation("AngleFusionClutter", "half the clutter", {"clutter_mean": 4.0}),
    Variation("AngleFusionClutter", "no sensor drops out", {"availability0_min": 1.0, "availability1_min": 1.0}),
    _flights("AngleFusionClutter"),
    *_angles("AngleFusionSlow"),
    *_horizons("AngleFusionSlow", 25, 60),
    _flights("AngleFusionSlow"),
    *(
        Variation("ManeuveringTarget", f"azimuths of {std:g} mrad", {"azimuth_std_mrad": std})
        for std in (0.5, 2.0, 4.0)
    ),
    *_horizons("ManeuveringTarget", 40, 100),
    Variation(
        "ManeuveringTarget", "turns of 30–50 m/s²",
        {"target_acceleration_min_m_s2": 30.0, "target_acceleration_max_m_s2": 50.0},
    ),
    Variation("ManeuveringTarget", "ground stations", {"carrier": "ground"}),
    _flights("ManeuveringTarget"),
    Variation("RadarPlacement", "angles of up to 4°", {"azimuth_std_max_deg": 4.0, "elevation_std_max_deg": 4.0}),
    *(Variation("RadarPlacement", f"{scans} scans", {"scans": scans}) for scans in (25, 100)),
    _flights("RadarPlacement"),
    *_horizons("MobilePlacement", 40, 90),
    Variation("MobilePlacement", "angles of up to 4°", {"azimuth_std_max_deg": 4.0, "elevation_std_max_deg": 4.0}),
    _flights("MobilePlacement"),
    *_range_sums("PassiveRadar"),
    *_horizons("PassiveRadar", 150, 450),
    Variation("PassiveRadar", "six echoes in ten", {"echo_probability": 0.6}),
    Variation("PassiveRadar", "targets that turn", {"maneuvers": True}),
    _flights("PassiveRadar"),
    *_range_sums("PassiveRadarRetune"),
    *_horizons("PassiveRadarRetune", 150, 450),
    Variation("PassiveRadarRetune", "retuning takes 2 s", {"retune_delay_s": 2.0}),
    Variation("PassiveRadarRetune", "targets that turn", {"maneuvers": True}),
    _flights("PassiveRadarRetune"),
    *_range_sums("MobileReceiver"),
    *_horizons("MobileReceiver", 150, 450),
    Variation("MobileReceiver", "targets that turn", {"maneuvers": True}),
    _flights("MobileReceiver"),
)  # fmt: skip
"""All of them. The numbers of targets, stations and transmitters are not among them: they decide what policies see."""
