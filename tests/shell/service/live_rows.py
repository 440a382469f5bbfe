"""Rows and events made up for sinks."""

import numpy as np

from holdfast.records import Estimate, Verdict
from holdfast.shell.service.episodes import event
from holdfast.shell.service.records import Labels, Row

LABELS = Labels(
    "drone", 0.1, ("north", "east"), ("accel",), ("gps", "flow"), ("spoof",)
)  # fmt: skip


def row(frame, alarm=False, mode="normal", sensors=("healthy", "healthy"), threshold=9.0):
    """A row whose numbers tell its frame."""
    n, ny, nd = 2, 2, 1
    estimate = Estimate(
        x=np.array([frame, -frame], float), x_cov=np.diag([0.25, 0.04]), d=np.array([0.5]),
        d_cov=np.array([[1.0]]), d_free=np.array([0.5]), d_free_cov=np.array([[1.0]]),
        d_rows=np.zeros((0, nd)), d_bound=np.zeros(0), residual=np.array([0.1, 0.2]),
        residual_cov=np.diag([0.01, 0.08]), status=np.array(0, np.int32),
    )  # fmt: skip
    assert estimate.x.shape == (n,)
    assert estimate.residual.shape == (ny,)
    verdict = Verdict(
        statistic=np.array(25.0 if alarm else 1.5), threshold=np.array(threshold),
        alarm=np.array(alarm), reason=np.array(2 if alarm else 0, np.int32),
        channel_alarms=np.zeros(0, bool),
    )  # fmt: skip
    return Row(frame, 0.1 * frame, estimate, verdict, sensors, mode, (1.0, None))


def alarm(frame, state="begin", subject="gps"):
    """An alarm's event."""
    return event(frame, 0.1 * frame, "alarm", subject, state, "measurements contradict the model",
                 25.0, 9.0)  # fmt: skip
