"""What was tried where learned policies are not ahead: printed below the leaderboard's open comparisons."""

from __future__ import annotations

TRIED: dict[str, str] = {
    "passive/TwoStation-v0": (
        "ratios of the time average to greedy's on drawn courses and on flights, one run each, 1,000 episodes of other "
        "seeds: the short preset 1.030 and 1.036; with a critic that sees the truth and a quarter of the targets on "
        "recorded courses 1.020 and 1.026; with twice the steps, a wider network, recorded courses and twice the "
        "planner's flights to imitate 1.025 and 1.025 (these two at twice the learning rate), with four times as many "
        "1.014 and 1.017, with eight times as many and a critic that sees the truth 1.008 and 1.009 (packed). What is "
        "left seems to be how closely the search is imitated; on flights the oracle is behind greedy as well."
    ),
    "passive/Ownship-v0": (
        "twice the steps, a quarter of the targets on recorded courses: final error on flights 1.038 [0.920, 1.170] of "
        "`lead_lag`'s instead of 1.056 [0.938, 1.190], all else as packed; 2,000 episodes of other seeds. Few flights "
        "with errors of ten kilometres decide the mean."
    ),
    "passive/OwnshipManeuvering-v0": (
        "the planner and a zigzag as teachers; drawn courses only (final error on recorded flights 1.16 of the "
        "rule's), half of the targets on recorded courses (1.06), the same with twice the steps and twice the "
        "final error's weight (1.07; drawn 1.03 instead of 1.07)."
    ),
    "passive/OwnshipMulti-v0": (
        "half of the targets on recorded courses and twice the steps: final error on flights 1.08 of the rule's "
        "instead of 1.10. There every tenth episode of the tracker without a turn model collapses under every "
        "policy, and decides the mean."
    ),
    "passive/AngleFusion-v0": (
        "ratios to greedy, time average on drawn courses and on flights, then the same at the end, one run each, 4,000 "
        "episodes of other seeds: packed 1.005 and 1.007, 0.995 and 0.996; the planner imitated first 1.016 and 1.018, "
        "0.985 and 0.987; greedy imitated first, half the final error's weight, 1.011 and 1.014, 0.996 and 0.996; no "
        "teacher, half the final error's weight and twice the mean error's, 1.007 and 1.010, 1.004 and 1.003. These "
        "three with a network of 128 x 128. What is gained at one is paid at the other; the planner is 0.3 % behind "
        "greedy's time average itself."
    ),
    "passive/AngleFusionClutter-v0": (
        "twice the steps and rewards from errors only, for the bound misleads where tracks are lost: time average "
        "0.995 of the rule's on drawn courses and 1.007 on flights, against 0.991 and 0.997 with the preset, on "
        "the same 2,000 episodes of other seeds, where the policy of the preset is level with rule and greedy. A "
        "few lost tracks decide."
    ),
    "passive/ManeuveringTarget-v0": (
        "ratios to the rule while maneuvering, of runs of their own on other seeds, before headings were counted "
        "from the sides to which stations get sooner: eight instead of two as the weight of the error in turns "
        "1.06; the rule imitated before reinforcement 1.03, with 1.02 of the time average; a closer imitation with "
        "a third of the exploration and of the learning rate, a fifth of the targets recorded, 1.06. With headings "
        "that cross 0.995; twice the errors' weight beside the bound's leaves that at 0.996 and the time average "
        "on flights at 1.005 instead of 1.006. The oracle is 2 % ahead."
    ),
    "passive/RadarPlacement-v0": (
        "the rule's layouts imitated on 32,768 tasks: 1.02 of its errors; on eight times as many (packed) 0.996 at the "
        "end and 1.000 on the time average, on 4,000 episodes of other seeds. The search by theory is 0.3 % ahead of "
        "the rule: there is little more to have."
    ),
    "passive/MobilePlacement-v0": (
        "ratios of the time average to greedy's on flights and on drawn courses, then the same at the end, one run "
        "each, 1,000 episodes of other seeds. By rewards (`--algo ppo` after imitating greedy): drawn courses only "
        "1.11 and 0.99, 1.33 and 0.96; a quarter recorded 1.09 and 1.01, half 1.00 and 1.05; half, a lower rate and "
        "the end's logarithm 1.05 and 1.04, 1.31 and 1.15; errors instead of logarithms 1.02 and 1.10, 1.33 and 1.33; "
        "four times the lessons and twice the steps 1.04 and 1.16, 1.36 and 1.45; a network shared between sensors "
        "learned no faster. Down the gradient of the bound: before velocities led across what is too near 1.05 and "
        "1.00, 1.27 and 0.85; since then with 6 million steps 1.01 and 1.01, 0.98 and 0.67 (weight 18 of the end; 8 "
        "is no better at the time average), thrice through every rollout at half the rate 0.98 and 0.99, 0.98 and "
        "0.70; with 12 million and weight 12 (packed) 0.89 and 0.95, 0.92 and 0.74."
    ),
    "passive/PassiveRadar-v0": (
        "ratios to `timed`, time average on drawn courses and on flights, then the same at the end, 1,000 episodes of "
        "other seeds: packed 1.002 and 1.005, 1.002 and 1.038; scores a quarter as sharp and a quarter of the targets "
        "on recorded courses, one run, 1.000 and 1.006, 1.006 and 1.010: level all of them. `timed` itself looks one "
        "scan ahead; looking 2, 3, 5 or 10 ahead is worse (1.006, 1.010, 1.016, 1.041 on drawn courses). The oracle "
        "knows who will be blocked; what is drawn at random cannot be learned."
    ),
    "passive/MobileReceiver-v0": (
        "half of the targets on recorded courses, one run, ratios to `timed_pursuit`, time average and end: on flights "
        "0.992 [0.935, 1.043] and 0.895 instead of 1.044 and 1.262 on 4,000 episodes of other seeds, but 1.008 "
        "[0.985, 1.035] and 0.980 instead of 0.987 [0.969, 1.007] and 1.036 on 2,000 more; on drawn courses 0.993 and "
        "0.984 (1,000), then 1.040 [0.996, 1.122] and 1.378 [0.749, 2.608] instead of 1.000 and 0.896 (2,000). Medians "
        "agree within 2 %: a few lost tracks decide the means, and the packed policy stays."
    ),
}
"""By environment id."""
