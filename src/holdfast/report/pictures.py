"""Which figures a report shows, and how to read each."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from holdfast.evaluate import scores
from holdfast.report import figures, mode_figures
from holdfast.report.drawing import inline, map_pair
from holdfast.report.figures import NARROW, PANELS, WIDE, Layout, Window
from holdfast.report.markup import Markup, element


class Picture(NamedTuple):
    """A figure: its name as a file, what it shows, how to read it, drawn wide and narrow."""

    name: str
    shows: str
    reading: str
    wide: str
    narrow: str

    def markup(self) -> Markup:
        """The figure as part of a page: wide for a desk, narrow for a phone."""
        drawings = (
            element("div", Markup(inline(drawing, f"{self.name}-{kind}", self.shows)), class_=kind)
            for kind, drawing in (("wide", self.wide), ("narrow", self.narrow))
        )
        return element("figure", *drawings, element("figcaption", self.reading))


def draw(data: xr.Dataset, summary: Mapping[str, Any], window: Window) -> dict[str, Picture]:
    """Every figure that this run has something for, by name."""
    found: dict[str, Picture] = {}

    def add(name: str, shows: str, reading: str, draw: Callable[[Layout], figures.Figure]) -> None:
        drawings = (figures.svg(draw(layout)) for layout in (WIDE, NARROW))
        found[name] = Picture(name, shows, reading, *drawings)

    shaded = " The attack is shaded." if window else ""
    truth = " Dashed: the truth of the simulation." if "true_x" in data else ""
    if np.any(np.isfinite(data.statistic.values)):
        add("statistic", "Detector's statistic over time against its threshold",
            "An alarm is raised where the statistic exceeds the threshold (dashed); alarms are "
            f"dots, and marks along the top edge.{shaded}",
            lambda layout: figures.statistic(data, window, layout))  # fmt: skip
    if "mode" in data and "p" in data:
        known = "true_mode" in data
        strips = "The strips show the mode believed in and the true one" if known else (
            "The strip shows the mode believed in")  # fmt: skip
        gap = "; a gap where none of the modes was true" if known else ""
        add("modes", "Probability of each mode over time, and the mode believed in",
            f"{strips}{gap}. Below, how probable the bank holds each mode; together they are 1.",
            lambda layout: mode_figures.modes(data, layout))  # fmt: skip
    if "d" in data and data.sizes["attack"]:
        add("attacks", "Attack estimate of each channel over time with its 2-sigma band",
            "What each attack channel is estimated to inject. Nothing is injected as long as "
            "the band (twice the standard deviation either side) covers zero; there is a gap "
            f"where the data do not determine it.{truth}{shaded}{_left_out(data, 'attack')}",
            lambda layout: figures.attacks(data, window, layout))  # fmt: skip
    if "sensor_attack" in data and np.any(data.sensor_attack.values != 0):
        add("sensor_attacks", "What each sensor is believed to be off by, over time",
            "Zero where the sensor is believed. A suspected sensor is given the constant offset "
            f"that would explain it best.{truth}{shaded}{_left_out(data, 'output')}",
            lambda layout: figures.sensor_attacks(data, window, layout))  # fmt: skip
    place = map_pair(data.state.values)
    if place is not None:
        add("path", "Path on a map: estimated, measured and, if simulated, true",
            "The way seen from above. Where measured and estimated part, somebody else is "
            "choosing the measurements, or the model is wrong.",
            lambda layout: figures.path(data, place, layout))  # fmt: skip
    add("states", "Estimate of each state over time with its 2-sigma band",
        f"The band is twice the standard deviation either side.{truth}{shaded}"
        f"{_left_out(data, 'state')}",
        lambda layout: figures.states(data, window, layout))  # fmt: skip
    if np.any(np.isfinite(data.residual.values)):
        add("residuals", "Residual of each output over time in standard deviations",
            "What each measurement differs from its prediction, in standard deviations. "
            "Without attack about 95 % lie within the dashed lines, without pattern."
            f"{shaded}{_left_out(data, 'output')}",
            lambda layout: figures.residuals(data, window, layout))  # fmt: skip
    if np.any(data["sample"].values):
        add("samples", "Samples that are missing or faulty, output by output over time",
            "Grey: samples that did not arrive. Pink: samples that were not a finite number, or "
            "that are missing from a row with such a sample.",
            lambda layout: figures.samples(data, layout))  # fmt: skip
    curve = trade_off(data, summary, window)
    if curve is not None:
        run = summary["per_run"][0]
        chosen = (run["episodes_before"], np.nan if run["delay_s"] is None else run["delay_s"])
        add("trade_off", "Delay of the alarm against false-alarm episodes before the attack",
            "Each dot is a threshold, this run replayed with it; the line is the best delay "
            "for as many episodes, the ring the threshold in use.",
            lambda layout: figures.trade_off(curve, chosen, layout))  # fmt: skip
    return found


def trade_off(
    data: xr.Dataset, summary: Mapping[str, Any], window: Window
) -> scores.TradeOff | None:
    """The curve of this run; None without an attack, rows before it, or any way to catch it."""
    if window is None or not np.any(data.time.values < window[0]):
        return None
    ratio = scores.margin(data.statistic.values, data.threshold.values)
    curve = scores.trade_off(
        data.time.values, ratio, window[0], stop=window[1], gap=summary["episode_gap_s"]
    )
    return curve if np.any(np.isfinite(curve.delay)) else None


def _left_out(data: xr.Dataset, kind: str) -> str:
    more = data.sizes[kind] - PANELS
    return f" The first {PANELS} of {data.sizes[kind]}; all are in result.nc." if more > 0 else ""
