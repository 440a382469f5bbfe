"""Invariant zeros of the plant that is analysed, from its attacks to its outputs."""

from holdfast.analysis.model import Model
from holdfast.numerics import zeros
from holdfast.numerics.zeros import Transfer, Zero

__all__ = ["Transfer", "Zero", "transfer"]


def transfer(model: Model) -> Transfer:
    """`holdfast.numerics.zeros.transfer` of the model's matrices."""
    return zeros.transfer(model.A, model.G, model.C, model.H)
