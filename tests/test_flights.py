"""Recorded flights: reading, cleaning, the smooth path, windows, the split by aircraft, and every kind of bad file."""

import csv
import gzip
import io
import math
from dataclasses import fields
from datetime import UTC, datetime, timedelta
from importlib import resources
from itertools import pairwise

import numpy as np
import pymap3d
import pytest

from passive_env import flight_path, flights
from passive_env.flight_cleaning import GAP_S, MIN_DURATION_S
from passive_env.flight_file import FOOT_M, KNOT_M_S
from passive_env.flights import FlightFileError, FlightPaths, FlightReport, load_flights

HEADER = [
    "timestamp",
    "icao24",
    "callsign",
    "latitude",
    "longitude",
    "altitude",
    "groundspeed",
    "track",
    "vertical_rate",
]
START = datetime(2024, 5, 1, 10, 0, 0, tzinfo=UTC)
ORIGIN = (47.0, 8.0, 3000.0)


# ------------------------------------------------------------------------------------------------ synthetic files


def straight(time_s, speed_m_s=100.0, course=0.7):
    """East, north [n, 2] m and velocity [n, 2] m/s of a straight flight; course in rad clockwise from north."""
    velocity = speed_m_s * np.array([math.sin(course), math.cos(course)])
    return time_s[:, None] * velocity, np.tile(velocity, (len(time_s), 1))


def circle(time_s, speed_m_s=100.0, radius_m=1500.0):
    """A full-bank survey turn: 6.7 m/s² at 100 m/s."""
    angle = speed_m_s / radius_m * time_s
    position = radius_m * np.stack([np.sin(angle), 1 - np.cos(angle)], axis=1)
    return position, speed_m_s * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def rows_of(path, time_s, icao24="abc123", callsign="TEST1", late_s=0.0):
    """CSV rows of a level flight over ORIGIN; late_s [n] shifts the position's time, as receivers do."""
    east_north, _ = path(time_s - late_s)
    _, velocity = path(time_s)
    lat, lon, _ = pymap3d.enu2geodetic(east_north[:, 0], east_north[:, 1], np.zeros(len(time_s)), *ORIGIN)
    knots = np.hypot(*velocity.T) / KNOT_M_S
    track = np.degrees(np.arctan2(velocity[:, 0], velocity[:, 1])) % 360
    feet = ORIGIN[2] / FOOT_M
    return [
        [str(START + timedelta(seconds=float(t))), icao24, callsign, f"{a:.6f}", f"{b:.6f}", f"{feet:.0f}", f"{v:.1f}",
         f"{c:.2f}", "0"]
        for t, a, b, v, c in zip(time_s, lat, lon, knots, track, strict=True)
    ]  # fmt: skip


def text_of(rows, header=HEADER):
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([header, *rows])
    return text.getvalue()


@pytest.fixture
def load_rows(tmp_path):
    """Write rows to a file of the test's own folder and load it."""

    def load(rows, header=HEADER):
        path = tmp_path / "own.csv"
        path.write_text(text_of(rows, header), encoding="utf-8")
        return load_flights(path)

    return load


@pytest.fixture
def good_rows():
    return rows_of(straight, np.arange(0.0, 200.0, 4.0))


@pytest.fixture(scope="module")
def library():
    return load_flights()


# ------------------------------------------------------------------------------------------------ the shipped file


def test_report_accounts_for_every_row_of_the_shipped_file(library):
    report = library.report
    assert report.rows_read == 27149
    assert report.rows_kept == sum(len(flight.time_s) for flight in library.flights)
    assert report.rows_kept + sum(report.dropped.values()) == report.rows_read
    assert (report.flights_kept, report.aircraft_kept) == (len(library.flights), 100)
    assert report.rows_kept > 0.95 * report.rows_read
    assert report.dropped_repeated_position > 1000  # frozen ends of approaches
    assert all(str(getattr(report, f.name)) in str(report) for f in fields(FlightReport) if getattr(report, f.name))


def test_shipped_flights_are_finite_increasing_and_gap_free(library):
    for flight in library.flights:
        assert flight.time_s[0] == 0
        assert np.diff(flight.time_s).min() > 0
        assert np.diff(flight.time_s).max() <= GAP_S
        assert np.isfinite(flight.position_m).all()
        np.testing.assert_allclose(flight.position_m[0, :2], 0, atol=1e-6)
        assert flight.duration_s >= MIN_DURATION_S


def test_split_shares_no_aircraft_and_loses_none(library):
    train, test = library.split("train"), library.split("test")
    in_train, in_test = ({flight.icao24 for flight in part.flights} for part in (train, test))
    assert in_train.isdisjoint(in_test)
    assert len(train.flights) + len(test.flights) == len(library.flights)
    assert 0.2 < len(in_test) / len(in_train | in_test) < 0.4
    assert library.split("all") is library


def test_split_is_the_same_on_every_machine(library):
    """CRC-32 (zlib) written out, and the survey aircraft's part as documented."""
    crc = 0xFFFFFFFF
    for byte in b"39b002":
        crc ^= byte
        for _ in range(8):
            crc = (crc >> 1) ^ (0xEDB88320 if crc & 1 else 0)
    assert flights.is_test("39b002") == ((crc ^ 0xFFFFFFFF) / 2**32 < flights.TEST_SHARE)
    survey = [flight for flight in library.split("train").flights if flight.callsign.startswith("SAVAN")]
    assert len({flight.icao24 for flight in survey}) == 1
    assert len(survey) >= 8
    assert not any(flight.callsign.startswith("SAVAN") for flight in library.split("test").flights)


def test_unknown_part_names_the_allowed_ones(library):
    with pytest.raises(ValueError, match=r"train, test, all.*'validation'"):
        library.split("validation")


def test_part_without_aircraft_is_an_error(load_rows, good_rows):
    library = load_rows(good_rows)
    other = "train" if flights.is_test("abc123") else "test"
    with pytest.raises(ValueError, match=r"own\.csv.*'all'"):
        library.split(other)


def test_resampled_speed_agrees_with_recorded_ground_speed(library):
    """Ground speed read from the file again, without the loader; matched by aircraft and time of day."""
    recorded = {}
    with gzip.open(resources.files("passive_env") / "data/flights.csv.gz", "rt") as file:
        for row in csv.DictReader(file):
            recorded.setdefault((row["icao24"], row["callsign"]), set()).add(float(row["groundspeed"]) * 1852 / 3600)
    difference = []
    for flight in library.flights:
        speed = np.hypot(*flight.path(flight.time_s, nu=1)[:, :2].T)
        own = np.hypot(*flight.velocity_m_s[:, :2].T)
        known = np.array(sorted(recorded[flight.icao24, flight.callsign]))
        assert np.abs(own[:, None] - known).min(axis=1).max() < 1.5  # only the tangent plane and the climb between them
        difference.append(speed - own)
    difference = np.abs(np.concatenate(difference))
    assert np.median(difference) < 0.5
    assert np.percentile(difference, 99) < 2.5


def test_path_predicts_rows_it_has_not_seen(library):
    """Every third row left out: its recorded velocity is met within 1 m/s, its position across the track within 5 m."""
    speed_error, across = [], []
    for flight in library.flights[::4]:
        seen = np.arange(len(flight.time_s)) % 3 != 1
        seen[-1] = True
        path = flight_path.fit_path(
            flight.time_s[seen], flight.position_m[seen, :2], flight.velocity_m_s[seen, :2], 30.0, 1.5, 0.1
        )
        velocity = path(flight.time_s[~seen], nu=1)
        speed_error.append(np.linalg.norm(velocity - flight.velocity_m_s[~seen, :2], axis=1))
        residual = flight.position_m[~seen, :2] - path(flight.time_s[~seen])
        normal = np.stack([velocity[:, 1], -velocity[:, 0]], axis=1) / np.linalg.norm(velocity, axis=1)[:, None]
        across.append(np.abs(np.sum(residual * normal, axis=1)))
    assert np.median(np.concatenate(speed_error)) < 1.0
    assert np.median(np.concatenate(across)) < 5.0


def test_recorded_positions_lie_on_the_path(library):
    """Independent of the velocities: chords of a minute between recorded positions equal the path's chords."""
    ratio = []
    for flight in library.flights:
        later = np.searchsorted(flight.time_s, flight.time_s + 60.0)
        first = np.flatnonzero(later < len(flight.time_s))
        later = later[first]
        path = flight.path(flight.time_s)
        chords = [np.linalg.norm(p[later, :2] - p[first, :2], axis=1) for p in (flight.position_m, path)]
        ratio.append(chords[1][chords[0] > 500] / chords[0][chords[0] > 500])
    ratio = np.concatenate(ratio)
    assert abs(np.median(ratio) - 1) < 1e-3
    assert np.percentile(np.abs(ratio - 1), 95) < 0.05


def test_accelerations_are_those_of_aircraft(library):
    """Below 1 g everywhere (a 40° bank is 8.2 m/s²); airliners and cruise far less."""
    acceleration = [flight.path(np.arange(0, flight.duration_s, 1.0), nu=2) for flight in library.flights]
    level = np.hypot(*np.concatenate(acceleration)[:, :2].T)
    climb = np.abs(np.concatenate(acceleration)[:, 2])
    assert level.max() < 9.0
    assert np.percentile(level, [50, 90, 99]) == pytest.approx([0.09, 0.86, 4.54], rel=0.1)
    assert climb.max() < 2.0
    assert np.percentile(climb, 99) < 0.7


# ------------------------------------------------------------------------------------------------ geometry


def ecef(lat, lon, alt):
    """WGS84 degrees, metres to earth-centred coordinates, from the ellipsoid's definition."""
    a, f = 6378137.0, 1 / 298.257223563
    e2 = f * (2 - f)
    lat, lon = math.radians(lat), math.radians(lon)
    n = a / math.sqrt(1 - e2 * math.sin(lat) ** 2)
    cos = math.cos(lat)
    return np.array(
        [(n + alt) * cos * math.cos(lon), (n + alt) * cos * math.sin(lon), (n * (1 - e2) + alt) * math.sin(lat)]
    )


def east_north_axes(lat, lon):
    lat, lon = math.radians(lat), math.radians(lon)
    east = [-math.sin(lon), math.cos(lon), 0.0]
    north = [-math.sin(lat) * math.cos(lon), -math.sin(lat) * math.sin(lon), math.cos(lat)]
    return np.array([east, north])


def test_east_north_equals_the_ellipsoid_formula(load_rows):
    """Cruise eastward for 200 km: positions, and velocities turned into the first row's axes."""
    time_s = np.arange(0.0, 900.0, 10.0)
    rows = rows_of(lambda t: straight(t, 230.0, 1.4), time_s)
    rows[0][5], rows[40][5] = "9700", "9900"
    flight = load_rows(rows).flights[0]
    first, row = ([float(v) for v in rows[i][3:8]] for i in (0, 40))
    axes = east_north_axes(*first[:2])
    expected = axes @ (ecef(row[0], row[1], row[2] * 0.3048) - ecef(first[0], first[1], first[2] * 0.3048))
    np.testing.assert_allclose(flight.position_m[40, :2], expected, atol=1e-3)
    assert flight.position_m[40, 2] == pytest.approx(9900 * 0.3048)
    course = math.radians(row[4])
    moving = row[3] * 1852 / 3600 * np.array([math.sin(course), math.cos(course)])
    np.testing.assert_allclose(flight.velocity_m_s[40, :2], axes @ east_north_axes(*row[:2]).T @ moving, atol=1e-6)


def test_velocity_is_the_derivative_of_position(library):
    flight = library.flights[-1]
    grid, eps = np.arange(1.0, flight.duration_s - 1.0, 7.3), 1e-3
    slope = (flight.path(grid + eps) - flight.path(grid - eps)) / (2 * eps)
    np.testing.assert_allclose(flight.path(grid, nu=1), slope, atol=1e-5)
    states = library.resample(0.5).states[:2000]
    mean_velocity = 0.5 * (states[1:, 3:] + states[:-1, 3:])
    np.testing.assert_allclose(np.diff(states[:, :3], axis=0) / 0.5, mean_velocity, atol=0.05)


@pytest.mark.parametrize("late_s", [0.0, 0.3], ids=["clean", "jitter"])
def test_tight_circle_keeps_its_shape_and_speed(load_rows, late_s):
    """A 6.7 m/s² turn, a row every 4 s, 1 knot steps, positions stamped 0.3 s wrong: a few metres to two dozen."""
    time_s = np.arange(0.0, 240.0, 4.0)
    late = late_s * np.random.default_rng(3).standard_normal(len(time_s))
    rows = rows_of(circle, time_s, late_s=late)
    for row in rows:
        row[6] = str(round(float(row[6])))
    library = load_rows(rows)
    states = library.resample(1.0).states[5:-5]
    position, velocity = circle(np.arange(5.0, 5.0 + len(states)))
    shift = circle(-late[:1])[0] if late_s else 0.0  # the origin is the first recorded position
    error = np.linalg.norm(states[:, :2] + shift - position, axis=1)
    assert library.report.rows_kept == len(rows)
    assert error.max() < (5.0 if late_s == 0 else 30.0)
    assert np.abs(np.hypot(*states[:, 3:5].T) - 100).max() < 1.5
    assert np.linalg.norm(states[:, 3:5] - velocity, axis=1).max() < 3.0


def test_turn_onset_is_not_rounded_off(load_rows):
    """Straight, then a 6.7 m/s² turn from one instant to the next, between two rows: cut by less than 20 m."""

    def path(t):
        corner = 50.0
        before, after = straight(t, 100.0, math.pi / 2), circle(t - corner)
        turned = after[0] + straight(np.array([corner]), 100.0, math.pi / 2)[0], after[1]
        return tuple(np.where(t[:, None] < corner, b, a) for b, a in zip(before, turned, strict=True))

    states = load_rows(rows_of(path, np.arange(0.0, 120.0, 4.0))).resample(1.0).states
    error = states[:, :2] - path(np.arange(float(len(states))))[0]
    assert np.linalg.norm(error, axis=1).max() < 20.0


def test_cubic_basis_sums_to_one_and_its_derivative_to_zero():
    _, values, slopes = flight_path._cubic_basis(np.linspace(0.0, 12.0, 50), 4.0, 3)
    np.testing.assert_allclose(values.sum(axis=1), 1.0)
    np.testing.assert_allclose(slopes.sum(axis=1), 0.0, atol=1e-15)


def test_banded_least_squares_equals_dense_least_squares():
    rng = np.random.default_rng(0)
    first = np.sort(rng.integers(0, 7, 40))
    first[-1] = 6
    design, target, weight = rng.standard_normal((40, 4)), rng.standard_normal((40, 2)), rng.uniform(0.5, 2, 40)
    dense = np.zeros((40, 10))
    for row, start in enumerate(first):
        dense[row, start : start + 4] = design[row]
    root = np.sqrt(weight)[:, None]
    expected = np.linalg.lstsq(root * dense, root * target, rcond=None)[0]
    column = first[:, None] + np.arange(4)
    np.testing.assert_allclose(flight_path._banded_least_squares(design, column, target, weight), expected, atol=1e-9)


# ------------------------------------------------------------------------------------------------ windows


def test_window_starts_equal_a_loop(library):
    paths, steps = library.resample(5.0), 150
    expected = []
    for start, stop in zip(paths.flight_start[:-1], paths.flight_start[1:], strict=True):
        expected += [row for row in range(start, stop) if row + steps < stop]
    np.testing.assert_array_equal(paths.window_starts(steps), expected)


@pytest.mark.parametrize("turning_s", [0.0, 4.0, 11.0])
def test_turning_starts_equal_a_loop(turning_s):
    paths = load_flights().split("test").resample(2.0)
    turning, expected = paths.turning_starts(20, 2.0, turning_s), []
    for start in paths.window_starts(20)[::7]:
        velocity = paths.states[start : start + 21, 3:5]
        hard = sum(math.dist(a, b) / 2.0 > 2.0 for a, b in pairwise(velocity))
        if 2.0 * hard >= turning_s:
            expected.append(start)
    assert expected
    assert np.array_equal(turning[np.isin(turning, paths.window_starts(20)[::7])], expected)


def test_windows_equal_a_loop(library):
    paths, steps = library.resample(2.0), 45
    uniforms = np.random.default_rng(1).random((5, 3))
    uniforms[0, :2] = 0.0, np.nextafter(1.0, 0.0)
    windows = paths.windows(uniforms, steps)
    starts = paths.window_starts(steps)
    assert windows.shape == (5, 3, 46, 6)
    for index in np.ndindex(5, 3):
        start = starts[int(uniforms[index] * len(starts))]
        np.testing.assert_array_equal(windows[index], paths.states[start : start + steps + 1])


def test_no_windows_from_no_uniforms(library):
    assert library.resample(5.0).windows(np.empty((0, 3)), 60).shape == (0, 3, 61, 6)


def test_windows_do_not_share_memory_with_the_library(library):
    paths = library.resample(5.0)
    windows = paths.windows(np.array(0.25), 10)
    windows[:] = -1.0
    assert not (paths.windows(np.array(0.25), 10) == -1.0).any()


def test_every_start_row_is_equally_likely():
    """Flights of 4, 2 and 6 rows and windows of 3: rows 0, 1 and 6..9 start one, each with a share of 1/6."""
    states = np.arange(12.0)[:, None] * np.ones(6)
    paths = FlightPaths(1.0, states, np.array([0, 4, 6, 12]), "three")
    np.testing.assert_array_equal(paths.window_starts(2), [0, 1, 6, 7, 8, 9])
    midpoints = (np.arange(6) + 0.5) / 6
    np.testing.assert_array_equal(paths.windows(midpoints, 2)[:, 0, 0], [0, 1, 6, 7, 8, 9])


def test_window_longer_than_every_flight_names_the_longest(library):
    with pytest.raises(
        ValueError, match=r"flights\.csv\.gz lasts 5000 s \(1000 steps of 5 s\); the longest lasts 2400 s"
    ):
        library.resample(5.0).windows(np.array([0.5]), 1000)


@pytest.mark.parametrize("bad", [-0.1, 1.0, math.nan])
def test_uniforms_outside_the_unit_interval_are_refused(library, bad):
    with pytest.raises(ValueError, match=r"\[0, 1\)"):
        library.resample(5.0).windows(np.array([0.5, bad]), 10)


@pytest.mark.parametrize("bad", [0.0, -1.0, math.nan, math.inf])
def test_step_must_be_positive(library, bad):
    with pytest.raises(ValueError, match="step_s"):
        library.resample(bad)


def test_negative_steps_are_refused(library):
    with pytest.raises(ValueError, match="steps"):
        library.resample(5.0).window_starts(-1)


def test_each_flight_starts_at_its_first_row_and_stays_within_its_last(library):
    for step_s in (1.0, 2.0, 0.1 * 3):
        paths = library.resample(step_s)
        lengths = np.diff(paths.flight_start)
        durations = np.array([flight.duration_s for flight in library.flights])
        assert np.all((lengths - 1) * step_s <= durations + 1e-6)
        assert np.all(lengths * step_s > durations)
        assert np.isfinite(paths.states).all()


# ------------------------------------------------------------------------------------------------ cleaning


def test_good_rows_are_all_kept(load_rows, good_rows):
    library = load_rows(good_rows)
    assert library.report == FlightReport(rows_read=50, rows_kept=50, flights_kept=1, aircraft_kept=1)
    assert (library.flights[0].icao24, library.flights[0].callsign) == ("abc123", "TEST1")
    assert "rows dropped: none" in str(library.report)


def test_duplicate_times_are_dropped(load_rows, good_rows):
    report = load_rows([*good_rows[:11], good_rows[10], *good_rows[11:]]).report
    assert (report.dropped_duplicate_time, report.rows_kept) == (1, 50)


def test_unsorted_rows_are_sorted(load_rows, good_rows):
    tidy = load_rows(good_rows).flights[0]
    library = load_rows([*good_rows[25:], *good_rows[:25]])
    assert library.report.rows_out_of_order == 1
    assert library.report.rows_kept == 50
    np.testing.assert_array_equal(library.flights[0].position_m, tidy.position_m)


def test_frozen_position_is_dropped_while_the_aircraft_moves(load_rows, good_rows):
    for row in good_rows[21:24]:
        row[3:5] = good_rows[20][3:5]
    report = load_rows(good_rows).report
    assert (report.dropped_repeated_position, report.rows_kept, report.flights_kept) == (3, 47, 1)


def test_hovering_aircraft_is_not_dropped(load_rows):
    rows = rows_of(lambda t: straight(t, 0.0), np.arange(0.0, 200.0, 4.0))
    assert load_rows(rows).report.rows_kept == 50


@pytest.mark.parametrize("at", [0, 1, 25, 49])
@pytest.mark.parametrize(("column", "value"), [(3, "47.2"), (3, "0.0"), (4, "8.4"), (5, "30000")])
def test_single_wild_values_are_dropped(load_rows, good_rows, at, column, value):
    tidy = load_rows(good_rows).resample(2.0)
    good_rows[at][column] = value
    library = load_rows(good_rows)
    assert (library.report.dropped_jump, library.report.rows_kept) == (1, 49)
    if 0 < at < 49:
        np.testing.assert_allclose(library.resample(2.0).states, tidy.states, atol=1.0)


def test_stale_velocities_do_not_bend_the_path(load_rows):
    """Two rows of a turn repeat an old velocity, one position is 200 m late: the circle stays."""
    rows = rows_of(circle, np.arange(0.0, 200.0, 4.0))
    rows[21][6:8] = rows[22][6:8] = rows[18][6:8]
    rows[30][3:5] = rows_of(circle, np.array([118.0]))[0][3:5]
    states = load_rows(rows).resample(1.0).states
    assert np.linalg.norm(states[:, :2] - circle(np.arange(len(states)))[0], axis=1).max() < 25.0


def test_gap_splits_the_flight(load_rows, good_rows):
    library = load_rows(good_rows[:20] + good_rows[30:])
    assert (library.report.splits_at_gap, library.report.flights_kept, library.report.rows_kept) == (1, 2, 40)
    assert [len(flight.time_s) for flight in library.flights] == [20, 20]
    np.testing.assert_allclose(library.flights[1].position_m[0, :2], 0, atol=1e-6)


def test_lasting_jump_splits_the_flight(load_rows, good_rows):
    for row in good_rows[25:]:
        row[3] = f"{float(row[3]) + 0.05:.6f}"
    report = load_rows(good_rows).report
    assert (report.splits_at_jump, report.flights_kept, report.rows_kept) == (1, 2, 50)


def test_aircraft_in_one_file_are_kept_apart(load_rows, good_rows):
    other = rows_of(lambda t: straight(t, 80.0, 2.0), np.arange(0.0, 200.0, 4.0), icao24="DEF456", callsign="")
    mixed = [row for pair in zip(good_rows, other, strict=True) for row in pair]
    library = load_rows(mixed)
    assert [(flight.icao24, flight.callsign) for flight in library.flights] == [("abc123", "TEST1"), ("def456", "")]
    assert library.report.rows_out_of_order == 0


@pytest.mark.parametrize("column", [0, 1, 3, 4, 5, 6, 7, 8])
@pytest.mark.parametrize("empty", ["", "nan", "NaT", " "])
def test_row_with_a_missing_value_is_dropped_and_counted(load_rows, good_rows, column, empty):
    good_rows[7][column] = empty
    report = load_rows(good_rows).report
    assert (report.dropped_missing_value, report.rows_kept) == (1, 49)


def test_short_pieces_are_dropped_and_counted(load_rows, good_rows):
    report = load_rows([*good_rows[:30], *good_rows[39:]]).report
    assert (report.dropped_too_short, report.rows_kept, report.flights_kept) == (11, 30, 1)


def test_timestamps_with_z_fractions_and_offsets(load_rows, good_rows):
    tidy = load_rows(good_rows).flights[0].time_s
    good_rows[1][0] = "2024-05-01T10:00:04Z"
    good_rows[2][0] = "2024-05-01 10:00:08.250000+00:00"
    good_rows[3][0] = "2024-05-01 12:00:12+02:00"
    time_s = load_rows(good_rows).flights[0].time_s
    np.testing.assert_allclose(time_s - tidy, np.eye(50)[2] * 0.25, atol=1e-6)


def test_columns_in_any_order_and_further_ones(load_rows, good_rows):
    order = [8, 3, 1, 0, 2, 7, 6, 5, 4]
    rows = [[str(i), *(row[j] for j in order), "False"] for i, row in enumerate(good_rows)]
    library = load_rows(rows, ["", *(HEADER[j] for j in order), "onground"])
    np.testing.assert_array_equal(library.flights[0].position_m, load_rows(good_rows).flights[0].position_m)


def test_gzip_is_recognised_by_its_content(tmp_path, good_rows):
    text = "\ufeff" + text_of(good_rows).replace("\n", "\r\n") + "\r\n"
    for name, content in {"a.csv": gzip.compress(text.encode()), "b.gz": text.encode()}.items():
        (tmp_path / name).write_bytes(content)
        library = load_flights(str(tmp_path / name))
        assert library.report.rows_kept == 50
        assert library.source == str(tmp_path / name)


# ------------------------------------------------------------------------------------------------ bad files


@pytest.mark.parametrize(
    ("column", "value", "expected"),
    [
        ("timestamp", "yesterday", "ISO 8601"),
        ("timestamp", "2024-05-01 10:00:20", "UTC offset"),
        ("latitude", "47,1", "from -90 to 90"),
        ("latitude", "north", "from -90 to 90"),
        ("latitude", "91.0", "from -90 to 90"),
        ("longitude", "-180.5", "from -180 to 180"),
        ("altitude", "FL100", "feet"),
        ("altitude", "inf", "feet"),
        ("groundspeed", "-3", "from 0 to 5000"),
        ("track", "NNE", "clockwise from north"),
        ("vertical_rate", "level", "feet per minute"),
    ],
)
def test_malformed_value_names_file_line_column_and_value(load_rows, good_rows, column, value, expected):
    good_rows[5][HEADER.index(column)] = value
    with pytest.raises(FlightFileError) as error:
        load_rows(good_rows)
    message = str(error.value)
    assert "own.csv, line 7, " in message  # the header is line 1
    assert all(part in message for part in (f"column '{column}'", repr(value), expected))


def test_missing_columns_are_named(load_rows, good_rows):
    with pytest.raises(
        FlightFileError, match=r"own\.csv, line 1: columns latitude, track missing; found timestamp, .*"
    ):
        load_rows(good_rows, [{"latitude": "lat", "track": "heading"}.get(name, name) for name in HEADER])


def test_column_named_twice(load_rows, good_rows):
    with pytest.raises(FlightFileError, match=r"own\.csv, line 1: column track .*twice"):
        load_rows([[*row, "1"] for row in good_rows], [*HEADER, "track"])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda row: row[:-1], r"own\.csv, line 12: column 'vertical_rate' is not there; 8 fields, expected 9"),
        (lambda row: [*row, "extra"], r"own\.csv, line 12: value 'extra' after the last column.*10 fields, expected 9"),
    ],
    ids=["short", "long"],
)
def test_row_of_wrong_length(load_rows, good_rows, change, message):
    good_rows[10] = change(good_rows[10])
    with pytest.raises(FlightFileError, match=message):
        load_rows(good_rows)


def test_blank_lines_are_skipped_and_do_not_shift_line_numbers(tmp_path, good_rows):
    good_rows[5][3] = "bad"
    lines = text_of(good_rows).splitlines()
    (tmp_path / "own.csv").write_text("\n".join([*lines[:3], "", *lines[3:]]))
    with pytest.raises(FlightFileError, match=r"line 8, column 'latitude': 'bad'"):
        load_flights(tmp_path / "own.csv")


def test_file_without_usable_flight_says_why(load_rows, good_rows):
    with pytest.raises(FlightFileError, match=r"own\.csv: no usable flight; .*10 rows read, 0 kept.*10 too short"):
        load_rows(good_rows[:10])
    for row in good_rows:
        row[6] = ""
    with pytest.raises(FlightFileError, match=r"no usable flight.*50 missing value"):
        load_rows(good_rows)


def test_speed_in_the_wrong_unit_is_noticed(load_rows, good_rows):
    for row in good_rows:
        row[6] = str(float(row[6]) * 1852 / 3600)
    with pytest.raises(FlightFileError, match="speed mismatch"):
        load_rows(good_rows)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "line 1: columns timestamp, .*an empty line"),
        (",".join(HEADER).encode(), "no rows"),
        (gzip.compress(b"timestamp", mtime=0)[:-9], "damaged gzip"),
        (b"\x1f\x8b\x00\x00", "damaged gzip"),
        (b"\xff\xfe\x00bad", "not UTF-8"),
    ],
)
def test_not_a_flights_file(tmp_path, content, message):
    path = tmp_path / "own.csv"
    path.write_bytes(content)
    with pytest.raises(FlightFileError, match=rf"own\.csv.*{message}"):
        load_flights(path)


def test_file_that_is_not_there(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.csv"):
        load_flights(tmp_path / "none.csv")


def test_random_tables_never_give_nan_or_an_unexpected_error(load_rows, good_rows):
    """Single values shuffled between rows, at random: the loader keeps, drops or refuses, and every row is counted."""
    rng = np.random.default_rng(7)
    for _ in range(20):
        rows = [list(row) for row in good_rows]
        for _ in range(40):
            i, j, column = rng.integers(50), rng.integers(50), rng.integers(9)
            rows[i][column] = rows[j][column] if rng.random() < 0.7 else ""
        try:
            library = load_rows(rows)
        except FlightFileError:
            continue
        assert library.report.rows_kept + sum(library.report.dropped.values()) == 50
        assert np.isfinite(library.resample(1.0).states).all()
