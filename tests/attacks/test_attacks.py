import importlib
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from holdfast.parts import InvalidValue
from holdfast.plants.build import linear_plant
from holdfast.records import Knowledge

DT = 0.1
KINDS = {
    "bias": {"value": 2.0},
    "ramp": {"rate": 3.0},
    "sine": {"amplitude": 2.0, "frequency": 0.7, "phase": 0.4},
    "noise": {"sd": 1.5},
    "hopping": {"count": 2, "sd": 1.5},
    "replay": {"seconds": 0.4},
    "delay": {"seconds": 0.4},
    "freeze": {},
}


@pytest.fixture(scope="module")
def plant():
    return linear_plant(
        A=np.eye(2) * 0.9,
        B=np.eye(2),
        C=np.ones((3, 2)),
        G=np.ones((2, 2)),
        H=np.ones((3, 2)),
        Q=np.eye(2),
        R=np.eye(3),
        dt=DT,
        inputs=["left", "right"],
        outputs=["gps", "wheel", "gyro"],
        attacks=["spoof", "push"],
    )


def build(kind, plant, **keys):
    return importlib.import_module(f"holdfast.attacks.{kind}").build(plant, **keys)


def samples(steps, seed=0):
    """Rows 0 .. steps-1 of what the attacker sees: k, u, y."""
    rng = np.random.default_rng(seed)
    return (
        jnp.arange(steps, dtype=jnp.int32),
        jnp.asarray(rng.normal(size=(steps, 2))),
        jnp.asarray(rng.normal(size=(steps, 3))),
    )


@eqx.filter_jit
def run(attack, known, key):
    first = attack.init(key, Knowledge(*(rows[0] for rows in known)))
    return jax.lax.scan(lambda state, row: attack.step(state, Knowledge(*row)), first, known)[1]


def injected(attack, known, seed=0):
    found = run(attack, known, jax.random.key(seed))
    return np.concatenate([found.u, found.y, found.d], 1)


@pytest.mark.parametrize("kind", KINDS)
def test_hits_only_its_channel_and_only_in_its_window(plant, kind):
    known = samples(40)
    for channel, column in (("sensor:wheel", 3), ("actuator:right", 1), ("channel:push", 6)):
        if kind in ("replay", "delay", "freeze") and channel == "channel:push":
            continue
        where = {"channels": [channel, "sensor:gps"]} if kind == "hopping" else {"channel": channel}
        columns = [2, column] if kind == "hopping" else [column]
        found = injected(build(kind, plant, **where, start=0.7, stop=2.3, **KINDS[kind]), known)
        inside = slice(8, 23) if kind == "ramp" else slice(7, 23)  # a ramp starts from zero
        assert np.all(found[inside][:, columns] != 0)
        found[7:23][:, columns] = 0
        rest = found.copy()
        rest[7:23, columns] = 0
        assert np.all(rest == 0)


@given(k=st.integers(0, 3000), length=st.integers(1, 3000), dt=st.sampled_from([0.1, 0.01, 0.3]))
def test_decimal_times_fall_on_their_samples(k, length, dt):
    one = linear_plant(A=[[0.5]], C=[[1.0]], Q=[[1.0]], R=[[1.0]], dt=dt)
    start, stop = round(k * dt, 6), round((k + length) * dt, 6)
    window = build("bias", one, channel="sensor:y1", start=start, stop=stop, value=1.0)
    assert (int(window.first), int(window.last)) == (k, k + length)


def test_a_start_between_samples_waits_for_the_next(plant):
    window = build("bias", plant, channel="sensor:gps", start=0.31, value=1.0)
    assert int(window.first) == 4
    assert int(window.last) == 2**31 - 1


def test_values(plant):
    known, t = samples(30), np.arange(30) * DT
    inside = (t >= 0.5 - 1e-12).astype(float)

    def on_wheel(kind, **keys):
        return injected(build(kind, plant, channel="sensor:wheel", start=0.5, **keys), known)[:, 3]

    np.testing.assert_array_equal(on_wheel("bias", value=2.0), 2.0 * inside)
    np.testing.assert_allclose(on_wheel("ramp", rate=3.0), 3.0 * (t - 0.5) * inside, atol=1e-14)
    np.testing.assert_allclose(
        on_wheel("sine", amplitude=2.0, frequency=0.7, phase=0.4),
        2.0 * np.sin(2 * np.pi * 0.7 * t + 0.4) * inside,
        atol=1e-14,
    )


def shown(plant, known, channel, column, kind, **keys):
    clean = np.concatenate(known[1:], 1)[:, column]
    added = injected(build(kind, plant, channel=channel, **keys), known)[:, column]
    return clean, clean + added


@pytest.mark.parametrize(("channel", "column"), [("sensor:gyro", 4), ("actuator:left", 0)])
def test_recordings(plant, channel, column):
    known = samples(40)
    at = (plant, known, channel, column)
    clean, seen = shown(*at, "freeze", start=1.0, stop=3.0)
    np.testing.assert_allclose(seen[10:30], clean[9], atol=1e-14)
    clean, seen = shown(*at, "freeze")
    np.testing.assert_allclose(seen, clean[0], atol=1e-14)
    clean, seen = shown(*at, "delay", start=1.0, stop=3.0, seconds=0.3)
    np.testing.assert_allclose(seen[10:30], clean[7:27], atol=1e-14)
    clean, seen = shown(*at, "delay", seconds=0.3)
    np.testing.assert_allclose(seen, clean[np.maximum(np.arange(40) - 3, 0)], atol=1e-14)
    clean, seen = shown(*at, "replay", start=1.0, stop=3.0, seconds=0.3)
    np.testing.assert_allclose(seen[10:30], clean[7 + np.arange(20) % 3], atol=1e-14)
    np.testing.assert_array_equal(seen[30:], clean[30:])


def test_noise_has_its_standard_deviation_and_its_own_draws(plant):
    steps, sd = 20_000, 1.5
    attack = build("noise", plant, channels=["sensor:gps", "channel:spoof"], sd=sd)
    found = injected(attack, samples(steps))[:, [2, 5]]
    # variance of the sample variance of a normal: 2 sd^4 / steps; 4 standard errors = 4 %
    assert np.all(np.abs(found.var(0) / sd**2 - 1) < 4 * math.sqrt(2 / steps))
    assert np.all(np.abs(found.mean(0)) < 4 * sd / math.sqrt(steps))
    between = np.corrcoef(found.T)[0, 1]
    after = np.corrcoef(found[1:, 0], found[:-1, 0])[0, 1]
    assert max(abs(between), abs(after)) < 4 / math.sqrt(steps)


def test_hopping_hits_count_channels_each_equally_often(plant):
    steps, names = 20_000, ["sensor:gps", "sensor:wheel", "sensor:gyro", "actuator:left"]
    attack = build("hopping", plant, channels=names, count=2, sd=1.5)
    found = injected(attack, samples(steps))
    hit = found != 0
    assert np.all(hit.sum(1) == 2)
    share = hit[:, [2, 3, 4, 0]].mean(0)
    assert np.all(np.abs(share - 0.5) < 4 * math.sqrt(0.25 / steps))
    size = found[hit]
    assert abs(size.var() / 1.5**2 - 1) < 4 * math.sqrt(2 / len(size))
    # no pair is preferred: each of the six comes in 1/6 of the steps
    pairs = np.unique(np.packbits(hit, axis=1), return_counts=True)[1] / steps
    assert len(pairs) == 6
    assert np.all(np.abs(pairs - 1 / 6) < 4 * math.sqrt(5 / 36 / steps))


@pytest.mark.parametrize("kind", ["noise", "hopping"])
def test_randomness_comes_from_the_key_alone(plant, kind):
    keys = {"count": 1, "sd": 1.0} if kind == "hopping" else {"sd": 1.0}
    attack, known = build(kind, plant, channel="sensor:gps", **keys), samples(10)
    np.testing.assert_array_equal(injected(attack, known, 1), injected(attack, known, 1))
    assert np.all(injected(attack, known, 1)[:, 2] != injected(attack, known, 2)[:, 2])


@pytest.mark.parametrize("kind", KINDS)
def test_a_new_value_compiles_nothing(plant, kind):
    compiled = []

    @eqx.filter_jit
    def count(attack, known):
        compiled.append(kind)
        return attack.step(attack.init(jax.random.key(0), known), known)

    known = Knowledge(jnp.asarray(0, jnp.int32), jnp.zeros(2), jnp.zeros(3))
    where = {"channels": ["sensor:gps", "sensor:gyro"], "stop": 9.0}
    for start, change in ((1.0, 1), (2.0, 2)):
        keys = {k: v if k in ("seconds", "count") else v * change for k, v in KINDS[kind].items()}
        count(build(kind, plant, **where, start=start, **keys), known)
    assert len(compiled) == 1


SENSORS = "one of actuator:left, actuator:right, sensor:gps, sensor:wheel, sensor:gyro"
ALL = f"{SENSORS}, channel:spoof, channel:push"


@pytest.mark.parametrize(
    ("kind", "keys", "message"),
    [
        ("bias", {"value": 1.0, "channel": "sensor:gsp"}, f"found 'sensor:gsp', expected {ALL}"),
        ("bias", {"value": 1.0, "channel": "gps"}, f"channel: found 'gps', expected {ALL}"),
        ("freeze", {"channel": "sensor:gsp"}, f"channel: found 'sensor:gsp', expected {SENSORS}"),
        (
            "delay",
            {"channel": "channel:push", "seconds": 1.0},
            "channel: found 'channel:push', expected a sensor or an actuator "
            "(delay plays back its samples)",
        ),
        ("bias", {"value": 1.0}, "channel, channels: found neither, expected one of the two"),
        (
            "bias",
            {"value": 1.0, "channel": "sensor:gps", "channels": ["sensor:gps"]},
            "channel, channels: found both, expected one of the two",
        ),
        ("bias", {"value": 1.0, "channels": []}, "channels: found an empty list"),
        ("bias", {"value": 1.0, "channels": ["sensor:gps"] * 2}, "expected names that differ"),
        ("bias", {"value": math.nan}, "value: found nan, expected a finite number"),
        ("noise", {"sd": -1.0}, "sd: found -1.0, expected a finite number >= 0"),
        ("sine", {"amplitude": 1.0, "frequency": -2.0}, "frequency: found -2.0"),
        ("hopping", {"count": 2, "sd": 1.0}, "count: found 2, expected 1 to 1"),
        ("hopping", {"count": 0, "sd": 1.0}, "count: found 0, expected 1 to 1"),
        ("bias", {"value": 1.0, "start": math.inf}, "start: found inf"),
        ("bias", {"value": 1.0, "start": 2.0, "stop": 2.0}, "stop: found 2.0, expected seconds"),
        ("bias", {"value": 1.0, "stop": math.nan}, "stop: found nan"),
        ("delay", {"seconds": 0.04}, "seconds: found 0.04, expected at least one sample"),
        ("delay", {"seconds": math.nan}, "seconds: found nan"),
        ("replay", {"seconds": 1.0, "start": 0.9}, "start: found 0.9, expected at least 1"),
    ],
)  # fmt: skip
def test_wrong_settings_are_named(plant, kind, keys, message):
    if not {"channel", "channels"} & keys.keys() and "neither" not in message:
        keys = {"channel": "sensor:gps", **keys}
    with pytest.raises(InvalidValue) as caught:
        build(kind, plant, **keys)
    assert message in str(caught.value)
