"""How estimates and P move where a constant gain L weighs the readings, for the constant-gain
filter (``constant_gain``) and the compiled engine.
"""

from __future__ import annotations

import numpy as np

from netkf.algorithms.kernels.square_root import lower_root
from netkf.algorithms.models import FlowModel
from netkf.linalg.arrays import FloatArray


def closed_loop(model: FlowModel, gain: FloatArray) -> FlowModel:
    """Return a model without readings whose P (n, n) moves as that of a filter of ``model`` with
    the constant ``gain`` L (n, p) for increments: drift ``A - L H``, noise ``Q + L R L'``.
    """
    # H and R without rows: the readings are in the drift and the noise already.
    noise, nothing = model.Q + gain @ model.R @ gain.T, model.H[:0]
    closed = np.ascontiguousarray(model.A - gain @ model.H)
    return FlowModel(closed, noise, nothing, model.R[:0, :0], model.horizon, model.interval)


def sample_maps(L: FloatArray, H: FloatArray, R: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return ``I - L H`` (n, n) and the lower triangular root (n, n) of ``L R L'``, for a gain L
    (n, p) and a sample with H (p, n) and R (p, p): the sample moves P to
    ``(I - L H) P (I - L H)' + L R L'``.
    """
    closed = np.eye(len(L)) - L @ H
    return closed, lower_root(np.asarray(L @ np.linalg.cholesky(R)))


def gain_rate(L: FloatArray, H: FloatArray) -> float:
    """Return the rate (1/s) at which increments move an estimate through the gain L (n, p): the
    Frobenius norm of L H, with H (p, n). Increments of at most 1 / rate seconds are used at once.
    """
    return float(np.linalg.norm(L @ H))
