"""The contracts of the parts as runnable checks, for holdfast's own parts and for yours.

Each check raises an `AssertionError` that says which contract broke, and where. A part that
passes can stand in a log replay, a simulation, a batch and a live stream alike.
"""

from holdfast.testing.attack import check_attack
from holdfast.testing.detector import check_detector
from holdfast.testing.estimator import check_estimator

__all__ = ["check_attack", "check_detector", "check_estimator"]
