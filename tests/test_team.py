"""Platforms as agents: what each commands, sees and earns, alone and in batches."""

import numpy as np
import pytest

from passive_env.catalogue import SCENARIOS, make_scenario
from passive_env.parallel import parallel_env
from passive_env.team import IdleWorlds, Team
from passive_env.team_vector_env import TeamVectorEnv
from passive_env.vector_env import PassiveVectorEnv

STEPS = 4
FAMILIES = {
    "TwoStation": {"steps": STEPS, "detection_probability": 0.7, "false_bearings_mean": 1.5},
    "AngleFusion": {
        "steps": STEPS, "clutter_density_per_deg2": 0.02, "clutter_window_deg": 5.0, "availability1_min": 0.5,
    },
    "ManeuveringTarget": {"steps": STEPS, "stations": 3, "detection_probability": 0.7},
    "MobilePlacement": {"steps": STEPS, "angle_only": 1},
}  # fmt: skip
"""A variant of every family with platforms to steer, such that each alone has something to see and to miss."""
over_families = pytest.mark.parametrize("name", FAMILIES)


def team_of(name, view="common", reward="team", **fields) -> Team:
    return Team(make_scenario(name, {**FAMILIES[name], **fields}).make_simulation(), view, reward)


def begun(team, episodes=5):
    return team.simulation.begin([np.random.default_rng(seed) for seed in range(episodes)])


def drawn(team, episodes, seed) -> np.ndarray:
    """Random commands [e, s, k] of all agents."""
    shape = (episodes, *team.steering.columns.shape)
    return np.random.default_rng(seed).uniform(-1.0, 1.0, shape)


def field(team, seen, name):
    """One number of observations [..., d], by its name."""
    return seen[..., [f.name for f in team.fields].index(name)]


def test_which_environments_have_agents():
    steered = {name for name, scenario in SCENARIOS.items() if scenario.steering is not None}
    families = {"AngleFusion", "AngleFusionClutter", "AngleFusionSlow", "ManeuveringTarget", "MobilePlacement"}
    assert steered == {"TwoStation"} | families


@over_families
@pytest.mark.parametrize("actions", ["continuous", "discrete"])
def test_an_agent_moves_its_platform_and_no_other(name, actions):
    team = team_of(name, actions=actions)
    simulation, world, size = team.simulation, begun(team, 3), len(team.agents)
    if name == "MobilePlacement":  # the first action sets all sensors down
        world, _, _ = simulation.advance(world, np.zeros((3, simulation.actions.size)))
    first, second = (team.action_space.sample() for _ in range(2))
    first[:], second[:] = (0, 2) if actions == "discrete" else (-1.0, 1.0)
    for i in range(size):
        calm = np.tile(first, (3, size, 1))
        moved = calm.copy()
        moved[:, i] = second
        ends = []
        for actions_of_all in (calm, moved):
            values = simulation.actions.decode(team.joined(actions_of_all), 3)
            np.testing.assert_array_equal(team.split(team.joined(actions_of_all)), actions_of_all)
            ends.append(simulation.advance(world, simulation.command(world, values))[0].platforms)
        changed = (ends[0] != ends[1]).any(axis=-1)
        np.testing.assert_array_equal(changed, np.tile(np.arange(size) == i, (3, 1)))


def changed_tape(tape, other):
    """A tape on which everything that happens to one platform alone is another."""
    noise = tape.noise.copy()
    noise[:, :, other] = 0.5 - 2.0 * noise[:, :, other]
    changes = {"noise": noise}
    if np.any(tape.platforms):  # sensors on carriers have no place yet
        changes["platforms"] = platforms = tape.platforms.copy()
        platforms[:, other, :2] += [700.0, -400.0]
    if hasattr(tape, "detected") and not tape.detected.all():
        changes["detected"] = detected = tape.detected.copy()
        detected[:, 2:, other] = ~detected[:, 2:, other]
    return tape._replace(**changes)


@over_families
@pytest.mark.parametrize("i", [0, 1])
def test_own_view_has_nothing_of_the_others(monkeypatch, name, i):
    """What the others do, where they are and what they measure is another; what this one sees is the same."""
    own, common = team_of(name, "own"), team_of(name)
    simulation, size = own.simulation, len(own.agents)
    others = [j for j in range(size) if j != i]
    mine = drawn(own, 5, 1)
    family = type(simulation.scenario)
    draw_tape = family.draw_tape
    views = []
    for twin in (False, True):
        if twin:

            def changed(self, generators):
                tape = draw_tape(self, generators)
                for other in others:
                    tape = changed_tape(tape, other)
                return tape

            monkeypatch.setattr(family, "draw_tape", changed)
        world, seen = begun(own), []
        for k in range(STEPS + 1):
            belief = simulation.belief(world)
            seen.append((own.observe(belief), common.observe(belief)))
            if k < STEPS:
                commands = drawn(own, 5, 2 + k + 100 * twin)
                commands[:, i] = np.roll(mine[:, i], k, axis=0)
                world, _, _ = simulation.advance(world, own.joined(commands))
        views.append([np.stack(part) for part in zip(*seen, strict=True)])
    (alone, shared), (alone_twin, shared_twin) = views
    np.testing.assert_array_equal(alone[:, :, i], alone_twin[:, :, i])
    for j in others:
        assert (alone[1:, :, j] != alone_twin[1:, :, j]).any(axis=(0, -1)).all()
    assert (shared[1:, :, i] != shared_twin[1:, :, i]).any(axis=(0, -1)).all()
    assert np.abs(alone).max() <= 5.0


def test_own_view_of_two_stations_by_hand():
    """Place, turn and bearings off the heading, from the world itself."""
    team = team_of("TwoStation", "own", detection_probability=1.0, false_bearings_mean=0.0)
    simulation, world = team.simulation, begun(team)
    commands = drawn(team, 5, 0)
    for _ in range(3):
        world, _, _ = simulation.advance(world, team.joined(commands))
    seen = team.observe(simulation.belief(world))
    std = np.radians(simulation.scenario.bearing_std_deg)
    for e in range(5):
        for s in range(2):
            x, y, vx, vy = world.platforms[e, s]
            x0, y0, vx0, vy0 = world.tape.platforms[e, s]
            ahead = np.array([vx, vy]) / 250.0
            left = np.array([-ahead[1], ahead[0]])
            way = np.array([x - x0, y - y0]) / 2e4
            assert field(team, seen, "time_left")[e, s] == pytest.approx(1.0 - 3.0 / STEPS)
            assert field(team, seen, "own.ahead")[e, s] == pytest.approx(way @ ahead, abs=1e-6)
            assert field(team, seen, "own.left")[e, s] == pytest.approx(way @ left, abs=1e-6)
            turned = np.arctan2(vy, vx) - np.arctan2(vy0, vx0)
            assert field(team, seen, "own.turned_cos")[e, s] == pytest.approx(np.cos(turned), abs=1e-6)
            assert field(team, seen, "own.turned_sin")[e, s] == pytest.approx(np.sin(turned), abs=1e-6)
            assert field(team, seen, "own.last_action0")[e, s] == pytest.approx(commands[e, s, 0], abs=1e-6)
            line = world.tape.targets[e, 3, :, :2] - [x, y]
            bearings = np.arctan2(line[:, 1], line[:, 0]) + std * world.tape.noise[e, 3, s]
            middle = np.angle(np.exp(1j * bearings).sum())
            order = np.argsort(np.angle(np.exp(1j * (bearings - middle))))
            for rank, bearing in enumerate(bearings[order]):
                assert field(team, seen, f"return{rank}.received")[e, s] == 1.0
                direction = np.array([np.cos(bearing), np.sin(bearing)])
                assert field(team, seen, f"return{rank}.azimuth_cos")[e, s] == pytest.approx(
                    direction @ ahead, abs=1e-6
                )
                assert field(team, seen, f"return{rank}.azimuth_sin")[e, s] == pytest.approx(direction @ left, abs=1e-6)
            assert [field(team, seen, f"agent.is{n}")[e, s] for n in range(2)] == [s == 0, s == 1]


def test_own_view_of_carriers_by_hand():
    """Place off the expected entry, and what was measured; nothing but the task before sensors are set down."""
    team = team_of("MobilePlacement", "own")
    simulation, world = team.simulation, begun(team)
    before = team.observe(simulation.belief(world))
    nothing = [i for i, f in enumerate(team.fields) if f.name.startswith("own.")]
    assert not before[..., nothing].any()
    commands = drawn(team, 5, 0)
    for _ in range(2):
        world, _, _ = simulation.advance(world, team.joined(commands))
    seen = team.observe(simulation.belief(world))
    task, truth = world.tape.task, world.truth[:, 0]
    for e in range(5):
        for s in range(3):
            along, left = task.entry_distance_m[e] - world.platforms[e, s, 0], -world.platforms[e, s, 1]
            assert field(team, seen, "own.azimuth_sin")[e, s] == pytest.approx(left / np.hypot(along, left), abs=1e-6)
            distance = (np.hypot(along, left) - 2e5) / 5e4
            assert field(team, seen, "own.distance")[e, s] == pytest.approx(distance, abs=1e-5)
            dx, dy, dz = truth[e, :3] - world.platforms[e, s, :3]
            noise = world.tape.noise[e, 2, s] * task.std[e]
            log_range = np.log((np.sqrt(dx * dx + dy * dy + dz * dz) + noise[0]) / 5e4) if s < 2 else 0.0
            azimuth = np.arctan2(dy, dx) + noise[1]
            assert field(team, seen, "own.measured")[e, s] == 1.0
            assert field(team, seen, "own.measured_log_range")[e, s] == pytest.approx(log_range, abs=1e-5)
            assert field(team, seen, "own.measured_cos")[e, s] == pytest.approx(-np.cos(azimuth), abs=1e-6)
            assert field(team, seen, "own.measured_sin")[e, s] == pytest.approx(-np.sin(azimuth), abs=1e-6)


def test_common_view_is_the_environments_own():
    team = team_of("TwoStation")
    simulation, world = team.simulation, begun(team)
    seen = team.observe(simulation.belief(world))
    central = simulation.observe(world)
    for s in range(2):
        np.testing.assert_array_equal(seen[:, s, :-2], central)
        np.testing.assert_array_equal(seen[:, s, -2:], np.tile(np.arange(2) == s, (5, 1)))
    np.testing.assert_array_equal(team.observe(None, central), seen)
    names = [f.name for f in team.fields]
    assert names[:-2] == [f.name for f in simulation.observation.fields]
    assert names[-2:] == ["agent.is0", "agent.is1"]


def test_common_view_of_the_mirrored_world():
    team = team_of("TwoStation")
    simulation, world = team.simulation, begun(team)
    world, _, _ = simulation.advance(world, team.joined(drawn(team, 5, 0)))
    seen = team.observe(simulation.belief(world))
    image = team.mirrored(seen)
    np.testing.assert_array_equal(image[..., :-2], simulation.observation.mirrored(seen[..., :-2]))
    np.testing.assert_array_equal(image[..., -2:], seen[..., -2:])
    assert (image != seen).any()
    with pytest.raises(ValueError, match="view = 'own': only observations with view 'common'"):
        team_of("TwoStation", "own").mirrored(seen)


@over_families
def test_difference_is_the_reward_less_that_of_the_flight_without_the_agent(name):
    """The second term by another route: the same seeds flown anew, one agent's commands replaced by idle ones."""
    team = team_of(name, reward="difference")
    size, episodes = len(team.agents), 3
    commands = [drawn(team, episodes, k) for k in range(STEPS)]
    idle = {"TwoStation": [0.0], "AngleFusion": [0.0, 0.0], "ManeuveringTarget": [0.0, -1.0]}.get(name, [0.0] * 3)

    def rewards(without=None):
        env = PassiveVectorEnv(team.simulation.scenario, num_envs=episodes, autoreset_mode="disabled")
        env.reset(seed=7)
        earned = []
        for command in commands:
            flown = command.copy()
            if without is not None:
                flown[:, without] = idle
            earned.append(env.step(team.joined(flown))[1])
        return np.array(earned)

    rows = TeamVectorEnv(team.simulation.scenario, episodes, reward="difference")
    rows.reset(seed=7)
    earned = [rows.step(command.reshape(episodes * size, -1))[1].reshape(episodes, size) for command in commands]
    flown = rewards()
    for i in range(size):
        np.testing.assert_allclose(np.array(earned)[..., i], flown - rewards(without=i), atol=1e-12)
        assert np.abs(np.array(earned)[..., i]).max() > 1e-6


def test_an_agent_that_idles_earns_no_difference():
    team = team_of("TwoStation", reward="difference")
    world, idle = begun(team), IdleWorlds(team)
    idle.begin(world)
    for k in range(STEPS):
        commands = drawn(team, 5, k)
        commands[:, 1] = 0.0
        world, reward, _ = team.simulation.advance(world, team.joined(commands))
        earned = idle.difference(team.joined(commands), reward)
        np.testing.assert_array_equal(earned[:, 1], 0.0)
        assert (earned[:, 0] != 0.0).any()  # errors below the floor earn nothing more


@pytest.mark.parametrize(("view", "reward"), [("common", "team"), ("own", "difference")])
def test_rows_equal_single_environments(view, reward):
    """Two episodes of all agents, the second one begun by the end of the first."""
    fields, episodes, seed = FAMILIES["TwoStation"], 3, 11
    rows = TeamVectorEnv("TwoStation", episodes, view, reward, **fields)
    singles = [parallel_env("TwoStation", view, reward, **fields) for _ in range(episodes)]
    seen, _ = rows.reset(seed=seed)
    alone = [env.reset(seed=seed + j)[0] for j, env in enumerate(singles)]
    for k in range(2 * STEPS):
        np.testing.assert_array_equal(seen, [each[agent] for each in alone for agent in rows.team.agents])
        actions = drawn(rows.team, episodes, k).astype(np.float32)
        seen, earned, terminated, truncated, info = rows.step(actions.reshape(2 * episodes, -1))
        steps = [env.step(dict(zip(env.agents, actions[j], strict=True))) for j, env in enumerate(singles)]
        np.testing.assert_array_equal(earned, [reward for step in steps for reward in step[1].values()])
        ended = k % STEPS == STEPS - 1
        assert not terminated.any()
        assert truncated.all() == truncated.any() == ended == all(steps[0][3].values())
        shown = info["final_info"] if ended else info
        told = [one for step in steps for one in step[4].values()]
        np.testing.assert_array_equal(shown["range_error_m"], [one["range_error_m"] for one in told])
        np.testing.assert_array_equal(shown["team_reward"], [one["team_reward"] for one in told])
        alone = [step[0] for step in steps]
        if ended:
            last = [each[agent] for each in alone for agent in rows.team.agents]
            np.testing.assert_array_equal(info["final_obs"], last)
            alone = [env.reset()[0] for env in singles]


def test_rows_refuse_bad_input():
    rows = TeamVectorEnv("TwoStation", 2, steps=STEPS)
    with pytest.raises(ValueError, match="reset_mask: all episodes begin together"):
        rows.reset(options={"reset_mask": np.array([True, False])})
    rows.reset(seed=0)
    with pytest.raises(ValueError, match=r"actions have shape \(2, 2\), must have shape \(4, 1\)"):
        rows.step(np.zeros((2, 2)))
    with pytest.raises(ValueError, match="every value must be a finite number"):
        rows.step(np.full((4, 1), np.nan))
    with pytest.raises(ValueError, match="seed: got 3 seeds for 2"):
        rows.reset(seed=[1, 2, 3])
