"""The contract of a detector."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from holdfast.parts import Detector, Plant
from holdfast.records import Estimate, Reason, Verdict
from holdfast.testing.common import check_machine, check_no_nan, check_part, require, scan


def check_detector(detector: Detector, plant: Plant, *, steps: int = 40, seed: int = 0) -> None:
    """Check a detector for estimates of ``plant``.

    Single steps, a scan and a batch give the same numbers; verdicts hold no NaN; an alarm has
    a reason, no alarm none; where nothing was ever determined there is no alarm, and an
    attack a million times the noise raises one (if the detector finds anything to test); the
    part is frozen and final and stepping does not change it.

    Raises `AssertionError` naming the contract that is broken.
    """
    check_part(detector, Detector)
    sound = _estimates_of(plant, steps, seed)
    state = detector.init()
    check_machine(detector, state, sound)
    blind = _undetermined(sound, slice(None))
    mixed = _undetermined(sound, slice(steps // 3, steps // 2))
    loud = eqx.tree_at(lambda e: (e.d, e.d_free, e.residual), sound, replace_fn=lambda v: v + 1e6)
    for name, rows in {"sound": sound, "mixed": mixed, "blind": blind, "loud": loud}.items():
        _check_verdicts(detector, scan(detector, state, rows), f"over {name} estimates")
    verdicts = scan(detector, state, blind)
    quiet = ~verdicts.alarm & jnp.isinf(verdicts.threshold)
    require(detector, bool(jnp.all(quiet)), "alarm or finite threshold with nothing to test")
    tests = bool(jnp.any(jnp.isfinite(scan(detector, state, sound).threshold)))
    woken = not tests or bool(jnp.any(scan(detector, state, loud).alarm))
    require(detector, woken, "no alarm at an attack a million times the noise")


def _estimates_of(plant: Plant, steps: int, seed: int) -> Estimate:
    """Records as an estimator of the plant would write: Gaussian with the covariance stated."""
    sizes = len(plant.states), len(plant.attacks), len(plant.outputs)
    keys = jax.random.split(jax.random.key(seed), 2 * len(sizes))
    values, covs = [], []
    for m, shape_key, draw_key in zip(sizes, keys[::2], keys[1::2], strict=True):
        factor = jnp.eye(m) + 0.3 * jax.random.normal(shape_key, (m, m))
        values.append(jax.random.normal(draw_key, (steps, m)) @ factor.T)
        cov = factor @ factor.T
        covs.append(jnp.broadcast_to((cov + cov.T) / 2, (steps, m, m)))
    (x, d, residual), (x_cov, d_cov, residual_cov) = values, covs
    none = jnp.zeros((steps, 0, sizes[1])), jnp.zeros((steps, 0))
    status = jnp.zeros(steps, jnp.int32)
    return Estimate(x, x_cov, d, d_cov, d, d_cov, *none, residual, residual_cov, status)


def _undetermined(rows: Estimate, where: slice) -> Estimate:
    """The records with attacks unknown and residuals empty in the rows ``where``."""
    unknown = jnp.diag(jnp.full(rows.d.shape[-1], jnp.inf))
    zeros = {name: 0.0 for name in ("d", "d_free", "residual", "residual_cov")}
    changed = zeros | {"d_cov": unknown, "d_free_cov": unknown}
    return replace(
        rows, **{k: getattr(rows, k).at[where].set(value) for k, value in changed.items()}
    )


def _check_verdicts(detector: Detector, rows: Verdict, where: str) -> None:
    """No NaN, an alarm has a reason, no alarm none, a channel's alarm is an alarm."""
    check_no_nan(detector, rows, where)
    codes = set(np.unique(np.asarray(rows.reason)).tolist())
    strange = codes - set(map(int, Reason))
    require(detector, not strange, f"reason codes {sorted(strange)} are not in the list {where}")
    agree = bool(jnp.all((rows.reason != int(Reason.NONE)) == rows.alarm))
    require(detector, agree, f"an alarm without a reason, or a reason without alarm {where}")
    covered = bool(jnp.all(~jnp.any(rows.channel_alarms, -1) | rows.alarm))
    require(detector, covered, f"a channel's alarm without an alarm {where}")
