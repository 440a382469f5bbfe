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
from scipy.special import chdtri

from holdfast.estimators.decomposition import Bank, advance, expect, local_bank, start
from holdfast.estimators.fusion_keys import check, numbers
from holdfast.estimators.penalty import (
    MANY,
    Chosen,
    Rule,
    begin,
    choose,
    costs,
    penalty,
    solve,
)
from holdfast.estimators.witness import Witness, WitnessState, witness
from holdfast.numerics.lasso import Warm
from holdfast.numerics.linalg import dot
from holdfast.numerics.local import least_squares
from holdfast.numerics.released import Released
from holdfast.parts import Estimator
from holdfast.plants.linear import LinearPlant
from holdfast.records import Estimate, Observation, Status

ILL_CONDITIONED = 1e6
"""Condition of the paper's coordinates from which the l1 norm in them is warned of."""
RELEASED = 0.01
"""Share of rows in which an honest sensor would still be held under suspicion."""
WRONG = 1e-9
"""Relative violation of the optimality conditions from which a row is NOT_CONVERGED."""


class Fusion(eqx.Module):
    """How local estimates are joined: x = F zeta + F f, c = -Z' zeta, covariance P while f = 0."""

    F: Float[Array, "n N"]
    Z: Float[Array, "N r"]
    P: Float[Array, "n n"]


class SecureFusionState(eqx.Module):
    """``f`` (m x d): the part of each local error that is put down to a lie, in the bank's
    coordinates; ``size`` (m,): what it changes, in standard deviations of the sharpest test;
    ``suspected`` (m,); ``residual``: the violation of the optimality conditions,
    ``pivots`` what the row took.
    """

    zeta: Float[Array, " N"]
    x: Float[Array, " n"]
    P: Float[Array, "n n"]
    warm: Warm | Float[Array, " M"] | None
    witness: WitnessState | None
    f: Float[Array, "m d"]
    size: Float[Array, " m"]
    suspected: Bool[Array, " m"]
    residual: Float[Array, ""]
    pivots: Int[Array, ""]


class SecureFusion(Estimator):
    """The fusion of the module. ``weight`` (g,) holds gamma; ``chosen`` says what it costs.

    The covariance is P + F_A (Z_A Z_A')^-1 F_A' and the square of the penalty's pull, A being the
    columns with f != 0: right if the lies are among those and it is not noise that chooses them
    (with a small gamma it is: then some 10 % short under a lie, and too large without one). ``a``
    of a row is the sample of each suspected sensor less what the others, weighted anew, say it
    should be. With ``refit`` the estimate is that of the other sensors, weighted anew, as long as
    somebody is suspected. Where a sample is missing, W is still that of complete data.
    """

    plant: LinearPlant
    bank: Bank
    fusion: Fusion
    x0: Float[Array, " n"]
    P0: Float[Array, "n n"]
    weight: Float[Array, " g"]
    back: Float[Array, "N M"]
    release: Float[Array, ""]
    witness: Witness | None
    group: tuple[int, ...] = eqx.field(static=True)
    plain: bool = eqx.field(static=True)
    kalman: bool = eqx.field(static=True)
    refit: bool = eqx.field(static=True)
    suspect: Float[Array, ""]
    chosen: Chosen

    @property
    def gamma(self) -> float:
        """The penalty in use."""
        return float(self.chosen.gamma)

    @property
    def quick(self) -> bool:
        """Whether a row costs some ten filter steps, and not hundreds."""
        return self.plain and self.witness is None and len(self.group) <= MANY

    def init(self) -> tuple[SecureFusionState, Estimate]:
        """The estimate one sample before the first row."""
        m, d = len(self.plant.outputs), len(self.bank.b)
        watching, warm = None, begin(self._columns(self.fusion), self.plain)
        if self.witness is not None:
            # its weights change from row to row, and what a row ends with is of no use to the next
            watching, warm = self.witness.init(self.x0, self.P0), None
        state = SecureFusionState(
            self.bank.init(self.x0), self.x0, self.P0, warm, watching,
            jnp.zeros((m, d)), jnp.zeros(m), jnp.zeros(m, bool), jnp.zeros(()), jnp.asarray(0),
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
            warm = begin(self._columns(fusion), self.plain)
        answer, warm = self._fused(fusion, local, P, warm, state.suspected)
        warm = warm if self.witness is None else None
        status = observation.status | jnp.where(
            answer.violation <= WRONG, 0, int(Status.NOT_CONVERGED)
        )
        status = status | jnp.where(answer.lost, int(Status.UNOBSERVABLE), 0)
        after = SecureFusionState(
            zeta, answer.x, P, warm, watching, answer.f, answer.size, answer.suspected,
            answer.violation, answer.pivots,
        )  # fmt: skip
        m = self.plant.at(1, answer.others, observation.u)
        off = observation.y - dot(m.C, answer.others) - dot(m.D, observation.u)
        estimate = Estimate.without_attack(
            answer.x, answer.x_cov, innovation, spread, status,
            a=jnp.where(answer.known & observation.seen, off, 0.0),
        )  # fmt: skip
        return after, estimate

    def _columns(self, fusion: Fusion) -> Float[Array, "M r"]:
        """Z' in the coordinates of the penalty."""
        return dot(self.back.T, fusion.Z[: self.back.shape[0]])

    def _fused(self, fusion: Fusion, local, P, warm, held: Bool[Array, " m"]):
        """The minimiser of a row, what it says of each sensor, and the estimate that follows.

        A sensor that was suspected (``held``) stays so while what the others say of it differs
        from zero: a penalty hides the tail of a lie.
        """
        m, d = len(held), len(self.bank.b)
        columns = self._columns(fusion)
        pull = dot(fusion.F[:, : m * d], self.back)
        member = jnp.any(self.back.reshape(m, d, -1) != 0, 1).astype(float)

        def sizes(f):
            return jnp.sqrt(jnp.sum(dot(member * f, columns) ** 2, 1))

        c = -dot(fusion.Z.T, local)
        solution, warm = solve(columns, self.weight, c, np.array(self.group, int), warm)
        size = sizes(solution.f)
        lying = dot(((size > self.suspect) | held).astype(float), member) > 0

        active = solution.f != 0
        released = Released.of(columns, lying)
        freed = released.solve(dot(columns, c))
        held = held & ~released.dependent & (sizes(freed) > self.release)
        suspected = (size > self.suspect) | held
        kalman = dot(fusion.F, local)
        lost = jnp.asarray(False)
        chosen, answer, drawn = active, solution.f, dot(columns, solution.p)
        if self.refit:
            lost = released.dependent
            # while nobody is suspected the penalty is what guards against a lie that is still small
            fresh = jnp.any(lying) & ~lost
            chosen, answer = jnp.where(fresh, lying, active), jnp.where(fresh, freed, answer)
            drawn = jnp.where(fresh, 0.0, drawn)
        of_chosen = Released.of(columns, chosen)
        half = of_chosen.half(pull.T)
        pulled = dot(pull, of_chosen.solve(drawn))
        x_cov = P + dot(half.T, half) + pulled[:, None] * pulled
        return _Answer(
            kalman + dot(pull, answer),
            jnp.where(of_chosen.dependent, jnp.diag(jnp.full(len(P), jnp.inf)), x_cov),
            dot(self.back, solution.f).reshape(m, d),
            size,
            kalman + dot(pull, freed),
            suspected,
            suspected & ~released.dependent,
            lost,
            solution.residual,
            solution.pivots,
        ), warm


class _Answer(NamedTuple):
    """What the fusion says at a row; ``others``: the estimate without the suspected sensors;
    ``known``: the suspected, where there is one; ``lost``: there is none, and it was asked for.
    """

    x: Float[Array, " n"]
    x_cov: Float[Array, "n n"]
    f: Float[Array, "m d"]
    size: Float[Array, " m"]
    others: Float[Array, " n"]
    suspected: Bool[Array, " m"]
    known: Bool[Array, " m"]
    lost: Bool[Array, ""]
    violation: Float[Array, ""]
    pivots: Int[Array, ""]


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
    observation's flags. ``suspect``: what a lie has to change, in standard deviations,
    for its sensor to be suspected; ``refit``: estimate without the suspected.

    Raises `InvalidValue` for what cannot be, naming the key.
    """
    bank, local = local_bank(plant, gain, bound)
    honest, members = (
        numbers(plant, "trusted", trusted),
        numbers(plant, "authenticated", authenticated),
    )
    check(gamma, rule, share, attack_size, norm, suspect)
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
        sizes[honest] = 0.0
        usual = 0.95 if rule == "coincide" else 0.01
        share = usual if share is None else share
        chosen = choose(local, fused, found, rule or "loss", share, sizes, seed)
    else:
        chosen = costs(local, fused, found, float(gamma), seed)
    return SecureFusion(
        plant=plant,
        bank=bank,
        fusion=Fusion(*map(jnp.asarray, (fused.F, fused.Z, fused.F @ local.W @ fused.F.T))),
        **dict(zip(("x0", "P0"), start(plant, x0, P0, local.P), strict=True)),
        weight=jnp.asarray(chosen.gamma * found.weight),
        back=jnp.asarray(found.back),
        release=jnp.sqrt(jnp.asarray(chdtri(len(local.b), RELEASED))),
        witness=witness(plant, local, members) if members else None,
        group=tuple(int(g) for g in found.group),
        plain=found.plain,
        kalman=gain is None and bound is None,
        suspect=jnp.asarray(suspect, float),
        refit=refit,
        chosen=jax.tree.map(lambda found: jnp.asarray(found, float), chosen),
    )
