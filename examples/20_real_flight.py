"""A real spoofed flight beside the autopilot's own gate. Data: HOLDFAST_DATA/px4_gps_spoof."""

import os
import sys
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from holdfast import Monitor, Observation, load_scenario, replay
from holdfast.estimators import unknown_input
from holdfast.evaluate.scores import episodes, event_rate, trade_off
from holdfast.shell.topics import read_topics
from holdfast.shell.uav import read_flight

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("HOLDFAST_DATA", ROOT / "../shared/data")) / "px4_gps_spoof"
if not DATA.is_dir():
    print(f"skipped: no folder {DATA}; set HOLDFAST_DATA to the folder that holds it")
    sys.exit(0)
monitor = load_scenario(ROOT / "examples/scenarios/px4_gps.toml").monitor
plant, kalman = monitor.estimator.plant, monitor.estimator
labels = [line.split(",") for line in (DATA / "labels.csv").read_text().split()[1:]]
start = next(int(stamp) for stamp, label in labels if label == "malicious") / 1e6
flights = [read_flight(path, plant) for path in (DATA, DATA / "spoof.ulg")]
fixes = [np.flatnonzero(f.log.observation.seen[:, 0]) for f in flights]  # their rows
verdicts = [replay(monitor, f.log.observation).verdict for f in flights]
benign, flown = (np.asarray(v.statistic)[rows] for v, rows in zip(verdicts, fixes, strict=True))
quiet, time = (f.accuracies["eph"].time for f in flights)  # the fixes' own stamps
first = int(np.argmax(flown > verdicts[1].threshold[0]))
before, seconds = start - time[0], quiet[-1] - quiet[0]
print(f"largest: {benign.max():.1f} without attack, {flown[time <= start].max():.1f} until it")
print(f"threshold {verdicts[1].threshold[0]}, spoofed fixes {flown[first : first + 4].round(1)}")
print(f"alarm {time[first] - start:.2f} s after the label, {sum(time[:first] > start)} fixes late")
rate = event_rate(0, seconds).upper * before
print(f"no episode in {seconds:.0f} s: at 95 % under {rate:.2f} per {before:.0f} s and", end=" ")
print(f"under {1 - 0.05 ** (1 / len(benign)):.2%} of fixes above the largest of {len(benign)}")
print("threshold over largest; episodes without attack, before the attack; delay (s)")
for share in (0.1, 0.2, 0.4, 0.6, 1, 2, 4, 4.4, 5, 10, 17):
    curve = trade_off(time, flown, start, gap=1.5, thresholds=[share * benign.max()])
    false = len(episodes(quiet, benign > share * benign.max(), 1.5))
    print(f"{share:5.1f} {false:4d} {curve.episodes[0]:4d} {curve.delay[0]:6.2f}")
o = flights[1].log.observation  # trusted until the alarm, from then on the offset is estimated
trusted = np.asarray(o.seen) & (np.arange(len(o.y)) < fixes[1][first])[:, None]
free = Monitor(unknown_input.build(plant, kalman.x0, kalman.P0), monitor.detector)
attack = replay(free, Observation.of(o.u, o.y, o.seen, trusted)).estimate
print("attack (m, m/s; sd); north and east honest to about 380 s: then the vehicle is flung too")
for stamp, row in zip(time[first : first + 6], fixes[1][first:], strict=False):
    pairs = zip(attack.d[row], np.sqrt(np.diag(attack.d_cov[row])), strict=True)
    print(f"{stamp:.2f}", *(f"{value:5.1f}({sd:.1f})" for value, sd in pairs))
for name in ("s_variance_m_s", "eph"):
    own, spoofed = (f.accuracies[name].value for f in flights)
    print(f"receiver's {name}: {own.max():.2f} at most; spoofed", spoofed[first:][:4].round(2))
names = [f"estimator_innovation{end}" for end in ("_test_ratios", "s", "_variances")]
ratio, e, var = read_topics(DATA / "spoof.ulg", names).values()
gps = ["gps_hvel[0]", "gps_hvel[1]", "gps_vvel", "gps_hpos[0]", "gps_hpos[1]"]
own = sum(e[c] ** 2 / np.where(var[c] > 0, var[c], np.inf) for c in gps)
print(f"PX4's gate: ratio {max(ratio[c].max() for c in gps):.3f} at most, rejects at 1;", end=" ")
print(f"99 % chi-square on its own variances: {(own > chi2.isf(0.01, 5)).sum()} of {len(own)}")
