"""Every contract can fail: one deliberately broken part each."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from holdfast.attacks import bias
from holdfast.detectors import chi_square
from holdfast.estimators import kalman
from holdfast.parts import Attack, Detector, Estimator, Plant
from holdfast.plants.build import linear_plant
from holdfast.records import Status
from holdfast.testing import check_attack, check_detector, check_estimator
from holdfast.testing.common import check_part

PLANT = linear_plant(
    A=[[0.9]], B=[[1.0]], C=[[1.0], [1.0]], G=[[1.0]], H=[[0.0], [0.0]], Q=[[1.0]], R=np.eye(2)
)


class Spoiled(Estimator):
    """A Kalman filter whose steps are spoiled by ``how``."""

    plant: Plant
    inner: Estimator
    how: object = eqx.field(static=True)
    notes: list = eqx.field(static=True, default_factory=list)

    def init(self):
        return self.inner.init()

    def step(self, state, observation):
        return self.how(self, state, observation)


def changed(**changes):
    """The estimate with some fields put through a function of (value, observation)."""

    def how(part, state, observation):
        state, estimate = part.inner.step(state, observation)
        for name, change in changes.items():
            value = change(getattr(estimate, name), observation)
            estimate = eqx.tree_at(lambda e, name=name: getattr(e, name), estimate, value)
        return state, estimate

    return how


def trusting(part, state, observation):
    """Takes a missing sample for a zero."""
    observation = eqx.tree_at(lambda o: o.seen, observation, replace_fn=jnp.ones_like)
    return part.inner.step(state, observation)


def growing(part, state, observation):
    """A state of another type than it started with."""
    state, estimate = part.inner.step(state, observation)
    return eqx.tree_at(lambda s: s.k, state, state.k.astype(float)), estimate


def noting(part, state, observation):
    """Keeps notes in its settings."""
    part.notes.append(1)
    return part.inner.step(state, observation)


TRACES = []


def counting(part, state, observation):
    """Depends on how often it was compiled."""
    TRACES.append(1)
    return changed(x=lambda x, _: x + 1e-3 * len(TRACES))(part, state, observation)


BAD, MISSING = int(Status.BAD_INPUT), int(Status.MISSING)


@pytest.mark.parametrize(
    ("how", "contract"),
    [
        (trusting, "is not like a plant without it"),
        (growing, "step turns a state"),
        (noting, "stepping has changed the settings"),
        (counting, "differ"),
        (changed(x=lambda x, o: jnp.where(o.status > 0, jnp.nan, x)), "NaN in x"),
        (changed(x=lambda x, o: jnp.where(o.status > 0, jnp.inf, x)), "infinity in x"),
        (changed(x=lambda x, _: jnp.concatenate([x, x])), "x has shape"),
        (changed(x_cov=lambda p, _: -p), "x_cov has a negative variance"),
        (changed(residual_cov=lambda s, _: s.at[0, 1].add(0.1)), "residual_cov is not symmetric"),
        (
            changed(residual_cov=lambda s, _: s.at[0, 1].set(9.0).at[1, 0].set(9.0)),
            "residual_cov is not positive semidefinite",
        ),
        (
            changed(residual_cov=lambda s, _: s.at[0, 0].set(jnp.inf)),
            "is not 0 beside an infinite variance",
        ),
        (changed(status=lambda s, _: s & ~BAD), "is reported as BAD_INPUT in rows []"),
        (changed(status=lambda s, _: s & ~MISSING), "is reported as MISSING in rows []"),
        (changed(status=lambda s, _: s | 1024), "status has unknown bits 0x400"),
        (
            changed(x=lambda x, o: jnp.where(o.status & BAD, x + 1.0, x)),
            "is not like a missing sample",
        ),
    ],
)  # fmt: skip
def test_estimators(how, contract):
    def build(plant):
        return Spoiled(plant, kalman.build(plant, [0.0], [[1.0]]), how)

    with pytest.raises(AssertionError) as caught:
        check_estimator(build, PLANT, steps=8)
    assert contract in str(caught.value)


def test_a_sound_part_passes():
    check_estimator(kalman.build(PLANT, [0.0], [[1.0]]), steps=8)


class Judge(Detector):
    """A chi-square test whose verdict is spoiled by ``how``."""

    inner: Detector
    how: object = eqx.field(static=True)

    def init(self):
        return self.inner.init()

    def step(self, state, estimate):
        state, verdict = self.inner.step(state, estimate)
        return state, self.how(verdict)


def set_to(**changes):
    def how(verdict):
        for name, change in changes.items():
            verdict = eqx.tree_at(lambda v, name=name: getattr(v, name), verdict, change(verdict))
        return verdict

    return how


@pytest.mark.parametrize(
    ("how", "contract"),
    [
        (set_to(statistic=lambda v: jnp.sqrt(1.0 - v.statistic)), "NaN in statistic"),
        (set_to(reason=lambda v: jnp.zeros_like(v.reason)), "an alarm without a reason"),
        (set_to(reason=lambda v: v.reason * 50), "reason codes [100]"),
        (set_to(channel_alarms=lambda v: jnp.ones(2, bool)), "a channel's alarm without an alarm"),
        (set_to(threshold=lambda v: jnp.zeros(())), "with nothing to test"),
        (
            set_to(alarm=lambda v: jnp.asarray(False), reason=lambda v: jnp.zeros_like(v.reason)),
            "no alarm at an attack",
        ),
    ],
)
def test_detectors(how, contract):
    with pytest.raises(AssertionError) as caught:
        check_detector(Judge(chi_square.build(PLANT), how), PLANT, steps=8)
    assert contract in str(caught.value)


class Spoiler(Attack):
    """A bias spoiled by ``how``."""

    inner: Attack
    how: object = eqx.field(static=True)

    def init(self, key, known):
        return self.inner.init(key, known)

    def step(self, state, known):
        state, injection = self.inner.step(state, known)
        return state, self.how(injection)


def unseeded(injection):
    drawn = np.random.default_rng().normal()
    return jax.tree.map(lambda leaf: leaf + drawn, injection)


@pytest.mark.parametrize(
    ("how", "contract"),
    [
        (lambda i: eqx.tree_at(lambda i: i.y, i, jnp.zeros(3)), "injection.y has shape (3,)"),
        (lambda i: eqx.tree_at(lambda i: i.y, i, i.y * jnp.nan), "NaN in y"),
        (lambda i: i.y, "does not return an Injection"),
        (unseeded, "single steps differ from a scan"),
    ],
)
def test_attacks(how, contract):
    inner = bias.build(PLANT, channel="sensor:y1", value=1.0)
    with pytest.raises(AssertionError) as caught:
        check_attack(Spoiler(inner, how), PLANT, steps=8)
    assert contract in str(caught.value)


class Heir(Spoiler):
    """Derives from a part that is final."""


class Loose(Attack):
    """A part that can be changed."""

    value: float = 1.0

    def __setattr__(self, name, value):
        object.__setattr__(self, name, value)

    def init(self, key, known):
        return ()

    def step(self, state, known):
        raise NotImplementedError


def test_parts_are_frozen_and_final():
    inner = bias.build(PLANT, channel="sensor:y1", value=1.0)
    with pytest.raises(AssertionError, match="Heir: derives from"):
        check_attack(Heir(inner, lambda i: i), PLANT)
    with pytest.raises(AssertionError, match="Window: is not a Detector"):
        check_part(inner, Detector)
    with pytest.raises(AssertionError, match="Loose: is not frozen"):
        check_attack(Loose(), PLANT)
