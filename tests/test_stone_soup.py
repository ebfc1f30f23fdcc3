"""Stone Soup's objects and back: nothing changes on the way, its metrics and its trackers agree with ours."""

from __future__ import annotations

import math
import sys
from datetime import datetime, timedelta
from typing import Any

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment
from scipy.stats import chi2

from agents.evaluation import fly
from agents.policy import make_policy
from passive_env.catalogue import make_scenario
from passive_env.episode_arrays import EpisodeArrays, Returns, record
from passive_env.extras import MissingExtra
from passive_env.stone_soup import (
    MAPPING,
    Episode,
    constant_velocity,
    from_stone_soup,
    metrics,
    retrack,
    to_stone_soup,
)
from trackers.angle_ekf import AngleEkf
from trackers.motion_3d import process_noise_3d, transition_3d

pytest.importorskip("stonesoup")
from stonesoup.models.measurement.nonlinear import CartesianToElevationBearing
from stonesoup.models.transition.linear import LinearGaussianTimeInvariantTransitionModel
from stonesoup.types.angle import Bearing, Elevation
from stonesoup.types.detection import Clutter, Detection, TrueDetection

CLUTTERED = {"detection_probability": 0.9, "false_bearings_mean": 1.0, "steps": 12}


def cluttered() -> Any:
    return make_scenario("TwoStation", CLUTTERED)


@pytest.fixture(scope="module")
def recording() -> EpisodeArrays:
    """Two episodes of three targets with missed detections and false bearings."""
    scenario = cluttered()
    return record(scenario, make_policy("paper", scenario), 2, 7)


@pytest.fixture(scope="module")
def episodes(recording) -> list[Episode]:
    return to_stone_soup(recording)


def arrays(recording: EpisodeArrays) -> dict[str, Any]:
    return {**recording._asdict(), **recording.returns._asdict(), "returns": ()}


def synthetic(size: int = 6, components: int = 2, times_s: tuple[float, ...] = (0.0, 0.1, 0.3, 7.25)) -> EpisodeArrays:
    """Numbers without any sense, but all different."""
    rng = np.random.default_rng(5)
    e, k, s, m, b = 2, len(times_s), 3, 2, 5
    root = rng.normal(size=(e, k, m, size, size))
    valid = rng.random((e, k, s, b)) < 0.5
    values = rng.uniform(-1.5, 1.5, (e, k, s, b, components))
    returns = Returns(
        np.where(valid[..., None], values, 0.0), valid, np.where(valid, rng.integers(-1, m, valid.shape), -1),
        rng.uniform(0.001, 0.1, (e, k, s, components)),
    )  # fmt: skip
    states = [1e4 * rng.normal(size=(e, k, n, size)) for n in (s, m, m)]
    return EpisodeArrays(np.array(times_s), *states, root @ np.swapaxes(root, -1, -2), returns, np.empty((e, 0, 0)))


# ------------------------------------------------------------------------------------------------------ recording


def test_a_recording_is_what_the_evaluation_flies(recording):
    scenario = cluttered()
    flown = fly(scenario, make_policy("paper", scenario), 2, 7)
    ranges = np.linalg.norm(recording.mean[..., :2] - recording.platforms[:, :, -1:, :2], axis=-1)
    true = np.linalg.norm(recording.truth[..., :2] - recording.platforms[:, :, -1:, :2], axis=-1)
    np.testing.assert_allclose(np.abs(ranges - true).mean(-1), flown.range_error_m, rtol=1e-9)
    assert recording.times_s.tolist() == (2.0 * np.arange(13)).tolist()


def check_unit_variance(values: np.ndarray) -> None:
    """The mean square of normal numbers of variance 1 lies in this band but for one case in a thousand."""
    low, high = chi2.ppf([5e-4, 1.0 - 5e-4], df=len(values)) / len(values)
    assert low < np.square(values).mean() < high


def test_recorded_returns_lie_where_they_come_from(recording):
    """Bearings of a target are those of its line of sight with noise of 1 σ; false ones spread over the circle."""
    returns, truth = recording.returns, recording.truth
    e, k, s, b = np.nonzero(returns.valid & (returns.origin >= 0))
    target = returns.origin[e, k, s, b]
    way = truth[e, k, target, :2] - recording.platforms[e, k, s, :2]
    error = np.remainder(returns.values[e, k, s, b, 0] - np.arctan2(way[:, 1], way[:, 0]) + np.pi, 2 * np.pi) - np.pi
    check_unit_variance(error / returns.std[e, k, s, 0])
    false = returns.values[returns.valid & (returns.origin < 0)]
    assert len(false) > 20
    assert false.std() > 1.0
    assert not returns.valid[:, 1:].all()
    assert (returns.values[~returns.valid] == 0.0).all()


def test_our_tracker_on_a_recording_makes_the_recorded_track(recording, episodes):
    """Through Stone Soup's objects and back, bit for bit."""
    back, scenario = from_stone_soup(episodes), cluttered()
    tracker = scenario.make_tracker()
    targets = recording.truth.shape[2]
    first = back.scan(0)
    state = tracker.initiate(first._replace(bearings=first.bearings[..., :targets], valid=first.valid[..., :targets]))
    for k in range(1, len(back.times_s)):
        state = tracker.update(tracker.predict(state, scenario.step_s), back.scan(k)).posterior
        np.testing.assert_array_equal(tracker.estimate(state).mean, recording.mean[:, k])
        np.testing.assert_array_equal(tracker.estimate(state).cov, recording.cov[:, k])


def test_what_cannot_be_recorded_says_why():
    scenario = make_scenario("RadarPlacement", {})
    with pytest.raises(ValueError, match="RadarPlacement: its sensors measure neither bearings, nor"):
        record(scenario, make_policy("random", scenario))
    scenario = cluttered()
    with pytest.raises(ValueError, match="episodes = 0: must be at least 1"):
        record(scenario, make_policy("paper", scenario), 0)
    with pytest.raises(ValueError, match="needs bearings of one accuracy"):
        synthetic().scan(0)


# ------------------------------------------------------------------------------------------------------- there and back


@pytest.mark.parametrize("made", ["flown", "bearings", "azimuth and elevation"])
def test_round_trip_is_exact(recording, made):
    given = {"flown": recording, "bearings": synthetic(4, 1), "azimuth and elevation": synthetic()}[made]
    back = from_stone_soup(to_stone_soup(given, datetime(2026, 2, 28, 23, 59, 59)))
    for name, array in arrays(given).items():
        np.testing.assert_array_equal(arrays(back)[name], array, err_msg=name)
        assert np.asarray(arrays(back)[name]).dtype == np.asarray(array).dtype


@pytest.mark.parametrize("components", [1, 2])
def test_objects_mean_what_stone_soup_takes_them_for(components):
    """Its own measurement models, at the true state, predict the direction from the platform to the target."""
    size = 2 * (components + 1)
    given = synthetic(size, components)
    (episode, _) = to_stone_soup(given)
    assert [len(part) for part in episode] == [2, 3, 4, 2]
    kinds = set()
    for k, detections in enumerate(episode.detections):
        for detection in detections:
            kinds.add(type(detection))
            s, b = detection.metadata["station"], detection.metadata["slot"]
            target = given.returns.origin[0, k, s, b]
            assert isinstance(detection, Clutter if target < 0 else TrueDetection)
            assert detection.timestamp == datetime(2000, 1, 1) + timedelta(seconds=float(given.times_s[k]))
            path = episode.truths[0] if target < 0 else detection.groundtruth_path
            x = given.truth[0, k, max(target, 0)] - given.platforms[0, k, s]
            expected = [math.atan2(x[1], x[0])]
            if components == 2:
                expected.insert(0, math.atan2(x[2], math.hypot(x[0], x[1])))
            predicted = detection.measurement_model.function(path[k])
            np.testing.assert_allclose(np.asarray(predicted, dtype=float)[:, 0], expected, atol=1e-12)
            assert [type(angle) for angle in detection.state_vector] == [Elevation, Bearing][-components:]
            noise = np.diagonal(detection.measurement_model.noise_covar)
            np.testing.assert_allclose(noise, given.returns.std[0, k, s, ::-1] ** 2, rtol=1e-12)
    assert kinds == {Clutter, TrueDetection}
    state = episode.tracks[1][2]
    np.testing.assert_array_equal(state.mean[list(MAPPING[size]), 0], given.mean[0, 2, 1, : size // 2])
    velocity = [i + 1 for i in MAPPING[size]]
    np.testing.assert_array_equal(state.mean[velocity, 0], given.mean[0, 2, 1, size // 2 :])
    both = np.ix_(MAPPING[size], velocity)
    np.testing.assert_array_equal(state.covar[both], given.cov[0, 2, 1, : size // 2, size // 2 :])


# ---------------------------------------------------------------------------------------------------- metrics, trackers


def test_gospa_and_ospa_are_those_of_their_definitions(recording, episodes):
    """Rahmathullah et al. (2016) and Schuhmacher et al. (2008) for three targets and three tracks, of order 2."""
    cutoff = 4000.0
    found = metrics(episodes[1], cutoff)
    gospa, ospa = found["gospa"]["GOSPA Metrics"].value, found["ospa"]["OSPA distances"].value
    missed = 0
    for k in range(len(recording.times_s)):
        apart = recording.truth[1, k, :, None, :2] - recording.mean[1, k, None, :, :2]
        cost = np.minimum(np.linalg.norm(apart, axis=-1), cutoff) ** 2
        best = cost[linear_sum_assignment(cost)]
        missed += (best == cutoff**2).sum()
        assert gospa[k].value["distance"] == pytest.approx(math.sqrt(best.sum()), rel=1e-9)
        assert ospa[k].value == pytest.approx(math.sqrt(best.mean()), rel=1e-9)
    assert 0 < missed < 3 * len(gospa)


def test_siap_accuracy_is_the_mean_error_of_tracks_near_their_targets():
    """Tracks 30 m and 0.5 m/s off beside targets that are far from each other; one track is lost half the time."""
    given = synthetic(4, 1, tuple(range(20)))
    truth = np.zeros_like(given.truth)
    truth[:, :, 1, 0] = 50e3
    mean = truth + np.array([30.0, 0.0, 0.0, 0.5])
    mean[:, 10:, 1, 1] = 20e3
    (episode, _) = to_stone_soup(given._replace(truth=truth, mean=mean))
    siap = metrics(episode, 1000.0)["siap"]
    assert siap["SIAP Position Accuracy"].value == pytest.approx(30.0)
    assert siap["SIAP Velocity Accuracy"].value == pytest.approx(0.5)
    assert siap["SIAP Completeness"].value == pytest.approx(0.75)
    assert siap["SIAP Spuriousness"].value == pytest.approx(0.25)


def exact_jacobian(model: Any, state: Any, **_: Any) -> np.ndarray:
    """Derivatives of elevation and bearing; Stone Soup 1.9 takes differences over 1e-8 m where a coordinate is
    negative, which leaves four digits."""
    x, y, z = (np.asarray(state.state_vector, dtype=float)[list(model.mapping)] - model.translation_offset)[:, 0]
    level = math.hypot(x, y)
    slant = level * (level**2 + z**2)
    H = np.zeros((2, model.ndim_state))
    H[0, list(model.mapping)] = -x * z / slant, -y * z / slant, level**2 / slant
    H[1, list(model.mapping[:2])] = -y / level**2, x / level**2
    return H


def test_stone_soups_filter_makes_our_track_of_our_detections(monkeypatch):
    """One sensor of azimuth and elevation: two extended Kalman filters, one number."""
    monkeypatch.setattr(CartesianToElevationBearing, "jacobian", exact_jacobian)
    scenario = make_scenario(
        "AngleFusion",
        {
            "tracker": "angle_ekf",
            "second_order": False,
            "availability1_min": 0.0,
            "availability1_max": 0.0,
            "steps": 15,
        },
    )
    assert isinstance(scenario.make_tracker(), AngleEkf)
    given = record(scenario, make_policy("rule", scenario), 1, 3)
    order = np.arange(6).reshape(2, 3).T.ravel()
    motion = LinearGaussianTimeInvariantTransitionModel(
        transition_matrix=transition_3d(scenario.step_s)[np.ix_(order, order)],
        covariance_matrix=process_noise_3d(scenario.step_s, scenario.process_noise_m_s2)[np.ix_(order, order)],
    )
    (episode,) = to_stone_soup(given)
    theirs = from_stone_soup([retrack(episode, motion, gate=1e3)])
    np.testing.assert_allclose(theirs.mean, given.mean, rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(theirs.cov, given.cov, rtol=1e-9, atol=1e-4)
    assert np.abs(given.mean[:, -1] - given.mean[:, 0]).max() > 100.0


def test_a_tracker_of_stone_soup_flies_beside_ours():
    """Three targets, two stations, unlabelled bearings: begun from our tracks, it follows all of them as ours does."""
    scenario = make_scenario("TwoStation", {})
    given = record(scenario, make_policy("paper", scenario), 3, 7)
    motion = constant_velocity(2, scenario.process_noise_m_s**2 / scenario.step_s)
    theirs = from_stone_soup([retrack(episode, motion, begin=10) for episode in to_stone_soup(given)])
    np.testing.assert_array_equal(theirs.mean[:, :11], given.mean[:, :11])
    errors = [np.linalg.norm((r.mean - r.truth)[:, -1, :, :2], axis=-1) for r in (given, theirs)]
    assert np.median(errors[1]) < 3.0 * np.median(errors[0])
    assert np.median(errors[1]) < 2000.0
    assert not np.array_equal(errors[0], errors[1])


# ------------------------------------------------------------------------------------------------------ bad input


def spoilt(episode: Episode, **changes: Any) -> list[Episode]:
    return [episode._replace(**changes)]


def unnumbered(episode: Episode, **metadata: Any) -> list[Any]:
    """Detections of which one says another place."""
    detections = [set(each) for each in episode.detections]
    one = next(iter(sorted(detections[1], key=lambda d: (d.metadata["station"], d.metadata["slot"]))))
    detections[1].add(
        Detection(one.state_vector, timestamp=metadata.pop("timestamp", one.timestamp), metadata=metadata)
    )
    return detections


def test_objects_that_do_not_belong_together_are_refused(episodes):
    one = episodes[0]
    shorter = [path[:-1] for path in one.tracks]
    later = one.detections[1].copy().pop().timestamp + timedelta(seconds=0.5)
    for wrong, words in (
        ([], "episodes: there are none"),
        (spoilt(one, tracks=shorter), "episode 0: track 0 has no state of 2000-01-01 00:00:24"),
        (
            spoilt(one, truths=[one.truths[0][:5], *one.truths[1:]]),
            "platform 0 has states of 13 instants: must have one of each of the 5",
        ),
        ([one, one._replace(tracks=one.tracks[:2])], "episode 1 has tracks of 2 targets, truths of 3: must have one"),
        ([one, one._replace(tracks=one.tracks[:2], truths=one.truths[:2])], "episode 1 has arrays of shapes"),
        (spoilt(one, truths=[]), "episode 0 has no truths: must have at least one"),
        (spoilt(one, platforms=[]), "episode 0 has no platforms: must have at least one"),
        (spoilt(one, detections=one.detections[:-1]), "detections of 12 instants, must be 13"),
        (spoilt(one, detections=unnumbered(one)), "have station = None and slot = None, must be whole numbers below 2"),
        (spoilt(one, detections=unnumbered(one, station=2, slot=0)), "station = 2 and slot = 0, must be"),
        (spoilt(one, detections=unnumbered(one, station=0, slot=0)), "station 0, slot 0 is the second one"),
        (spoilt(one, detections=unnumbered(one, station=0, slot=9, timestamp=later)), "is of .*, not 2000-01-01"),
    ):
        with pytest.raises(ValueError, match=words):
            from_stone_soup(wrong)


def test_settings_of_metrics_and_trackers_are_checked(episodes):
    for settings in ({"cutoff_m": 0.0}, {"cutoff_m": math.nan}, {"order": 0.5}):
        with pytest.raises(ValueError, match="must be positive, and at least 1"):
            metrics(episodes[0], **settings)
    with pytest.raises(ValueError, match="has no truths: must have at least one"):
        metrics(episodes[0]._replace(truths=[]))
    for begin in (-1, 13):
        with pytest.raises(ValueError, match=f"begin = {begin}: must be an instant, 0 to 12"):
            retrack(episodes[0], constant_velocity(2, 1.0), begin)


def test_a_missing_extra_names_the_command(recording, episodes, monkeypatch):
    for name in list(sys.modules):
        if name.partition(".")[0] == "stonesoup":
            monkeypatch.setitem(sys.modules, name, None)
    for call in (
        lambda: to_stone_soup(recording),
        lambda: from_stone_soup(episodes),
        lambda: metrics(episodes[0]),
        lambda: retrack(episodes[0], None),
        lambda: constant_velocity(2, 1.0),
    ):
        with pytest.raises(
            MissingExtra, match=r'stonesoup is not installed: python -m pip install "passive-env\[stone'
        ):
            call()


def test_one_target_seen_by_labelled_azimuths_is_recorded_too():
    scenario = make_scenario("ManeuveringTarget", {"steps": 3})
    given = record(scenario, make_policy("open", scenario), 2, 1)
    assert given.returns.values.shape == (2, 4, scenario.stations, 1, 1)
    assert ((given.returns.origin == 0) == given.returns.valid).all()
    back = from_stone_soup(to_stone_soup(given))
    np.testing.assert_array_equal(back.returns.values, given.returns.values)


def test_range_sums_of_a_passive_radar_are_recorded_and_tracked_too():
    """Round trip, Stone Soup's predictions at the truth, and its filter on the echoes after our first ten steps."""
    scenario = make_scenario("PassiveRadar", {"steps": 60})
    given = record(scenario, make_policy("round_robin", scenario), 2, 4)
    assert given.transmitters.shape == (2, scenario.pool, scenario.dimensions)
    episodes = to_stone_soup(given)
    back = from_stone_soup(episodes)
    for name, array in arrays(given).items():
        np.testing.assert_array_equal(arrays(back)[name], array, err_msg=name)
    normalised = []
    for k, detections in enumerate(episodes[0].detections):
        for detection in detections:
            truth, model = episodes[0].truths[0][k], detection.measurement_model
            place = given.truth[0, k, 0, : scenario.dimensions]
            ends = (
                given.platforms[0, k, 0, : scenario.dimensions],
                given.transmitters[0, detection.metadata["station"]],
            )
            predicted = float(model.function(truth)[0, 0])
            assert predicted == pytest.approx(sum(np.linalg.norm(place - end) for end in ends), rel=1e-12)
            normalised.append((detection.state_vector[0, 0] - predicted) / math.sqrt(model.noise_covar[0, 0]))
    assert len(normalised) > 20
    check_unit_variance(np.array(normalised))
    motion = constant_velocity(scenario.dimensions, scenario.process_noise_m_s2**2 * scenario.step_s)
    theirs = from_stone_soup([retrack(episode, motion, begin=10) for episode in episodes])
    errors = [np.linalg.norm((r.mean - r.truth)[:, -1, 0, : scenario.dimensions], axis=-1) for r in (given, theirs)]
    assert (errors[1] < 3.0 * errors[0] + 500.0).all()
    with pytest.raises(ValueError, match="needs bearings of one accuracy"):
        given.scan(0)
