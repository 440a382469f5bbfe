"""The false-alarm rate of Wald's sequential test with reset, without simulation.

Host-side, when a detector is built: the log-likelihood ratio is a random walk that starts
again at 0 whenever it leaves (-h, h), so alarms form a renewal process.
"""

from collections.abc import Callable

import numpy as np
from scipy.special import chdtr, chdtri, hyp0f1

from holdfast.numerics.roots import bracketed_root
from holdfast.parts import InvalidValue

CELLS = 201
MOST_CELLS = 1601


def increments(shift: float, dof: int) -> tuple[Callable, float, float]:
    """(F, low, sd) of one row's log-likelihood ratio without attack.

    F is its distribution function, ``low`` its least value, ``sd`` its standard deviation.
    """
    from scipy.interpolate import CubicSpline  # takes long to import

    root = np.linspace(0.0, np.sqrt(chdtri(dof, 1e-15)), 2000)
    value = np.log(hyp0f1(dof / 2.0, (shift * root) ** 2 / 4.0)) - shift**2 / 2.0
    # the statistic is a smooth function of its ratio; its distribution function is not
    statistic = CubicSpline(value, root**2)

    def distribution(ratio: np.ndarray) -> np.ndarray:
        inside = np.clip(ratio, value[0], value[-1])
        return np.where(ratio <= value[0], 0.0, chdtr(dof, statistic(inside)))

    middle = chdtr(dof, root**2)
    mass = np.diff(middle)
    centre = 0.5 * (value[1:] + value[:-1])
    mean = centre @ mass
    return distribution, float(value[0]), float(np.sqrt((centre - mean) ** 2 @ mass))


def alarm_rate(h: float, distribution: Callable, cells: int = CELLS) -> float:
    """Alarms per row in the long run with boundaries h and -|h|.

    For h > 0: (probability that a cycle ends above) / (expected rows of a cycle), from the
    renewal equation with the walk's position kept to ``cells`` cells (Brook and Evans). For
    h <= 0 every row ends a cycle.
    """
    if h <= 0:
        return float(1.0 - distribution(np.asarray(h)))
    width = 2.0 * h / cells
    z = width * (np.arange(cells) - cells // 2)
    edges = distribution(width * (np.arange(-cells, cells + 1) - 0.5))
    steps = np.diff(edges)
    rows = np.arange(cells)
    moves = steps[rows[None, :] - rows[:, None] + cells]
    right = np.stack([1.0 - distribution(h - z), np.ones(cells)], 1)
    up, length = np.linalg.solve(np.eye(cells) - moves, right)[cells // 2]
    return float(up / length)


def boundary(level: float, shift: float, dof: int) -> float:
    """The h at which alarms come at ``level`` per row.

    Raises `InvalidValue` where the shift is so small against the level that a decision would
    take thousands of rows.
    """
    distribution, low, sd = increments(shift, dof)
    if alarm_rate(0.0, distribution) <= level:
        # even one row rarely passes 0: the test of a single row, which has this level
        return bracketed_root(lambda h: alarm_rate(h, distribution) - level, (low, 0.0))
    # the cells must resolve one row's step
    cells = CELLS
    high = 8.0 * sd
    while True:
        cells = max(CELLS, 2 * round(8.0 * high / sd) + 1)
        if cells > MOST_CELLS:
            raise InvalidValue(
                "shift", shift, f"a larger one: at level {level:g} this takes too many rows"
            )
        if alarm_rate(high, distribution, cells) < level:
            break
        high *= 1.6

    def excess(h: float) -> float:
        return float(np.log(alarm_rate(h, distribution, cells) / level))

    return bracketed_root(excess, (1e-6 * sd, high), rtol=1e-6)
