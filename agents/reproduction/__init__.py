"""Published results repeated: one package per paper, each with the same form (`report`): tables, claims, verdicts."""

from __future__ import annotations

from agents.reproduction.angle_fusion import ANGLE_FUSION, print_angle_fusion, reproduce_angle_fusion
from agents.reproduction.imm_mie import IMM_MIE, print_imm_mie, reproduce_imm_mie
from agents.reproduction.passive_radar import PASSIVE_RADAR, print_passive_radar, reproduce_passive_radar
from agents.reproduction.radar_placement import RADAR_PLACEMENT, print_radar_placement, reproduce_radar_placement
from agents.reproduction.two_station import TWO_STATION, print_report, reproduce_two_station

__all__ = [
    "PAPERS",
    "print_angle_fusion",
    "print_imm_mie",
    "print_passive_radar",
    "print_radar_placement",
    "print_report",
    "reproduce_angle_fusion",
    "reproduce_imm_mie",
    "reproduce_passive_radar",
    "reproduce_radar_placement",
    "reproduce_two_station",
]

PAPERS = {paper.name: paper for paper in (TWO_STATION, ANGLE_FUSION, IMM_MIE, RADAR_PLACEMENT, PASSIVE_RADAR)}
"""All papers by name."""
