"""Tables and sentences of the arena, from cases written by hand."""

import math

import numpy as np
import pandas as pd
import pytest

from holdfast.report.arena_numbers import number
from holdfast.report.arena_tables import LEGEND, losses, markdown, said, summary, tables, winners
from holdfast.shell.arena_cases import FAILED

INF, NAN = math.inf, math.nan


def case(attack, estimator, error, half=0.1, **more):
    """A row of the cases; ``half``: of the interval, none where the error is not finite."""
    finite = math.isfinite(error)
    row = {
        "ground": "car", "study": "estimators", "attack": attack, "estimator": estimator,
        "detector": "", "truth": "", "error": error,
        "error_low": error - half if finite else NAN, "error_high": error + half if finite else NAN,
        "failed": not error < FAILED, "tightness": NAN, "promise": "", "alarms": NAN,
        "alarms_low": NAN, "alarms_high": NAN, "false_alarms": 0.01, "attackable": None,
    }  # fmt: skip
    return row | more


def alarm(attack, estimator, detector, share, half=0.01):
    more = {"alarms": share, "alarms_low": share - half, "alarms_high": share + half}
    return case(attack, estimator, 1.0, study="detectors", detector=detector, **more)


def frame(*rows):
    return pd.DataFrame(list(rows))


def promised(kind, tightness=NAN):
    return {"promise": kind, "tightness": tightness}


FOUGHT = frame(
    case("none", "Kalman", 1.0, **promised("exact", 1.0), false_alarms=0.02),
    case("none", "NISE", 1.15, **promised("exact", 1.0)),
    case("none", "decoder", 2.0, **promised("kept", 0.2)),
    case("bias", "Kalman", 3544.0, attackable=False),
    case("bias", "NISE", 1.2, **promised("broken", 1.3), attackable=False),
    case("bias", "decoder", 3.2, **promised("kept", 0.8), attackable=False),
    case("covert", "Kalman", INF, attackable=True),
    case("covert", "NISE", NAN, attackable=True),
    case("covert", "decoder", 123456.0, attackable=True, **promised("kept", 0.5)),
    case("drift", "Kalman", 2.0),
    case("drift", "NISE", 2.5),
    case("drift", "decoder", 2.45),
)


def lines(cases, start):
    return [line for line in markdown(cases).splitlines() if line.startswith(f"| {start} |")]


def test_the_summary_counts():
    found = summary(FOUGHT)
    assert found == {
        "cases": 12, "promised": 6, "exact": 2, "kept": 3, "broken": 1,
        "attacked": 9, "attacked_promised": 3, "failed_promised": 2,
        "failed_unpromised": 3, "sound_unpromised": 3,
        "tightness_median": 0.5, "tightness_least": 0.2, "tightness_most": 0.8,
        "false_alarms_least": 0.01, "false_alarms_most": 0.02,
        "false_alarms_worst": "Kalman on car",
    }  # fmt: skip
    text = markdown(FOUGHT)
    assert text.startswith("Of 12 cases 6 have a promise: 2 exact, 3 bounds, 1 broken. Of 9 cases")
    assert "The error is 0.20 to 0.80 of its bound, in the median 0.50." in text
    assert "1.0 to 2.0 per cent of the rows have an alarm, most with Kalman on car." in text


def test_what_is_not_there_is_not_said():
    found = frame(case("none", "Kalman", 1.0, false_alarms=NAN), case("bias", "Kalman", 2.0))
    found["false_alarms"] = NAN
    assert math.isnan(summary(found)["tightness_median"])
    assert summary(found)["false_alarms_worst"] == ""
    text = markdown(found)
    assert "0 have a promise: 0 exact, 0 bounds, none broken." in text
    assert "of its bound" not in text
    assert "per cent of the rows" not in text


def test_the_false_alarms_are_those_without_mismatch():
    rows = [case("none", "Kalman", 1.0), case("none", "IMM", 1.0, truth="tau = 2")]
    rows[1]["false_alarms"] = 0.5
    assert summary(frame(*rows))["false_alarms_most"] == 0.01


def test_winners_share_what_their_intervals_overlap():
    none, bias, covert, drift = winners(FOUGHT)
    assert none.best == ("Kalman", "NISE")
    assert (none.lost_to, none.own) == ("", "NISE")
    assert bias.best == ("NISE",)
    assert bias.failed == ("Kalman", "decoder")
    assert (covert.best, covert.lost_to) == (("decoder",), "")
    assert covert.failed == ("Kalman", "NISE", "decoder")
    assert drift.best == ("Kalman",)
    assert (drift.lost_to, drift.lost_value) == ("Kalman", 2.0)
    assert (drift.own, drift.own_value) == ("decoder", 2.45)
    assert losses(FOUGHT) == (
        "In 1 of 4 comparisons a baseline beats all of our own beyond the 95 % intervals.",
        [("car, estimators", "drift", "Kalman 2.00", "decoder 2.45")],
    )
    assert "- car, estimators, drift: Kalman 2.00; our own: decoder 2.45\n" in markdown(FOUGHT)


@pytest.mark.parametrize(("own", "lost"), [(2.15, ""), (2.25, "Huber"), (INF, "Huber")])
def test_a_loss_is_beyond_both_intervals(own, lost):
    rows = [case("bias", name, 2.0 + i / 10) for i, name in enumerate(("Huber", "Kalman"))]
    (win,) = winners(frame(*rows, case("bias", "NISE", own)))
    assert win.lost_to == lost
    assert win.best[:2] == ("Huber", "Kalman")


def test_who_failed_is_not_beside_who_did_not():
    """One run of many that is lost makes an interval that overlaps everything."""
    lost = case("bias", "gated Kalman", 1e9) | {"error_low": 0.5, "failed": True}
    (win,) = winners(frame(case("bias", "NISE", 1.2), lost))
    assert win.best == ("NISE",)
    (win,) = winners(frame(case("bias", "NISE", 9.0) | {"failed": True}, lost))
    assert win.best == ("NISE", "gated Kalman")


def test_one_of_our_own_is_enough_and_nobody_can_win_without_a_value():
    (win,) = winners(frame(case("a", "Kalman", 1.0), case("a", "x", 9.0), case("a", "y", 1.1)))
    assert win.lost_to == ""
    assert winners(frame(case("a", "Kalman", INF), case("a", "x", NAN))) == []
    (win,) = winners(frame(case("a", "Kalman", 1.0), case("a", "gated Kalman", 5.0)))
    assert win.lost_to == ""


DETECTED = frame(
    *(alarm("none", e, d, NAN) for e in ("Kalman", "NISE") for d in ("chi", "CUSUM")),
    alarm("bias", "Kalman", "chi", 0.5), alarm("bias", "Kalman", "CUSUM", 0.9),
    alarm("bias", "NISE", "chi", 0.004), alarm("bias", "NISE", "CUSUM", 0.0),
    alarm("ramp", "Kalman", "chi", 0.5), alarm("ramp", "Kalman", "CUSUM", 0.6),
    alarm("ramp", "NISE", "chi", 0.61), alarm("ramp", "NISE", "CUSUM", 0.3),
)  # fmt: skip


def test_detectors_compete_for_alarms():
    bias, ramp = winners(DETECTED)
    assert (bias.best, bias.lost_to, bias.own) == (
        ("Kalman / CUSUM",), "Kalman / CUSUM", "NISE / chi",
    )  # fmt: skip
    assert ramp.best == ("NISE / chi", "Kalman / CUSUM")
    assert (ramp.lost_to, ramp.failed) == ("", ())
    assert losses(DETECTED)[1] == [
        ("car, detectors", "bias", "Kalman / CUSUM 90.0 %", "NISE / chi 0.400 %")
    ]
    (line,) = lines(DETECTED, "bias")
    assert line == "| bias | 50 | **90** | <1 | 0 |"
    (line,) = lines(DETECTED, "false alarms, %")
    assert line == "| false alarms, % | 1.0 | 1.0 | 1.0 | 1.0 |"
    assert not lines(DETECTED, "none")


def test_marks_of_the_best_the_failed_and_the_promised():
    text = markdown(FOUGHT).splitlines()
    top = text.index("| attack | Kalman | NISE | decoder | undetected lies can grow |")
    assert text[top - 2 : top + 6] == [
        "### car: estimators",
        "",
        "| attack | Kalman | NISE | decoder | undetected lies can grow |",
        "| --- | ---: | ---: | ---: | --- |",
        "| none | **1.0** \N{CHECK MARK} | **1.1** \N{CHECK MARK} | 2.0 \N{CHECK MARK} |  |",
        "| bias | *3500* | **1.2** \N{BALLOT X} | *3.2* \N{CHECK MARK} | no |",
        "| covert | *inf* | *-* | ***1.2e5*** \N{CHECK MARK} | yes |",
        "| drift | **2.0** | 2.5 | 2.5 |  |",
    ]
    assert all(ord(sign) < 128 or sign in "\N{CHECK MARK}\N{BALLOT X}" for sign in markdown(FOUGHT))
    assert f" {FAILED:g} times the unit" in LEGEND


def test_mismatch_has_a_part_for_each_truth():
    rows = [
        case(attack, name, error * (1 + t), study="mismatch", truth=f"tau = {t}")
        for t in (1, 2)
        for attack in ("none", "bias")
        for name, error in (("Kalman", 0.5), ("NISE", 0.25))
    ]
    for row in rows:
        row["false_alarms"] = 0.123 if row["truth"] == "tau = 1" else 0.5
    (found,) = tables(frame(*rows))
    assert found.heads == ("truth", "attack")
    assert [row.names for row in found.rows] == [
        (f"tau = {t}", what) for t in (1, 2) for what in ("none", "bias", "false alarms, %")
    ]
    assert lines(frame(*rows), "tau = 1") == [
        "| tau = 1 | none | 1.0 | **0.50** |",
        "| tau = 1 | bias | 1.0 | **0.50** |",
        "| tau = 1 | false alarms, % | 12 | 12 |",
    ]
    assert winners(frame(*rows)) == []


def test_names_are_no_markdown_and_files_give_the_same(tmp_path):
    found = pd.concat([FOUGHT, DETECTED, frame(case("a|b *c*", "x_y", 1.0, ground="[b"))])
    text = markdown(found)
    assert "| a\\|b \\*c\\* | **1.0** |" in text
    assert "### \\[b: estimators" in text
    found.to_csv(tmp_path / "cases.csv", index=False)
    for kept in (True, False):
        again = pd.read_csv(tmp_path / "cases.csv", keep_default_na=kept)
        assert markdown(again) == text


@pytest.mark.parametrize(
    ("value", "text"),
    [(1.0, "1.0"), (9.96, "10"), (3544.2, "3500"), (99499.0, "99000"), (99999.0, "1e5"),
     (123456.0, "1.2e5"), (0.0123, "0.012"), (0.0, "0"), (1e-7, "1e-7"), (INF, "inf"),
     (NAN, "-"), (np.float64(26.49), "26")],
)  # fmt: skip
def test_numbers_have_two_digits(value, text):
    assert number(value) == text


def test_shares_have_no_decimals():
    shares = [said(v, "alarms") for v in (0.0, 0.004, 0.01, 0.996, 1.0, NAN)]
    assert shares == ["0", "<1", "1", "100", "100", "-"]
    assert said(0.0093, "false alarms") == "0.93"
