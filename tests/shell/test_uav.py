"""Flights made here: a vehicle whose samples are known, written as CSV topics or as a ulog."""

import struct
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from holdfast.plants.build import linear_plant
from holdfast.plants.library.uav import build
from holdfast.shell.errors import InputError
from holdfast.shell.uav import read_flight

PLANT = build(dt=0.2)
LAT, LON, ALT = 47.0, 8.0, 500.0


def gps(time, **columns):
    """A GPS topic; position wanders with the sample's number so that every value is unique."""
    n = len(time)
    i = np.arange(n)
    topic = {
        "timestamp": np.rint(np.asarray(time) * 1e6),
        "lat": np.rint((LAT + 1e-6 * i) * 1e7),
        "lon": np.rint((LON - 2e-6 * i) * 1e7),
        "alt": np.rint((ALT + 0.5 * i) * 1e3),
        "vel_n_m_s": 0.1 * i,
        "vel_e_m_s": -0.2 * i,
        "vel_d_m_s": 0.3 * i,
        "fix_type": np.full(n, 3),
        "vel_ned_valid": np.ones(n),
        "s_variance_m_s": 0.3 + 0.01 * i,
        "eph": np.full(n, 1.5),
    }
    return topic | {name: np.asarray(value) for name, value in columns.items()}


def baro(time, height=None):
    height = 100.0 + 0.01 * np.arange(len(time)) if height is None else height
    return {"timestamp": np.rint(np.asarray(time) * 1e6), "baro_alt_meter": np.asarray(height)}


def write(folder, prefix="", **topics):
    """CSV files named after the topics."""
    for name, topic in topics.items():
        rows = zip(*([repr(float(v)) for v in column] for column in topic.values()), strict=True)
        text = "\n".join([",".join(topic), *map(",".join, rows)]) + "\n"
        (folder / f"{prefix}{name}.csv").write_text(text)
    return folder


def flight(folder, gps_topic, baro_topic, **options):
    write(folder, vehicle_gps_position=gps_topic, vehicle_air_data=baro_topic)
    return read_flight(folder, PLANT, **options)


def every(dt, count, start=10.0):
    return start + dt * np.arange(count)


def test_each_sample_lies_in_the_row_nearest_to_it(tmp_path):
    jitter = 0.04 * np.sin(np.arange(51))
    f = flight(tmp_path, gps(every(1.0, 11) + 0.01), baro(every(0.2, 51) + jitter))
    o = f.log.observation
    assert o.y.shape == (51, 7)
    np.testing.assert_allclose(np.diff(f.log.time), 0.2, rtol=1e-9)
    np.testing.assert_array_equal(np.flatnonzero(o.seen[:, 0]), np.arange(0, 51, 5))
    assert np.all(o.seen[:, 6])
    np.testing.assert_allclose(o.y[:, 6], 0.01 * np.arange(51), atol=1e-12)
    np.testing.assert_allclose(o.y[::5, 3], 0.1 * np.arange(11), rtol=1e-12)
    np.testing.assert_allclose(o.y[::5, 2], -0.5 * np.arange(11), atol=1e-9)
    assert np.all(np.asarray(o.y)[~np.asarray(o.seen)] == 0)
    assert f.counts["gps"].used == 11
    assert f.counts["gps"].missing == 0
    assert not np.any(o.trusted)


def test_sensors_half_a_row_apart_do_not_compete_for_rows(tmp_path):
    # rows anchored at the GPS would put neighbouring heights, 0.1 s off +- 0.03 s, into one row
    jitter = 0.03 * np.array([1, -1])[np.arange(200) % 2]
    f = flight(tmp_path, gps(every(1.0, 40)), baro(every(0.2, 200) + 0.1 + jitter))
    assert f.counts["baro"].used == 200
    assert f.counts["gps"].used == 40


def test_a_missing_sample_leaves_its_row_empty(tmp_path):
    keep = np.r_[0:7, 9:30]
    f = flight(tmp_path, gps(np.delete(every(1.0, 9), 2)), baro(every(0.2, 41)[keep]))
    seen = np.asarray(f.log.observation.seen)
    assert np.flatnonzero(~seen[:30, 6]).tolist() == [7, 8]
    assert np.flatnonzero(seen[:, 0]).tolist() == [0, 5, 15, 20, 25, 30, 35, 40]
    assert (f.counts["baro"].missing, f.counts["gps"].missing) == (2, 1)


def test_of_two_samples_for_one_row_the_nearer_stays(tmp_path):
    time = np.sort(np.r_[every(1.0, 5), 12.06])
    f = flight(tmp_path, gps(time), baro(every(0.2, 21)))
    rows = np.flatnonzero(f.log.observation.seen[:, 0])
    assert rows.tolist() == [0, 5, 10, 15, 20]
    np.testing.assert_allclose(f.log.observation.y[rows, 3], [0, 0.1, 0.2, 0.4, 0.5], rtol=1e-12)
    assert (f.counts["gps"].used, f.counts["gps"].duplicate) == (5, 1)


def test_a_sample_past_the_tolerance_is_late(tmp_path):
    time = every(1.0, 31)
    time[25] += 0.07
    f = flight(tmp_path, gps(time), baro(every(0.2, 151)), tolerance=0.05)
    assert np.flatnonzero(~np.asarray(f.log.observation.seen)[::5, 0]).tolist() == [25]
    assert (f.counts["gps"].used, f.counts["gps"].late) == (30, 1)


def test_without_a_fix_nothing_is_seen_and_the_origin_is_the_first_fix(tmp_path):
    topic = gps(every(1.0, 6), fix_type=[0, 2, 3, 3, 3, 2], vel_ned_valid=[0, 0, 1, 0, 1, 1])
    f = flight(tmp_path, topic, baro(every(0.2, 26)))
    seen = np.asarray(f.log.observation.seen)[::5]
    assert seen[:, 0].tolist() == [False, False, True, True, True, False]
    assert seen[:, 3].tolist() == [False, False, True, False, True, False]
    np.testing.assert_allclose(f.log.observation.y[[10, 15], 2], [0.0, -0.5], atol=1e-9)
    assert f.counts["gps"].without_fix == 3


def test_a_value_that_is_no_number_is_a_fault_not_a_gap(tmp_path):
    height = 100.0 + np.arange(26.0)
    height[[0, 3]] = np.nan
    f = flight(tmp_path, gps(every(1.0, 6)), baro(every(0.2, 26), height))
    assert np.all(f.log.observation.seen[:, 6])
    assert np.flatnonzero(np.isnan(f.log.observation.y[:, 6])).tolist() == [0, 3]
    assert f.log.observation.y[1, 6] == 0.0
    assert f.counts["baro"].faulty == 2


def earth_centred(lat, lon, alt):
    a, flattening = 6378137.0, 1 / 298.257223563
    lat, lon = np.radians(lat), np.radians(lon)
    b = a * (1 - flattening)
    r = a**2 / np.sqrt((a * np.cos(lat)) ** 2 + (b * np.sin(lat)) ** 2)
    return np.array([
        (r + alt) * np.cos(lat) * np.cos(lon),
        (r + alt) * np.cos(lat) * np.sin(lon),
        (r * (b / a) ** 2 + alt) * np.sin(lat),
    ])  # fmt: skip


@pytest.mark.parametrize("lon", [8.0, 179.9999])
def test_the_local_frame_is_that_of_the_ellipsoid(tmp_path, lon):
    rng = np.random.default_rng(0)
    lat = np.r_[LAT, LAT + rng.uniform(-1e-3, 1e-3, 20)]
    lon = np.r_[lon, lon + rng.uniform(-1e-3, 1e-3, 20)]
    alt = np.r_[ALT, ALT + rng.uniform(-50, 50, 20)]
    topic = gps(every(1.0, 21), lat=lat * 1e7, lon=((lon + 180) % 360 - 180) * 1e7, alt=alt * 1e3)
    y = np.asarray(flight(tmp_path, topic, baro(every(0.2, 101))).log.observation.y)[::5, :3]
    s, c = np.sin(np.radians(lat[0])), np.cos(np.radians(lat[0]))
    sl, cl = np.sin(np.radians(lon[0])), np.cos(np.radians(lon[0]))
    axes = np.array([[-s * cl, -s * sl, c], [-sl, cl, 0], [-c * cl, -c * sl, -s]])
    centred = earth_centred(lat, lon, alt)
    expected = (axes @ (centred - centred[:, :1])).T
    # 130 m away and 50 m up the tangent plane itself is about 4 mm off
    np.testing.assert_allclose(y, expected, atol=5e-3)
    assert np.max(np.abs(expected)) > 70


def test_both_generations_of_column_names_give_the_same(tmp_path):
    old = gps(every(1.0, 6))
    new = {k: v for k, v in old.items() if k not in ("lat", "lon", "alt")} | {
        "latitude_deg": old["lat"] * 1e-7,
        "longitude_deg": old["lon"] * 1e-7,
        "altitude_msl_m": old["alt"] * 1e-3,
    }
    first = flight(tmp_path, old, baro(every(0.2, 26))).log.observation.y
    np.testing.assert_array_equal(
        flight(tmp_path, new, baro(every(0.2, 26))).log.observation.y, first
    )


def test_accuracies_are_signals_of_their_own(tmp_path):
    f = flight(tmp_path, gps(every(1.0, 6) + 0.03), baro(every(0.2, 26)))
    assert set(f.accuracies) == {"s_variance_m_s", "eph"}
    np.testing.assert_allclose(f.accuracies["s_variance_m_s"].value, 0.3 + 0.01 * np.arange(6))
    np.testing.assert_allclose(f.accuracies["eph"].time, every(1.0, 6) + 0.03)


def test_outputs_follow_the_plant(tmp_path):
    plant = linear_plant(
        A=np.eye(2), C=np.eye(2), Q=np.eye(2), R=np.eye(2), dt=0.2, outputs=["baro", "gps_down"]
    )
    full = flight(tmp_path, gps(every(1.0, 6)), baro(every(0.2, 26))).log.observation
    some = read_flight(tmp_path, plant).log.observation
    np.testing.assert_array_equal(some.y, full.y[:, np.array([6, 2])])


@settings(max_examples=25, deadline=None)
@given(data=st.data())
def test_nothing_is_invented_and_every_sample_is_accounted_for(tmp_path_factory, data):
    jitter = st.floats(-0.5, 0.5, allow_nan=False)
    gap = data.draw(st.lists(st.floats(0.0, 2.5), min_size=3, max_size=30))
    time = 10.0 + np.cumsum(gap)
    wobble = data.draw(st.lists(jitter, min_size=40, max_size=40))
    tolerance = data.draw(st.sampled_from([0.02, 0.1]))
    heights = np.sort(every(0.2, 40) + np.asarray(wobble))
    f = flight(tmp_path_factory.mktemp("f"), gps(time), baro(heights), tolerance=tolerance)
    o, count = f.log.observation, f.counts["gps"]
    rows = np.flatnonzero(o.seen[:, 0])
    which = np.rint(np.asarray(o.y)[rows, 3] / 0.1).astype(int)
    assert len(set(which)) == len(which) == count.used
    assert np.all(np.abs(np.round(time[which], 6) - f.log.time[rows]) <= tolerance + 1e-6)
    assert count.used + count.duplicate + count.late + count.without_fix == len(time)
    assert np.all(np.asarray(o.y)[~np.asarray(o.seen)] == 0)


def ulog(**topics):
    """A ulog of doubles: header, one format and one subscription a topic, data in time order."""

    def message(kind, body):
        return struct.pack("<HB", len(body), ord(kind)) + body

    parts = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0)]
    data = []
    for number, (name, topic) in enumerate(topics.items()):
        fields = [column for column in topic if column != "timestamp"]
        declared = "".join(f"double {field};" for field in fields)
        parts.append(message("F", f"{name}:uint64_t timestamp;{declared}".encode()))
        for i, stamp in enumerate(topic["timestamp"]):
            values = struct.pack(f"<{len(fields)}d", *(topic[field][i] for field in fields))
            body = struct.pack("<HQ", number, int(stamp)) + values
            data.append((stamp, message("D", body)))
    for number, name in enumerate(topics):
        parts.append(message("A", struct.pack("<BH", 0, number) + name.encode()))
    return b"".join(parts + [part for _, part in sorted(data)])


@pytest.fixture
def whole():
    return ulog(
        vehicle_gps_position=gps(every(1.0, 6)), vehicle_air_data=baro(every(0.2, 26) + 0.01)
    )


def test_a_ulog_gives_what_the_folder_gives(tmp_path, whole):
    pytest.importorskip("pyulog")
    expected = flight(tmp_path, gps(every(1.0, 6)), baro(every(0.2, 26) + 0.01))
    (tmp_path / "log.ulg").write_bytes(whole)
    found = read_flight(tmp_path / "log.ulg", PLANT)
    np.testing.assert_array_equal(found.log.observation.y, expected.log.observation.y)
    np.testing.assert_array_equal(found.log.time, expected.log.time)
    assert found.counts == expected.counts


def test_a_cut_ulog_is_refused_unless_allowed(tmp_path, whole):
    pytest.importorskip("pyulog")
    (tmp_path / "cut.ulg").write_bytes(whole[:-100])
    with pytest.raises(InputError, match=r"cut\.ulg: found a file that stops inside a message"):
        read_flight(tmp_path / "cut.ulg", PLANT)
    found = read_flight(tmp_path / "cut.ulg", PLANT, allow_cut=True)
    assert 0 < found.counts["baro"].used < 26


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "an empty file"),
        (b"ULog", "no readable ulog"),
        (b"hello" * 100, "no readable ulog"),
        (ulog(vehicle_air_data=baro(every(0.2, 5))), "vehicle_gps_position: found no such topic"),
    ],
)
def test_a_ulog_that_cannot_serve_is_refused_in_one_line(tmp_path, capsys, content, words):
    pytest.importorskip("pyulog")
    path = tmp_path / "bad.ulg"
    path.write_bytes(content)
    with pytest.raises(InputError, match=words) as refusal:
        read_flight(path, PLANT)
    assert "bad.ulg" in str(refusal.value)
    assert "\n" not in str(refusal.value)
    assert capsys.readouterr().out == ""


def test_without_pyulog_the_message_says_what_to_install(tmp_path, monkeypatch, whole):
    (tmp_path / "log.ulg").write_bytes(whole)
    monkeypatch.setitem(sys.modules, "pyulog", None)
    with pytest.raises(InputError, match=r'pip install "holdfast\[ulog\]"'):
        read_flight(tmp_path / "log.ulg", PLANT)


def without(topic, name):
    return {key: value for key, value in topic.items() if key != name}


@pytest.mark.parametrize(
    ("gps_topic", "baro_topic", "words"),
    [
        (gps(every(1.0, 5), fix_type=[2] * 5), baro(every(0.2, 5)), "fix_type: found no fix"),
        (gps([]), baro(every(0.2, 5)), "vehicle_gps_position: found no samples"),
        (gps(every(1.0, 5)), baro([]), "vehicle_air_data: found no samples"),
        (gps(every(1.0, 5)), baro(every(0.2, 5), [np.nan] * 5), "found no number at all"),
        (without(gps(every(1.0, 5)), "vel_d_m_s"), baro(every(0.2, 5)), "vel_d_m_s: found no such"),
        (gps([1.0, 2.0, 1.5]), baro(every(0.2, 5)), "sample 3: found 1.500000 s after 2.000000"),
        (gps([1.0, 2.0]), baro([1.0, 1e13]), "timestamp: found 1e"),
    ],
)
def test_topics_that_cannot_serve_are_refused_by_name(tmp_path, gps_topic, baro_topic, words):
    with pytest.raises(InputError, match=words) as refusal:
        flight(tmp_path, gps_topic, baro_topic)
    assert str(tmp_path) in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_a_folder_needs_one_file_per_topic(tmp_path):
    with pytest.raises(InputError, match=r"vehicle_gps_position: found no such file"):
        read_flight(tmp_path, PLANT)
    topics = dict(vehicle_gps_position=gps(every(1.0, 5)), vehicle_air_data=baro(every(0.2, 9)))
    write(tmp_path, "a_", **topics)
    assert read_flight(tmp_path, PLANT).counts["gps"].used == 5
    write(tmp_path, "b_", **topics)
    with pytest.raises(InputError, match=r"found a_vehicle_gps_position\.csv, b_"):
        read_flight(tmp_path, PLANT)


def test_a_cell_that_is_not_a_number_is_named(tmp_path):
    write(tmp_path, vehicle_gps_position=gps(every(1.0, 5)), vehicle_air_data=baro(every(0.2, 3)))
    file = tmp_path / "vehicle_air_data.csv"
    file.write_text(file.read_text().replace("100.01", "high"))
    with pytest.raises(InputError, match=r"air_data\.csv: row 3, column baro_alt_meter: found 'hi"):
        read_flight(tmp_path, PLANT)
    file.write_text("timestamp,baro_alt_meter\n1\n")
    with pytest.raises(InputError, match=r"row 2: found 1 cells, expected 2"):
        read_flight(tmp_path, PLANT)


def test_a_plant_that_a_flight_cannot_feed_is_refused(tmp_path):
    write(tmp_path, vehicle_gps_position=gps(every(1.0, 5)), vehicle_air_data=baro(every(0.2, 9)))
    one = dict(A=[[1.0]], C=[[1.0]], Q=[[1.0]], R=[[1.0]], dt=0.2)
    with pytest.raises(InputError, match=r"outputs: found 'gps_nort'.*did you mean 'gps_north'"):
        read_flight(tmp_path, linear_plant(**one, outputs=["gps_nort"]))
    with pytest.raises(InputError, match=r"inputs: found 'thrust'"):
        read_flight(tmp_path, linear_plant(**one, B=[[1.0]], inputs=["thrust"], outputs=["baro"]))
    with pytest.raises(InputError, match=r"tolerance: found 0.3 s"):
        read_flight(tmp_path, PLANT, tolerance=0.3)
