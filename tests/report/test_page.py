"""The page: complete, self-contained, escaped, and right in its first sentence."""

import json
from html.parser import HTMLParser

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr

import demo
from holdfast.records import Reason, Status
from holdfast.report import page, sections, words
from holdfast.report.tables import dataset, summary

EVIL = "<script>alert('x')</script> & \"co\""
VOID = {"meta", "br", "hr", "img", "input", "link"}


class Reader(HTMLParser):
    """Checks nesting; collects tags, ids, links, text."""

    def __init__(self):
        super().__init__()
        self.open, self.tags, self.ids, self.links, self.said = [], [], [], [], []

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        self.tags.append(tag)
        self.ids += [given["id"]] if "id" in given else []
        self.links += [v for k, v in attrs if k in ("href", "xlink:href", "src")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        self.handle_endtag(tag)

    def handle_endtag(self, tag):
        if tag not in VOID:
            assert self.open.pop() == tag

    def handle_data(self, data):
        self.said.append(data)


def written(folder, trace, plant, **more):
    time = demo.time_of(trace)
    window = more.get("attack_window")
    found = summary(trace, plant, time, window)
    given = {"title": "Flight", "scenario_text": "[plant]\n", "units": demo.UNITS} | more
    path = page.write_report(folder, trace=trace, plant=plant, time=time, summary=found, **given)
    reader = Reader()
    reader.feed(path.read_text("utf-8"))
    assert reader.open == []
    return reader, found


def test_a_report_is_complete_and_self_contained(tmp_path, plant, flight):
    reader, found = written(
        tmp_path / "new" / "report", flight, plant, title=EVIL, scenario_text=EVIL, notes=[EVIL],
        blindness=[EVIL, {"channel": EVIL, "size_m": 7.3}],
        calibration={"sentence": EVIL, "method": EVIL, "standard_error": None},
    )  # fmt: skip
    folder = tmp_path / "new" / "report"
    names = {str(f.relative_to(folder)) for f in folder.rglob("*") if f.is_file()}
    shown = ("statistic", "attacks", "path", "states", "residuals", "trade_off")
    drawn = {f"figures/{name}.svg" for name in shown}
    assert names == {*page.FILES, *drawn}
    assert "script" not in reader.tags
    assert all(link.startswith(("#", "data:")) for link in reader.links)
    assert len(reader.ids) == len(set(reader.ids))
    said = "".join(reader.said)
    # title, heading, scenario, note, twice in blindness, twice in calibration
    assert said.count(EVIL) == 8
    assert reader.tags.count("figure") == len(shown)
    assert json.loads((folder / "scores.json").read_text()) == found
    assert (folder / "scenario.toml").read_text() == EVIL
    with xr.open_dataset(folder / "result.nc", engine="h5netcdf") as back:
        expected = dataset(flight, plant, demo.time_of(flight), units=demo.UNITS)
        xr.testing.assert_identical(back.load(), expected)


def test_a_log_and_a_batch_get_reports(tmp_path, plant, flight, log):
    reader, _ = written(tmp_path / "log", log, plant, attack_window=(30.0, 50.0))
    said = "".join(reader.said)
    assert "Recorded log" in said
    assert (tmp_path / "log" / "figures" / "samples.svg").is_file()
    quiet = eqx.tree_at(lambda t: t.verdict.alarm, flight, jnp.zeros(600, bool))
    both = jax.tree.map(lambda *a: jnp.stack(a), flight, quiet)
    reader, _ = written(tmp_path / "both", both, plant)
    assert "The attack raised an alarm in 1 of 2 runs" in "".join(reader.said)


def test_a_failing_write_leaves_nothing_behind(tmp_path, plant, flight, monkeypatch):
    (tmp_path / "report.html").write_text("old")
    monkeypatch.setattr(page.os, "replace", lambda *_: (_ for _ in ()).throw(OSError("full")))
    monkeypatch.setattr(page, "draw", lambda *_: {})
    with pytest.raises(OSError, match="full"):
        written(tmp_path, flight, plant)
    assert [f.name for f in tmp_path.rglob("*") if f.is_file()] == ["report.html"]


def verdict_of(trace, plant, window=None):
    found = summary(trace, plant, demo.time_of(trace), window)
    return words.verdict(found, demo.UNITS)


def test_the_verdict_says_what_happened(plant, flight, log):
    found = verdict_of(flight, plant)
    first = np.flatnonzero(np.asarray(flight.verdict.alarm))[0]
    size = f"{float(flight.estimate.d[first, 0]):.1f}"
    sd = f"{2 * float(flight.estimate.d_cov[first, 0, 0]) ** 0.5:.1f}"
    at, late = (first + 1) / 10, (first + 1) / 10 - 30
    plain = found.sentence.replace(words.NBSP, " ")
    assert found.level == "attack"
    assert plain == (
        f"Alarm at {at:.1f} s: attack on spoof_north, {late:.1f} s after it began; "
        f"estimated size {size} ± {sd} m."
    )
    silent = eqx.tree_at(lambda t: t.verdict.alarm, flight, jnp.zeros(600, bool))
    missed = verdict_of(silent, plant)
    assert missed.level == "missed"
    assert "raised no alarm" in missed.sentence
    unknown = verdict_of(log, plant)
    assert unknown.level == "alarm"
    assert unknown.sentence.startswith("Alarm at")
    none = verdict_of(eqx.tree_at(lambda t: t.verdict.alarm, log, jnp.zeros(600, bool)), plant)
    assert (none.level, none.sentence[:8]) == ("quiet", "No alarm")


def test_false_alarms_are_called_so(plant, flight):
    zero = jax.tree.map(jnp.zeros_like, flight.injection)
    calm = eqx.tree_at(lambda t: t.injection, flight, zero)
    found = verdict_of(calm, plant)
    assert found.level == "alarm"
    assert "false-alarm episode" in found.sentence
    early = eqx.tree_at(lambda t: t.verdict.alarm, flight, flight.verdict.alarm.at[9].set(True))
    assert "1 false-alarm episode in the" in " ".join(verdict_of(early, plant).more)


@pytest.mark.parametrize(
    ("value", "half", "expected"),
    [(6.187, 2.57, "6.2 ± 2.6"), (-0.01234, 0.0031, "-0.0123 ± 0.0031"),
     (1234.0, 56.0, "1234 ± 56"), (1234.0, 560.0, "1230 ± 560"), (3.0, 0.0, "3")],
)  # fmt: skip
def test_numbers_show_what_is_known(value, half, expected):
    found = words.within(value, half).replace(words.NBSP, " ").replace(words.MINUS, "-")
    assert found == expected


def test_every_reason_can_be_said():
    for reason in Reason:
        episode = {"words": reason.words, "reason": reason.name, "channel": "gps"}
        assert "gps" in words.reason(episode)


def test_the_share_of_rows_with_contradictory_limits_is_printed(plant, flight):
    """Of all rows, though a row may carry several statuses."""
    bits = np.zeros(600, np.int32)
    bits[:30] = int(Status.INFEASIBLE)
    bits[:12] |= int(Status.MISSING)
    marked = eqx.tree_at(lambda t: t.estimate.status, flight, jnp.asarray(bits))
    text = str(sections.quality(summary(marked, plant, demo.time_of(marked))))
    row = text[text.index("INFEASIBLE") :]
    assert row.index(">30<") < row.index(f">{words.percent(0.05)}<")
    assert "contradict" in row
