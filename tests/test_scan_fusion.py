"""Fusion scan by scan of sensors that move and may miss scans: against whole episodes, fewer sensors and the theory."""

import numpy as np
import pytest

from trackers.consistency import mean_band, nees
from trackers.converted_fusion import ConvertedFusion
from trackers.converted_measurement import Layout, polar
from trackers.gaussian import Gaussian
from trackers.motion_3d import predict_3d
from trackers.scan_fusion import MODES, FusedScan, ScanFusion

T, BATCH, SCANS = 10.0, 5, 25
KINDS = ([True, True, True], [True, True, False], [True, False, False], [False, False, False])


def courses(batch=BATCH, scans=SCANS, q=0.0, seed=0):
    """Paths [e, k, 6] past the sensors."""
    rng = np.random.default_rng(seed)
    path = np.zeros((batch, scans, 6))
    path[:, 0] = [90e3, 10e3, 9e3, -250.0, -20.0, 0.0]
    path[:, 0, :2] += rng.normal(0.0, 5e3, (batch, 2))
    for k in range(1, scans):
        push = q * rng.standard_normal((batch, 3))
        path[:, k, 3:] = path[:, k - 1, 3:] + T * push
        path[:, k, :3] = path[:, k - 1, :3] + T * path[:, k - 1, 3:] + 0.5 * T * T * push
    return path


def layouts(kinds, batch=BATCH, scans=SCANS, seed=1, std=(60.0, 0.02, 0.01)) -> Layout:
    """Sensors that move, one place per scan."""
    rng = np.random.default_rng(seed)
    start = rng.uniform([-40e3, -60e3, 0.0], [60e3, 60e3, 3e3], (batch, 1, len(kinds), 3))
    drift = rng.uniform([-1e3, -1e3, 0.0], [1e3, 1e3, 100.0], (batch, 1, len(kinds), 3))
    place = start + drift * np.arange(scans)[:, None, None]
    return Layout(place, np.broadcast_to(std, (batch, len(kinds), 3)), np.array(kinds))


def expected(batch=BATCH) -> Gaussian:
    return Gaussian(np.full((batch, 6), 7.0), np.tile(4.0 * np.eye(6), (batch, 1, 1)))


def at_scan(layout, k, kept=slice(None)) -> Layout:
    return Layout(layout.position[:, k, kept], layout.std[:, kept], layout.ranging[kept])


def scans_of(path, layout, seed=2):
    """Measurements [k, e, n, 3] and the noise [e, k, n, 3] in them."""
    noise = np.random.default_rng(seed).standard_normal(layout.position.shape)
    z = polar(path[:, :, None], layout.position) + layout.std[:, None] * noise
    return np.swapaxes(z, 0, 1), noise


def run(tracker, layout, z, measured, kept=slice(None)):
    """States after every scan."""
    state, states = tracker.initiate(expected(len(layout.std))), []
    for k in range(len(z)):
        scan = FusedScan(z[k][:, kept], measured[k][:, kept], at_scan(layout, k, kept))
        state = tracker.update(tracker.predict(state, T), scan).posterior
        states.append(state)
    return states


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("kinds", KINDS, ids=str)
def test_scan_by_scan_equals_the_whole_episodes_filter(kinds, mode):
    path, layout = courses(), layouts(kinds)
    z, noise = scans_of(path, layout)
    whole = ConvertedFusion(step_s=T, acceleration_std=0.3, linearisation=mode, minimum_range_m=0.0)
    track = whole.track(path, layout, noise, moving=True)
    for k, state in enumerate(run(ScanFusion(linearisation=mode), layout, z, np.ones(z.shape[:-1], dtype=bool))):
        np.testing.assert_allclose(state.mean, track.mean[:, k], rtol=1e-9, atol=1e-6)
        np.testing.assert_allclose(state.cov, track.cov[:, k], rtol=1e-9, atol=1e-6)
        assert (state.scans == k + 1).all()


@pytest.mark.parametrize("kinds", KINDS, ids=str)
def test_what_is_promised_is_the_whole_episodes_theory(kinds):
    """In one call, and scan by scan with the state handed on."""
    path, layout = courses(), layouts(kinds)
    theory = ConvertedFusion(step_s=T, acceleration_std=0.3, minimum_range_m=0.0).theoretical(path, layout, moving=True)
    tracker = ScanFusion(minimum_range_m=0.0)
    start = tracker.initiate(expected())
    promised = tracker.promise(start, path, layout, T)
    np.testing.assert_allclose(promised.position_std_m, theory.position_std_m, rtol=1e-12)
    np.testing.assert_allclose(promised.cov, theory.cov, rtol=1e-12, atol=1e-9)
    state = start
    for k in range(SCANS):
        state = tracker.promise(state, path[:, k : k + 1], layout._replace(position=layout.position[:, k : k + 1]), T)
        np.testing.assert_allclose(state.position_std_m[:, 0], theory.position_std_m[:, k], rtol=1e-12)


@pytest.mark.parametrize("kinds", [[True, True, True], [True, True, False]], ids=str)
def test_a_sensor_that_misses_every_scan_is_as_good_as_absent(kinds):
    path, layout = courses(), layouts(kinds)
    z, _ = scans_of(path, layout)
    measured = np.ones(z.shape[:-1], dtype=bool)
    measured[..., 1] = False
    z[..., 1, :] = np.nan
    tracker, kept = ScanFusion(), [0, 2]
    for with_it, without in zip(
        run(tracker, layout, z, measured), run(tracker, layout, z, measured, kept), strict=True
    ):
        np.testing.assert_allclose(with_it.mean, without.mean, rtol=1e-12, atol=1e-9)
        np.testing.assert_allclose(with_it.cov, without.cov, rtol=1e-12, atol=1e-9)


def test_a_sensor_too_close_promises_nothing():
    path, layout = courses(), layouts([True, True, True])
    tracker = ScanFusion(minimum_range_m=5e3)
    start = tracker.initiate(expected())
    near = layout.position.copy()
    near[:, :, 2] = path[..., :3] + [3e3, -3e3, -2e3]  # 4.7 km off
    other = at = layout._replace(position=near)
    other = Layout(at.position[:, :, :2], at.std[:, :2], at.ranging[:2])
    with_it, without = (tracker.promise(start, path, each, T) for each in (at, other))
    np.testing.assert_allclose(with_it.position_std_m, without.position_std_m, rtol=1e-12)
    seen = ScanFusion(minimum_range_m=4.6e3).promise(start, path, at, T)
    assert (seen.position_std_m < 0.9 * without.position_std_m).all()


def test_a_scan_that_nobody_measures_only_predicts():
    path, layout = courses(), layouts([True, True])
    z, _ = scans_of(path, layout)
    measured = np.ones(z.shape[:-1], dtype=bool)
    tracker = ScanFusion()
    state = run(tracker, layout, z[:6], measured[:6])[-1]
    predicted = tracker.predict(state, T)
    update = tracker.update(predicted, FusedScan(z[6], ~measured[6], at_scan(layout, 6)))
    prediction = predict_3d(Gaussian(state.mean, state.cov), T, tracker.acceleration_std)
    np.testing.assert_allclose(update.posterior.mean, prediction.mean, rtol=1e-14)
    np.testing.assert_allclose(update.posterior.cov, prediction.cov, rtol=1e-12)
    assert (update.nis == 0.0).all()
    assert (update.log_likelihood == 0.0).all()
    assert (update.innovation == 0.0).all()
    assert (update.posterior.scans == 6).all()


def test_a_track_waits_for_its_second_scan_and_knows_how_long():
    """A missed second scan: the velocity is the displacement over the time between the two that were taken."""
    path, layout = courses(), layouts([True, True, False])
    z, _ = scans_of(path, layout)
    measured = np.ones(z.shape[:-1], dtype=bool)
    measured[1:3, :, :2] = False  # the sensor without range does measure, but starts no track beside those with it
    first, second, third, fourth = run(ScanFusion(), layout, z[:4], measured[:4])
    for waiting in (second, third):
        np.testing.assert_array_equal(waiting.mean, first.mean)
        np.testing.assert_array_equal(waiting.scans, first.scans)
    assert (third.waited_s == 2 * T).all()
    moved = (fourth.mean[:, :3] - first.mean[:, :3]) / (3 * T)
    np.testing.assert_allclose(fourth.mean[:, 3:], moved, rtol=1e-9)
    assert (fourth.scans == 2).all()


def test_before_the_first_scan_the_expectation_moves_on():
    tracker, start = ScanFusion(), ScanFusion.initiate(expected())
    after = tracker.predict(start, T)
    np.testing.assert_allclose(after.mean, predict_3d(expected(), T, 0.3).mean)
    np.testing.assert_allclose(after.cov, predict_3d(expected(), T, 0.3).cov)


def test_the_track_is_honest_where_angles_are_small():
    """NEES of 400 runs at the last scan: the linearised filter is exact as angle errors and ranges go to 0."""
    runs = 400
    path, layout = courses(runs, q=0.3), layouts([True] * 3, runs, std=(60.0, 1e-3, 1e-3))
    z, _ = scans_of(path, layout)
    state = run(ScanFusion(), layout, z, np.ones(z.shape[:-1], dtype=bool))[-1]
    low, high = mean_band(6, runs)
    assert low < nees(state.mean, state.cov, path[:, -1]).mean() < high


def test_innovations_are_measured_less_predicted():
    path, layout = courses(), layouts([True, False, True])
    z, _ = scans_of(path, layout)
    measured = np.ones(z.shape[:-1], dtype=bool)
    measured[5, :, 2] = False
    tracker = ScanFusion()
    state = tracker.predict(run(tracker, layout, z[:5], measured[:5])[-1], T)
    update = tracker.update(state, FusedScan(z[5], measured[5], at_scan(layout, 5)))
    wanted = z[5] - polar(state.mean[:, None], layout.position[:, 5])
    wanted[:, 1, 0] = wanted[:, 2] = 0.0
    np.testing.assert_allclose(update.innovation, wanted, atol=1e-9)


# ------------------------------------------------------------------------------------------------ bad input


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"acceleration_std": -1.0}, "acceleration_std"),
        ({"linearisation": "local"}, "fused, iterated"),
        ({"minimum_range_m": np.nan}, "minimum_range_m"),
        ({"expected_range_m": 0.0}, "expected_range_m"),
        ({"velocity_std": np.inf}, "velocity_std"),
    ],
)
def test_bad_settings_are_refused(settings, words):
    with pytest.raises(ValueError, match=words):
        ScanFusion(**settings)


def test_unsound_scans_and_layouts_are_refused():
    path, layout = courses(), layouts([True, True])
    z, _ = scans_of(path, layout)
    tracker, measured = ScanFusion(), np.ones(z.shape[1:-1], dtype=bool)
    state, good = tracker.initiate(expected()), at_scan(layout, 0)
    buried = good.position.copy()
    buried[2, 1, 2] = -1.0
    for scan, words in (
        (FusedScan(z[0], measured[:, :1], good), "measured has shape"),
        (FusedScan(z[0], measured.astype(float), good), "bool"),
        (FusedScan(np.where(np.arange(3) == 0, -1.0, z[0]), measured, good), "must be positive"),
        (FusedScan(np.full_like(z[0], np.nan), measured, good), "NaN"),
        (FusedScan(z[0], measured, good._replace(position=buried)), "under ground"),
        (FusedScan(z[0], measured, good._replace(std=0.0 * good.std)), "positive and finite"),
    ):
        with pytest.raises(ValueError, match=words):
            tracker.update(state, scan)
    with pytest.raises(ValueError, match="same scans"):
        tracker.promise(state, path[:, :3], layout, T)
    with pytest.raises(ValueError, match="finite"):
        tracker.promise(state, np.full_like(path, np.nan), layout, T)
    with pytest.raises(ValueError, match="under ground"):
        tracker.promise(state, path, layout._replace(position=layout.position - [0.0, 0.0, 1e5]), T)
    with pytest.raises(ValueError, match="finite"):
        tracker.initiate(Gaussian(np.full((2, 6), np.nan), np.tile(np.eye(6), (2, 1, 1))))
