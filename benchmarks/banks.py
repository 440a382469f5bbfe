"""Banks of modes on the 68-bus network beside plain dense ones, in one run on one processor.

    python benchmarks/banks.py [--steps 200]

136 states, 204 outputs, six attack channels, four positions of two switches. The same measured
rows, one step after the other from Python: `loop.monitor_step`, compiled, its state donated.
"exact": gains at every row; "frozen": held while they repeat themselves within 1e-4. The dense
banks do the same mathematics with a covariance of its own for every mode, linearised where ours
is: NumPy and SciPy, mode by mode with BLAS; JAX, the same compiled. Answers are compared first, in
standard deviations.
"""

import argparse
import os
import time
from collections.abc import Callable
from typing import Any, NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")
if hasattr(os, "sched_setaffinity"):  # XLA has threads of its own
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from holdfast.detectors import chi_square
from holdfast.estimators.hypotheses import modes_of
from holdfast.loop import Monitor, monitor_step
from holdfast.papers import nisme_grid as grid
from holdfast.plants.library import swing
from holdfast.records import Observation

jax.config.update("jax_cpu_enable_async_dispatch", False)

PLANT, PRIOR = grid.PLANT, np.array(grid.PRIOR)
FREEZE = grid.FREEZE
LOG_2_PI = float(np.log(2.0 * np.pi))


class Answer(NamedTuple):
    """Of a row: log-probabilities, and state and attack of the mode believed in with their sd."""

    p: np.ndarray
    x: np.ndarray
    d: np.ndarray
    x_sd: np.ndarray
    d_sd: np.ndarray


class Network:
    """The swing equation in NumPy: what a dense bank needs of it."""

    def __init__(self):
        self.ends, self.E = np.asarray(PLANT.ends), np.asarray(PLANT.incidence)
        self.t = np.asarray(PLANT.strength) * np.asarray(PLANT.closed)
        self.m, self.D = np.asarray(PLANT.inertia), np.asarray(PLANT.damping)
        self.B, self.load = np.asarray(PLANT.actuators), np.asarray(PLANT.load)
        n = self.n = len(self.m)
        C = np.zeros((n, 3, 2 * n))
        each = np.arange(n)
        C[each, 0, n + each], C[each, 1, each], C[each, 2, n + each] = self.D, 1.0, 1.0
        self.C, self.H = C.reshape(3 * n, 2 * n), np.asarray(PLANT.sensors) * PRIOR
        self.Q, self.R = (np.asarray(v) ** 2 for v in PLANT.deviation)

    def rate(self, position: int, x, u, d):
        """Of states (modes x 2n) with attacks (modes x 6)."""
        theta, f = x[:, : self.n], x[:, self.n :]
        flow = (self.t[position] * np.sin(theta @ self.E)) @ self.E.T
        return np.hstack([f, (u + d @ self.B.T - self.D * f - flow) / self.m])

    def moved(self, position: int, x, u, d):
        h = PLANT.dt
        k1 = self.rate(position, x, u, d)
        k2 = self.rate(position, x + 0.5 * h * k1, u, d)
        k3 = self.rate(position, x + 0.5 * h * k2, u, d)
        k4 = self.rate(position, x + h * k3, u, d)
        return x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4), (k1, k2, k3)

    def slope(self, position: int, x):
        """d rate / d x of one state."""
        n, (a, b) = self.n, self.ends
        t = self.t[position] * np.cos(x[a] - x[b])
        L = np.zeros((2 * n, 2 * n))
        for i, j, sign in ((a, a, -1.0), (b, b, -1.0), (a, b, 1.0), (b, a, 1.0)):
            np.add.at(L, (n + i, j), sign * t / self.m[i])
        each = np.arange(n)
        L[each, n + each] = 1.0
        L[n + each, n + each] = -self.D / self.m
        return L

    def jacobian(self, position: int, x, u, d):
        """A, and G in units of the prior, of one Runge-Kutta step."""
        h, n, one = PLANT.dt, self.n, np.eye(2 * self.n)
        _, ks = self.moved(position, x[None], u, d[None])
        force = np.vstack([np.zeros((n, 6)), self.B / self.m[:, None] * PRIOR])
        T, G, sums = one, np.zeros((2 * n, 6)), [0.0, 0.0]
        points = [x, x + 0.5 * h * ks[0][0], x + 0.5 * h * ks[1][0], x + h * ks[2][0]]
        for point, ahead, weight in zip(points, (0.5, 0.5, 1.0, 0.0), (1, 2, 2, 1), strict=True):
            J = self.slope(position, point)
            V, W = J @ T, J @ G + force
            sums = [sums[0] + weight * V, sums[1] + weight * W]
            T, G = one + ahead * h * V, ahead * h * W
        return one + h / 6.0 * sums[0], h / 6.0 * sums[1]


class Dense:
    """A full covariance for each mode, NumPy and SciPy.

    A sensor's attack does not move the network, so nothing of it is carried on.
    """

    def __init__(self, modes, floor: float):
        self.net, self.floor = Network(), floor
        self.position = np.array([m.position for m in modes])
        active = np.array([m.active for m in modes])
        moving = np.any(np.asarray(PLANT.actuators) != 0, 0)
        self.before = [np.flatnonzero(a & moving) for a in active]
        self.now = [np.flatnonzero(a & ~moving) for a in active]
        n, count = 2 * self.net.n, len(modes)
        self.x = np.tile(np.asarray(swing.operating_point(PLANT)), (count, 1))
        self.P = np.tile(grid.START_SD**2 * np.eye(n), (count, 1, 1))
        self.log_p = np.full(count, -np.log(count))

    def step(self, u, y) -> Answer:
        net, n = self.net, 2 * self.net.n
        expected = np.zeros(3 * net.n)
        expected[::3] = -net.load * u
        ahead, gains = np.empty_like(self.x), {}
        for position in np.unique(self.position):
            at = np.flatnonzero(self.position == position)
            best = at[np.argmax(self.log_p[at])]
            gains[position] = net.jacobian(position, self.x[best], u, np.zeros(6))
            ahead[at] = net.moved(position, self.x[at], u, np.zeros((len(at), 6)))[0]
        likely, told = np.empty(len(self.x)), {}
        for j, x in enumerate(ahead):
            A, G = gains[self.position[j]]
            free = G[:, self.before[j]]
            X = np.hstack([free, np.zeros((n, len(self.now[j])))])
            F = np.hstack([net.C @ free, net.H[:, self.now[j]]])
            P = A @ self.P[j] @ A.T
            P[np.diag_indices(n)] += net.Q
            CP = net.C @ P
            S = CP @ net.C.T
            S[np.diag_indices(len(S))] += net.R
            L = cho_factor(S, lower=True, overwrite_a=True, check_finite=False)[0]
            nu = y - expected - net.C @ x
            w = solve_triangular(
                L, np.column_stack([nu, F, CP]), lower=True, overwrite_b=True, check_finite=False
            )
            r = F.shape[1]
            e, WF, U = w[:, 0], w[:, 1 : 1 + r], w[:, 1 + r :]
            Sigma, score = WF.T @ WF, WF.T @ e
            size = -2.0 * np.sum(np.log(np.diag(L))) - len(y) * LOG_2_PI - e @ e
            x, P = x + U.T @ e, P - U.T @ U
            if r:
                X = X - U.T @ WF
                with_prior = cho_factor(Sigma + np.eye(r), check_finite=False)
                size += score @ cho_solve(with_prior, score)
                size -= 2.0 * np.sum(np.log(np.diag(with_prior[0])))
                cov = np.linalg.inv(Sigma)
                d = cov @ score
                x, P = x + X @ d, P + X @ cov @ X.T
                told[j] = d, np.sqrt(np.diag(cov))
            self.x[j], self.P[j], likely[j] = x, 0.5 * (P + P.T), 0.5 * size
        self.log_p = bayes(self.log_p, likely, self.floor)
        return self.answer(told)

    def answer(self, told) -> Answer:
        j = int(np.argmax(self.log_p))
        used = np.concatenate([self.before[j], self.now[j]])
        d, sd = np.zeros(6), np.zeros(6)
        if len(used):
            d[used], sd[used] = (PRIOR[used] * v for v in told[j])
        return Answer(np.exp(self.log_p), self.x[j].copy(), d, np.sqrt(np.diag(self.P[j])), sd)


def bayes(log_p, likely, floor: float):
    log_p = log_p + likely - np.max(likely)
    log_p = np.maximum(log_p - np.log(np.sum(np.exp(log_p))), np.log(floor))
    return log_p - np.log(np.sum(np.exp(log_p)))


class DenseJax:
    """The same as `Dense`, compiled: positions linearised once each, modes one after the other."""

    def __init__(self, modes, floor: float):
        self.dense = Dense(modes, floor)
        active = np.array([m.active for m in modes])
        state = tuple(map(jnp.asarray, (self.dense.x, self.dense.P, self.dense.log_p)))
        self.state = state
        position, on = jnp.asarray(self.dense.position), jnp.asarray(active)
        self.run = jax.jit(
            lambda s, u, y: dense_step(s, position, on, u, y, floor), donate_argnums=0
        )

    def step(self, u, y) -> Answer:
        self.state, answer = self.run(self.state, u, y)
        return Answer(*map(np.asarray, jax.block_until_ready(answer)))


def dense_step(state, position, on, u, y, floor: float) -> tuple[Any, tuple]:
    X, P, log_p = state
    k, none = jnp.asarray(1), jnp.zeros(6)
    C, H = jnp.asarray(Network().C), PLANT.sensors * PRIOR
    Q, R = PLANT.noise(k, X[0], u)

    def linearised(p):
        best = jnp.argmax(jnp.where(position == p, log_p, -jnp.inf))
        return PLANT.at_position(p).jacobian(k, X[best], u, none)

    A, G = jax.lax.map(linearised, jnp.arange(len(PLANT.positions)))

    def mode(given):
        p, used, x, P = given
        at = PLANT.at_position(p)
        x = at.transition(k, x, u, none)
        nu = y - at.output(k, x, u, none)
        X = jnp.where(used, G[p] * PRIOR, 0.0)
        F = C @ X + jnp.where(used, H, 0.0)
        P = A[p] @ P @ A[p].T + Q
        CP = C @ P
        L = jnp.linalg.cholesky(CP @ C.T + R)
        w = jax.scipy.linalg.solve_triangular(L, jnp.column_stack([nu, F, CP]), lower=True)
        e, WF, U = w[:, 0], w[:, 1:7], w[:, 7:]
        Sigma = WF.T @ WF + jnp.diag(jnp.where(used, 0.0, 1.0))
        score = WF.T @ e
        with_prior = jnp.linalg.cholesky(Sigma + jnp.diag(jnp.where(used, 1.0, 0.0)))
        z = jax.scipy.linalg.solve_triangular(with_prior, score, lower=True)
        size = jnp.log(jnp.diagonal(with_prior)).sum() + jnp.log(jnp.diagonal(L)).sum()
        likely = 0.5 * (z @ z - e @ e) - size
        cov = jnp.linalg.inv(Sigma)
        d, X = cov @ score, X - U.T @ WF
        x, P = x + U.T @ e + X @ d, P - U.T @ U + X @ cov @ X.T
        sd = jnp.sqrt(jnp.where(used, jnp.diagonal(cov), 0.0))
        return x, 0.5 * (P + P.T), likely, PRIOR * d, PRIOR * sd

    X, P, likely, d, d_sd = jax.lax.map(mode, (position, on, X, P))
    log_p = jax.nn.log_softmax(log_p + likely)
    log_p = jax.nn.log_softmax(jnp.maximum(log_p, jnp.log(floor)))
    j = jnp.argmax(log_p)
    answer = jnp.exp(log_p), X[j], d[j], jnp.sqrt(jnp.diagonal(P[j])), d_sd[j]
    return (X, P, log_p), answer


class Ours:
    """The product's bank, one row at a time."""

    def __init__(self, modes: Any, **settings: Any):
        estimator = grid.bank(modes, **settings)
        monitor = Monitor(estimator, chi_square.build(PLANT, on="attack"))
        self.state = jax.tree.map(jnp.array, monitor.init())
        self.run = jax.jit(lambda s, o: monitor_step(monitor, s, o), donate_argnums=0)

    def step(self, u, y, seen=None) -> Answer:
        self.state, (e, _) = self.run(self.state, Observation.of(u, y, seen))
        jax.block_until_ready(e)
        sd = (np.sqrt(np.diag(np.asarray(v))) for v in (e.x_cov, e.d_cov))
        return Answer(*map(np.asarray, (e.p, e.x, e.d)), *sd)

    @property
    def settled(self) -> bool:
        """Whether the gains of the next row are held, as long as nothing is missing."""
        return bool(self.state[0].kept.value.settled)


Step = Callable[[Any, Any], Answer]


def ran(step: Step, u, y) -> list[Answer]:
    return [step(*row) for row in zip(u, y, strict=True)]


def off(found: list[Answer], truth: list[Answer]) -> str:
    """The largest differences: of state and attack in sd of ``truth``, of a probability."""
    x = max(np.max(np.abs(a.x - b.x) / b.x_sd) for a, b in zip(found, truth, strict=True))
    p = max(np.max(np.abs(a.p - b.p)) for a, b in zip(found, truth, strict=True))
    d = 0.0
    for a, b in zip(found, truth, strict=True):
        used = b.d_sd > 0
        d = max(d, np.max(np.abs(a.d - b.d)[used] / b.d_sd[used], initial=0.0))
    return f"x {x:.1e} sd, d {d:.1e} sd, p {p:.1e}"


def timed(name: str, step: Step, u, y, reference: float | None = None) -> float:
    times = []
    for row in zip(u, y, strict=True):
        start = time.perf_counter()
        step(*row)
        times.append(1e3 * (time.perf_counter() - start))
    median = float(np.median(times))
    beside = "" if reference is None else f", {median / reference:.2f} of the dense NumPy bank's"
    print(f"{name:32s} median {median:8.2f} ms, best {min(times):8.2f} ms{beside}", flush=True)
    return median


def contest(title: str, modes: Any, rows, steps: int, few: int, dense: int) -> None:
    """``few`` rows compared; then timed, exact ones over ``few`` rows and frozen over ``steps``,
    the dense over ``dense`` of them.
    """
    u, y = rows
    listed = modes_of(PLANT, modes)
    print(f"== {title}: {len(listed)} modes", flush=True)
    exact, frozen = Ours(modes, freeze=0.0), Ours(modes)
    plain, compiled = Dense(listed, grid.FLOOR), DenseJax(listed, grid.FLOOR)
    truth = ran(plain.step, u[:dense], y[:dense])
    apart = (u[:few], y[:few])
    found = ran(exact.step, *apart)
    print("dense JAX - dense NumPy:", off(ran(compiled.step, u[:dense], y[:dense]), truth))
    print("exact - dense NumPy:", off(found[:dense], truth))
    held = ran(frozen.step, *apart)
    print(f"frozen - exact, {few} rows:", off(held, found), flush=True)
    slow = slice(few, few + dense)
    reference = timed("dense, NumPy and SciPy", plain.step, u[slow], y[slow])
    timed("dense, JAX", compiled.step, u[slow], y[slow], reference)
    timed("exact", exact.step, u[few : 2 * few], y[few : 2 * few], reference)
    timed("frozen", frozen.step, u[few : few + steps], y[few : few + steps], reference)


def frozen_gains(rows, count: int) -> None:
    """What holding gains changes, and how long after a gap they are held again; four modes."""
    u, y = rows
    exact = ran(Ours(grid.FOUR, freeze=0.0).step, u[:count], y[:count])
    for freeze in (1e-2, 1e-3, 1e-4, 1e-6):
        bank = Ours(grid.FOUR, freeze=freeze)
        found, first = [], 0
        for row in zip(u[:count], y[:count], strict=True):
            found.append(bank.step(*row))
            first += not bank.settled
        seen = np.arange(y.shape[1]) != 0
        bank.step(u[count], np.where(seen, y[count], 0.0), seen)
        gap = 0
        while not bank.settled and gap < 100:
            gap += 1
            bank.step(u[count + gap], y[count + gap])
        print(
            f"freeze {freeze:g}: gains computed at {first} of {count} rows, off by "
            f"{off(found, exact)}; held again {gap} rows after a gap",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--steps", type=int, default=200, help="rows timed with frozen gains")
    steps = parser.parse_args().steps
    runs = grid.drawn(grid.keys(1), grid.attacks(1.0), steps + 400)
    rows = np.asarray(runs.u[0]), np.asarray(runs.y[0])
    contest("case study 1", grid.FOUR, rows, steps, few=100, dense=100)
    contest("all", "all", rows, steps, few=20, dense=4)
    frozen_gains(rows, 300)


if __name__ == "__main__":
    main()
