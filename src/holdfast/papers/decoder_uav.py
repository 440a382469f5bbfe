"""DECODER, Section V: the quadrotor under attack; what is reproduced, what works, what cannot."""

from typing import Any, NamedTuple

import numpy as np

from holdfast.papers import decoder_mitm as mitm
from holdfast.papers import decoder_placed as placed
from holdfast.papers import decoder_spoofing as spoofing
from holdfast.papers.rows import Row, claim, unstated
from holdfast.plants.library import quadrotor

SEEDS, STEPS = 16, 300


class Run(NamedTuple):
    """Section V-B and V-C1 without noise, V-C1 and V-C2 with it."""

    placed: placed.Placed
    mitm: mitm.Run
    spoofing: spoofing.Run


def drive(
    seeds: int = SEEDS, steps: int = STEPS, pairs: int = placed.PAIRS, windows: int = placed.WINDOWS
) -> Run:
    """Everything that is drawn, flown and decoded."""
    return Run(placed.drive(pairs, windows), mitm.drive(seeds, steps), spoofing.drive(seeds, steps))


def judged(run: Run) -> list[Row]:
    """All rows of Section V."""
    return [
        equation_15(), sizes(), *placed.judged(run.placed), *mitm.judged(run.mitm),
        *spoofing.judged(run.spoofing),
    ]  # fmt: skip


def equation_15() -> Row:
    """That k can be subtracted in u."""
    plant, dt = quadrotor.build(), 0.1
    k = np.zeros(10)
    k[8:] = -quadrotor.GRAVITY * dt**2 / 2, -quadrotor.GRAVITY * dt
    B = np.asarray(plant.B)
    u = np.linalg.lstsq(B, -k, rcond=None)[0]
    left = float(np.max(np.abs(B @ u + k)))
    return claim(
        "(15)", "the gravity k can be dropped, as u can take it away: largest entry of B u + k",
        0.0, left, left < 1e-12, f"With a thrust of {u[2]:.2f} = g / k_T.",
    )  # fmt: skip


def sizes() -> Row:
    """What the paper does not say of its examples."""
    return unstated(
        "Section V-A", "noise, window, weights of the feedback, sizes of attacks, paths", None,
        "Chosen: positions .1 m, speeds .1 m/s, angles .01 rad, accelerations .1 m/s^1.5; T = 10 "
        "at .1 s; drift of 1 m/s and sine of 5 m, .05 Hz on p_x after 5 s; hopping attack of 3 m "
        "on one position sensor; a flight home from (10, -6, 4) m, a climbing circle of 10 m.",
    )  # fmt: skip


def figures(run: Run) -> dict[str, Any]:
    """Figs. 8 and 11."""
    return mitm.figures(run.mitm) | spoofing.figures(run.spoofing)
