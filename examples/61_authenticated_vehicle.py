"""A vehicle whose messages pass through a man in the middle who alters all that have no tag."""

import numpy as np

import holdfast
from holdfast import auth
from holdfast.attacks import stealthy
from holdfast.auth.samples import decode, encode
from holdfast.detectors import chi_square
from holdfast.estimators import kalman
from holdfast.numerics.stealth import Stealth
from holdfast.plants.library import vehicle_tracking
from holdfast.plants.watched import watched
from holdfast.reach.policy import policy
from holdfast.reach.setting import Setting
from holdfast.records import Enforcement, Reason

STEPS, LEVEL, EPSILON, LIMIT = 60, 0.015, 0.001, 0.7
plant = vehicle_tracking.build()
system, stealth = watched(plant), Stealth("chi_square", EPSILON, LEVEL, 2)
watch = chi_square.build(plant, level=LEVEL)
monitor = holdfast.Monitor(kalman.build(plant, np.zeros(2), system.P), watch)
keys = auth.KeyRing.of(bytes(range(16)))  # a real key comes from a key store
rng = np.random.default_rng(0)
x, y, (w, v) = np.zeros(2), np.zeros((STEPS, 2)), rng.normal(size=(2, STEPS, 2))
for k in range(STEPS):
    x = system.A @ x + np.sqrt(vehicle_tracking.PROCESS) * w[k]
    y[k] = x + np.sqrt(vehicle_tracking.SENSORS) * v[k]


def drive(held: Enforcement, plan: np.ndarray, forge_at: int = 0):
    """Estimates by step, and the steps at which a message was not what it had to be."""
    schedule, ids = auth.Schedule.of(held), (1, 2)
    sender = auth.Transmitter(schedule, tuple(auth.SecocSender(keys, i, 8) for i in ids))
    receiver = auth.Receiver(schedule, tuple(auth.SecocVerifier(keys, i, 8) for i in ids))
    live, said, failed = holdfast.Live(monitor), [], []
    sending, receiving = sender.start(), receiver.start()
    for k in range(1, STEPS + 1):
        sending, messages = sender.send(sending, k, y[k - 1])
        for i, must in enumerate(schedule.at(k)):
            if not must or k == forge_at:
                altered = encode(decode(messages[i][:8]) + plan[k - 1, i])
                messages[i] = altered + rng.bytes(4 * must)
        receiving, got = receiver.receive(receiving, k, messages)
        estimate, verdict = live.push(auth.observation(got, [0.0]))
        said.append(np.asarray(estimate.x))
        failed += [k] * (int(auth.with_failures(verdict, got).reason) == Reason.FORGED)
    return np.array(said), failed


found = policy(Setting(system, stealth, np.ones(2, bool), None, np.eye(2)), LIMIT).enforcement
for held in (Enforcement.of([1, 1], 0, 1), found):
    attack = stealthy.build(
        plant, epsilon=EPSILON, level=LEVEL, channels=[f"sensor:{name}" for name in plant.outputs],
        start=0.01, stop=0.01 * STEPS + 0.01, at=0.01 * STEPS - 0.01, enforcement=held)  # fmt: skip
    plan = np.asarray(attack.attack.plan)
    moved = np.max(np.linalg.norm(drive(held, plan)[0] - drive(held, 0 * plan)[0], axis=1))
    print(f"{np.mean(held.share):6.1%} authenticated: moved by up to {moved:.2f}, limit {LIMIT}")
print("tags forged at step 30, alarms at", drive(held, plan, forge_at=30)[1])
