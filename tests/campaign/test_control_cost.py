"""The cost of the control: of a run against its record, of many against Lyapunov's equation."""

import equinox as eqx
import jax
import numpy as np
import pytest
import scipy.linalg

from holdfast.campaign.aggregate import STATISTICS, mean
from holdfast.campaign.blocks import block, case_of, point_key, single
from holdfast.campaign.run_scores import run_scores
from holdfast.shell.campaigning import run_study
from holdfast.shell.files import load_scenario
from studied import KALMAN, scenario_text, study_text

LQR = """\
[controller]
kind = "lqr"
state_weight = [[1.0, 0.2], [0.2, 0.5]]
input_weight = [[0.3]]
reference = [7.0, 0.0]
"""
PLACED = '[controller]\nkind = "pole_placement"\npoles = [0.8, 0.9]\n'
PUSHED = '[[attack]]\nkind = "bias"\nchannel = "actuator:accel"\nstart = 1\nvalue = 2.0'
A = np.array([[1.0, 0.1], [0.0, 0.98]])
B = np.array([[0.005], [0.1]])
C = np.array([[1.0, 0.0]])
Q = np.array([[1e-3, 2e-4], [2e-4, 4e-3]])
R = np.array([[0.02]])
QX = np.array([[1.0, 0.2], [0.2, 0.5]])
RU = np.array([[0.3]])


def case_with(tmp_path, controller):
    path = tmp_path / "scenario.toml"
    path.write_text(scenario_text(KALMAN, f"{PUSHED}\n\n{controller}"))
    return case_of(load_scenario(path), 50, True)


def test_it_is_that_of_the_record_and_counts_what_was_commanded(tmp_path):
    """To rounding, which the order of the sums decides: 1e-12 of the cost."""
    case, key = case_with(tmp_path, LQR), point_key(3, "a")
    steady = jax.numpy.array([0.5])
    case = eqx.tree_at(lambda c: c.scenario.controller.steady, case, steady)
    trace = jax.tree.map(np.asarray, single(case, key, 7))
    gain, reference = np.asarray(case.scenario.controller.gain), np.array([7.0, 0.0])
    u, total, pushed = trace.observation.u, 0.0, 0.0
    for k in range(50):
        off, hit = trace.x[k] - reference, u[k] + trace.injection.u[k - 1] * (k > 0)
        total += (off @ QX @ off + (u[k] - 0.5) @ RU @ (u[k] - 0.5)) / 50
        pushed += (off @ QX @ off + (hit - 0.5) @ RU @ (hit - 0.5)) / 50
    found = block(case, key, 0, 8).scores["control_cost"]
    assert found.shape == (8,)
    assert found[7] == pytest.approx(total, rel=1e-12)
    # the input is the command, and what the attacker adds to it would be seen in the cost
    commanded = 0.5 - (trace.estimate.x[:-1] - reference) @ gain.T
    np.testing.assert_allclose(u[1:], commanded, atol=1e-12)
    assert np.all(trace.injection.u[20:] == 2.0)
    assert abs(pushed - total) > 1e-3 * total


@pytest.mark.parametrize("controller", [PLACED, ""], ids=["no weights", "no controller"])
def test_there_is_none_without_weights(tmp_path, controller):
    case = case_with(tmp_path, controller)
    trace = eqx.filter_eval_shape(single, case, jax.random.key(0), 0)
    found = eqx.filter_eval_shape(run_scores, case.scenario, trace, case.maps)
    assert "nees" in found
    assert "control_cost" not in found


def test_a_run_that_left_the_numbers_costs_infinitely(tmp_path):
    """And the mean of runs with one of them has no interval, but quantiles."""
    case = case_with(tmp_path, LQR)
    trace = single(case, point_key(3, "a"), 7)
    gone = trace.x.at[30].set(jax.numpy.array([np.inf, -np.inf]))
    gone = eqx.tree_at(lambda t: t.x, trace, gone)
    found = run_scores(case.scenario, gone, case.maps)
    assert float(found["control_cost"]) == np.inf
    for values in ([1.0, 2.0, 3.0, np.inf], [1.0, 2.0, 3.0, 1e308, 1e308]):
        got = dict(zip(STATISTICS, mean(np.array(values)), strict=True))
        assert got["mean"] == np.inf
        assert np.isnan(got["low"])
        assert got["q50"] == sorted(values)[(len(values) - 1) // 2]


def test_the_mean_over_runs_is_the_stationary_cost(tmp_path):
    """LQR on the estimate of a Kalman filter that starts with its stationary covariance.

    z = (x, e), e the error of the estimate, is then z_k = F z_{k-1} + noise of covariance W, and
    the covariances S_k = S + F^k (S_0 - S) F'^k with S = F S F' + W: the expected cost is that of
    S, and a transient that is known. The standard error of the mean is a run's spread (20 %) by
    sqrt(4096), 0.3 %; four of them are allowed, so that a cost without its input part (a third
    of it), or of the estimate in place of the state (a fifth less), fails.
    """
    P = scipy.linalg.solve_discrete_are(A.T, C.T, Q, R)
    L = P @ C.T @ np.linalg.inv(C @ P @ C.T + R)
    P = (np.eye(2) - L @ C) @ P
    X = scipy.linalg.solve_discrete_are(A, B, QX, RU)
    K = np.linalg.solve(RU + B.T @ X @ B, B.T @ X @ A)
    keep = np.eye(2) - L @ C
    F = np.block([[A - B @ K, B @ K], [np.zeros((2, 2)), keep @ A]])
    W = np.block([[Q, Q @ keep.T], [keep @ Q, keep @ Q @ keep.T + L @ R @ L.T]])
    S = scipy.linalg.solve_discrete_lyapunov(F, W)
    told = np.hstack([np.eye(2), -np.eye(2)])  # the estimate x - e

    def cost(S, before):
        return np.trace(QX @ S[:2, :2]) + np.trace(RU @ K @ told @ before @ told.T @ K.T)

    steps, runs, expected, before = 400, 4096, 0.0, np.tile(P, (2, 2))
    for _ in range(steps):
        now = F @ before @ F.T + W
        expected += cost(now, before) / steps
        before = now
    assert expected == pytest.approx(cost(S, S), rel=0.02)  # the transient is a small part

    write_oracle(tmp_path, P)
    found = run_study(study_at(tmp_path, runs, steps))
    got = found.summary.sel(score="control_cost")
    error = float(got.sel(statistic="high") - got.sel(statistic="mean")) / 1.959963984540054
    assert error < 0.004 * expected
    assert float(got.sel(statistic="mean")) == pytest.approx(expected, abs=4 * error)
    inputs = np.trace(RU @ K @ told @ S @ told.T @ K.T)
    estimated = np.trace(QX @ told @ S @ told.T) + inputs
    assert min(inputs, abs(estimated - expected)) > 8 * error


def write_oracle(folder, P):
    (folder / "scenario.toml").write_text(f"""\
[plant]
kind = "linear"
dt = 0.1
A = {A.tolist()}
B = {B.tolist()}
C = {C.tolist()}
Q = {Q.tolist()}
R = {R.tolist()}

[controller]
kind = "lqr"
state_weight = {QX.tolist()}
input_weight = {RU.tolist()}

[estimator]
kind = "kalman"
x0 = [0, 0]
P0 = {P.tolist()}

[detector]
kind = "chi_square"
""")


def study_at(folder, runs, steps):
    path = folder / "study.toml"
    path.write_text(study_text(runs=runs, steps=steps))
    return path
