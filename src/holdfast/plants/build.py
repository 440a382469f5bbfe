"""A checked `LinearPlant` from arrays: shapes, finiteness, covariances, names, discretisation."""

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import solve_triangular

from holdfast.numerics.sampling import sample
from holdfast.parts import InvalidValue
from holdfast.plants.constraints import constraints as checked_constraints
from holdfast.plants.linear import LinearPlant, Sampling, Table

ROUNDING = 1e-8
"""Relative asymmetry and indefiniteness of a covariance put down to rounding: files hold
covariances with eight digits or more."""


def linear_plant(
    *,
    A: Any,
    C: Any,
    Q: Any,
    R: Any,
    B: Any = None,
    D: Any = None,
    G: Any = None,
    H: Any = None,
    dt: float = 1.0,
    time: str = "discrete",
    method: str = "zoh",
    noise: str = "held",
    states: Sequence[str] | None = None,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    attacks: Sequence[str] | None = None,
    scheduling: str | None = None,
    constraints: dict[str, dict[str, Any]] | None = None,
) -> LinearPlant:
    """A linear plant from matrices, each constant (2-D), per step (3-D) or a `Table`.

    ``time`` "continuous" is discretised with ``dt`` seconds by ``method`` "zoh" or "euler"
    and ``noise`` "held" or "white" (see `holdfast.numerics.sampling`); R is always discrete.
    ``constraints``: {"state" | "attack": {"matrix", "bound", "bound_u"}}.

    Raises `InvalidValue` naming the key, what was found and what was expected.
    """
    _choice("time", time, ("discrete", "continuous"))
    _choice("method", method, ("zoh", "euler"))
    _choice("noise", noise, ("held", "white"))
    if not (np.isfinite(dt) and dt > 0):
        raise InvalidValue("dt", dt, "a positive number of seconds")
    given = {"A": A, "B": B, "C": C, "D": D, "G": G, "H": H, "Q": Q, "R": R}
    found = {key: _matrix(key, value) for key, value in given.items() if value is not None}
    found = _completed(found)
    names = {
        "states": _names("states", states, "x", _columns(found["A"])),
        "inputs": _names("inputs", inputs, "u", _columns(found["B"])),
        "outputs": _names("outputs", outputs, "y", _rows(found["C"])),
        "attacks": _names("attacks", attacks, "d", _columns(found["G"])),
    }
    for key in ("Q", "R"):
        found[key] = _mapped(lambda m, key=key: covariance(key, m), found[key])
    schedule = _schedule(scheduling, found, names)
    if time == "discrete":
        _warn_if_continuous(found["A"])
        sampling = None
    else:
        found, sampling = _discretised(found, dt, method, noise)
    sizes = (len(names[k]) for k in ("states", "inputs", "attacks"))
    limits = checked_constraints(constraints or {}, *sizes)
    arrays: dict[str, Any] = {key: _mapped(jnp.asarray, value) for key, value in found.items()}
    R_found: Any = found["R"]
    constant_R = isinstance(R_found, np.ndarray) and R_found.ndim == 2
    return LinearPlant(
        **arrays,
        white=_whitening(R_found) if constant_R else None,
        constraints=limits,
        dt=float(dt),
        states=names["states"],
        inputs=names["inputs"],
        outputs=names["outputs"],
        attacks=names["attacks"],
        schedule=schedule,
        sampling=sampling,
    )


def _choice(key: str, value: str, allowed: tuple[str, ...]) -> None:
    if value not in allowed:
        raise InvalidValue(key, repr(value), " or ".join(map(repr, allowed)))


def _matrix(key: str, value: Any) -> np.ndarray | Table:
    if isinstance(value, Table):
        grid, values = np.asarray(value.grid, float), np.asarray(value.values, float)
        if grid.ndim != 1 or len(grid) < 2 or np.any(np.diff(grid) <= 0):
            raise InvalidValue(f"{key}.grid", grid.tolist(), "two or more increasing numbers")
        if values.ndim != 3 or len(values) != len(grid):
            raise InvalidValue(f"{key}.values", values.shape, f"{len(grid)} matrices")
        if not np.all(np.isfinite(values)):
            raise InvalidValue(f"{key}.values", "NaN or infinity", "finite numbers")
        return Table(jnp.asarray(grid), jnp.asarray(values))
    try:
        array = np.asarray(value, float)
    except (TypeError, ValueError):
        raise InvalidValue(key, "rows of unequal length or text", "numbers in a matrix") from None
    if array.ndim not in (2, 3):
        raise InvalidValue(key, f"{array.ndim} dimensions", "2 (rows), or 3 with time first")
    if not np.all(np.isfinite(array)):
        raise InvalidValue(key, "NaN or infinity", "finite numbers")
    return array


def _mapped(function: Callable[[Any], Any], source: np.ndarray | Table) -> Any:
    """``function`` on the array, or on the values of a table."""
    if isinstance(source, Table):
        return Table(source.grid, jnp.asarray(function(np.asarray(source.values))))
    return function(source)


def _shape(source: np.ndarray | Table) -> tuple[int, int]:
    values = source.values if isinstance(source, Table) else source
    return values.shape[-2], values.shape[-1]


def _rows(source: np.ndarray | Table) -> int:
    return _shape(source)[0]


def _columns(source: np.ndarray | Table) -> int:
    return _shape(source)[1]


def _completed(found: dict[str, Any]) -> dict[str, Any]:
    """Zero matrices for what was left out, and every shape checked against A and C."""
    n, ny = _rows(found["A"]), _rows(found["C"])
    nu = next((_columns(found[k]) for k in ("B", "D") if k in found), 0)
    nd = next((_columns(found[k]) for k in ("G", "H") if k in found), 0)
    expected = {
        "A": (n, n), "B": (n, nu), "C": (ny, n), "D": (ny, nu),
        "G": (n, nd), "H": (ny, nd), "Q": (n, n), "R": (ny, ny),
    }  # fmt: skip
    for key, shape in expected.items():
        if key not in found:
            found[key] = np.zeros(shape)
        elif _shape(found[key]) != shape:
            rows, columns = _shape(found[key])
            raise InvalidValue(
                key, f"{rows} x {columns}", f"{shape[0]} x {shape[1]} to go with A and C"
            )
    lengths = {k: len(v) for k, v in found.items() if not isinstance(v, Table) and v.ndim == 3}
    if len(set(lengths.values())) > 1:
        raise InvalidValue(
            next(iter(lengths)), f"per-step lengths {lengths}", "one number of steps for all"
        )
    return found


def _names(key: str, names: Sequence[str] | None, letter: str, count: int) -> tuple[str, ...]:
    if names is None:
        return tuple(f"{letter}{i + 1}" for i in range(count))
    if len(names) != count:
        raise InvalidValue(key, f"{len(names)} names {list(names)}", f"{count} names")
    if len(set(names)) != len(names):
        raise InvalidValue(key, list(names), "names that differ")
    return tuple(names)


def covariance(key: str, m: Any) -> np.ndarray:
    """``m`` (or a stack), exactly symmetric; `InvalidValue` where it is no covariance.

    R must be positive definite, the others only not indefinite.
    """
    m = np.asarray(m, float)
    transposed = np.swapaxes(m, -1, -2)
    size = np.max(np.abs(m), initial=0.0)
    if np.max(np.abs(m - transposed), initial=0.0) > ROUNDING * size:
        raise InvalidValue(key, "a matrix that is not symmetric", "a covariance")
    m = (m + transposed) / 2
    values = np.linalg.eigvalsh(m)
    lowest, highest = np.min(values, initial=np.inf), np.max(np.abs(values), initial=0.0)
    if key == "R" and m.shape[-1]:
        diagonal = np.sqrt(np.abs(np.diagonal(m, axis1=-2, axis2=-1)))
        if np.any(diagonal == 0):
            raise InvalidValue(key, "a zero on the diagonal", "a positive definite covariance")
        scaled = m / diagonal[..., :, None] / diagonal[..., None, :]
        if np.min(np.linalg.eigvalsh(scaled)) < 1e-12:
            raise InvalidValue(
                key, f"smallest eigenvalue {lowest:.3g}", "a positive definite covariance"
            )
    elif lowest < -ROUNDING * highest:
        raise InvalidValue(
            key, f"smallest eigenvalue {lowest:.3g}", "a covariance (no negative eigenvalue)"
        )
    return m


def _whitening(R: np.ndarray) -> tuple[jax.Array, jax.Array]:
    """W with W R W' = I, and its inverse, once for all rows at which everything is seen."""
    lower = np.linalg.cholesky(R)
    return jnp.asarray(solve_triangular(lower, np.eye(len(R)), lower=True)), jnp.asarray(lower)


def _schedule(
    scheduling: str | None, found: dict[str, Any], names: dict[str, tuple[str, ...]]
) -> tuple[str, int] | None:
    tables = [key for key, value in found.items() if isinstance(value, Table)]
    if scheduling is None:
        if tables:
            raise InvalidValue("scheduling", "nothing", f"a name: {tables[0]} is given on a grid")
        return None
    for kind in ("inputs", "states"):
        if scheduling in names[kind]:
            return kind[:-1], names[kind].index(scheduling)
    known = ", ".join(names["inputs"] + names["states"])
    raise InvalidValue("scheduling", repr(scheduling), f"an input or a state: {known}")


def _warn_if_continuous(A: np.ndarray | Table) -> None:
    matrices = A.values if isinstance(A, Table) else A
    values = np.linalg.eigvals(np.asarray(matrices))
    if values.size and np.all(values.real <= 0):
        listed = ", ".join(f"{v:.3g}" for v in np.ravel(values)[:4])
        warnings.warn(
            f"A is taken as discrete, but its eigenvalues ({listed}) look like those of "
            'x\' = A x: if so, set time = "continuous"',
            stacklevel=4,
        )


def _discretised(
    found: dict[str, Any], dt: float, method: str, noise: str
) -> tuple[dict[str, Any], Sampling | None]:
    keys = ("A", "B", "G", "Q")
    if any(isinstance(found[key], Table) for key in keys):
        return found, Sampling(method, noise)
    nu = _columns(found["B"])

    def one(A, B, G, Q):
        Ad, columns, Qd = sample(A, jnp.concatenate([B, G], 1), Q, dt, method, noise)
        return Ad, columns[:, :nu], columns[:, nu:], Qd

    axes = [0 if found[key].ndim == 3 else None for key in keys]
    over_time = any(axis == 0 for axis in axes)
    run = jax.jit(jax.vmap(one, in_axes=axes) if over_time else one)
    discrete = run(*(jnp.asarray(found[key]) for key in keys))
    return {**found, **dict(zip(keys, map(np.asarray, discrete), strict=True))}, None
