"""The numbers that DECOMPOSE prints for its example (Section VI)."""

from typing import Any

import numpy as np

from holdfast.papers.decompose_example import EXAMPLE, Given
from holdfast.papers.rows import Row, claim, unstated

HALF = 0.5e-4 * (1.0 + 1e-9)
"""Half a unit of the last printed digit."""
K = [
    [0.2443, 0.0431, 0.1942, 0.2693, -0.0885],
    [-0.0838, 0.2494, 0.1469, -0.1991, 0.0846],
    [0.1175, -0.4272, 0.2265, 0.0629, 0.1955],
]
P = [[0.2443, -0.0838, 0.1175], [-0.0838, 0.1879, -0.1452], [0.1175, -0.1452, 0.3995]]
EIGENVALUES = [-0.2848, 0.1061, 0.1925]
TRACE = 0.8317
G = [
    [[0.7783, 0.0, 0.0], [1.1187, 0.0, 0.0], [1.2384, 0.0, 0.0]],
    [[0.7783, 0.7783, -1.1660], [1.1187, 1.1187, -0.9496], [1.2384, 1.2384, -0.9122]],
    [[0.7783, 1.5567, 1.1660], [1.1187, 2.2373, 0.9496], [1.2384, 2.4768, 0.9122]],
    [[0.7783, -0.7783, -0.5830], [1.1187, -1.1187, -0.4748], [1.2384, -1.2384, -0.4561]],
    [[-0.3892, 0.7783, 1.1660], [-0.5593, 1.1187, 0.9496], [-0.6192, 1.2384, 0.9122]],
]


def printed(id: str, what: str, paper: Any, ours: Any, note: str = "") -> Row:
    """A number, or a matrix row by row, that has to agree to its last printed digit."""
    close = np.max(np.abs(ours - np.asarray(paper))) <= HALF
    verdict = "reproduced" if close else "not reproduced"
    return Row(id, what, paper, np.asarray(ours).tolist(), None, verdict, note)


def unobservable(given: Given = EXAMPLE) -> Row:
    """Ranks of the observability matrices of the five sensors."""
    n = len(given.A)
    ranks = [
        int(np.linalg.matrix_rank([row @ np.linalg.matrix_power(given.A, k) for k in range(n)]))
        for row in given.C
    ]
    return claim(
        "Section VI, observability", "the system is not fully observable by the first sensor: "
        "states that each sensor observes", "< 3", ranks, ranks[0] < n,
        "True of all five: A has the eigenvalue 1 twice.",
    )  # fmt: skip


def numbers(given: Given = EXAMPLE) -> list[Row]:
    """All printed matrices and numbers, in the paper's order."""
    values = np.sort(np.real(np.linalg.eigvals(given.M)))
    return [
        printed("(34), K", "the steady-state Kalman gain, to the last printed digit", K, given.K),
        printed("(34), P", "its covariance, to the last printed digit", P, given.P),
        printed(
            "Section VI, eigenvalues", "of A - K C A, to the last printed digit", EIGENVALUES,
            values, "The rows of the printed G_i are in this order.",
        ),
        *(
            printed(f"Section VI, G_{i + 1}", "(18), to the last printed digit", G[i], mine)
            for i, mine in enumerate(np.real(given.G)[:5])
        ),
        printed("Section VI, tr P", "to the last printed digit", TRACE, np.trace(given.P)),
    ]  # fmt: skip


def settings(seeds: int, draws: int, steps: int) -> Row:
    """What Fig. 2 leaves out, and what was chosen."""
    return unstated(
        "Section VI, settings", "T, the runs and the gammas of Fig. 2: seeds, draws of the exact "
        "Gaussian and steps of each", [seeds, draws, steps],
        "Chosen: constant attacks long since at work, stationary errors. (31) is posed in the "
        "paper's coordinates, on which its l1 norm depends: in another basis it is another "
        "estimator.",
    )  # fmt: skip
