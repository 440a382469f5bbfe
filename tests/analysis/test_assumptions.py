"""NISE's assumptions on plants for which it is known by hand which of them hold."""

import jax.numpy as jnp
import numpy as np
import pytest

from analysis.models import plant
from holdfast.analysis.assumptions import assumptions, on_assumptions
from holdfast.plants.nonlinear import nonlinear_plant

COUPLED = np.array([[0.9, 0.0], [0.1, 0.8]])


def bent(f, h, ny=2, Q=None, attacks=("d",)):
    """Two states, by functions."""
    return nonlinear_plant(
        f, h, Q=1e-2 * np.eye(2) if Q is None else Q, R=np.eye(ny), dt=0.1, states=("a", "b"),
        outputs=tuple(f"y{i}" for i in range(ny)), attacks=attacks,
    )  # fmt: skip


def judged(found_plant, channels=(0,), x0=(0.0, 0.0)):
    n = len(found_plant.states)
    found = assumptions(found_plant, np.asarray(x0)[:n], np.eye(n), channels)
    return {one.name.removeprefix("Assumption "): one for one in found}


def holds(found):
    return [found[name].holds for name in ("4.1", "5.1", "5.2", "5.3", "5.4")]


def test_a_linear_plant_meets_all_but_what_is_the_attackers():
    linear = plant(COUPLED, [[1.0], [0.0]], np.vstack([np.eye(2), np.ones((1, 2))]))
    found = judged(linear)
    assert holds(found) == [True, None, True, True, True]
    assert found["5.3"].sentence == "f and h are linear"
    assert found["5.4"].sentence == "(C_3, Abar) is observable: Lemma 5.1"
    assert "|A| <= 0.922" in found["5.2"].sentence
    assert np.linalg.norm(COUPLED, 2) == pytest.approx(0.922, abs=5e-4)


def test_a_pair_that_is_not_observable_may_do_all_the_same():
    """y = x + v tells x at once, though C_3 has no rows."""
    found = judged(plant([[0.9]], [[1.0]], [[1.0]]))
    assert found["5.4"].holds
    assert found["5.4"].sentence.startswith("1 sample determines the state")


def test_what_no_sample_tells_must_fade():
    """Of diag(.5, a) only the first state is measured."""
    for a, wanted in ((0.5, True), (1.1, False)):
        half = plant(np.diag([0.5, a]), [[1.0], [0.0]], [[1.0, 0.0]], [[0.0]])
        found = judged(half, channels=())
        assert found["5.4"].holds is wanted, a
    assert "grows without limit" in found["5.4"].sentence


def test_noise_without_a_lower_bound():
    found = judged(plant(COUPLED, [[1.0], [0.0]], np.eye(2), Q=np.diag([1.0, 0.0])))
    assert (found["5.2"].holds, found["5.4"].holds) == (False, None)
    assert "Q is singular" in found["5.2"].sentence


def turned(x, u, d):
    """The attack acts along a direction that the state gives."""
    return jnp.stack([0.9 * x[0] + d[0] * jnp.cos(x[1]), 0.8 * x[1] + d[0] * jnp.sin(x[1])])


def straight(x, u, d):
    return jnp.stack([0.9 * x[0] + 0.1 * jnp.sin(x[1]) + d[0], 0.8 * x[1]])


def both(x, u, d):
    return x


def test_what_assumption_4_1_is_about():
    # only what is attacked is turned, and only what is free of attack may be bent
    found = judged(bent(turned, both))
    assert found["4.1"] == found["4.1"]._replace(holds=False)
    assert "(G_2)" in found["4.1"].sentence
    assert judged(bent(turned, both), channels=())["4.1"].holds
    bent_beside = judged(bent(straight, lambda x, u, d: jnp.stack([x[0], jnp.sin(x[1])])))
    assert bent_beside["4.1"].holds
    assert bent_beside["5.3"].holds
    assert "of second order" in bent_beside["5.3"].sentence
    bent_there = judged(bent(straight, lambda x, u, d: jnp.stack([jnp.tanh(x[0]), x[1]])))
    assert "(z_2)" in bent_there["4.1"].sentence
    scaled = judged(bent(straight, lambda x, u, d: jnp.stack([x[0] + d[0] * x[1], x[1]])))
    assert "(H)" in scaled["4.1"].sentence
    # at b = 0 the output does not show the attack
    assert "reaches no output" in scaled["5.2"].sentence


def test_a_corner():
    # |x|^1.5 at 0: its derivative is there, its second one is not
    corner = lambda x, u, d: jnp.stack([x[0], (x[1] ** 2 + 1e-300) ** 0.75, x[1]])  # noqa: E731
    found = judged(bent(straight, corner, ny=3))
    assert not found["5.3"].holds
    assert "not of second order" in found["5.3"].sentence


def test_no_derivative():
    with pytest.warns(UserWarning, match="derivative"):
        rooted = bent(lambda x, u, d: jnp.sqrt(x), both, attacks=())
    found = judged(rooted, channels=(), x0=(-1.0, 1.0))
    assert {name: one.holds for name, one in found.items()} == {
        "4.1": False, "5.1": None, "5.2": False, "5.3": False, "5.4": False,
    }  # fmt: skip
    assert "not finite" in found["5.2"].sentence


def test_sentences_about_the_largest_sets_and_only_what_is_not_met():
    two = plant(COUPLED, [[1.0, 0.0], [0.0, 0.0]], np.eye(2), [[0.0, 0.0], [0.0, 1.0]],
                Q=np.diag([1.0, 0.0]))  # fmt: skip
    said = on_assumptions(two, np.zeros(2), np.eye(2), [(), (0,), (1,), (0, 1), (0,)])
    assert said == [
        "With d1+d2 attacked, Assumption 5.2 of NISE is not met: the process noise has no lower "
        "bound: Q is singular."
    ]
    assert on_assumptions(two, np.zeros(2), np.eye(2), []) == []
