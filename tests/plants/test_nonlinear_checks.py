import math
import sys
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

from holdfast.parts import InvalidValue
from holdfast.plants.adaptive import adaptive
from holdfast.plants.nonlinear import nonlinear_plant


def sound(x, u, d):
    return x + 0.1 * jnp.sin(x[::-1]) + d[0]


def make(f=sound, h=lambda x, u, d: x[:1], **changes):
    keys = dict(
        Q=np.eye(2), R=np.eye(1), dt=0.1, states=["a", "b"], inputs=["push"], outputs=["seen"],
        attacks=["shove"],
    )  # fmt: skip
    return nonlinear_plant(f, h, **(keys | changes))


def branching(x, u, d):
    if x[0] > 0:
        return x
    return -x


def numpy_inside(x, u, d):
    return np.sin(x)


def converting(x, u, d):
    return x * math.cos(x[0])


def counting(x, u, d):
    return x + sum(range(x[0].astype(int)))


def masking(x, u, d):
    return x[x > 0]


def assigning(x, u, d):
    x[0] = 0.0
    return x


@pytest.mark.parametrize(
    ("f", "found", "expected"),
    [
        (branching, r"an if, .* \(branching, line \d+\)", "jnp.where"),
        (numpy_inside, r"numpy function .* \(numpy_inside, line \d+\)", "jax.numpy"),
        (converting, r"float\(\).* \(converting, line \d+\)", "jax.numpy"),
        (counting, r"index or count \(counting", "jnp.where"),
        (masking, r"mask as an index \(masking", "jnp.where"),
        (assigning, r"item assignment.*\(assigning", r"function of \(x, u, d\) in jax.numpy"),
        (lambda x, u: x, "positional arguments", r"function of \(x, u, d\)"),
        (lambda x, u, d: [x[0], x[1]], "a list", r"shape \(2,\): jnp.stack"),
        (lambda x, u, d: x[:1], r"shape \(1,\)", r"shape \(2,\)"),
        (lambda x, u, d: jnp.zeros(2, jnp.int32), "int32 numbers", "float64 numbers"),
        (lambda x, u, d: x.astype(jnp.float32), "float32 numbers", "float64 numbers"),
        (lambda x, u, d: jnp.sqrt(-1.0 - x**2), "a value that is NaN at every", "finite"),
        (lambda x, u, d: x + jnp.sqrt(0.0 * d[0]), "a derivative by d that is NaN", "finite"),
        pytest.param(
            *(lambda x, u, d: x / (0.0 * u[0]), "a value that is NaN at every", "finite"),
            marks=pytest.mark.slow,
        ),
        pytest.param(
            *(lambda x, u, d: jnp.sqrt(0.0 * x), r"by x that is NaN .* x = \[0.0, 0.0\]", "finite"),
            marks=pytest.mark.slow,
        ),
    ],
)
def test_a_function_that_cannot_be_used_is_told(f, found, expected):
    with pytest.raises(InvalidValue, match=rf"^f: found .*{found}.*, expected .*{expected}"):
        make(f)


@pytest.mark.slow
def test_an_output_is_tried_too():
    with pytest.raises(InvalidValue, match=r"^h: found a derivative by x that is NaN at every"):
        make(h=lambda x, u, d: jnp.sqrt(0.0 * x[:1]))


@pytest.mark.parametrize(
    ("functions", "told"),
    [
        # a range where the landmark is, and an attack whose effect begins vertically
        (
            {"h": lambda x, u, d: jnp.sqrt(jnp.sum(x**2))[None]},
            r"h: a derivative by x that is NaN at x = \[0.0, 0.0\], u = \[0.0\], d = \[0.0\], "
            "one of 1 of the 5",
        ),
        (
            {"f": lambda x, u, d: x + jnp.sqrt(jnp.abs(d[0]))},
            r"f: a derivative by d that is (NaN|infinite) at x = .*, one of 3 of the 5",
        ),
    ],
)
def test_a_point_without_derivative_is_a_warning(functions, told):
    with pytest.warns(UserWarning, match=told):
        make(**functions)


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"Q": np.eye(3)}, "Q"),
        ({"R": [[0.0]]}, "R"),
        ({"dt": 0.0}, "dt"),
        ({"states": ["a", "a"]}, "states"),
        ({"angles": ["a"]}, "angles"),
        ({"constraints": {"attack": {"matrix": [[1.0, 2.0]], "bound": [1.0]}}}, None),
    ],
)
def test_settings_are_checked_before_functions(changes, key):
    with pytest.raises(InvalidValue) as refused:
        make(branching, **changes)
    assert refused.value.key == (key or "constraints.attack.matrix")


def test_innovations_of_angles_go_the_shorter_way():
    plant = make(h=lambda x, u, d: x, R=np.eye(2), outputs=["range", "bearing"], angles=["bearing"])
    y = jnp.asarray([[7.0, 3.1], [7.0, -3.1], [-7.0, 0.3], [0.0, np.pi], [0.0, -np.pi]])
    at = jnp.asarray([[0.0, -3.1], [0.0, 3.1], [0.0, 0.1], [0.0, 0.0], [0.0, 0.0]])
    short = 6.2 - 2 * np.pi
    expected = [[7.0, short], [7.0, -short], [-7.0, 0.2], [0.0, np.pi], [0.0, np.pi]]
    found = jax.vmap(plant.innovation)(y, at)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-15)
    assert make().innovation(jnp.asarray([9.0]), jnp.asarray([0.0]))[0] == 9.0


@pytest.mark.slow
def test_an_adaptive_solver_keeps_its_tolerance():
    J = np.array([[0.0, 1.0], [-9.0, -0.4]])
    at = [jnp.asarray([1.0, -0.5]), jnp.asarray([0.2])]

    def rate(x, u):
        return jnp.asarray(J) @ x + u[0] * jnp.asarray([0.0, 1.0])

    f = jax.jit(lambda x, u: (adaptive(rate, 2.0)(x, u), jax.jacfwd(adaptive(rate, 2.0))(x, u)))
    moved, by_x = f(*at)
    held = expm(2.0 * np.block([[J, np.array([[0.0], [1.0]])], [np.zeros((1, 3))]]))
    truth = held @ np.concatenate(at)
    # some 30 steps, each off by less than 1e-10 + 1e-8 |x|
    np.testing.assert_allclose(moved, truth[:2], rtol=0, atol=3e-7)
    np.testing.assert_allclose(by_x, held[:2, :2], rtol=0, atol=3e-6)
    assert moved.dtype == jnp.float64


@pytest.mark.slow
def test_an_equation_that_is_too_stiff_gives_nan():
    f = adaptive(lambda x: -1e9 * x, 1.0)
    assert np.all(np.isnan(jax.jit(f)(jnp.ones(2))))


def test_the_extra_is_named_where_it_is_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "diffrax", None)
    with pytest.raises(InvalidValue, match=r"adaptive: found no diffrax, .*holdfast\[solver\]"):
        adaptive(lambda x: -x, 1.0)


@pytest.mark.slow
def test_a_plant_of_adaptive_steps_passes_the_checks():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        plant = make(adaptive(lambda x, u, d: -x + u[0] + d[0], 0.1))
    moved = jax.jit(lambda p: p.transition(1, jnp.ones(2), jnp.ones(1), jnp.ones(1)))(plant)
    # x' = -x + 2 from 1
    np.testing.assert_allclose(moved, 2.0 - np.exp(-0.1), rtol=0, atol=1e-9)
