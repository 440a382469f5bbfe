import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from holdfast.auth import Schedule, Sensors
from holdfast.auth.samples import decode, encode
from holdfast.records import Enforcement

rules = st.tuples(st.integers(0, 7), st.integers(0, 9), st.integers(-5, 12))


@given(found=st.lists(rules, min_size=1, max_size=4))
def test_it_is_the_enforcement_of_the_records(found):
    policy = Enforcement.of(*zip(*found, strict=True))
    schedule, steps = Schedule.of(policy), np.arange(0, 40)
    expected = np.asarray(policy.at(steps.astype(np.int32)))
    np.testing.assert_array_equal(schedule.mask(0, 40), expected)
    np.testing.assert_array_equal([schedule.at(int(k)) for k in steps], expected)
    np.testing.assert_array_equal(schedule.tags(0, 40), expected.sum(axis=0))
    assert schedule.sensors == len(found)


def test_steps_beyond_32_bits():
    schedule = Schedule.of(Enforcement.of([10, 1], [1, 1], [0, 0]))
    assert schedule.at(10**12) == (True, True)
    assert schedule.mask(10**12 + 1, 10**12 + 2).tolist() == [[False, True]]


def test_looking_up_a_step_does_not_wake_jax(monkeypatch):
    """`Enforcement.at` costs some 100 us a call outside of a compiled function."""
    schedule = Schedule.of(Enforcement.of([3, 4], 1, 0))
    monkeypatch.setattr(jnp, "asarray", None)
    monkeypatch.setattr(jnp, "mod", None)
    assert schedule.at(12) == (True, True)
    assert schedule.mask(3, 5).tolist() == [[True, False], [False, True]]


def test_a_table_ends_with_everything_demanded():
    table = np.array([[True, False], [False, False]])
    schedule = Schedule.of(table)
    expected = [[True, True], [True, False], [False, False], [True, True]]
    np.testing.assert_array_equal(schedule.mask(-1, 3), expected)
    assert [list(schedule.at(k)) for k in range(-1, 3)] == expected


@pytest.mark.parametrize("policy", [np.ones(3, bool), np.ones((2, 2)), np.ones((0, 2), bool)])
def test_arrays_that_are_no_table(policy):
    with pytest.raises(ValueError, match="policy: found"):
        Schedule.of(policy)


@given(value=st.floats())
def test_samples_keep_every_bit(value):
    assert np.float64(decode(encode(value))).tobytes() == np.float64(value).tobytes()


def test_samples_on_the_wire():
    assert encode(1.0).hex() == "3ff0000000000000"
    assert encode(np.float64(-2.5)).hex() == "c004000000000000"
    assert decode(bytes(7)) is None


def test_sensors_and_their_ids():
    sensors = Sensors.of(["gps", "baro"], first=0x100)
    assert sensors.data_ids == (0x100, 0x101)
    assert [sensors.index(found) for found in (0x101, 0x102)] == [1, None]
    for names, ids, words in [
        (("a", "b"), (1,), "data_ids: found 1, expected one for each of 2"),
        (("a", "b"), (1, 1), "data_ids: found"),
        (("a", "a"), (1, 2), "names: found"),
        (("a",), (65536,), "expected 0 to 65535"),
    ]:
        with pytest.raises(ValueError, match=words):
            Sensors(names, ids)
