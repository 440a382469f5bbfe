"""Local estimates joined so that a few lying sensors cannot break the whole.

    minimise over x, v, f   1/2 v' W^-1 v + gamma |f|   subject to   zeta = G x - v - f

with the local estimates zeta of `holdfast.estimators.decomposition`, solved exactly at every
row. Without x and v it is a (group) LASSO: x = F zeta + F f, f the minimiser of
1/2 |c - Z' f|^2 + gamma |f| with c = -Z' zeta, Z Z' = W^-1 (I - G F). While f = 0 it is the
Kalman filter.

Some sensors may be known to tell the truth. One that is always authenticated has no f. Samples
that are authenticated now and then feed a Kalman filter of their own (a local estimate remembers
old lies, so one good sample does not clean it), which joins the fusion without a penalty.

Source: DECOMPOSE (31) to (33), Theorems 3 and 4; Remark 2 for other gains.
"""

import warnings
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from holdfast.estimators.decomposition import Bank, advance, expect, local_bank, start
from holdfast.estimators.penalty import Chosen, Rule, begin, choose, costs, penalty, solve
from holdfast.estimators.witness import Witness, WitnessState, witness
from holdfast.numerics.lasso import Warm
from holdfast.numerics.linalg import RANK_TOLERANCE, dot
from holdfast.numerics.local import least_squares
from holdfast.parts import Estimator, InvalidValue
from holdfast.plants.linear import LinearPlant
from holdfast.records import Estimate, Observation, Status

ILL_CONDITIONED = 1e6
"""Condition of the paper's coordinates from which the l1 norm in them is warned of."""
WRONG = 1e-9
"""Relative violation of the optimality conditions from which a row is NOT_CONVERGED."""


class Fusion(eqx.Module):
    """How local estimates are joined: x = F zeta + F f, c = -Z' zeta, covariance P while f = 0."""

    F: Float[Array, "n N"]
    Z: Float[Array, "N r"]
    P: Float[Array, "n n"]


class SecureFusionState(eqx.Module):
    """``f`` (m x d): the part of each local error that is put down to a lie, in the bank's
    coordinates; ``size`` (m,): how large it is in standard deviations of that local error;
    ``residual``: the violation of the optimality conditions, ``pivots`` what the row took.
    """

    zeta: Float[Array, " N"]
    x: Float[Array, " n"]
    P: Float[Array, "n n"]
    warm: Warm | Float[Array, " M"] | None
    witness: WitnessState | None
    f: Float[Array, "m d"]
    size: Float[Array, " m"]
    residual: Float[Array, ""]
    pivots: Int[Array, ""]


class SecureFusion(Estimator):
    """The fusion of the module. ``weight`` (g,) holds gamma; ``chosen`` says what it costs.

    The covariance is P + F_A (Z_A Z_A')^-1 F_A' and the square of the penalty's pull, A being the
    columns with f != 0: right if the lies are among those. ``a`` of a row is the constant offset
    of each suspected sensor that would explain its f without the penalty's pull. With ``refit``
    the estimate is that of the other sensors, weighted anew. Where a sample is missing, W is
    still that of complete data.
    """

    plant: LinearPlant
    bank: Bank
    fusion: Fusion
    x0: Float[Array, " n"]
    P0: Float[Array, "n n"]
    weight: Float[Array, " g"]
    back: Float[Array, "N M"]
    inflow: Float[Array, " d"]
    scatter: Float[Array, "m d d"]
    witness: Witness | None
    group: tuple[int, ...] = eqx.field(static=True)
    kalman: bool = eqx.field(static=True)
    suspect: float = eqx.field(static=True)
    refit: bool = eqx.field(static=True)
    chosen: Chosen = eqx.field(static=True)

    @property
    def gamma(self) -> float:
        """The penalty in use."""
        return self.chosen.gamma

    def init(self) -> tuple[SecureFusionState, Estimate]:
        """The estimate one sample before the first row."""
        m, d = self.scatter.shape[:2]
        watching, warm = None, begin(self._columns(self.fusion), self._plain)
        if self.witness is not None:
            # its weights change from row to row, and what a row ends with is of no use to the next
            watching, warm = self.witness.init(self.x0, self.P0), None
        state = SecureFusionState(
            self.bank.init(self.x0), self.x0, self.P0, warm, watching,
            jnp.zeros((m, d)), jnp.zeros(m), jnp.zeros(()), jnp.asarray(0),
        )  # fmt: skip
        nothing = jnp.zeros(m), jnp.zeros((m, m)), jnp.asarray(0)
        first = Estimate.without_attack(self.x0, self.P0, *nothing, a=jnp.zeros(m))
        return state, first

    def step(
        self, state: SecureFusionState, observation: Observation
    ) -> tuple[SecureFusionState, Estimate]:
        """One row of every local filter, and their fusion."""
        expected = expect(self.plant, state.x, state.P, observation.u)
        zeta, innovation, spread, P = advance(
            self.plant, self.bank, state.zeta, expected, observation
        )
        watching = None
        if self.witness is None or state.witness is None:
            fusion, local, warm = self.fusion, zeta, state.warm
            # with another gain the fusion is still the best one, whose covariance is constant
            P = P if self.kalman else self.fusion.P
        else:
            watching = self.witness.step(state.witness, state.x, observation)
            fusion = Fusion(*self.witness.joined(watching))
            local, P = jnp.concatenate([zeta, watching.s]), fusion.P
            warm = begin(self._columns(fusion), self._plain)
        answer, warm = self._fused(fusion, local, P, warm)
        warm = warm if self.witness is None else None
        status = observation.status | jnp.where(
            answer.violation <= WRONG, 0, int(Status.NOT_CONVERGED)
        )
        status = status | jnp.where(answer.lost, int(Status.UNOBSERVABLE), 0)
        after = SecureFusionState(
            zeta, answer.x, P, warm, watching, answer.f, answer.size, answer.violation,
            answer.pivots,
        )  # fmt: skip
        estimate = Estimate.without_attack(
            answer.x, answer.x_cov, innovation, spread, status, a=answer.offset
        )
        return after, estimate

    @property
    def _plain(self) -> bool:
        return len(set(self.group)) == len(self.group)

    def _columns(self, fusion: Fusion) -> Float[Array, "M r"]:
        """Z' in the coordinates of the penalty."""
        return dot(self.back.T, fusion.Z[: self.back.shape[0]])

    def _fused(self, fusion: Fusion, local, P, warm):
        """The minimiser of a row, what it says of each sensor, and the estimate that follows."""
        m, d = self.scatter.shape[:2]
        columns, pull = self._columns(fusion), dot(fusion.F[:, : m * d], self.back)
        c = -dot(fusion.Z.T, local)
        solution, warm = solve(columns, self.weight, c, np.array(self.group, int), warm)
        f = dot(self.back, solution.f).reshape(m, d)
        size = jnp.sqrt(jnp.einsum("ide,id,ie->i", self.scatter, f, f))
        suspected = size > self.suspect
        lying = dot(jnp.repeat(suspected, d).astype(float), jnp.abs(self.back)) > 0

        active = solution.f != 0
        released = _Released.of(columns, lying)
        freed = released.solve(dot(columns, c))
        offset = -dot(dot(self.back, freed).reshape(m, d), self.inflow)
        offset = jnp.where(suspected & ~released.dependent, offset, 0.0)
        if self.refit:
            lost, chosen = released.dependent, jnp.where(released.dependent, active, lying)
            answer = jnp.where(lost, solution.f, freed)
            drawn = jnp.where(lost, dot(columns, solution.p), 0.0)
        else:
            lost, chosen, answer = jnp.asarray(False), active, solution.f
            drawn = dot(columns, solution.p)
        of_chosen = _Released.of(columns, chosen)
        half = of_chosen.half(pull.T)
        pulled = dot(pull, of_chosen.solve(drawn))
        x_cov = P + dot(half.T, half) + pulled[:, None] * pulled
        return _Answer(
            dot(fusion.F, local) + dot(pull, answer),
            jnp.where(of_chosen.dependent, jnp.diag(jnp.full(len(P), jnp.inf)), x_cov),
            f,
            size,
            offset,
            lost,
            solution.residual,
            solution.pivots,
        ), warm


class _Answer(NamedTuple):
    """What the fusion says at a row; ``lost``: without the suspected sensors it says nothing."""

    x: Float[Array, " n"]
    x_cov: Float[Array, "n n"]
    f: Float[Array, "m d"]
    size: Float[Array, " m"]
    offset: Float[Array, " m"]
    lost: Bool[Array, ""]
    violation: Float[Array, ""]
    pivots: Int[Array, ""]


class _Released(NamedTuple):
    """Least squares over marked columns: (Z_A Z_A')^-1, rows and columns scaled to one.

    ``dependent``: some marked column is a combination of others, and nothing is solved.
    """

    marked: Bool[Array, " M"]
    scale: Float[Array, " M"]
    lower: Float[Array, "M M"]
    dependent: Bool[Array, ""]

    @classmethod
    def of(cls, columns: Float[Array, "M r"], marked: Bool[Array, " M"]) -> "_Released":
        """The factor of the Gram matrix of the marked columns."""
        length = jnp.sqrt(jnp.sum(columns**2, 1))
        scale = jnp.where(marked & (length > 0), 1.0 / jnp.where(length > 0, length, 1.0), 0.0)
        unit = scale[:, None] * columns
        gram = dot(unit, unit.T)
        lower = jnp.linalg.cholesky(gram + jnp.diag(jnp.where(marked, RANK_TOLERANCE**1.5, 1.0)))
        pivots = jnp.where(marked, jnp.diagonal(lower) ** 2, 1.0)
        dependent = ~jnp.all(pivots > RANK_TOLERANCE)
        return cls(marked, scale, jnp.where(dependent, jnp.eye(len(marked)), lower), dependent)

    def half(self, b: Float[Array, "M *k"]) -> Float[Array, "M *k"]:
        """H with H' H = b' (Z_A Z_A')^-1 b."""
        shape = (-1,) + (1,) * (b.ndim - 1)
        scaled = self.scale.reshape(shape) * b
        return jax.scipy.linalg.solve_triangular(self.lower, scaled, lower=True)

    def solve(self, b: Float[Array, " M"]) -> Float[Array, " M"]:
        """(Z_A Z_A')^-1 b on the marked columns, 0 elsewhere."""
        back = jax.scipy.linalg.solve_triangular(self.lower, self.half(b), trans=1, lower=True)
        return self.scale * back


def build(
    plant: LinearPlant,
    x0=None,
    P0=None,
    *,
    gamma: float | None = None,
    rule: Rule | None = None,
    share: float | None = None,
    attack_size: float = 100.0,
    seed: int = 0,
    norm: Literal["modulus", "group"] = "modulus",
    gain: Any = None,
    bound: float | None = None,
    trusted: Sequence[str] = (),
    authenticated: Sequence[str] = (),
    suspect: float = 5.0,
    refit: bool = False,
) -> SecureFusion:
    """The secure fusion for a constant plant.

    ``gamma``, or a ``rule`` for it (`holdfast.estimators.penalty.choose`): "coincide" with
    ``share`` of the rows (0.95), "loss" of at most ``share`` of the mean squared error without
    attack (0.01, what is done unless told), "worst_case" over constant attacks of
    ``attack_size`` standard deviations of each sensor. ``norm``: the paper's modulus, or "group",
    one norm per sensor. ``gain``, ``bound``: as `decomposition.build`. ``trusted``: outputs that
    are always authenticated; ``authenticated``: outputs that are now and then, by the
    observation's flags. ``suspect``: standard deviations of its local error from which a sensor
    is suspected; ``refit``: estimate without the suspected.

    Raises `InvalidValue` for what cannot be, naming the key.
    """
    bank, local = local_bank(plant, gain, bound)
    honest, members = (
        _numbers(plant, "trusted", trusted),
        _numbers(plant, "authenticated", authenticated),
    )
    if gamma is not None and rule is not None:
        raise InvalidValue("rule", repr(rule), "no rule beside a gamma that is given")
    if gamma is not None and not (np.isfinite(gamma) and gamma > 0):
        raise InvalidValue("gamma", gamma, "a positive number")
    if not suspect > 0:
        raise InvalidValue("suspect", suspect, "a positive number of standard deviations")
    if norm == "modulus" and local.coordinates.condition > ILL_CONDITIONED:
        warnings.warn(
            f"the paper's coordinates have the condition number {local.coordinates.condition:.1g} "
            "here (eigenvalues of A - K C A nearly equal), and the l1 norm means little in them: "
            'norm = "group" does not depend on them',
            stacklevel=2,
        )
    fused, found = least_squares(local.G, local.W), penalty(local, norm, honest)
    if gamma is None:
        sizes = attack_size * np.sqrt(np.diagonal(np.asarray(plant.R)))
        rule = rule or "loss"
        share = _share(rule, share)
        chosen = choose(local, fused, found, rule, share, sizes, seed)
    else:
        chosen = costs(local, fused, found, gamma, seed)
    m, d = local.sensors, len(local.b)
    blocks = [local.W[i * d : (i + 1) * d, i * d : (i + 1) * d] for i in range(m)]
    settled = np.linalg.solve(np.eye(d) - local.S, local.b)
    return SecureFusion(
        plant=plant,
        bank=bank,
        fusion=Fusion(*map(jnp.asarray, (fused.F, fused.Z, fused.F @ local.W @ fused.F.T))),
        **dict(zip(("x0", "P0"), start(plant, x0, P0, local.P), strict=True)),
        weight=jnp.asarray(chosen.gamma * found.weight),
        back=jnp.asarray(found.back),
        inflow=jnp.asarray(settled / (settled @ settled)),
        scatter=jnp.asarray(np.linalg.inv(np.stack(blocks))),
        witness=witness(plant, local, members) if members else None,
        group=tuple(int(g) for g in found.group),
        kalman=gain is None and bound is None,
        suspect=suspect,
        refit=refit,
        chosen=chosen,
    )


def _share(rule: Rule, share: float | None) -> float:
    if share is None:
        return 0.95 if rule == "coincide" else 0.01
    if not 0 < share < 1:
        raise InvalidValue("share", share, "a number between 0 and 1")
    return share


def _numbers(plant: LinearPlant, key: str, names: Sequence[str]) -> list[int]:
    for name in names:
        if name not in plant.outputs:
            raise InvalidValue(key, repr(name), f"one of {', '.join(plant.outputs)}")
    return [plant.outputs.index(name) for name in names]
