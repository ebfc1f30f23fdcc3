"""What was tried where learned policies are not ahead: printed below the leaderboard's open comparisons."""

from __future__ import annotations

from typing import NamedTuple


class Tried(NamedTuple):
    """Trainings of an environment's policy that were compared, on other episodes than the leaderboard's.

    Attributes:
        measured: what the figures are.
        columns: of figures.
        rows: what was tried, and a figure per column; an empty one was not measured.
        lesson: what they seem to say.
    """

    measured: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    lesson: str


_FOUR = ("average, drawn", "average, recorded", "final, drawn", "final, recorded")

TRIED: dict[str, Tried] = {
    "passive/TwoStation-v0": Tried(
        "Ratios of the time average to that of `greedy`, one run each, 1,000 episodes.",
        ("drawn", "recorded"),
        (
            ("the short preset", "1.030", "1.036"),
            ("a critic that sees the truth, a quarter of the targets recorded, twice the rate", "1.020", "1.026"),
            ("twice the steps and lessons, a wider network, recorded targets, twice the rate", "1.025", "1.025"),
            ("four times as many steps", "1.014", "1.017"),
            ("eight times as many, a critic that sees the truth (packed)", "1.008", "1.009"),
        ),
        "What is left seems to be how closely the search is imitated; on flights the oracle is behind greedy as well.",
    ),
    "passive/Ownship-v0": Tried(
        "Ratio of the final error on flights to that of `lead_lag`, 2,000 episodes.",
        ("recorded",),
        (
            ("packed", "1.056 [0.938, 1.190]"),
            ("twice the steps, a quarter of the targets recorded", "1.038 [0.920, 1.170]"),
        ),
        "Few flights with errors of ten kilometres decide the mean. On drawn courses (docs/ownship.md, 10,000 "
        "episodes) five seeds have 0.861 to 0.882 of the final error of `rule` and 0.792 to 0.798 of the time average "
        "of `rule_average`, the planner 0.886 and 0.817. A critic that sees the belief only, the three heaviest "
        "hypotheses in the observation, the time average as only reward, a recurrent network, SAC and learning without "
        "a teacher did worse.",
    ),
    "passive/OwnshipManeuvering-v0": Tried(
        "Ratios of the final error to that of `rule`.",
        ("drawn", "recorded"),
        (
            ("drawn targets only", "", "1.16"),
            ("half of the targets recorded (packed)", "1.07", "1.06"),
            ("the same, twice the steps and twice the final error's weight", "1.03", "1.07"),
        ),
        "The planner and a zigzag as teachers were tried as well.",
    ),
    "passive/OwnshipMulti-v0": Tried(
        "Ratio of the final error on flights to that of `rule`.",
        ("recorded",),
        (("drawn targets only", "1.10"), ("half of the targets recorded, twice the steps (packed)", "1.08")),
        "On flights every tenth episode of the tracker without a turn model collapses under every policy, and decides "
        "the mean.",
    ),
    "passive/AngleFusion-v0": Tried(
        "Ratios to `greedy`, one run each, 4,000 episodes; all but the packed one with a network of 128 × 128.",
        _FOUR,
        (
            ("packed", "1.005", "1.007", "0.995", "0.996"),
            ("the planner imitated first", "1.016", "1.018", "0.985", "0.987"),
            ("greedy imitated first, half the final error's weight", "1.011", "1.014", "0.996", "0.996"),
            ("no teacher, half the final error's weight, twice the mean error's", "1.007", "1.010", "1.004", "1.003"),
        ),
        "What is gained at one is paid at the other: the planner itself is no better than greedy on the time average.",
    ),
    "passive/AngleFusionClutter-v0": Tried(
        "Ratios of the time average to that of `rule`, the same 2,000 episodes.",
        ("drawn", "recorded"),
        (
            ("packed", "0.991", "0.997"),
            ("twice the steps, rewards from errors only: bounds mislead where tracks are lost", "0.995", "1.007"),
        ),
        "A few lost tracks decide.",
    ),
    "passive/AngleFusionSlow-v0": Tried(
        "Ratios to `rule`, drawn courses, 2,000 episodes.",
        ("average", "final"),
        (
            ("the preset before, seed 0", "", "0.964"),
            ("training seed 0 (packed)", "0.933", "0.919"),
            ("training seed 1", "0.978", "1.005"),
            ("training seed 2", "0.973", "0.974"),
            ("training seed 3", "0.985", "0.990"),
        ),
        "Not every training finds which way to turn first. The packed one is ahead of rule and greedy on the means. "
        "Trained with a quarter of the targets recorded, on 2,000 others: 0.944 and 0.931, of recorded targets 0.959 "
        "and 0.955, where the packed one has 0.929 and 0.911, of recorded ones 0.947 and 0.940.",
    ),
    "passive/ManeuveringTarget-v0": Tried(
        "Ratios to `rule` while maneuvering; the first three before headings were counted from the sides to which "
        "stations get sooner.",
        ("drawn",),
        (
            ("eight instead of two as the weight of the error in turns", "1.06"),
            ("the rule imitated first", "1.03"),
            ("a closer imitation, a third of exploration and rate, a fifth of the targets recorded", "1.06"),
            ("headings that cross (packed)", "0.995"),
            ("the same, twice the errors' weight beside the bound's", "0.996"),
        ),
        "With the last one the time average on flights is 1.005 of the rule's, else 1.006. The oracle is 2 % ahead. "
        "Nothing was tried for the time average alone, where `greedy` is ahead by 1 to 2 %.",
    ),
    "passive/RadarPlacement-v0": Tried(
        "Ratios to `rule_best`, drawn courses, 4,000 episodes.",
        ("average", "final"),
        (
            ("the rule's layouts imitated on 32,768 tasks", "1.02", "1.02"),
            ("on eight times as many (packed)", "1.002", "0.996"),
        ),
        "The search by theory is 0.3 % ahead of the rule: there is little more to have.",
    ),
    "passive/MobilePlacement-v0": Tried(
        "Ratios to `greedy`, one run each, 1,000 episodes; the first six learned by rewards after imitating greedy "
        "(`--algo ppo`), the others down the gradient of the bound.",
        _FOUR,
        (
            ("drawn targets only", "0.99", "1.11", "0.96", "1.33"),
            ("a quarter of the targets recorded", "1.01", "1.09", "", ""),
            ("half", "1.05", "1.00", "", ""),
            ("half, a lower rate, the final error's logarithm", "1.04", "1.05", "1.15", "1.31"),
            ("errors instead of logarithms", "1.10", "1.02", "1.33", "1.33"),
            ("four times the lessons, twice the steps", "1.16", "1.04", "1.45", "1.36"),
            ("gradient, velocities still led round what is too near", "1.00", "1.05", "0.85", "1.27"),
            ("gradient, 6 million steps, weight 18 of the end", "1.01", "1.01", "0.67", "0.98"),
            ("the same thrice through every rollout at half the rate", "0.99", "0.98", "0.70", "0.98"),
            ("12 million steps, weight 12 (packed)", "0.95", "0.89", "0.74", "0.92"),
        ),
        "A network shared between sensors learned no faster by rewards; weight 8 of the end is no better at the time "
        "average. What the end gains the way there loses: with weight 18 the final error is a tenth smaller, which is "
        "level with `greedy_after_optimizer`, and the time average 6 % larger.",
    ),
    "passive/PassiveRadar-v0": Tried(
        "Ratios to `timed`, one run each, 1,000 episodes.",
        _FOUR,
        (
            ("packed", "1.002", "1.005", "1.002", "1.038"),
            ("scores a quarter as sharp, a quarter of the targets recorded", "1.000", "1.006", "1.006", "1.010"),
        ),
        "Level all of them. `timed` itself looks one scan ahead; looking 2, 3, 5 or 10 ahead is worse (1.006, 1.010, "
        "1.016, 1.041 on drawn courses). The oracle knows who will be blocked; what is drawn at random cannot be "
        "learned.",
    ),
    "passive/PassiveRadarRetune-v0": Tried(
        "Ratios to `timed10`, one run each, 1,000 episodes.",
        _FOUR,
        (
            ("packed", "0.986", "0.985", "0.976", "1.056"),
            ("half of the targets recorded", "0.993", "0.992", "1.010", "1.009"),
        ),
        "Seeds hardly differ: five trainings of the preset end between 0.56 and 0.61 of the final error of `repeat`.",
    ),
    "passive/MobileReceiver-v0": Tried(
        "Ratios to `timed_pursuit`, one run each; first on 4,000 (recorded) and 1,000 episodes (drawn), then on 2,000 "
        "others of both.",
        _FOUR,
        (
            ("packed, first", "", "1.044", "", "1.262"),
            ("half of the targets recorded, first", "0.993", "0.992 [0.935, 1.043]", "0.984", "0.895"),
            ("packed, then", "1.000", "0.987 [0.969, 1.007]", "0.896", "1.036"),
            (
                "half of the targets recorded, then", "1.040 [0.996, 1.122]", "1.008 [0.985, 1.035]",
                "1.378 [0.749, 2.608]", "0.980",
            ),
        ),
        "Medians agree within 2 %: a few lost tracks decide the means, and the packed policy stays.",
    ),
}  # fmt: skip
"""By environment id."""
