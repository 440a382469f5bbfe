"""Functions that a user gives a plant, tried once before anything is estimated with them.

They must be traceable by JAX, of the right shape, and have derivatives: an estimator that
linearises a plant says nothing sensible after the first NaN.
"""

import itertools
import warnings
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from holdfast.parts import InvalidValue

LIBRARIES = (
    "jax",
    "jaxlib",
    "numpy",
    "scipy",
    "equinox",
    "jaxtyping",
    "beartype",
    "diffrax",
    "holdfast",
)
"""Code in which no user's mistake is."""
GOLDEN = 0.618033988749895


class Arguments(NamedTuple):
    """The names of what the functions of a plant are called with, in this order.

    ``positions``: None where they do not get one.
    """

    states: Sequence[str]
    inputs: Sequence[str]
    attacks: Sequence[str]
    positions: Sequence[str] | None = None

    @property
    def shapes(self) -> list[jax.ShapeDtypeStruct]:
        """Shapes and types, as `jax.eval_shape` takes them."""
        found = [jax.ShapeDtypeStruct((len(names),), float) for names in self[:3]]
        if self.positions is not None:
            found.append(jax.ShapeDtypeStruct((), jnp.int32))
        return found

    @property
    def written(self) -> str:
        """How the call reads."""
        return "(x, u, d)" if self.positions is None else "(x, u, d, position)"


def check_functions(functions: dict[str, tuple[Callable, int]], arguments: Arguments) -> None:
    """Each function by its name, with how many numbers it returns.

    Traced once, then tried at a few points: the origin and four others up to 1.2 from it in
    every coordinate, three of the five with d = 0, at every position. One whose value, or
    derivative by x or d, is NaN or infinite at all points is refused. Where that happens at
    some points only the plant may be sound (a range has no derivative where its landmark is):
    a warning names the first of them.

    Raises `InvalidValue` naming the function, what was found and what was expected.
    """
    for name, (function, size) in functions.items():
        _check_shape(name, function, size, arguments)
    only = {name: function for name, (function, _) in functions.items()}
    numbers = [()] if arguments.positions is None else [(i,) for i in range(len(_names(arguments)))]
    for number in numbers:
        position = tuple(jnp.asarray(i, jnp.int32) for i in number)
        where = "".join(f" in position {_names(arguments)[i]!r}" for i in number)
        _check_derivatives(only, _points(arguments), position, where)


def _names(arguments: Arguments) -> Sequence[str]:
    return arguments.positions or ()


def _check_shape(name: str, function: Callable, size: int, arguments: Arguments) -> None:
    try:
        found = jax.eval_shape(function, *arguments.shapes)
    except Exception as error:
        raise InvalidValue(
            name, *untraceable(error, f"a function of {arguments.written} in jax.numpy")
        ) from error
    if not isinstance(found, jax.ShapeDtypeStruct):
        kind = type(found).__name__
        raise InvalidValue(name, f"a {kind}", f"one array of shape ({size},): jnp.stack([..])")
    if found.shape != (size,):
        raise InvalidValue(name, f"shape {found.shape}", f"shape ({size},)")
    wanted = jnp.result_type(float)
    if found.dtype != wanted:
        raise InvalidValue(name, f"{found.dtype} numbers", f"{wanted} numbers")


def untraceable(error: Exception, otherwise: str) -> tuple[str, str]:
    """What a function did that cannot be traced, and what to do instead."""
    errors = jax.errors
    causes: list[tuple[Any, str, str]] = [
        (
            errors.TracerBoolConversionError,
            "an if, while, and, or or not on a traced value",
            "jnp.where(condition, a, b), or & and |: every case is traced at once",
        ),
        (
            errors.TracerArrayConversionError,
            "a numpy function on a traced value",
            "its namesake in jax.numpy",
        ),
        (
            errors.TracerIntegerConversionError,
            "a traced value as a Python index or count",
            "indexing of jax.numpy arrays, or jnp.where",
        ),
        (
            errors.NonConcreteBooleanIndexError,
            "a traced mask as an index",
            "jnp.where(mask, a, b)",
        ),
        (
            errors.ConcretizationTypeError,
            "float(), int() or a function of math on a traced value",
            "functions of jax.numpy, and no conversion",
        ),
    ]
    place = _place(error)
    for kind, found, expected in causes:
        if isinstance(error, kind):
            return found + place, expected
    first = (str(error).splitlines() or [type(error).__name__])[0]
    return first + place, otherwise


def _place(error: Exception) -> str:
    """The last line of the user's own code that the error came through."""
    place, trace = "", error.__traceback__
    while trace is not None:
        code, module = trace.tb_frame.f_code, str(trace.tb_frame.f_globals.get("__name__", ""))
        if module.split(".")[0] not in LIBRARIES:
            place = f" ({code.co_name}, line {trace.tb_lineno})"
        trace = trace.tb_next
    return place


def _points(arguments: Arguments) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """x, u and d to try."""
    sizes = [len(names) for names in arguments[:3]]
    starts = np.cumsum([0, *sizes])

    def spread(start):
        # different everywhere, in [0, 1), the same in every run
        numbers = np.mod(GOLDEN * (start + 1 + np.arange(starts[-1])), 1.0)
        return [numbers[a:b] for a, b in itertools.pairwise(starts)]

    x, u, d = spread(0)
    mixed, small = ([2.0 * part - 1.0 for part in spread(start)] for start in (50, 100))
    return [
        (0.0 * x, 0.0 * u, 0.0 * d),
        (0.2 + x, 0.2 + u, 0.0 * d),
        (-0.2 - x, 0.2 + u, 0.0 * d),
        (mixed[0], mixed[1], mixed[2]),
        (0.01 * small[0], 0.01 * small[1], 0.01 * small[2]),
    ]


def _check_derivatives(functions: dict[str, Callable], points, position, where: str) -> None:
    @jax.jit
    def finite(x, u, d, position):
        # one derivative along a direction that mixes all entries: what is not finite stays so
        ahead = jnp.ones_like(x), jnp.ones_like(d)
        moved = [
            jax.jvp(lambda x, d, f=f: f(x, u, d, *position), (x, d), ahead)
            for f in functions.values()
        ]
        return jnp.all(jnp.stack([jnp.all(jnp.isfinite(part)) for m in moved for part in m]))

    if all(bool(finite(*map(jnp.asarray, point), position)) for point in points):
        return
    for name, function in functions.items():
        failed = _not_finite(function, points, position)
        told = [(what, point) for what, point in zip(failed, points, strict=True) if what]
        if not told:
            continue
        what, point = told[0]
        shown = ", ".join(
            f"{letter} = {np.round(part, 4).tolist()}"
            for letter, part in zip("xud", point, strict=True)
            if part.size
        )
        if len(told) == len(points):
            found = f"{what} at every point tried{where}, such as {shown}"
            raise InvalidValue(name, found, "finite values and derivatives near the origin")
        warnings.warn(
            f"{name}: {what} at {shown}{where}, one of {len(told)} of the {len(points)} points "
            "tried; an estimator that gets there diverges",
            stacklevel=5,
        )


def _not_finite(function: Callable, points, position) -> list[str]:
    """What of a function is not finite at each point; "" if all is."""

    @jax.jit
    def parts(x, u, d, position):
        # one by one: taken together, an infinite derivative by d times 0 makes those by x NaN
        by_x = jax.jacfwd(lambda x: function(x, u, d, *position))(x)
        by_d = jax.jacfwd(lambda d: function(x, u, d, *position))(d)
        return function(x, u, d, *position), by_x, by_d

    names = ("a value", "a derivative by x", "a derivative by d")
    found = []
    for point in points:
        told = [
            f"{name} that is {'NaN' if np.any(np.isnan(part)) else 'infinite'}"
            for name, part in zip(names, parts(*map(jnp.asarray, point), position), strict=True)
            if not np.all(np.isfinite(part))
        ]
        found.append(told[0] if told else "")
    return found
