"""The same questions asked of the whole log at once, in exact arithmetic."""

import numpy as np

PRIME = 2_147_483_629
"""Ranks of integer matrices modulo a prime of 31 bits: products stay inside 63 bits, and a
minor that is not zero is a multiple of it with a chance of about 5e-10."""


def reduced(matrix):
    """Reduced row echelon form modulo `PRIME`, and its pivot columns."""
    rows = np.asarray(matrix, np.int64) % PRIME
    pivots = []
    for column in range(rows.shape[1]):
        at = len(pivots)
        there = np.flatnonzero(rows[at:, column])
        if not len(there):
            continue
        rows[[at, at + there[0]]] = rows[[at + there[0], at]]
        rows[at] = rows[at] * pow(int(rows[at, column]), PRIME - 2, PRIME) % PRIME
        others = np.arange(len(rows)) != at
        rows[others] = (rows[others] - rows[others, column][:, None] * rows[at]) % PRIME
        pivots.append(column)
        if len(pivots) == len(rows):
            break
    return rows, pivots


def determined(matrix):
    """Which unknowns every solution of ``matrix`` z = b agrees on."""
    rows, pivots = reduced(matrix)
    known = np.zeros(matrix.shape[1], bool)
    free = np.setdiff1d(np.arange(matrix.shape[1]), pivots)
    for row, column in enumerate(pivots):
        known[column] = not np.any(rows[row, free])
    return known


def response(A, G, C, H, steps):
    """y_1..y_steps as a matrix times (d_0, ..., d_steps), x_0 being zero; integers mod prime."""
    n, nd = G.shape
    state = np.zeros((n, nd * (steps + 1)), np.int64)
    rows = []
    for k in range(1, steps + 1):
        state = A @ state % PRIME
        state[:, nd * (k - 1) : nd * k] += G
        out = C @ state
        out[:, nd * k : nd * (k + 1)] += H
        rows.append(out % PRIME)
    return np.vstack(rows)


def smallest_delays(A, G, C, H, direct, longest):
    """For every channel the smallest delay, late in the log; by definition, from `response`."""
    n, nd = G.shape
    horizon = 4 * n + longest
    whole = response(A, G, C, H, horizon)
    ny = len(C)
    late = range(horizon - n + 1, horizon + 1)
    known = {k: determined(whole[: k * ny, : nd * (k + 1)]) for k in late}
    found = []
    for i in range(nd):
        back = 0 if direct[i] else 1
        fits = (
            delay
            for delay in range(longest + 1)
            if all(known[k][nd * (k - back - delay) + i] for k in late)
        )
        found.append(next(fits, None))
    return found
