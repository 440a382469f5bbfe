"""The parts of the page that are numbers and words."""

import re
from collections.abc import Mapping, Sequence
from typing import Any

from holdfast.report import words
from holdfast.report.markup import (
    Column,
    Markup,
    element,
    items,
    join,
    records,
    settings,
    table,
)
from holdfast.report.words import DASH, number, percent, seconds

SHOWN = 20
"""Episodes and modes listed on the page; scores.json has all."""

_TAGS = {"attack": "Attack detected", "missed": "Attack missed", "alarm": "Alarm",
         "quiet": "No alarm"}  # fmt: skip


def verdict_card(summary: Mapping[str, Any], units: Mapping[str, str]) -> Markup:
    """The verdict, first thing on the page."""
    found = words.verdict(summary, units)
    level = "quiet-level" if found.level == "quiet" else found.level
    more = [element("p", " ".join(found.more))] if found.more else []
    tag = element("span", _TAGS[found.level], class_="tag")
    return element("div", tag, element("strong", found.sentence), *more, class_=f"verdict {level}")


def key_numbers(summary: Mapping[str, Any]) -> Markup:
    """The few numbers that are asked for first."""
    tiles: list[tuple[str, str, str]] = []
    run, dt = summary["per_run"][0], summary["dt_s"]
    detection, false = summary["detection"], summary["false_alarms"]
    if detection is not None:
        several = summary["runs"] > 1
        delay = detection["median_delay_s"] if several else run["delay_s"]
        tiles.append(("Median delay" if several else "Delay of the alarm", seconds(delay, dt),
                      "from the attack's start"))  # fmt: skip
        missed = detection["missed_tested_rows"]
        caught = None if missed["value"] is None else 1 - missed["value"]
        tiles.append(("Attacked rows with alarm", percent(caught),
                      f"of {missed['of']} rows tested"))  # fmt: skip
    if false is not None and false["episodes"]["duration"]:
        rate = false["episodes"]
        tiles.append(("False-alarm episodes", str(rate["events"]),
                      f"in {number(rate['duration'])} s without attack; at most "
                      f"{number(3600 * rate['upper'])} an hour (95 %)"))  # fmt: skip
        rows = false["rows"]
        tiles.append(("False alarms per row tested", percent(rows["value"]),
                      f"{percent(rows['low'])} to {percent(rows['high'])} (95 %)"))  # fmt: skip
    if false is None and detection is None:
        tiles.append(("Alarm episodes", str(len(run["episodes"])),
                      f"{percent(summary['alarm_rows']['value'])} of the rows"))  # fmt: skip
    modes = summary["modes"]
    if modes is not None and modes["accuracy"] is not None:
        tiles.append(("Mode right", percent(modes["accuracy"]["value"]),
                      f"of {modes['accuracy']['of']} rows"))  # fmt: skip
    tested = summary["tested"]
    tiles.append(("Rows tested", percent(tested["value"]), f"of {tested['of']} rows"))
    cells = (
        element("div", element("dt", name), element("dd", value, element("small", more)))
        for name, value, more in tiles
    )
    return element("dl", *cells, class_="numbers")


def contents(parts: Sequence[str]) -> Markup:
    """Links to the sections."""
    found = (re.search(r'<h2 id="([^"]*)">(.*?)</h2>', part) for part in parts)
    links = [element("a", Markup(m[2]), href=f"#{m[1]}") for m in found if m]
    return element("nav", *links, aria_label="Contents")


def episodes(summary: Mapping[str, Any], units: Mapping[str, str]) -> Markup:
    """The table of alarm episodes of the (first) run."""
    found, dt = summary["per_run"][0]["episodes"], summary["dt_s"]
    heading = element("h3", "Alarm episodes")
    if not found:
        return join([heading, element("p", "None.")])
    sized = any("estimate" in episode for episode in found)
    rows = [
        [
            seconds(episode["begin_s"], dt), seconds(episode["end_s"], dt),
            str(episode["alarm_rows"]),
            words.reason(episode) + (" (false alarm)" if _is_false(episode, summary) else ""),
            *([words.size(episode, units) if "estimate" in episode else DASH] if sized else []),
            number(episode["largest_statistic"]), number(episode["threshold"]),
        ]
        for episode in found[:SHOWN]
    ]  # fmt: skip
    given = "Reason and estimate (± two standard deviations)" if sized else "Reason"
    gap = number(summary["episode_gap_s"])
    caption = f"Alarms at most {gap} s apart are one episode. {given} at its first row."
    if len(found) > SHOWN:
        caption += f" The first {SHOWN} of {len(found)}; all are in scores.json."
    columns = [Column("Begin"), Column("End"), Column("Alarms", True), Column("Reason"),
               *([Column("Attack estimate", True)] if sized else []),
               Column("Largest statistic", True), Column("Threshold", True)]  # fmt: skip
    return join([heading, table(columns, rows, caption)])


def _is_false(episode: Mapping[str, Any], summary: Mapping[str, Any]) -> bool:
    if summary["attack"] is None:
        return summary["simulated"]
    return episode["begin_s"] < summary["attack"]["start_s"]


def mode_scores(summary: Mapping[str, Any]) -> Markup:
    """How often each mode was believed in and, if the truth is known, how rightly and how soon."""
    found, dt = summary["modes"], summary["dt_s"]
    said = words.modes(summary)
    parts = [element("p", said)] if said else []
    if found["true"]:
        columns = [Column("True mode"), Column("Rows", True), Column("Believed in", True),
                   Column("Times", True), Column("Median delay", True),
                   Column("Largest delay", True)]  # fmt: skip
        rows = [
            [name, str(row["accuracy"]["of"]), percent(row["accuracy"]["value"]),
             str(row["spells"]), seconds(row["median_delay_s"], dt),
             seconds(row["largest_delay_s"], dt)]
            for name, row in found["true"].items()
        ]  # fmt: skip
        caption = "Delays are until the mode was first believed in, each time it was true."
        parts.append(table(columns, rows, caption))
    columns = [Column("Mode believed in"), Column("Rows", True), Column("Share", True)]
    ordered = sorted(found["believed"].items(), key=lambda item: -item[1]["hits"])
    rows = [[name, str(row["hits"]), percent(row["value"])] for name, row in ordered[:SHOWN]]
    more = len(ordered) - SHOWN
    caption = f"The first {SHOWN} of {len(ordered)}; all are in scores.json." if more > 0 else ""
    return join([*parts, table(columns, rows, caption)])


def state_scores(summary: Mapping[str, Any]) -> Markup:
    """Errors of the state estimate, if the truth is known."""
    return _errors(summary["state"], "State", "Error of the estimate against the true state.")


def attack_scores(summary: Mapping[str, Any]) -> Markup:
    """Errors of the attack estimate, if the truth is known."""
    return _errors(
        summary["attack_estimate"], "Channel", "Error of the estimate against what was injected."
    )


def _errors(found: Mapping[str, Any] | None, kind: str, caption: str) -> Markup:
    if not found:
        return Markup("")
    columns = [Column(kind), Column("RMS error", True), Column("Worst error", True),
               Column("Median sd stated", True), Column("Rows determined", True)]  # fmt: skip
    rows = [
        [name, number(row["rmse"]), number(row["worst"]), number(row["median_sd"]),
         percent(row["determined"]["value"])]
        for name, row in found.items()
    ]  # fmt: skip
    return table(columns, rows, caption)


def consistency(summary: Mapping[str, Any]) -> Markup:
    """Whether the covariances stated are honest."""
    names = {"nis": "Residuals (NIS)", "nees": "State errors (NEES)"}
    rows = []
    for key, found in summary["consistency"].items():
        judged = DASH if found["ratio"] is None else _judgement(found)
        rows.append([names[key], number(found["ratio"]),
                     f"{number(found['low'])} to {number(found['high'])}", judged,
                     f"{found['rows']} {found['over']}"])  # fmt: skip
    columns = [Column("Consistency"), Column("Ratio", True), Column("95 % interval", True),
               Column("Judgement"), Column("Over")]  # fmt: skip
    return table(columns, rows, "Squares over their stated covariance: 1 where it is honest.")


def _judgement(found: Mapping[str, Any]) -> str:
    if found["consistent"]:
        return "consistent"
    larger = found["ratio"] > found["high"]
    return "errors larger than stated" if larger else "errors smaller than stated"


def detector(
    summary: Mapping[str, Any],
    calibration: Mapping[str, Any] | None,
    blindness: Sequence[str | Mapping[str, Any]],
) -> Markup:
    """Calibration, blindness, and how well the statistic tells attacked rows from others."""
    parts: list[Markup] = []
    detection = summary["detection"]
    if detection is not None and detection["auc"]["value"] is not None:
        area = detection["auc"]
        parts.append(element("p",
            f"An attacked row has a larger statistic than one before the attack with probability "
            f"{number(area['value'])} (area under the ROC curve; 95 % interval "
            f"{number(area['low'])} to {number(area['high'])}, rows taken as independent; "
            "0.5 is chance)."))  # fmt: skip
    if blindness:
        parts.append(element("h3", "What it cannot see"))
        lines = [line for line in blindness if isinstance(line, str)]
        rows = [row for row in blindness if not isinstance(row, str)]
        parts += [items(lines)] if lines else []
        parts += [records(rows)] if rows else []
    if calibration:
        rest = {k: v for k, v in calibration.items() if k != "sentence" and v is not None}
        said = [element("p", calibration["sentence"])] if "sentence" in calibration else []
        parts += [element("h3", "Calibration of the threshold"), *said, settings(rest)]
    if not parts:
        parts.append(element("p", "No calibration was asked for and no attack is known, so "
                             "nothing can be said about what this detector misses."))  # fmt: skip
    return join(parts)


def quality(summary: Mapping[str, Any]) -> Markup:
    """What arrived, what did not, and what the estimator said about it."""
    samples = summary["rows"] * summary["runs"]
    rows = [
        [name, *(f"{found[kind]} ({percent(found[kind] / samples)})" if found[kind] else "0"
                 for kind in ("missing", "faulty", "missing_or_faulty"))]
        for name, found in summary["data"].items()
    ]  # fmt: skip
    columns = [Column("Output"), Column("Missing", True), Column("Faulty", True),
               Column("One of the two", True)]  # fmt: skip
    lost = any(any(found.values()) for found in summary["data"].values())
    parts = [table(columns, rows) if lost else element("p", "Every sample arrived and was sound.")]
    if summary["status"]["OK"] < samples:
        status = [
            [name, str(n), percent(n / samples), _STATUS.get(name, "")]
            for name, n in summary["status"].items()
        ]
        columns = [Column("Status"), Column("Rows", True), Column("Share", True), Column("Meaning")]
        parts += [element("h3", "Status of the estimator"), table(columns, status)]
    return join(parts)


_STATUS = {
    "OK": "nothing to report",
    "MISSING": "some samples did not arrive",
    "BAD_INPUT": "a sample was not a finite number and was dropped",
    "UNOBSERVABLE": "an attack channel could not be identified",
    "AMBIGUOUS": "several explanations fit equally well",
    "INFEASIBLE": "limits contradict each other; the estimate is without them",
    "HIDDEN_INPUT": "an attack reaches the outputs one row later only",
    "NOT_READY": "too few rows so far",
    "NOT_CONVERGED": "an iteration stopped before it had converged",
    "DIVERGED": "numbers left the finite range; the last sound ones are kept",
}


def files(names: Sequence[str]) -> Markup:
    """What lies beside the page."""
    what = {
        "result.nc": "every number, with named dimensions (NetCDF; xarray opens it)",
        "scores.json": "the scores on this page and more",
        "scenario.toml": "the scenario, to run it again",
    }
    return items(
        [Markup(f"{element('code', name)}: {what[name]}") for name in names if name in what]
        + [Markup(f"{element('code', 'figures/')}: the figures as SVG")]
    )
