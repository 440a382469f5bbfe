"""Scores of a run inside the compiled simulation, against those of its record."""

import jax
import numpy as np
import pytest

from holdfast.campaign.blocks import case_of, point_key, single
from holdfast.campaign.run_scores import BINS, as_channels, bin_edges, margins, run_scores
from holdfast.evaluate import modes as mode_scores
from holdfast.report.tables import summary
from holdfast.report.truth import true_attack, true_mode
from holdfast.shell.banks import hypotheses_of
from holdfast.shell.files import load_scenario
from studied import scenario_text

ESTIMATORS = {
    "kalman": 'kind = "kalman"',
    "unknown_input": 'kind = "unknown_input"\ndelay = 1',
    "nisme": 'kind = "nisme"\nattack_prior_sd = [20.0, 10.0]',
}
LATE = "start = 5\nstop = 12"
ATTACKS = {
    "none": "",
    "sensor by name": f'[[attack]]\nkind = "bias"\nchannel = "sensor:gps"\n{LATE}\nvalue = 3',
    "actuator": '[[attack]]\nkind = "sine"\nchannel = "actuator:accel"\n'
    f"{LATE}\namplitude = 2\nfrequency = 0.2",
    "channels": '[[attack]]\nkind = "bias"\nstart = 5\nvalue = 3\n'
    'channels = ["channel:gps_spoof", "channel:accel_attack"]',
    "wheel": f'[[attack]]\nkind = "bias"\nchannel = "sensor:wheel"\n{LATE}\nvalue = 0.5',
}


@pytest.fixture(scope="module", params=[(e, a) for e in ESTIMATORS for a in ATTACKS], ids="-".join)
def run(request, tmp_path_factory):
    estimator, attack = request.param
    path = tmp_path_factory.mktemp("scored") / "scenario.toml"
    path.write_text(scenario_text(ESTIMATORS[estimator], ATTACKS[attack]))
    scenario = load_scenario(path)
    case = case_of(scenario, 150, drawn=False)
    trace = jax.tree.map(np.asarray, single(case, point_key(1, "a"), 7))
    found = run_scores(scenario, jax.tree.map(jax.numpy.asarray, trace), case.maps)
    return scenario, trace, jax.tree.map(np.asarray, found)


@pytest.mark.slow
def test_they_are_those_of_the_record(run):
    scenario, trace, found = run
    plant = scenario.plant
    modes = hypotheses_of(scenario.monitor.estimator)
    time = plant.dt * np.arange(1, 151)
    said = summary(trace, plant, time, modes=modes)
    truth = true_attack(trace, plant)
    for kind, part, names in (
        ("state", "state", plant.states), ("attack", "attack_estimate", plant.attacks)
    ):  # fmt: skip
        if said[part] is None:
            assert f"{kind}_rmse" not in found
            continue
        for i, name in enumerate(names):
            for score, other in (("rmse", "rmse"), ("worst", "worst")):
                ours, theirs = found[f"{kind}_{score}"][i], said[part][name][other]
                assert ours == pytest.approx(np.nan if theirs is None else theirs, nan_ok=True)
    false = said["false_alarms"]["rows"]
    assert (found["false_alarms"], found["benign_rows"]) == (false["hits"], false["of"])
    for name in ("nis", "nees"):
        ratio = found[name] / found[f"{name}_degrees"]
        assert ratio == pytest.approx(said["consistency"][name]["ratio"], rel=1e-9)
    if said["attack"] is None:
        assert np.isnan(found["detection_delay"])
        assert found["attacked_rows"] == 0
    else:
        missed = said["detection"]["missed_rows"]
        assert (found["missed"], found["attacked_rows"]) == (missed["hits"], missed["of"])
        delay = said["per_run"][0]["delay_s"]
        assert found["detection_delay"] == pytest.approx(np.inf if delay is None else delay)
    if "mode_rows" in found:
        believed = mode_scores.accuracy(trace.estimate.mode, true_mode(trace, truth, modes))
        assert (found["mode_right"], found["mode_rows"]) == (believed.hits, believed.of)


@pytest.mark.slow
def test_bins_hold_the_margins(run):
    _, trace, _ = run
    benign, attacked = map(np.asarray, margins(jax.tree.map(jax.numpy.asarray, trace)))
    ratio = trace.verdict.statistic / trace.verdict.threshold
    tested = np.isfinite(trace.verdict.threshold)
    if trace.estimate.mode is not None:
        # a row in which a bank believes in no attack has passed its test
        ratio, tested = np.where(tested, ratio, 0.0), np.ones(len(tested), bool)
    hit = np.zeros(len(ratio), bool)
    for part in (trace.injection.u, trace.injection.y, trace.injection.d):
        hit |= np.any(part != 0, 1)
    rows = np.flatnonzero(hit)
    before = np.arange(len(ratio)) < (rows[0] if len(rows) else len(ratio))
    edges = bin_edges()
    assert len(edges) == len(benign) == BINS
    for multiple in (0.0, edges[100], 1.0, edges[200]):
        place = np.searchsorted(edges, multiple)
        assert benign[place:].sum() == np.sum(ratio[before & tested] >= edges[place])
    assert attacked.sum() == np.sum(tested[rows[0] : rows[-1] + 1] if len(rows) else 0)


@pytest.mark.slow
def test_localisation_counts_channels(tmp_path):
    path = tmp_path / "scenario.toml"
    detector = '[detector]\nkind = "per_channel"\non = "residual"'
    path.write_text(scenario_text(ESTIMATORS["kalman"], ATTACKS["wheel"], detector))
    scenario = load_scenario(path)
    case = case_of(scenario, 150, drawn=False)
    trace = single(case, point_key(1, "a"), 7)
    found = jax.tree.map(np.asarray, run_scores(scenario, trace, case.maps))
    flags, rows = np.asarray(trace.verdict.channel_alarms), slice(49, 119)
    assert found["attacked_rows"] == found["hit"] == 70
    assert found["named"] == flags[rows].sum()
    assert found["named_hit"] == flags[rows, 2].sum() > 0


def test_a_plant_that_moves_has_no_fixed_map():
    from holdfast.plants.library import bicycle

    assert as_channels(bicycle.build()) is None
