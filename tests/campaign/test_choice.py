"""Attacks chosen by number act as they do alone, and share one program."""

import jax
import numpy as np
import pytest

from holdfast.campaign import blocks
from holdfast.campaign.blocks import case_of, point_key, single
from holdfast.campaign.choice import Choice, structure_of, together
from holdfast.shell.files import load_scenario
from studied import KALMAN, SPOOF, scenario_text

KINDS = {
    "none": "",
    "bias": SPOOF,
    "bias again": SPOOF.replace("1.5", "-0.5"),
    "noise": '[[attack]]\nkind = "noise"\nchannel = "sensor:wheel"\nsd = 0.5',
    "replay": '[[attack]]\nkind = "replay"\nchannel = "sensor:gps"\nstart = 2\nseconds = 1',
    "two": SPOOF + '\n[[attack]]\nkind = "noise"\nchannel = "actuator:accel"\nsd = 0.5',
    "hopping": '[[attack]]\nkind = "hopping"\nchannels = ["sensor:gps", "sensor:wheel"]\n'
    "count = 1\nsd = 1",
}


@pytest.mark.slow
def test_a_run_is_what_it_is_alone(tmp_path):
    scenarios = []
    for number, text in enumerate(KINDS.values()):
        path = tmp_path / f"{number}.toml"
        path.write_text(scenario_text(KALMAN, text))
        scenarios.append(load_scenario(path))
    merged = together(scenarios)
    assert len({structure_of(s) for s in scenarios}) == 6
    assert len({structure_of(s) for s in merged}) == 1
    assert all(isinstance(s.attacks[0], Choice) for s in merged)
    key = point_key(0, "a")
    for alone, chosen in zip(scenarios, merged, strict=True):
        one, two = (
            jax.tree.map(np.asarray, single(case_of(s, 40, True), key, 3)) for s in (alone, chosen)
        )
        for name in ("u", "y", "d"):
            injected = getattr(one.injection, name)
            np.testing.assert_array_equal(getattr(two.injection, name), injected)
        np.testing.assert_allclose(two.estimate.x, one.estimate.x, rtol=0, atol=1e-12)
        np.testing.assert_array_equal(two.verdict.alarm, one.verdict.alarm)


def test_one_program_for_all_kinds_values_and_starts(tmp_path):
    """Traced once, whatever the kind of attack; other numbers are data as well."""
    scenarios = []
    for number, text in enumerate([*KINDS.values(), SPOOF.replace("start = 2", "start = 1")]):
        path = tmp_path / f"{number}.toml"
        path.write_text(scenario_text(KALMAN, text))
        scenarios.append(load_scenario(path))
    traced = 0
    simulate = blocks.simulate

    def counting(*args):
        nonlocal traced
        traced += 1
        return simulate(*args)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(blocks, "simulate", counting)
        for scenario in together(scenarios):
            blocks.block(case_of(scenario, 31, True), point_key(0, "b"), 0, 10)
    assert traced == 1


def test_alike_attacks_are_left_as_they_are(tmp_path):
    path = tmp_path / "one.toml"
    path.write_text(scenario_text())
    scenario = load_scenario(path)
    assert together([scenario, scenario])[0].attacks == scenario.attacks
