"""Light drawings of long series: what is drawn, before anything draws it."""

import html
import re

import numpy as np

INK, SOFT, GRID, PAPER = "#1c2733", "#5a6774", "#dce2e8", "#fefefe"
MAIN, ALARM, ATTACK, LOST, FAULT = "#0072b2", "#d55e00", "#e69f00", "#8894a0", "#cc79a7"
"""Okabe and Ito's palette, which the colour-blind tell apart."""

MORE = "#009e73", "#56b4e9"
"""Of the same palette, for more than a few kinds: readable on light and dark as they are."""

VARIABLES = {
    INK: "ink", SOFT: "soft", GRID: "grid", PAPER: "paper", MAIN: "main", ALARM: "alarm",
    ATTACK: "attack", LOST: "lost", FAULT: "fault",
}  # fmt: skip
"""The page's CSS variable for each colour, so that one drawing serves light and dark."""


def extremes(t: np.ndarray, values: np.ndarray, bins: int) -> tuple[np.ndarray, np.ndarray]:
    """At most two points a bin, the lowest and the highest in the order in which they come.

    A line through them covers the same pixels as the whole series. NaN where a whole bin is.
    """
    if len(t) <= 2 * bins:
        return t, values
    times, folded = _folded(t, bins), _folded(values, bins)
    hollow = np.isnan(folded)
    low = np.where(hollow, np.inf, folded).argmin(1)
    high = np.where(hollow, -np.inf, folded).argmax(1)
    order = np.sort(np.stack([low, high], 1), axis=1)
    rows = np.arange(len(folded))[:, None]
    return times[rows, order].ravel(), folded[rows, order].ravel()


def envelope(
    t: np.ndarray, low: np.ndarray, high: np.ndarray, bins: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The lowest of ``low`` and the highest of ``high`` in each bin, at the bin's first time."""
    if len(t) <= 2 * bins:
        return t, low, high
    low, high = _folded(low, bins), _folded(high, bins)
    bottom = np.where(np.isnan(low), np.inf, low).min(1)
    top = np.where(np.isnan(high), -np.inf, high).max(1)
    empty = ~np.isfinite(bottom) | ~np.isfinite(top)
    bottom, top = np.where(empty, np.nan, bottom), np.where(empty, np.nan, top)
    return _folded(t, bins)[:, 0], bottom, top


def shares(mask: np.ndarray, bins: int) -> np.ndarray:
    """The share of True in each bin."""
    if len(mask) <= bins:
        return mask.astype(float)
    folded = _folded(mask.astype(float), bins)
    count = (~np.isnan(folded)).sum(1)
    return np.nansum(folded, 1) / count


def averaged(values: np.ndarray, bins: int) -> tuple[np.ndarray, np.ndarray]:
    """The mean of each column of values over at most so many parts of the rows, and which row
    each part begins with.
    """
    starts = np.arange(0, len(values), -(-len(values) // bins))
    sizes = np.diff(np.append(starts, len(values)))
    return np.add.reduceat(values.astype(float), starts) / sizes[:, None], starts


def _folded(values: np.ndarray, bins: int) -> np.ndarray:
    size = -(-len(values) // bins)
    rows = -(-len(values) // size)
    padded = np.full(rows * size, np.nan)
    padded[: len(values)] = values
    return padded.reshape(rows, size)


def lonely(values: np.ndarray) -> np.ndarray:
    """Points without a neighbour, which a line would not show."""
    known = np.concatenate([[False], ~np.isnan(values), [False]])
    return known[1:-1] & ~known[:-2] & ~known[2:]


def spans(t: np.ndarray, mask: np.ndarray, width: float) -> list[tuple[float, float]]:
    """(begin, length) of the runs of True, each row ``width`` long and ending at its time."""
    edges = np.diff(np.concatenate([[0], mask.astype(int), [0]]))
    firsts, lasts = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1) - 1
    return [
        (float(t[a] - width), float(t[b] - t[a] + width))
        for a, b in zip(firsts, lasts, strict=True)
    ]


def spread(t, mask, bins) -> np.ndarray:
    """The mask, with every bin that has a True filled where rows are finer than a pixel."""
    if len(t) <= 4 * bins:
        return mask
    size = -(-len(mask) // (2 * bins))
    found = shares(mask, 2 * bins) > 0
    return np.repeat(found, size)[: len(mask)]


_NOT_A_PLACE = {"v", "vel", "velocity", "speed", "doppler", "rate", "a", "acc", "accel",
                "acceleration", "bias"}  # fmt: skip


def map_pair(names) -> tuple[str, str] | None:
    """The names of the east and north positions among ``names``."""
    found = []
    for axis in ("east", "north"):
        fits = [
            str(name) for name in names
            if axis in (tokens := set(str(name).lower().replace("-", "_").split("_")))
            and not tokens & _NOT_A_PLACE
        ]  # fmt: skip
        if not fits:
            return None
        found.append(fits[0])
    return found[0], found[1]


def inline(svg: str, prefix: str, label: str) -> str:
    """An SVG file as an element of a page: own ids, the page's colours, a name to read out."""
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.S)
    head, body = svg[svg.index("<svg") :].split(">", 1)
    box = re.search(r'viewBox="[^"]*"', head)
    body = re.sub(r'(\bid="|url\(#|href="#)', rf"\g<1>{prefix}-", body)
    for colour, name in VARIABLES.items():
        body = re.sub(rf"(fill|stroke): {colour}", rf"\1: var(--{name})", body)
    label = html.escape(label, quote=True)
    return f'<svg {box[0] if box else ""} role="img" aria-label="{label}">{body.strip()}'


def lighter(svg: str) -> str:
    """The same drawing with coordinates to a hundredth of a point."""

    def shorter(match: re.Match[str]) -> str:
        return re.sub(r"(\d+\.\d{2})\d+", r"\1", match[0]).replace("\n", "")

    return re.sub(r'\bd="[^"]*"', shorter, svg)
