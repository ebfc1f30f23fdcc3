"""Recorded measurements: files are read or refused with reason, and tracks are those of the environment."""

import csv
import io
import json
import math
from functools import lru_cache

import numpy as np
import pymap3d
import pytest

from agents import cli
from agents.policy import make_policy
from agents.track import FAMILIES, find_family, follow, open_playback
from agents.track_files import advice_rows, summary, track_csv
from agents.track_sample import SAMPLE_GUESS, SAMPLES, fly_episode, sample_path, write_episode
from passive_env.playback import paced
from passive_env.recording import read_angles, read_azimuths, read_bearings, read_range_sums
from passive_env.recording_file import RecordingError
from trackers import AdaptiveRpEkf, AnglePdaf, Imm3, ImmMie, RangeSumEkf, RpEkf, Scan
from trackers.gaussian import Gaussian
from trackers.rp_ekf import Bank, predict

NAMES = list(SAMPLES)
UNSEEN = ("steps", "availability1_min", "availability1_max")
"""Fields of samples that a tracker does not know."""


@lru_cache(maxsize=8)
def episode(tracker):
    return fly_episode(*SAMPLES[tracker])


def opened(tracker, file, **more):
    told = {name: value for name, value in SAMPLES[tracker].fields.items() if name not in UNSEEN}
    told |= {"steps": SAMPLES[tracker].fields["steps"]} if "steps" in SAMPLES[tracker].fields else {}
    return open_playback(file, tracker, fields=told | more, guess=episode(tracker).guess)[1]


def write(folder, text, name="file.csv"):
    file = folder / name
    file.write_text(text, encoding="utf-8")
    return file


# -- the way round -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("tracker", NAMES)
def test_simulated_then_written_then_tracked_is_the_environments_track(tracker, tmp_path):
    flown = episode(tracker)
    file = write_episode(tmp_path / "file.csv", tracker, flown, radians=True)
    playback = opened(tracker, file)
    track = follow(playback, make_policy(SAMPLES[tracker].policy, playback.scenario))
    assert np.array_equal(track.mean, np.concatenate([belief.mean for belief in flown.beliefs]))
    assert np.array_equal(track.cov, np.concatenate([belief.cov for belief in flown.beliefs]))
    assert track.commands[:-1] == pytest.approx(np.concatenate(flown.commands), abs=1e-9)
    assert len(track.commands) == len(flown.commands) + 1
    assert np.ptp(track.commands[:-1], axis=0).max() > 0.0


def assert_alike(name: str, mine, wanted, within: float) -> None:
    """Equal numbers, part by part where a field is a scan, whose last slots [e, s, b, …] a file need not have."""
    if isinstance(wanted, tuple) and wanted:
        for part, ours, theirs in zip(wanted._fields, mine, wanted, strict=True):
            assert_alike(f"{name}.{part}", ours, theirs, within)
    else:
        ours, theirs = (np.asarray(value, dtype=float) for value in (mine, wanted))
        if name.startswith("received.") and ours.ndim > 2 and ours.shape[2] < theirs.shape[2]:
            assert name != "received.valid" or not theirs[:, :, ours.shape[2] :].any()
            theirs = theirs[:, :, : ours.shape[2]]
        np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=within, err_msg=name)


@pytest.mark.parametrize("tracker", NAMES)
def test_beliefs_are_those_of_the_environment(tracker, tmp_path):
    """All that a policy may see; what it commanded last is found from how the platforms flew."""
    flown = episode(tracker)
    playback = opened(tracker, write_episode(tmp_path / "file.csv", tracker, flown, radians=True))
    beliefs = [playback.belief(moment.world) for moment in playback.moments()]
    for ours, theirs in zip(beliefs[:-1], flown.beliefs[:-1], strict=True):
        for name in ours._fields:
            mine, wanted = getattr(ours, name), getattr(theirs, name)
            if name == "last_action" and tracker == "passive-radar":
                continue  # scores; whom they chose is another field
            if name != "track_state":
                assert_alike(name, mine, wanted, 2e-6)


VARIANTS = [
    ("rp-ekf", "TwoStation", {"detection_probability": 0.8, "false_bearings_mean": 1.0, "steps": 25}, "rule"),
    ("rp-ekf", "TwoStation", {"bearings": "reference", "steps": 25}, "rule"),
    ("rp-ekf", "OwnshipMulti", {"detection_probability": 0.9, "steps": 20}, "straight"),
    ("angle-fusion", "AngleFusionClutter", {}, "rule"),
    ("imm-mie", "ManeuveringTarget", {"carrier": "ground"}, "rule"),
    ("passive-radar", "PassiveRadarRetune", {"steps": 40}, "round_robin"),
    ("passive-radar", "MobileReceiver", {"steps": 40, "tracker": "ekf"}, "pursuit"),
    ("passive-radar", "PassiveRadar", {"steps": 40, "dimensions": 3}, "round_robin"),
]


@pytest.mark.parametrize(("tracker", "environment", "fields", "policy"), VARIANTS)
def test_clutter_delays_and_moving_receivers_come_back_too(tracker, environment, fields, policy, tmp_path):
    flown = fly_episode(environment, fields, policy, 11)
    file = write_episode(tmp_path / "file.csv", tracker, flown, radians=True)
    told = {name: value for name, value in fields.items() if name != "tracker"}
    _, playback = open_playback(file, tracker, environment, told, guess=flown.guess)
    track = follow(playback, make_policy(policy, playback.scenario))
    assert np.array_equal(track.mean, np.concatenate([belief.mean for belief in flown.beliefs]))
    assert np.array_equal(track.cov, np.concatenate([belief.cov for belief in flown.beliefs]))
    assert track.commands[:-1] == pytest.approx(np.concatenate(flown.commands), abs=1e-9)
    turns = slice(0, 1 if environment == "MobileReceiver" else 0 if tracker == "passive-radar" else None)
    for moment, theirs in zip(track.moments[:-1], flown.beliefs[:-1], strict=True):
        ours = playback.belief(moment.world)
        assert ours.last_action[:, turns] == pytest.approx(theirs.last_action[:, turns], abs=2e-6)
        others = [name for name in ours._fields if name not in ("last_action", "track_state")]
        for name in others:
            assert_alike(name, getattr(ours, name), getattr(theirs, name), 1e-9)


@pytest.mark.parametrize("tracker", NAMES)
def test_rows_lost_at_random_leave_a_track_that_is_finite_and_wider(tracker, tmp_path):
    rows = sample_path(tracker).read_text(encoding="utf-8").splitlines()
    kept = np.random.default_rng(4).random(len(rows)) < 0.4
    kept[:25] = True  # the start
    thin = write(tmp_path, "\n".join(row for row, keep in zip(rows, kept, strict=True) if keep))
    whole, track = follow(opened(tracker, "sample")), follow(opened(tracker, thin))
    for part in (track.mean, track.cov, *track.sights, *track.fits):
        assert np.isfinite(part).all()
    assert len(track.time_s) < len(whole.time_s)
    assert np.trace(track.cov[-1, 0, :2, :2]) > np.trace(whole.cov[-1, 0, :2, :2])


@pytest.mark.parametrize("tracker", NAMES)
def test_shipped_samples_are_what_the_simulator_makes(tracker, tmp_path):
    shipped, anew = sample_path(tracker), write_episode(tmp_path / "file.csv", tracker, episode(tracker))
    columns = [list(csv.reader(io.StringIO(file.read_text(encoding="utf-8")))) for file in (shipped, anew)]
    assert columns[0][0] == columns[1][0]
    assert len(columns[0]) == len(columns[1])
    for old, new in zip(columns[0][1:], columns[1][1:], strict=True):
        for a, b in zip(old, new, strict=True):
            assert a == b or float(a) == pytest.approx(float(b), rel=1e-7, abs=1e-6)
    assert shipped.stat().st_size < 60_000
    if tracker == "passive-radar":
        assert pytest.approx(episode(tracker).guess, abs=0.5) == SAMPLE_GUESS


@pytest.mark.parametrize("tracker", NAMES)
def test_degrees_from_north_give_the_same_track(tracker, tmp_path):
    flown = episode(tracker)
    track = follow(opened(tracker, write_episode(tmp_path / "file.csv", tracker, flown)))
    wanted = np.concatenate([belief.mean for belief in flown.beliefs])
    assert np.abs(track.mean - wanted).max() < 1e-9 * np.abs(wanted).max()


# -- times that are not a step apart -----------------------------------------------------------------------------------


def test_an_instant_left_out_is_a_scan_that_everybody_missed(tmp_path):
    """Empty rows and no rows are the same to the track, and to the count of steps."""
    rows = sample_path("imm-mie").read_text(encoding="utf-8").splitlines()
    head, body = rows[0], [row.split(",") for row in rows[1:]]
    at = rows[0].split(",").index("bearing_deg")
    gone = {"7.0", "8.0", "20.0"}
    empty = [[*row[:at], "", *row[at + 1 :]] if row[0] in gone else row for row in body]
    left = [row for row in body if row[0] not in gone]
    texts = ["\n".join([head, *(",".join(row) for row in part)]) for part in (empty, left)]
    tracks = [follow(open_playback(write(tmp_path, text, f"{i}.csv"), "imm-mie")[1]) for i, text in enumerate(texts)]
    whole, short = tracks
    there = np.isin(whole.time_s, short.time_s)
    assert there.sum() == len(whole.time_s) - 3
    assert np.array_equal(whole.mean[there], short.mean)
    assert np.array_equal(whole.cov[there], short.cov)
    assert whole.moments[-1].world.step == short.moments[-1].world.step
    assert (summary(whole)["missing_scans"], summary(short)["missing_scans"]) == (0, 3)


def test_irregular_times_predict_with_the_time_that_passed(tmp_path):
    """The same calls of the tracker by hand: 2 s steps, then 1.5 s, then 5.2 s in three parts."""
    text = "time_s,station,direction_rad,east_m,north_m\n"
    text += "".join(
        f"{t},{name},{angle},{x},0\n"
        for t, pair in (
            (0.0, (0.52, 0.85)), (2.0, (0.53, 0.86)), (4.0, (0.535, 0.872)), (5.5, (0.54, None)), (10.7, (0.56, 0.9)),
            (12.7, (0.565, 0.91)), (14.7, (0.57, 0.92)),
        )
        for name, x, angle in (("A", -5000.0, pair[0]), ("B", 9000.0, pair[1]))
        if angle is not None
    )  # fmt: skip
    track = follow(open_playback(write(tmp_path, text), "rp-ekf", fields={"process_noise_m_s": 10.0})[1])
    tracker = RpEkf(floor_m=5e3, cap_m=2e5, process_noise=10.0)
    places, std = np.array([[[-5000.0, 0.0], [9000.0, 0.0]]]), math.radians(0.5)

    def scan(a, b):
        told = np.array([[[math.nan if x is None else x] for x in (a, b)]])
        return Scan(np.nan_to_num(told), np.isfinite(told), places, std)

    state = tracker.initiate(scan(0.52, 0.85))
    for share, parts, pair in (
        (1.0, 1, (0.53, 0.86)), (1.0, 1, (0.535, 0.872)), (0.75, 1, (0.54, None)), (2.6 / 3, 3, (0.56, 0.9)),
    ):  # fmt: skip
        slower = RpEkf(floor_m=5e3, cap_m=2e5, process_noise=10.0 * math.sqrt(share))
        for _ in range(parts - 1):
            state = slower.update(slower.predict(state, 2.0 * share), scan(None, None)).posterior
        state = slower.update(slower.predict(state, 2.0 * share), scan(*pair)).posterior
    estimate = tracker.estimate(state)
    assert track.time_s[4] == 10.7
    assert track.mean[4] == pytest.approx(estimate.mean[0], rel=1e-9)
    assert track.cov[4] == pytest.approx(estimate.cov[0], rel=1e-7)
    assert track.fits[1][:, 0].tolist() == [0, 2, 2, 1, 2, 2, 2]


def test_paced_noise_adds_up_to_that_of_a_step():
    """Two halves disturb the velocity as much as a whole."""
    start = Gaussian(np.zeros((1, 1, 6)), np.eye(6)[None, None])
    whole = AnglePdaf(process_noise=7.0)
    half = paced(whole, 0.5)
    twice = half.predict(half.predict(start, 1.0), 1.0)
    assert twice.cov[0, 0, 3, 3] == pytest.approx(whole.predict(start, 2.0).cov[0, 0, 3, 3])
    bank = Bank(np.zeros((1, 1, 4)), np.eye(4)[None, None], np.zeros((1, 1)))
    q = paced(RpEkf(process_noise=6.0), 0.5).process_noise
    halves = predict(predict(bank, 1.0, q), 1.0, q)
    assert halves.cov[0, 0, 3, 3] == pytest.approx(predict(bank, 2.0, 6.0).cov[0, 0, 3, 3])
    assert paced(RangeSumEkf(), 0.25).process_noise == pytest.approx((4.0, 4.0, 0.04))
    assert paced(ImmMie(acceleration_std=3.0), 4.0).acceleration_std == pytest.approx(1.5)
    assert paced(Imm3(), 4.0).noise_std == pytest.approx((0.5, 2.0, 6.0))


@pytest.mark.parametrize("tracker", [AdaptiveRpEkf(), ImmMie(), Imm3()], ids=lambda tracker: type(tracker).__name__)
def test_paced_switching_adds_up_to_that_of_a_step(tracker):
    third = np.array(paced(tracker, 1.0 / 3.0).transition)
    assert third @ third @ third == pytest.approx(np.array(tracker.transition), abs=1e-9)
    assert paced(tracker, 1.0) is tracker


# -- what a file says --------------------------------------------------------------------------------------------------


def test_units_and_names_of_angles(tmp_path):
    """Bearings run clockwise from north, directions counter-clockwise from east; a row each way, the same angle."""
    told = [("bearing_deg", 60.0), ("azimuth_rad", math.radians(60.0)), ("direction_mrad", 1e3 * math.radians(30.0))]
    for column, value in told:
        read = read_bearings(write(tmp_path, f"time_ms,{column},east_km,north_m\n500,{value!r},-2,30\n"))
        assert read.angles[0, 0, 0, 0] == pytest.approx(math.radians(30.0), abs=1e-14)
        assert read.time_s.tolist() == [0.5]
        assert read.platforms[0, 0].tolist() == [-2000.0, 30.0, 0.0, 0.0]


def test_a_missing_station_flies_straight_on(tmp_path):
    text = "time_s,station,bearing_deg,east_m,north_m\n0,A,10,0,0\n0,B,20,0,0\n2,A,10,20,2\n5,B,,7,0\n6,A,11,40,4\n"
    read = read_azimuths(write(tmp_path, text))
    assert read.present.tolist() == [[True, True], [True, False], [False, True], [True, False]]
    assert read.valid[..., 0].tolist() == [[True, True], [True, False], [False, False], [True, False]]
    assert read.platforms[2, 0] == pytest.approx([50.0, 5.0, 10.0, 1.0])
    assert read.platforms[3, 1] == pytest.approx([8.4, 0.0, 1.4, 0.0])


def test_times_of_day_count_from_the_first_row(tmp_path):
    text = "time_utc,bearing_deg,east_m,north_m\n2026-05-01T12:00:00.5+00:00,1,0,0\n2026-05-01T14:00:03+02:00,1,0,0\n"
    read = read_bearings(write(tmp_path, text))
    assert read.time_s.tolist() == [0.0, 2.5]
    assert read.epoch.startswith("2026-05-01T12:00:00.5")


def test_bearings_of_far_stations_are_turned_into_the_frame(tmp_path):
    """A target over the ground seen from two stations 100 km apart, by `pymap3d`: their norths are 1.1° apart."""
    target, stations = (50.6, 9.5), ((50.0, 9.0), (50.1, 10.4))
    rows = ""
    for i, (lat, lon) in enumerate(stations):
        azimuth, _, _ = pymap3d.geodetic2aer(*target, 0.0, lat, lon, 0.0)
        rows += f"0,{'AB'[i]},{azimuth:.12f},{lat},{lon},10,20\n"
    head = "time_s,station,bearing_deg,latitude_deg,longitude_deg,velocity_east_m_s,velocity_north_m_s\n"
    read = read_bearings(write(tmp_path, head + rows))
    east, north, _ = pymap3d.geodetic2enu(*target, 0.0, *stations[0], 0.0)
    for s in range(2):
        line = np.array([east, north]) - read.platforms[0, s, :2]
        assert read.angles[0, s, 0, 0] == pytest.approx(math.atan2(line[1], line[0]), abs=2e-4)
    bare = math.pi / 2.0 - math.radians(float(rows.splitlines()[1].split(",")[2]))
    assert abs(read.angles[0, 1, 0, 0] - bare) > math.radians(1.0)
    assert np.hypot(*read.platforms[0, 1, 2:]) == pytest.approx(math.hypot(10.0, 20.0), rel=1e-3)


def test_directions_in_space_on_the_earth(tmp_path):
    """Azimuth and elevation by `pymap3d`: the line of sight in the frame runs to the target."""
    target, stations = (47.3, 8.4, 9000.0), ((47.0, 8.0, 400.0), (47.1, 8.9, 5000.0))
    head = "time_s,station,azimuth_deg,elevation_deg,latitude_deg,longitude_deg,height_m\n"
    rows = ""
    for i, place in enumerate(stations):
        azimuth, elevation, _ = pymap3d.geodetic2aer(*target, *place)
        rows += f"0,{'AB'[i]},{azimuth:.12f},{elevation:.12f},{place[0]},{place[1]},{place[2]}\n"
    read = read_angles(write(tmp_path, head + rows), origin=(47.2, 8.3, 100.0))
    goal = np.array(pymap3d.geodetic2enu(*target, 47.2, 8.3, 100.0))
    for s in range(2):
        azimuth, elevation = read.angles[0, s, 0]
        level = math.cos(elevation)
        sight = np.array([level * math.cos(azimuth), level * math.sin(azimuth), math.sin(elevation)])
        line = goal - read.platforms[0, s, :3]
        assert sight == pytest.approx(line / np.linalg.norm(line), abs=1e-9)
    back = read.frame.geodetic(*goal)
    assert np.degrees(back[:2]) == pytest.approx(target[:2], abs=1e-9)
    low = read.frame.ground(goal[:1], goal[1:2])
    place = pymap3d.geodetic2enu(*low[0], 0.0, *read.frame, deg=False)
    assert place[:2] == pytest.approx(goal[:2], abs=2.0)


def test_a_file_of_latitudes_gives_the_track_of_the_file_of_metres(tmp_path):
    """The sample put on the earth by `pymap3d`, bearings turned to the north of each station."""
    origin = (51.0, 7.0, 0.0)
    rows = list(csv.DictReader(io.StringIO(sample_path("imm-mie").read_text(encoding="utf-8"))))
    head = "time_s,station,bearing_deg,latitude_deg,longitude_deg,height_m,velocity_east_m_s,velocity_north_m_s\n"
    text = head
    for row in rows:
        east, north = float(row["east_m"]) + 40e3, float(row["north_m"]) + 30e3
        lat, lon, height = pymap3d.enu2geodetic(east, north, 0.0, *origin)
        bearing = ""
        if row["bearing_deg"]:
            angle = math.radians(float(row["bearing_deg"]))
            space = pymap3d.enu2uvw(math.sin(angle), math.cos(angle), 0.0, *origin[:2])
            x, y, _ = pymap3d.uvw2enu(*space, lat, lon)
            bearing = repr(float(math.degrees(math.atan2(x, y)) % 360.0))
        text += f"{row['time_s']},{row['station']},{bearing},{lat!r},{lon!r},{height!r},"
        text += f"{row['velocity_east_m_s']},{row['velocity_north_m_s']}\n"
    text = text.replace("np.float64(", "").replace(")", "")
    flat = follow(open_playback("sample", "imm-mie")[1])
    round_ = follow(open_playback(write(tmp_path, text), "imm-mie", origin=origin)[1])
    late = slice(5, None)
    assert round_.mean[late, 0, :2] == pytest.approx(flat.mean[late, 0, :2] + (40e3, 30e3), abs=2.0)
    lat, lon = round_.on_earth[-1, 0]
    place = pymap3d.geodetic2enu(lat, lon, 0.0, *origin)
    assert place[:2] == pytest.approx(round_.mean[-1, 0, :2], abs=1.0)
    assert "latitude_deg" in track_csv(round_).splitlines()[0]


# -- bad input ---------------------------------------------------------------------------------------------------------

GOOD = "time_s,station,bearing_deg,east_m,north_m\n0,A,10,0,0\n0,B,12,100,0\n1,A,11,0,5\n1,B,13,100,5\n"


def changed(old, new):
    assert old in GOOD
    return GOOD.replace(old, new)


BAD = [
    (changed("1,A,11,0,5\n1,B,13,100,5", "1,A,11,0,5\n0.5,B,13,100,5"), "line 5: time goes back by 0.5 s; sort"),
    (changed("1,B,13,100,5", "1,A,13,0,5"), "line 5: station 'A' at 1 s has a row already .line 4."),
    (changed("bearing_deg", "bearing_grad"), "column 'bearing_grad' has the unknown unit 'grad', must be bearing_deg"),
    (changed("bearing_deg", "bearing"), "column 'bearing' has no unit, must be bearing_deg or bearing_rad"),
    (changed("east_m", "east_ft"), "column 'east_ft' has the unknown unit 'ft', must be east_m or east_km"),
    (changed("bearing_deg", "bearnig_deg"), "unknown column 'bearnig_deg'; did you mean 'bearing_deg'"),
    (changed("A,11", "A,nan"), "line 4, column 'bearing_deg': nan is not finite.*leave the cell empty"),
    (changed("A,11,0", "A,11,inf"), "line 4, column 'east_m': inf is not finite"),
    (changed("A,11", "A,eleven"), "line 4, column 'bearing_deg': 'eleven' is no number"),
    (changed("A,11", "A,400"), "line 4, column 'bearing_deg': 400 found, must be within one full turn"),
    (changed("A,11,0", "A,11,"), "line 4, column 'east_m': is empty"),
    (changed("1,A", "1,"), "line 4, column 'station': is empty"),
    (changed("1,A", ",A"), "line 4, column 'time_s': is empty"),
    (changed("1,A,11,0,5", "1,A,11,0"), "line 4: has 4 fields, must have 5"),
    (changed("time_s", "note"), "has neither time_s nor time_utc"),
    (changed("time_s", "time_utc"), "line 2, column 'time_utc': '0' found, must be an ISO 8601 time"),
    (changed("bearing_deg", "note_b"), "must have one column of a horizontal angle.*has none"),
    (changed("north_m", "note_n"), "line 1: has no column north"),
    (changed("east_m,north_m", "note_e,note_n"), "places must be east and north.*has neither"),
    (changed("east_m,north_m", "east_m,latitude_deg"), "places must be east and north.*has both"),
    (changed("east_m,north_m", "latitude_deg,longitude_deg"), "column 'latitude_deg': 100 found.*-90 to 90"),
    (changed("north_m", "east_km"), "'east_km' and 'east_m' tell the same"),
    (GOOD.splitlines()[0], "has a header but no rows"),
    ("", "is empty, must be a CSV file"),
    (GOOD.replace(",", ";"), "line 1: its columns are separated by ';', must be by commas"),
    (GOOD.replace(",", "\t"), "line 1: its columns are separated by '.t', must be by commas"),
    ('a,b\n"1', "is no CSV text"),
]


@pytest.mark.parametrize(("text", "words"), BAD, ids=[words[:40] for _, words in BAD])
def test_bad_files_are_refused(text, words, tmp_path):
    with pytest.raises(RecordingError, match=words):
        read_azimuths(write(tmp_path, text))
    assert issubclass(RecordingError, ValueError)


def test_bytes_that_are_no_text(tmp_path):
    (tmp_path / "file.csv").write_bytes(b"\xff\xfe\x00time")
    with pytest.raises(RecordingError, match="is no UTF-8 text"):
        read_azimuths(tmp_path / "file.csv")


ANGLE_ROWS = "time_s,azimuth_deg,elevation_deg,east_m,north_m,up_m,available\n"
SUM_ROWS = "time_s,transmitter,range_sum_m,east_m,north_m,transmitter_east_m,transmitter_north_m\n"


@pytest.mark.parametrize(
    ("read", "text", "words"),
    [
        (read_bearings, GOOD.replace("1,B,13,100,5", "1,A,11,0,5"), "has the row of line 4 twice"),
        (read_bearings, GOOD.replace("1,B,13,100,5", "1,A,,0,5"), "rows with and without an angle .line 4."),
        (read_bearings, GOOD.replace("1,B,13,100,5", "1,A,13,50,5"), "place of A is another than before"),
        (read_angles, GOOD, "has no column elevation"),
        (read_angles, ANGLE_ROWS + "0,1,2,0,0,0,yes\n", "available is 'yes', must be 1 or 0"),
        (read_angles, ANGLE_ROWS + "0,1,2,0,0,0,0\n", "available is 0, but the row has a return"),
        (read_angles, ANGLE_ROWS + "0,1,95,0,0,0,1\n", "'elevation_deg': 95 found, must be from -90 to 90"),
        (read_range_sums, GOOD, "unknown column 'station'"),
        (read_range_sums, SUM_ROWS + "0,T,-5,0,0,9,9\n", "'range_sum_m': -5 found, must be a positive length"),
        (read_range_sums, SUM_ROWS + "0,T,5,0,0,9,9\n0,T,6,0,0,9,9\n", "transmitter 'T' at 0 s has a row already"),
        (read_range_sums, SUM_ROWS + "0,T,5,0,0,9,9\n1,T,6,0,0,9,8\n", "line 3: the place of transmitter is another"),
        (read_range_sums, SUM_ROWS + "0,T,5,0,0,9,9\n0,U,6,1,0,9,8\n", "line 3: the place of receiver is another"),
    ],
)  # fmt: skip
def test_bad_rows_of_other_trackers_are_refused(read, text, words, tmp_path):
    with pytest.raises(RecordingError, match=words):
        read(write(tmp_path, text))


@pytest.mark.parametrize(
    ("tracker", "text", "more", "words"),
    [
        ("imm-mie", GOOD, {"reference": "C"}, "--reference 'C': must be one of the stations A, B"),
        ("imm-mie", GOOD, {"guess": (0.0, 0.0, 0.0, 0.0)}, "--guess: is not used"),
        ("imm-mie", GOOD, {"origin": (50.0, 8.0)}, "--origin: is not used"),
        ("imm-mie", GOOD, {"environment": "TwoStation"}, "is no environment for this recording"),
        ("imm-mie", GOOD, {"environment": "Tow"}, "unknown environment 'Tow'"),
        ("imm-mie", GOOD, {"fields": {"tracker": "ie"}}, "--tracker says which one runs"),
        ("imm-mie", GOOD, {"fields": {"stations": 3}}, "stations=3 among the fields: the recording says 2"),
        ("rp-ekf", GOOD, {"fields": {"targets": 3}}, "targets=3 among the fields: the recording says 1"),
        ("imm-mie", GOOD, {"fields": {"sites": "paper_good"}}, "sites among the fields: the recording says where"),
        ("imm-mie", GOOD, {"fields": {"target": 1}}, "has no field 'target'"),
        ("imm-mie", GOOD.replace("\n1,", "\n0.01,"), {}, "median time between scans is 0.01 s"),
        ("imm-mie", "\n".join(GOOD.splitlines()[:3]), {}, "has one scan"),
        ("imm-mie", GOOD.replace(",B,", ",A2,").replace(",A,", ",A2,"), {}, "has a row already"),
        ("imm-mie", "\n".join(r for r in GOOD.splitlines() if ",B," not in r), {}, "has one station"),
        ("imm-mie", GOOD + "2e5,A,1,0,0\n", {}, "median time"),
        ("imm-mie", GOOD + "2,A,1,0,0\n2e5,A,1,0,0\n", {}, "nothing from 2 s to 200000 s.*split the file there"),
        ("rp-ekf", GOOD.replace("1,B", "1,C"), {}, "has 3 stations, A, B, C; the bank weighs"),
        ("rp-ekf", GOOD, {"fields": {"nogo_discs": 1}}, "has no field 'nogo_discs'"),
        ("passive-radar", SUM_ROWS + "0,T,5,0,0,9,9\n1,T,6,0,0,9,9\n", {}, "--guess: range sums need one"),
        ("passive-radar", SUM_ROWS + "0,T,5,0,0,9,9\n1,T,6,0,0,9,9\n", {"guess": (1.0,)}, "--guess 1.0: must be 4"),
        (
            "passive-radar", SUM_ROWS + "0,T,5,0,0,9,9\n1,T,6,0,0,9,9\n", {"guess": (1.0, 2.0, 0.0, 0.0)},
            "has one transmitter, a track on range sums needs two",
        ),
        ("kalman", GOOD, {}, "--tracker 'kalman': must be one of rp-ekf"),
    ],
)  # fmt: skip
def test_what_does_not_fit_together_is_refused(tracker, text, more, words, tmp_path):
    with pytest.raises((ValueError, TypeError), match=words):
        open_playback(write(tmp_path, text), tracker, **more)


def test_too_few_scans_for_a_start_on_range_sums(tmp_path):
    rows = "".join(
        f"{t},{n},9e4,0,0,{x},{y}\n" for t in range(3) for n, x, y in (("T", 9e3, 0), ("U", 0, 9e3), ("V", 5e3, -9e3))
    )
    with pytest.raises(ValueError, match="has 3 scans, a track starts from acquisition_scans = 20: take fewer"):
        open_playback(write(tmp_path, SUM_ROWS + rows), "passive-radar", guess=(1e4, 4e4, 0.0, 0.0))


def test_stations_with_different_noise_are_refused_by_the_bank(tmp_path):
    text = (
        GOOD.replace("bearing_deg", "bearing_deg,bearing_std_deg").replace("A,11", "A,11,1").replace("B,13", "B,13,2")
    )
    text = text.replace("A,10", "A,10,1").replace("B,12", "B,12,1")
    with pytest.raises(ValueError, match="at 1 s stations differ in their bearings' standard deviation"):
        open_playback(write(tmp_path, text), "rp-ekf")


def test_trackers_go_by_their_families_names_and_their_own():
    assert find_family("rp-ekf") == ("rp-ekf", "rp_ekf")
    assert find_family("angle-pdaf-sequential") == ("angle-fusion", "angle_pdaf_sequential")
    assert find_family("imm3") == ("imm-mie", "imm3")
    assert all(find_family(name) == (title, name) for title in FAMILIES for name in FAMILIES[title].trackers
               if name not in FAMILIES)  # fmt: skip


# -- the command -------------------------------------------------------------------------------------------------------


def test_command_writes_track_advice_and_pictures(tmp_path, capsys):
    out = tmp_path / "out"
    assert cli.main(["track", "sample", "--tracker", "imm-mie", "--policy", "rule", "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert {file.name for file in out.iterdir()} == {"track.csv", "track.json", "track.png", "fit.png", "advice.csv"}
    rows = list(csv.DictReader(io.StringIO((out / "track.csv").read_text(encoding="utf-8"))))
    told = json.loads((out / "track.json").read_text(encoding="utf-8"))
    assert len(rows) == 71
    last = rows[-1]
    place = [float(last["east_m"]), float(last["north_m"])]
    assert place == pytest.approx(told["final"][0]["mean"][:2])
    assert float(last["std_east_m"]) ** 2 == pytest.approx(float(last["cov_east_east"]))
    assert float(last["model_1"]) + float(last["model_2"]) == pytest.approx(1.0)
    assert last["used"] == "S1 S2"
    assert rows[0]["nis"] == ""
    low, high = told["nis_per_degree_band95"]
    assert 0.5 < low < 1.0 < high < 2.0
    advice = list(csv.DictReader(io.StringIO((out / "advice.csv").read_text(encoding="utf-8"))))
    assert list(advice[0]) == ["time_s", "turn_S1_deg_s", "turn_S2_deg_s", "speed_S1_m_s", "speed_S2_m_s"]
    assert len(advice) == 71
    assert "next maneuver, by rule" in printed
    assert "range" in printed


def test_command_refuses_before_it_writes(tmp_path, capsys):
    file, out = write(tmp_path, changed("A,11", "A,nan")), tmp_path / "out"
    assert cli.main(["track", str(file), "--tracker", "imm-mie", "--out", str(out)]) == 2
    assert "nan is not finite" in capsys.readouterr().err
    assert cli.main(["track", str(tmp_path / "none.csv"), "--tracker", "imm-mie", "--out", str(out)]) == 2
    assert "none.csv: no such file" in capsys.readouterr().err
    assert cli.main(["track", str(tmp_path), "--tracker", "imm-mie", "--out", str(out)]) == 2
    assert f"{tmp_path}: no such file" in capsys.readouterr().err
    assert cli.main(["track", "sample", "--tracker", "imm-mie", "--policy", "nobody", "--out", str(out)]) == 2
    assert "unknown policy 'nobody'" in capsys.readouterr().err
    assert cli.main(["track", "sample", "--tracker", "imm-mie", "--policy", "oracle", "--out", str(out)]) == 2
    assert "looks at the truth" in capsys.readouterr().err
    assert not out.exists()


def test_policies_steer_as_many_stations_as_there_are(tmp_path):
    text = "time_s,azimuth_deg,elevation_deg,east_m,north_m,up_m\n0,1,2,0,0,5000\n2,1,2,0,300,5000\n4,2,,0,600,5000\n"
    playback = open_playback(write(tmp_path, text), "angle-fusion")[1]
    assert follow(playback).fits[1][:, 0].tolist() == [0, 2, 1]
    told = ["track", str(tmp_path / "file.csv"), "--tracker", "angle-fusion", "--policy", "rule", "--out"]
    assert cli.main([*told, str(tmp_path / "out")]) == 2
    assert not (tmp_path / "out").exists()


def test_steps_of_times_since_1970_are_round(tmp_path):
    rows = "".join(f"{1.7e9 + 0.1 * k:.3f},A,{k},0,0\n{1.7e9 + 0.1 * k:.3f},B,{k},9,0\n" for k in range(5))
    head = "time_s,station,bearing_deg,east_m,north_m\n"
    assert open_playback(write(tmp_path, head + rows), "imm-mie")[1].scenario.step_s == 0.1
    assert open_playback(write(tmp_path, GOOD + "1.6,A,1,0,0\n"), "imm-mie")[1].scenario.step_s == 0.8


def test_range_and_its_spread_are_those_along_the_line_of_sight(tmp_path):
    track = follow(open_playback("sample", "imm-mie")[1])
    distance, std, bearing = track.sights
    line = track.mean[-1, 0, :2] - track.platforms[-1, -1, :2]
    assert distance[-1, 0] == pytest.approx(np.hypot(*line))
    assert bearing[-1, 0] == pytest.approx(math.degrees(math.atan2(line[0], line[1])) % 360.0)
    unit = line / np.hypot(*line)
    assert std[-1, 0] ** 2 == pytest.approx(unit @ track.cov[-1, 0, :2, :2] @ unit)


def test_advice_of_a_radar_names_transmitters():
    playback = opened("passive-radar", "sample")
    track = follow(playback, make_policy("round_robin", playback.scenario))
    listen = [row["listen"].split() for row in advice_rows(track)]
    assert {name for names in listen for name in names} == set(playback.recording.names)
    assert all(len(names) == 2 for names in listen)
