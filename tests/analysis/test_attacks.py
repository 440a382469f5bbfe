"""Delays, reasons and sensors against the whole log at once, in exact arithmetic."""

import numpy as np
import pytest

from analysis.batch import determined, smallest_delays
from analysis.models import model, plant
from holdfast.analysis.attacks import identifiability, undetermined_steps
from holdfast.analysis.model import models_over
from holdfast.estimators import unknown_input
from systems import estimates


def random_integers(rng):
    """Small sparse systems: many are not identifiable, or only late."""
    n, ny, nd = rng.integers(1, 5), rng.integers(1, 4), rng.integers(1, 4)
    sparse = [rng.integers(-1, 2, shape) * (rng.random(shape) < 0.6) for shape in ((n, n), (n, nd))]
    C = rng.integers(-1, 2, (ny, n)) * (rng.random((ny, n)) < 0.6)
    H = rng.integers(-1, 2, (ny, nd)) * (rng.random((ny, nd)) < rng.choice([0.0, 0.2, 0.5]))
    return sparse[0], sparse[1], C, H


def seen_in_rows(H):
    """Which axes lie in the row space of an integer H."""
    return determined(np.asarray(H))


@pytest.mark.parametrize("block", range(4))
def test_delays_are_those_of_the_whole_log(block):
    rng = np.random.default_rng(block)
    found, wanted = [], []
    for _ in range(75):
        A, G, C, H = random_integers(rng)
        result = identifiability(model(A, G, C, H))
        direct = seen_in_rows(H)
        assert [c.direct for c in result.channels] == direct.tolist()
        found.append([c.delay for c in result.channels])
        wanted.append(smallest_delays(A, G, C, H, direct, len(A) + 1))
    assert found == wanted
    # the sample holds all kinds: at once, late, and never
    flat = [delay for row in wanted for delay in row]
    assert 0 in flat
    assert None in flat
    assert any(delay is not None and delay > 0 for delay in flat)


def test_units_do_not_matter():
    """Every state, output and attack in units 1e-6 to 1e6 times as large: the same answers."""
    rng = np.random.default_rng(5)
    for _ in range(60):
        A, G, C, H = random_integers(rng)
        x, y, d = (10.0 ** rng.uniform(-6, 6, size) for size in (len(A), len(C), G.shape[1]))
        other = (
            A * x / x[:, None],
            G * d / x[:, None],
            C * x / y[:, None],
            H * d / y[:, None],
        )
        one, two = identifiability(model(A, G, C, H)), identifiability(model(*other))
        assert one.channels == two.channels
        assert one.transfer.rank == two.transfer.rank
        found, wanted = ([z.z for z in r.transfer.zeros] for r in (two, one))
        # zeros of small integer systems, at worst triple: rounding to the third root, 5e-6
        np.testing.assert_allclose(sorted_values(found), sorted_values(wanted), atol=1e-4)


def sorted_values(values):
    return sorted(np.round(values, 3), key=lambda z: (z.real, z.imag))


def test_every_sensor_that_helps_is_named():
    rng = np.random.default_rng(9)
    named = 0
    for _ in range(60):
        A, G, C, H = random_integers(rng)
        n, nd = G.shape
        result = identifiability(model(A, G, C, H))
        wanted = [{} for _ in range(nd)]
        for i in range(n):
            more = np.vstack([C, np.eye(n, dtype=int)[i]]), np.vstack([H, np.zeros((1, nd), int)])
            helped = smallest_delays(A, G, *more, seen_in_rows(H), n + 1)
            for j, delay in enumerate(helped):
                before = result.channels[j].delay
                if delay is not None and (before is None or delay < before):
                    wanted[j][f"x{i + 1}"] = delay
        for channel, states in zip(result.channels, wanted, strict=True):
            assert {s.state: s.delay for s in channel.sensors} == states
            order = [s.delay for s in channel.sensors]
            assert order == sorted(order)
            named += len(states)
    assert named > 20


STEP = 0.01
DOUBLE = np.array([[1.0, STEP], [0.0, 1.0]])
PUSH = np.array([[0.0], [STEP]])


def test_position_shows_an_acceleration_attack_one_step_later():
    result = identifiability(model(DOUBLE, PUSH, np.array([[1.0, 0.0]])))
    (channel,) = result.channels
    assert (channel.delay, result.delay, channel.direct) == (1, 1, False)
    assert [(s.state, s.delay) for s in channel.sensors] == [("x2", 0)]


def test_speed_shows_it_at_once():
    result = identifiability(model(DOUBLE, PUSH, np.array([[0.0, 1.0]])))
    assert result.channels[0].delay == 0
    assert result.channels[0].sensors == ()


@pytest.mark.parametrize("step", [1.0, 1e-2, 1e-4])
def test_a_chain_of_integrators_takes_as_many_steps_as_it_has(step):
    """Sampled fast: the attack's first effect on the output is step^5, 1e-20 at worst."""
    A = np.eye(5) + step * np.eye(5, k=1)
    result = identifiability(model(A, step * np.eye(5)[:, 4:], np.eye(5)[:1]))
    assert result.channels[0].delay == 4
    assert [(s.state, s.delay) for s in result.channels[0].sensors] == [
        ("x5", 0), ("x4", 1), ("x3", 2), ("x2", 3),
    ]  # fmt: skip


def test_two_attacks_on_one_output_are_never_told_apart():
    result = identifiability(model(np.eye(2), np.eye(2), np.array([[1.0, 1.0]])))
    assert [c.delay for c in result.channels] == [None, None]
    assert "2 attack channels reach 1 output in only 1 independent way" in result.channels[0].reason
    lost = result.transfer.lost[:, 0]
    # one cancels the other in the only output; 1e-12: a few roundings of numbers of size 1
    np.testing.assert_allclose(lost[0], -lost[1], rtol=1e-12)
    assert lost[0] != 0


def test_the_attack_before_the_first_row_can_hide_for_ever():
    """As many direct attacks as outputs: invertible, and yet x_1 is never known."""
    A, G = np.array([[0.5, 0.1], [0.0, 0.3]]), np.array([[0.0], [1.0]])
    result = identifiability(model(A, G, np.array([[1.0, 0.0]]), np.array([[1.0]])))
    assert result.transfer.rank == 1
    assert result.channels[0].delay is None
    assert "before the first row" in result.channels[0].reason


def test_no_attack_channels():
    result = identifiability(model(DOUBLE, np.zeros((2, 0)), np.eye(2)))
    assert (result.channels, result.delay, result.transfer.rank) == ((), 0, 0)


def test_steps_without_identification_are_those_of_the_estimator():
    """A vehicle that stops and starts: steering has no effect on the state at standstill."""
    speed = np.concatenate([np.linspace(1.0, 0.0, 8), np.zeros(3), np.linspace(0.0, 1.0, 6)])
    A = np.tile(np.eye(3), (len(speed), 1, 1))
    A[:, 0, 1] = STEP * speed
    G = np.zeros((len(speed), 3, 2))
    G[:, 0, 0] = G[:, 1, 0] = STEP * speed
    G[:, 2, 1] = STEP
    vehicle = plant(A, G, np.eye(3))
    log = np.zeros((len(speed), 0)), np.zeros((len(speed), 3)), np.ones((len(speed), 3), bool)
    estimate = estimates(unknown_input.build(vehicle, np.zeros(3), np.eye(3)), *log)
    hidden = np.isinf(np.diagonal(estimate.d_cov, axis1=1, axis2=2))
    counts = undetermined_steps(models_over(vehicle, np.zeros(3)))
    assert counts == {"d1": int(hidden[:, 0].sum()), "d2": 0}
    assert counts["d1"] == 5
