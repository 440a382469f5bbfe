"""The 68-bus network of Section 7 under its attacks, and banks run over what was measured.

Simulated once per seed by the product's own loop; every bank sees the same rows. What the paper
leaves open is set as the errata found it: operating point 0.3 sin(i) rad, feedback linearisation
from the measured angles and frequencies (which nobody falsifies), x_0 ~ N(theta*, 0.01^2).
"""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from holdfast.attacks import bias, sine, switch
from holdfast.controllers import linearising
from holdfast.detectors import chi_square
from holdfast.estimators import nisme
from holdfast.loop import Monitor, Scenario, simulate
from holdfast.numerics.linalg import mahalanobis
from holdfast.parts import Attack, Estimator, Plant
from holdfast.plants.library import swing
from holdfast.records import Estimate, Observation

PLANT = swing.build()
CHANNELS = [f"channel:{name}" for name in PLANT.attacks]
SENSORS, ACTUATORS = list(PLANT.attacks[:3]), list(PLANT.attacks[3:])
LINES = PLANT.positions[-1]
"""Both lines open."""
BUSES = len(PLANT.buses)
SECONDS, SPELL = 40.0, 10.0
"""Length of a run, and of each of its four intervals."""
TRUE = (1, 2, 3, 0)
"""The true mode of each interval: sensors, actuators, lines, none."""
START_SD = 0.01
PRIOR = [0.01] * 3 + [0.3] * 3
"""How large an attack may well be: of a sensor of P_elec and of an actuator (per unit)."""
FLOOR = 1e-4
FREEZE = 1e-4
EVERY = 20
"""Rows from one whose residual is judged to the next."""
PRINTED_FLOOR = 0.033
PRINTED_Z, STRICT = 0.8, 0.99
"""The floor of the paper, and confidence levels of a z-test: as printed, and a stricter one."""
THREE = [SENSORS, ACTUATORS, {"switch": LINES}]
FOUR = [[], *THREE]
NAMES = ("none", "+".join(SENSORS), "+".join(ACTUATORS), LINES)
"""Modes 0 to 3 of case study 1."""
ALL_SIX = [{"attacks": [*SENSORS, *ACTUATORS], "switch": name} for name in PLANT.positions]


Rows = Float[Array, "seeds N m"] | np.ndarray


class Drawn(NamedTuple):
    """Runs of the network, seeds first, then rows 1 to N: state, input, measurement, and the
    attack that a row can tell (of sensors at k, of actuators at k - 1).
    """

    x: Rows
    u: Rows
    y: Rows
    d: Rows


class Told(NamedTuple):
    """What a bank said, seeds first: the mode by number of ``names``, its probabilities, state,
    attack with its standard deviations; ``size``: d' (P^d)^-1 d of the mode believed in; ``nis``
    and ``dof`` of its residual, at every `EVERY`-th row (0 elsewhere).
    """

    mode: np.ndarray
    p: np.ndarray
    x: np.ndarray
    d: np.ndarray
    sd: np.ndarray
    size: np.ndarray
    nis: np.ndarray
    dof: np.ndarray


class Measured(Estimator):
    """The measured angles and frequencies as they come: all that the controller uses."""

    plant: Plant

    def init(self) -> tuple[Float[Array, " n"], Estimate]:
        """The operating point."""
        return self._said(swing.operating_point(PLANT))

    def step(
        self, state: Float[Array, " n"], observation: Observation
    ) -> tuple[Float[Array, " n"], Estimate]:
        """Theta and f of the row."""
        _, theta, f = observation.y.reshape(BUSES, 3).T
        return self._said(jnp.concatenate([theta, f]))

    def _said(self, x) -> tuple[Float[Array, " n"], Estimate]:
        nothing = jnp.zeros(len(self.plant.outputs))
        n, ny = len(x), len(nothing)
        return x, Estimate.without_attack(x, jnp.zeros((n, n)), nothing, jnp.zeros((ny, ny)), 0)


def attacks(spell: float = SPELL) -> tuple[Attack, ...]:
    """0.01 cos(0.12 t) on three sensors, then 0.1 - 0.6 sin(0.3 t) on three actuators, then both
    lines open, each for ``spell`` seconds.
    """
    sensors, actuators = CHANNELS[:3], CHANNELS[3:]
    second = {"channels": actuators, "start": spell, "stop": 2 * spell}
    return (
        sine.build(
            PLANT, amplitude=0.01, frequency=0.12 / (2 * math.pi), phase=math.pi / 2,
            channels=sensors, stop=spell,
        ),
        bias.build(PLANT, value=0.1, **second),
        sine.build(PLANT, amplitude=-0.6, frequency=0.3 / (2 * math.pi), **second),
        switch.build(PLANT, to=LINES, start=2 * spell, stop=3 * spell),
    )  # fmt: skip


def keys(seeds: int) -> Key[Array, " seeds"]:
    """One key per seed; the first seeds stay the same where there are more."""
    return jax.vmap(jax.random.fold_in, (None, 0))(jax.random.key(0), jnp.arange(seeds))


@eqx.filter_jit
def drawn(seeds: Key[Array, " seeds"], given: tuple[Attack, ...], steps: int) -> Drawn:
    """The network under ``given`` attacks for ``steps`` samples, once per seed."""
    detector = chi_square.build(PLANT, on="attack")

    def one(key):
        start, run = jax.random.split(key)
        x = swing.operating_point(PLANT)
        x = x + START_SD * jax.random.normal(start, x.shape)
        monitor = Monitor(Measured(PLANT), detector)
        trace = simulate(Scenario(PLANT, x, monitor, linearising.build(PLANT), given), run, steps)
        assert trace.x is not None
        assert trace.injection is not None
        d = trace.injection.d
        moved = jnp.concatenate([jnp.zeros((1, 3)), d[:-1, 3:]])
        return Drawn(
            trace.x, trace.observation.u, trace.observation.y,
            jnp.concatenate([d[:, :3], moved], 1),
        )  # fmt: skip

    return jax.lax.map(one, seeds)


def bank(modes: Any, prior: float = 1.0, **settings: Any) -> nisme.Nisme:
    """A bank from theta*, 1e-4 I, its attack prior so many times `PRIOR`."""
    x = swing.operating_point(PLANT)
    given: dict[str, Any] = {"floor": FLOOR, "freeze": FREEZE} | settings
    sd = (prior * np.array(PRIOR)).tolist()
    return nisme.build(
        PLANT, x, START_SD**2 * np.eye(len(x)), modes=modes, attack_prior_sd=sd, **given
    )


def told(estimator: nisme.Nisme, runs: Drawn, seeds: int) -> Told:
    """What a bank says of the first ``seeds`` runs, one by one: one program serves any number."""
    each = []
    for u, y in zip(runs.u[:seeds], runs.y[:seeds], strict=True):
        rows = jax.tree.map(jnp.asarray, Observation.of(u, y))
        each.append(Told(*map(np.asarray, _told(estimator, rows))))
    return Told(*map(np.stack, zip(*each, strict=True)))


@eqx.filter_jit
def _told(estimator: nisme.Nisme, observations: Observation):
    def row(state, observation):
        state, e = estimator.step(state, observation)
        nis, dof = jax.lax.cond(
            state.k % EVERY == 0,
            lambda: mahalanobis(e.residual, e.residual_cov),
            lambda: (jnp.asarray(0.0), jnp.asarray(0)),
        )
        size, _ = mahalanobis(e.d, e.d_cov)
        return state, (e.mode, e.p, e.x, e.d, jnp.sqrt(jnp.diagonal(e.d_cov)), size, nis, dof)

    return jax.lax.scan(row, estimator.init()[0], observations)[1]


def interval(steps: int, spell: float = SPELL) -> np.ndarray:
    """In which of the four intervals each of the rows 1 to ``steps`` is."""
    return np.minimum(np.arange(1, steps + 1) // round(spell / PLANT.dt), len(TRUE) - 1)


def true_modes(place: np.ndarray) -> np.ndarray:
    """The true mode, 0 to 3, of rows in these intervals."""
    return np.array(TRUE)[place]


def of_case_1(mode: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    """Modes by their number in case study 1; 4 for every other mode, as in Fig. 6."""
    return np.array([NAMES.index(n) if n in NAMES else len(NAMES) for n in names])[mode]


def accuracy(right: np.ndarray, place: np.ndarray) -> np.ndarray:
    """The share of ``right`` rows (seeds x N) in each interval (seeds x 4)."""
    return np.stack([right[:, place == i].mean(1) for i in range(len(TRUE))], 1)


class Amount(NamedTuple):
    """Seeds of the four-mode bank, of all that it is compared with, and of the full bank, whose
    other likelihoods are run with intervals of ``short`` seconds.
    """

    seeds: int = 10
    few: int = 2
    full: int = 3
    short: float = 1.0


class Said(NamedTuple):
    """What a bank said: its modes by their number in case study 1, and ``right``: where true."""

    mode: np.ndarray
    right: np.ndarray
    told: Told
    place: np.ndarray

    @property
    def accuracy(self) -> np.ndarray:
        """Seeds x 4."""
        return accuracy(self.right, self.place)


class Run(NamedTuple):
    """The network, and by name what each bank said of it."""

    drawn: Drawn
    said: dict[str, Said]


def at_each(level: float) -> float:
    """The false-alarm budget of a row in which six tests have the confidence ``level`` each."""
    return 1.0 - level ** len(PLANT.attacks)


def banks() -> dict[str, Any]:
    """The banks that are compared with the four-mode one, by name."""
    four, reduced = FOUR, {"modes": "all", "bank": ALL_SIX}
    found = {}
    for likelihood in ("paper", "quadratic"):
        found[f"four, {likelihood}"] = {"modes": four, "likelihood": likelihood}
        printed = {"modes": THREE, "likelihood": likelihood, "floor": PRINTED_FLOOR}
        found[f"three, {likelihood}"] = printed
        found[f"reduced, {likelihood}"] = reduced | {"likelihood": likelihood}
    for word, prior in (("x 10", 10.0), ("/ 10", 0.1)):
        found[f"four, prior {word}"] = {"modes": four, "prior": prior}
        found[f"reduced, prior {word}"] = reduced | {"prior": prior}
    found["reduced"] = reduced
    found["reduced, printed"] = reduced | {"level": at_each(PRINTED_Z)}
    found["reduced, strict"] = reduced | {"level": at_each(STRICT)}
    return found


def drive(amount: Amount = Amount()) -> Run:  # noqa: B008
    """Everything that is simulated and estimated."""
    steps = round(SECONDS / PLANT.dt)
    runs = drawn(keys(max(amount[:3])), attacks(), steps)
    place = interval(steps)
    said = {"four": asked(runs, place, amount.seeds, modes=FOUR)}
    for name, settings in banks().items():
        said[name] = asked(runs, place, amount.few, **settings)
    said["full"] = asked(runs, place, amount.full, modes="all")
    steps = round(4 * amount.short / PLANT.dt)
    brief = drawn(keys(amount.few), attacks(amount.short), steps)
    place = interval(steps, amount.short)
    for likelihood in ("paper", "quadratic"):
        found = asked(brief, place, amount.few, modes="all", likelihood=likelihood)
        said[f"full, {likelihood}"] = found
    return Run(runs, said)


def asked(runs: Drawn, place: np.ndarray, seeds: int, **settings: Any) -> Said:
    """A bank run over the first seeds."""
    estimator = bank(**settings)
    return judged_by(told(estimator, runs, seeds), estimator.named, place)


def judged_by(told: Told, names: tuple[str, ...], place: np.ndarray) -> Said:
    """What was said beside what was true."""
    mode = of_case_1(told.mode, names)
    return Said(mode, mode == true_modes(place), told, place)
