"""NISME's assumptions judged: what they ask for, and what of it the 68-bus network meets."""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np

from holdfast.analysis.assumptions import Assumption, assumptions
from holdfast.papers.rows import Row, claim, unstated
from holdfast.plants.library import swing, unicycle

MODES = ((), (0, 1, 2), (3, 4, 5), ())
"""Attack channels of the paper's modes 0 to 3; mode 3 has its lines open instead."""
OPEN = 3
"""The position in which both lines are open."""
MEETS = ("Assumption 4.1", "Assumption 5.2", "Assumption 5.3", "Assumption 5.4")
STEP = 1e-4


def network(modes: tuple[tuple[int, ...], ...] = MODES) -> list[dict[str, Assumption]]:
    """The assumptions for each of the modes of the 68-bus network."""
    plant, found = swing.build(), []
    x0, P0 = np.asarray(swing.operating_point(plant)), 1e-4 * np.eye(len(plant.states))
    for number, channels in enumerate(modes):
        position = jnp.asarray(OPEN if number == 3 else 0, jnp.int32)
        of = assumptions(plant.at_position(position), x0, P0, channels)
        found.append({one.name: one for one in of})
    return found


def remark_7_1(found: list[dict[str, Assumption]]) -> Row:
    """Modes 1 to 3 and the assumptions, 5.3 with some constant."""
    met = [[bool(of[name].holds) for name in MEETS] for of in found[1:]]
    return claim(
        "Remark 7.1", "modes 1, 2, 3 of the 68-bus network meet Assumptions 4.1, 5.2, 5.3 (with "
        "some constant) and uniform observability (5.4)", [[True] * 4] * 3, met, bool(np.all(met)),
        "At points drawn about the operating point, by `holdfast.analysis.assumptions`.",
    )  # fmt: skip


def each(found: list[dict[str, Assumption]], name: str) -> Row:
    """One assumption in modes 0 to 3."""
    met = [of[name].holds for of in found]
    return claim(
        f"{name}, 68-bus network", "met in modes 0 to 3 at the points tried", [True] * 4, met,
        all(met), found[-1][name].sentence + ".",
    )  # fmt: skip


def assumption_4_1(odometry: bool = True) -> Row:
    """A unicycle with its odometry attacked, or the range to a landmark."""
    plant = unicycle.build(landmarks=[[5.0, 0.0], [0.0, 5.0], [4.0, 4.0]])
    channels = tuple(
        i for i, name in enumerate(plant.attacks) if (":" in name) != odometry
    )[:2]  # fmt: skip
    found = assumptions(plant, np.zeros(3), 1e-2 * np.eye(3), channels)[0]
    return claim(
        "Assumption 4.1, unicycle", "met by a robot among three landmarks whose odometry is "
        "attacked", True, found.holds, bool(found.holds),
        "G_2 turns with the heading. The library linearises it at the estimate before.",
    )  # fmt: skip


def assumption_5_1() -> Row:
    """Nothing but the attacker decides it."""
    return unstated(
        "Assumption 5.1", "d(t) is continuous with a bounded slope", None,
        "It is about the attacker: nothing in the plant or the data shows it, and a sensor attack "
        "has no slope between samples.",
    )  # fmt: skip


def case_study_attack(jump: float = 0.6 * np.sin(3.0) - 0.1) -> Row:
    """The slope of the actuator attack 0.1 - 0.6 sin(0.3 t), which begins at t = 10 s."""
    slopes = [abs(jump) / dt + 0.18 for dt in (1e-2, 1e-4, 1e-6)]
    return claim(
        "Remark 7.1, Assumption 5.1", "met by the case studies: largest slope of the actuator "
        "attack over 1e-2, 1e-4, 1e-6 s (1/s)", "bounded", slopes, slopes[-1] < 10.0,
        "It jumps from 0 to 0.1 - 0.6 sin 3 at t = 10 s. In between the slope is 0.18 / s.",
    )  # fmt: skip


def bi_lipschitz(shear: float = 0.0) -> Row:
    """The output (x_1, x_2 + atan x_1 + ``shear`` x_1), sensor 1 and what moves x_1 attacked."""
    x = np.array([0.0, 10.0, 100.0, 1000.0])
    slope = 1.0 / (1.0 + x**2) + shear
    largest = float(np.max(1.0 / slope))
    return claim(
        "Assumption 5.2, bi-Lipschitz", "f and h bi-Lipschitz are enough: |Sigmabar^-1| for "
        "h = (x1, x2 + atan x1), y1 and x1 attacked, x1 = 0 .. 1000", "bounded", largest,
        largest < 100.0, "T_2 C G_2 = 1 / (1 + x1^2) has no lower bound.",
    )  # fmt: skip


def assumption_5_3(f: Callable = np.sin, slope: Callable = np.cos) -> Row:
    """The remainder of ``f`` at 0.3 over the square of the step, for smaller and smaller steps."""
    x, sizes = 0.3, 10.0 ** -np.arange(1.0, 5.0)
    left = [abs(float(f(x + t) - f(x) - slope(x) * t)) / t**2 for t in sizes]
    return claim(
        "Assumption 5.3", "|phi| <= e |x~|^2 near x for any e > 0: phi / x~^2 of f = sin at 0.3, "
        "x~ = 0.1 .. 1e-4", 0.0, left, left[-1] < 1e-6,
        "It tends to |f''| / 2: with any e only a linear f has it, at every x. With some e it is "
        "met by any f with second derivatives, and is so taken in the rows that follow.",
    )  # fmt: skip


def assumption_5_3_rho(rate: float = -1.0) -> Row:
    """Rho of (5) for x' = ``rate`` x from x = 1, over the square of the period."""
    eps = 10.0 ** -np.arange(1.0, 5.0)
    rho = [abs(float((np.expm1(rate * e) - rate * e) / e)) / e**2 for e in eps]
    return claim(
        "Assumption 5.3, rho", "|rho| <= eps^2 e for any e > 0: rho / eps^2 of x' = -x from 1, "
        "eps = 0.1 .. 1e-4", 0.0, rho, rho[-1] < 1e-6,
        "rho is eps/2 df/dt and more: of first order in eps.",
    )  # fmt: skip


def hoelder(f: Callable = np.square) -> Row:
    """|f(x) - f(y)| / |x - y|^2 of a quadratic function."""
    ratio = [abs(float(f(1.0 + t) - f(1.0))) / t**2 for t in 10.0 ** -np.arange(1.0, 5.0)]
    return claim(
        "Assumption 5.3, Hoelder", "x^2 is Hoelder continuous with exponent 2: |f(1 + t) - f(1)| / "
        "t^2, t = 0.1 .. 1e-4", "bounded", ratio, ratio[-1] < 100.0,
        "Only constants are: the derivative of such an f is 0.",
    )  # fmt: skip
