import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from holdfast.controllers.feedback import build
from holdfast.parts import InvalidValue
from holdfast.plants.build import linear_plant
from holdfast.plants.library import tanks
from holdfast.records import Estimate


def plant_of(A, B, **others):
    n = np.shape(A)[-1]
    return linear_plant(A=A, B=B, C=np.eye(n), Q=np.eye(n), R=np.eye(n), **others)


def estimate_of(x):
    n = len(x)
    return Estimate.without_attack(
        jnp.asarray(x, float), jnp.eye(n), jnp.zeros(n), jnp.eye(n), jnp.asarray(0)
    )


def gain_of(controller):
    """The columns of -command at unit states."""
    n = controller.reference.shape[0]
    zero = np.asarray(controller.command(estimate_of(np.zeros(n))))
    return np.stack([zero - controller.command(estimate_of(row)) for row in np.eye(n)], 1)


def test_scalar_closed_form():
    # s solves s = q + a^2 s r / (r + b^2 s): a quadratic in s
    a, b, q, r = 1.2, 0.5, 2.0, 3.0
    s = max(np.roots([b * b, r - a * a * r - q * b * b, -q * r]).real)
    controller = build(plant_of([[a]], [[b]]), state_weight=[[q]], input_weight=[[r]])
    np.testing.assert_allclose(gain_of(controller), [[a * b * s / (r + b * b * s)]], rtol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_no_other_gain_costs_less(seed):
    rng = np.random.default_rng(seed)
    A, B = rng.normal(size=(4, 4)) * 0.7, rng.normal(size=(4, 2))
    X, U = np.cov(rng.normal(size=(4, 9))), np.cov(rng.normal(size=(2, 9)))
    controller = build(plant_of(A, B), state_weight=X.tolist(), input_weight=U.tolist())
    K = gain_of(controller)

    def cost(K):
        """Sum over time of x'Xx + u'Uu from x_0 ~ (0, I), by Lyapunov's equation."""
        closed = A - B @ K
        assert max(abs(np.linalg.eigvals(closed))) < 1
        return np.trace(scipy.linalg.solve_discrete_lyapunov(closed.T, X + K.T @ U @ K))

    size = np.abs(K).max()
    for _ in range(10):
        aside = rng.normal(size=K.shape)
        aside *= 1e-3 * size / np.linalg.norm(aside)
        # at the optimum the slope vanishes: both sides cost more, and equally much
        above, below = cost(K + aside) - cost(K), cost(K - aside) - cost(K)
        assert above > 0
        assert below > 0
        assert abs(above - below) < 0.1 * (above + below)


def test_holds_the_reference():
    dt = 0.1
    plant = plant_of([[1, dt], [0, 1]], [[dt**2 / 2], [dt]])
    controller = build(
        plant, state_weight=[[1, 0], [0, 0]], input_weight=[[1]], reference=[7.0, 0.0]
    )
    x = np.zeros(2)
    for _ in range(300):
        x = np.asarray(plant.A) @ x + np.asarray(plant.B) @ controller.command(estimate_of(x))
    np.testing.assert_allclose(x, [7, 0], atol=1e-6)


GOOD = {"state_weight": [[1, 0], [0, 1]], "input_weight": [[1]]}


@pytest.mark.parametrize(
    ("A", "B", "keys", "message"),
    [
        ([[1.1, 0], [0, 0.5]], [[0], [1]], {}, "no input that reaches the mode 1.1"),
        ([[1.1, 0], [0, 0.5]], np.zeros((2, 0)), {}, "plant.B: found no inputs"),
        ([[1.1, 0], [0, 0.5]], [[1], [0]], {"state_weight": [[0, 0], [0, 1]]}, "no weight on the"),
        ([[1.1, 0], [0, 0.5]], [[1], [0]], {"state_weight": [[1]]}, "state_weight: found shape"),
        ([[1.1, 0], [0, 0.5]], [[1], [0]], {"input_weight": [[0]]}, "input_weight: found [[0]]"),
        ([[1.1, 0], [0, 0.5]], [[1], [0]], {"reference": [1]}, "reference: found [1]"),
        ([[1.1, 0], [0, 0.5]], [[1], [0]], {"state_weight": [[1, 2], [0, 1]]}, "not symmetric"),
        ([[1.1, 0], [0, 0.5]], [[1], [0]], {"state_weight": [[1, 2], [2, 1]]}, "negative eigen"),
        (np.ones((3, 2, 2)), [[1], [0]], {}, "plant: found matrices that change"),
    ],
)
def test_wrong_settings_are_named(A, B, keys, message):
    with pytest.raises(InvalidValue) as caught:
        build(plant_of(A, B), **{**GOOD, **keys})
    assert message in str(caught.value)


def test_a_stable_mode_need_not_be_reached():
    controller = build(plant_of([[1.1, 0], [0, 0.5]], [[1], [0]]), **GOOD)
    assert np.all(np.isfinite(controller.gain))


def test_holds_the_operating_point_of_a_nonlinear_plant():
    """Tanks: linearised where they stand, against the differences of the plant itself."""
    plant = tanks.build()
    flows = [0.022, 0.015]
    levels = tanks.operating_point(flows)
    controller = build(
        plant, state_weight=np.eye(4).tolist(), input_weight=(1e3 * np.eye(2)).tolist(),
        reference=levels.tolist(), command=flows,
    )  # fmt: skip
    step, none = jnp.asarray(1, jnp.int32), jnp.zeros(0)
    transition = jax.jit(lambda x, u: plant.transition(step, x, u, none))

    def moved(x, u):
        return np.asarray(transition(jnp.asarray(x), jnp.asarray(u)))

    h = 1e-5
    A = np.stack([(moved(levels + h * e, flows) - moved(levels - h * e, flows)) / (2 * h)
                  for e in np.eye(4)], 1)  # fmt: skip
    B = np.stack([(moved(levels, flows + h * e) - moved(levels, flows - h * e)) / (2 * h)
                  for e in np.eye(2)], 1)  # fmt: skip
    S = scipy.linalg.solve_discrete_are(A, B, np.eye(4), 1e3 * np.eye(2))
    K = np.linalg.solve(1e3 * np.eye(2) + B.T @ S @ B, B.T @ S @ A)
    # central differences of 1e-5 are good to 1e-9
    assert np.asarray(controller.gain) == pytest.approx(K, rel=1e-6, abs=1e-9)

    x = levels + 0.1
    for _ in range(2000):
        x = moved(x, np.asarray(controller.command(estimate_of(x))))
    assert x == pytest.approx(levels, abs=1e-9)
    assert np.asarray(controller.command(estimate_of(x))) == pytest.approx(flows, abs=1e-9)


def test_a_command_of_wrong_length_is_named():
    with pytest.raises(InvalidValue, match="one per input"):
        build(tanks.build(), state_weight=np.eye(4).tolist(), input_weight=np.eye(2).tolist(),
              command=[0.0])  # fmt: skip
