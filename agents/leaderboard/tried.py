"""What was tried where learned policies are not ahead: printed below the leaderboard's open comparisons."""

from __future__ import annotations

TRIED: dict[str, str] = {
    "passive/OwnshipManeuvering-v0": (
        "the planner and a zigzag as teachers; drawn courses only (final error on recorded flights 1.16 of the "
        "rule's), half of the targets on recorded courses (1.06), the same with twice the steps and twice the "
        "final error's weight (1.07; drawn 1.03 instead of 1.07)."
    ),
    "passive/OwnshipMulti-v0": (
        "half of the targets on recorded courses and twice the steps: final error on flights 1.08 of the rule's "
        "instead of 1.10. There every tenth episode of the tracker without a turn model collapses under every policy, "
        "and decides the mean."
    ),
    "passive/ManeuveringTarget-v0": (
        "ratios to the rule while maneuvering, of runs of their own on other seeds: eight instead of two as the weight "
        "of the error in turns 1.06; the rule imitated before reinforcement 1.03, with 1.02 of the time average; a "
        "closer imitation with a third of the exploration and of the learning rate, a fifth of the targets recorded, "
        "1.06. Searching greedily gains nothing there, and the oracle 2 %."
    ),
}
"""By environment id."""
