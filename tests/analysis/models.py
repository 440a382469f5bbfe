"""Models for the analysis, from matrices alone."""

import numpy as np

from holdfast.analysis.model import model_at
from systems import quiet_plant


def plant(A, G, C, H=None, Q=None, R=None):
    A, G, C = (np.asarray(m, float) for m in (A, G, C))
    n, nd, ny = A.shape[-1], G.shape[-1], C.shape[-2]
    H = np.zeros((ny, nd)) if H is None else np.asarray(H, float)
    Q = 1e-2 * np.eye(n) if Q is None else np.asarray(Q, float)
    return quiet_plant(A=A, G=G, C=C, H=H, Q=Q, R=np.eye(ny) if R is None else np.asarray(R, float))


def model(A, G, C, H=None, Q=None, R=None):
    """The model of a constant plant."""
    return model_at(plant(A, G, C, H, Q, R), np.zeros(np.shape(A)[-1]))
