"""The contract of an estimator."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from holdfast.loop import Monitor, Scenario, replay, simulate
from holdfast.numerics.blue import whitener
from holdfast.parts import Detector, Estimator, Plant
from holdfast.plants.linear import LinearPlant, Table
from holdfast.records import Array, Estimate, Observation, Status, Verdict, screen
from holdfast.testing.common import (
    EXACT,
    REARRANGED,
    check_machine,
    check_no_nan,
    check_part,
    check_same,
    require,
    row_of,
    scan,
)


def check_estimator(
    build_or_estimator: Callable[[Plant], Estimator] | Estimator,
    plant: Plant | None = None,
    *,
    steps: int = 40,
    seed: int = 0,
) -> None:
    """Check an estimator, or the one that a function makes for ``plant``.

    Single steps, a replay and a simulation give the same numbers; records have the plant's
    shapes, hold no NaN, symmetric positive semidefinite covariances and a known status; a bad
    sample is reported and otherwise as if it had not arrived; a sensor that never arrives is
    as if the plant had none (only with a function and a `LinearPlant`: it takes another
    estimator, for the smaller plant); a batch is as its members; the part is frozen and final
    and stepping does not change it.

    Raises `AssertionError` naming the contract that is broken.
    """
    build = None
    if isinstance(build_or_estimator, Estimator):
        estimator = build_or_estimator
    else:
        assert plant is not None, "check_estimator needs the plant to build an estimator for"
        build, estimator = build_or_estimator, build_or_estimator(plant)
    plant = estimator.plant
    check_part(estimator, Estimator)
    state, first = estimator.init()
    log = _log(plant, first.x, steps, seed)
    rows = _screened(log)
    _check_shapes(estimator, first, jax.eval_shape(estimator.step, state, row_of(rows, 0))[1])
    check_machine(estimator, state, rows)
    _check_estimates(estimator, scan(estimator, state, rows))
    _check_same_everywhere(estimator, first.x, steps, seed)
    _check_bad_samples(estimator, log)
    if build is not None and isinstance(plant, LinearPlant):
        _check_absent_sensors(build, plant, log)


class _Silent(Detector):
    """Judges nothing."""

    def init(self) -> tuple:
        return ()

    def step(self, state: tuple, estimate: Estimate) -> tuple[tuple, Verdict]:
        none = jnp.zeros(0, bool)
        no = jnp.asarray(False)
        return state, Verdict(jnp.zeros(()), jnp.asarray(jnp.inf), no, jnp.asarray(0), none)


def _log(plant: Plant, x0: Float[Array, " n"], steps: int, seed: int) -> Observation:
    """What the plant does under random inputs; nobody attacks."""
    nd = jnp.zeros(len(plant.attacks))

    @eqx.filter_jit
    def run(plant, x0, key):
        def row(x, inputs):
            k, key = inputs
            steer, move, measure = jax.random.split(key, 3)
            u = jax.random.normal(steer, (len(plant.inputs),))
            x = plant.advance(move, k, x, u, nd)
            return x, (u, plant.measure(measure, k, x, u, nd))

        keys = jax.random.split(key, steps)
        return jax.lax.scan(row, x0, (jnp.arange(1, steps + 1, dtype=jnp.int32), keys))[1]

    return Observation.of(*run(plant, x0, jax.random.key(seed)))


@eqx.filter_jit
def _screened(log: Observation) -> Observation:
    """What an estimator is given of a log."""

    def row(u_before, observation):
        clean = screen(observation, u_before)
        return clean.u, clean

    return jax.lax.scan(row, jnp.zeros(log.u.shape[-1]), log)[1]


def _check_shapes(estimator: Estimator, first: Estimate, later: Estimate) -> None:
    """Both records have the plant's sizes; no attack channel is estimated, or all are."""
    plant = estimator.plant
    for when, record in (("init", first), ("step", later)):
        n, ny, nd = len(plant.states), len(plant.outputs), record.d.shape[-1]
        require(estimator, nd in (0, len(plant.attacks)), f"{when} estimates {nd} attack channels")
        rows = record.d_bound.shape[-1]
        expected = {
            "x": (n,), "x_cov": (n, n), "d": (nd,), "d_cov": (nd, nd), "d_free": (nd,),
            "d_free_cov": (nd, nd), "d_rows": (rows, nd), "d_bound": (rows,),
            "residual": (ny,), "residual_cov": (ny, ny), "status": (),
        }  # fmt: skip
        for name, shape in expected.items():
            found = getattr(record, name).shape
            require(estimator, found == shape, f"{when}: {name} has shape {found}, not {shape}")


def _check_estimates(estimator: Estimator, rows: Estimate, where: str = "") -> None:
    """No NaN, values finite, covariances that are covariances, status from the list."""
    check_no_nan(estimator, rows, where)
    for name in ("x", "d", "d_free", "residual"):
        finite = bool(jnp.all(jnp.isfinite(getattr(rows, name))))
        require(estimator, finite, f"infinity in {name} {where}".strip())
    for name in ("x_cov", "d_cov", "d_free_cov", "residual_cov"):
        _check_covariances(estimator, name, np.asarray(getattr(rows, name)), where)
    for name in ("d", "d_free"):
        spread = np.diagonal(np.asarray(getattr(rows, f"{name}_cov")), axis1=1, axis2=2)
        zero = np.all(np.asarray(getattr(rows, name))[np.isinf(spread)] == 0)
        require(estimator, bool(zero), f"{name} is not 0 where its variance is inf {where}")
    known = sum(Status)
    unknown = int(np.bitwise_or.reduce(np.asarray(rows.status), initial=0)) & ~known
    require(estimator, unknown == 0, f"status has unknown bits {unknown:#x} {where}".strip())


def _check_covariances(estimator: Estimator, name: str, covs: np.ndarray, where: str) -> None:
    """Symmetric, no negative eigenvalue; ``inf`` only on the diagonal, zeros beside it."""
    variance = np.diagonal(covs, axis1=1, axis2=2)
    require(estimator, bool(np.all(variance >= 0)), f"{name} has a negative variance {where}")
    lost = np.isinf(variance)
    beside = (lost[:, :, None] | lost[:, None, :]) & ~np.eye(covs.shape[-1], dtype=bool)
    clear = np.all(covs[beside] == 0)
    require(estimator, bool(clear), f"{name} is not 0 beside an infinite variance {where}")
    scale = np.where(lost | (variance == 0), 1.0, np.sqrt(np.where(lost, 1.0, variance)))
    unit = np.where(lost[:, :, None] | lost[:, None, :], 0.0, covs)
    unit = unit / scale[:, :, None] / scale[:, None, :]
    skew = np.max(np.abs(unit - np.swapaxes(unit, 1, 2)), initial=0.0)
    require(estimator, bool(skew <= EXACT), f"{name} is not symmetric, by {skew:.3g} {where}")
    if covs.shape[-1]:
        lowest = np.linalg.eigvalsh(unit).min()
        require(
            estimator,
            bool(lowest >= -REARRANGED),
            f"{name} is not positive semidefinite (correlation eigenvalue {lowest:.3g}) {where}",
        )


def _check_same_everywhere(
    estimator: Estimator, x0: Float[Array, " n"], steps: int, seed: int
) -> None:
    """Simulation, replay and the estimator on its own give the same numbers."""
    monitor = Monitor(estimator, _Silent())
    key = jax.random.key(seed)
    simulated = simulate(Scenario(estimator.plant, jnp.asarray(x0), monitor), key, steps)
    diverged = bool(jnp.any(simulated.estimate.status & int(Status.DIVERGED)))
    require(estimator, not diverged, "diverges on its own plant")
    log = simulated.observation
    replayed = replay(monitor, log)
    check_same(estimator, "replay differs from simulation", replayed.estimate, simulated.estimate)
    alone = scan(estimator, estimator.init()[0], _screened(log))
    check_same(estimator, "replay differs from single steps", replayed.estimate, alone)


def _check_bad_samples(estimator: Estimator, log: Observation) -> None:
    """NaN and infinity are reported in their row, and otherwise as if nothing had arrived."""
    k, start = log.y.shape[0] // 2, estimator.init()[0]

    def changed(name: str, where: Any, value: Any) -> Observation:
        found = np.array(getattr(log, name))
        found[where] = value
        return replace(log, **{name: found})

    def run(name: str, where: Any, value: Any) -> Estimate:
        return scan(estimator, start, _screened(changed(name, where, value)))

    for i, name in enumerate(estimator.plant.outputs):
        gap = run("seen", (k, i), False)
        _check_estimates(estimator, gap, f"with a sample of {name} missing")
        _check_reported(estimator, f"a gap of {name}", gap, Status.MISSING, k)
        for bad in (math.nan, math.inf, -math.inf):
            found = run("y", (k, i), bad)
            _check_reported(estimator, f"{bad} in {name}", found, Status.BAD_INPUT, k)
            contract = f"{bad} in {name} is not like a missing sample"
            check_same(estimator, contract, _unmarked(found), _unmarked(gap))
    if log.u.shape[-1]:
        found, held = run("u", k, math.nan), run("u", k, log.u[k - 1])
        _check_reported(estimator, "a NaN input", found, Status.BAD_INPUT, k)
        contract = "a NaN input is not like the one before held"
        check_same(estimator, contract, _unmarked(found), _unmarked(held))
    nothing = run("seen", slice(k, None), False)
    _check_estimates(estimator, nothing, "once nothing arrives")
    # overflow is caught by the loop, which says DIVERGED
    huge = replay(Monitor(estimator, _Silent()), changed("y", k, 1e300)).estimate
    check_no_nan(estimator, huge, "after a sample of 1e300")


def _check_reported(estimator: Estimator, what: str, rows: Estimate, bit: Status, k: int) -> None:
    """The status has this bit in row k and in no other."""
    said = np.flatnonzero(np.asarray(rows.status) & int(bit)).tolist()
    require(estimator, said == [k], f"{what} in row {k} is reported as {bit.name} in rows {said}")


def _unmarked(rows: Estimate) -> Estimate:
    """The same without the marks of a bad or missing sample."""
    marks = int(Status.BAD_INPUT | Status.MISSING)
    return replace(rows, status=np.asarray(rows.status) & ~marks)


def _check_absent_sensors(
    build: Callable[[Plant], Estimator], plant: LinearPlant, log: Observation
) -> None:
    """A sensor from which nothing arrives might as well not be there.

    The attack is compared where the sensor carries none: elsewhere the smaller plant may give
    it for another time.
    """
    estimator = build(plant)
    for i, name in enumerate(plant.outputs if len(plant.outputs) > 1 else ()):
        rest = np.delete(np.arange(len(plant.outputs)), i)
        blind = Observation.of(log.u, log.y, log.seen & (np.arange(len(plant.outputs)) != i))
        less = Observation.of(log.u, log.y[:, rest])
        smaller = build(_without(plant, rest))
        found = scan(estimator, estimator.init()[0], _screened(blind))
        expected = scan(smaller, smaller.init()[0], _screened(less))
        names = ["x", "x_cov"]
        carried = plant.H.values if isinstance(plant.H, Table) else plant.H
        if not np.any(np.asarray(carried)[..., i, :]):
            names += ["d", "d_cov", "d_free", "d_free_cov"]
        pairs = [{name: getattr(e, name) for name in names} for e in (found, expected)]
        contract = f"{name} absent is not like a plant without it"
        check_same(estimator, contract, *pairs, tolerance=REARRANGED)


def _without(plant: LinearPlant, rest: np.ndarray) -> LinearPlant:
    """The plant with the outputs ``rest`` alone."""

    def kept(matrix: Any, *axes: int) -> Any:
        if isinstance(matrix, Table):
            return Table(matrix.grid, kept(matrix.values, *axes))
        for axis in axes:
            matrix = jnp.take(matrix, rest, axis)
        return matrix

    R = kept(plant.R, -2, -1)
    white = None if plant.white is None else whitener(R, jnp.ones(len(rest), bool))
    return replace(
        plant,
        C=kept(plant.C, -2),
        D=kept(plant.D, -2),
        H=kept(plant.H, -2),
        R=R,
        white=white,
        outputs=tuple(plant.outputs[i] for i in rest),
    )
