"""The exact steady error covariance of the push-sum filter at every node."""

from __future__ import annotations

import numpy as np

from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray, symmetric
from netkf.linalg.spectra import contracts
from netkf.scenario.scenario import Scenario
from netkf.theory.numerics.positive_maps import fixed_point
from netkf.theory.push_sum.estimation_steps import EstimationSteps, estimation_steps
from netkf.theory.push_sum.mean_square import push_sum_radius, radius, second_moment_map


def push_sum_error_covariance(scenario: Scenario) -> FloatArray:
    """Return the exact steady covariance (N, n, n) of x - xhat, in the order of the nodes.

    The mean is over noises and links, for paper P steps 4-5 at the asymptotic gains. The filter's
    gains converge to these if links fail in both directions together and no gain is frozen early (P
    Theorem 2). The filters' Q and R may differ from the truth. Raises TheoryError if
    ``push_sum_radius`` is not below 1 or does not exist.
    """
    return _covariance(estimation_steps(scenario), push_sum_radius(scenario))


def covariance_of_steps(steps: EstimationSteps) -> FloatArray:
    """Return the steady covariance (N, n, n) of errors under estimation ``steps``. Raises
    TheoryError if their mean-square radius is not below 1.
    """
    return _covariance(steps, radius(steps))


def _covariance(steps: EstimationSteps, value: float) -> FloatArray:
    """Return the steady covariance (N, n, n); raises TheoryError unless ``value`` is below 1."""
    if not contracts(value):
        raise TheoryError(
            f"no steady error covariance: the mean-square radius is {value:.6g}, not below 1; "
            "raise gamma or the delivery probability"
        )
    N, n, _ = steps.closed.shape
    scale = steps.scale
    scales = np.tile(scale, N)
    # States in units of P_inf's deviations; then the stacked second moments X of all nodes solve
    # X = T(X) + E[(M (x) I) cov(h) (M (x) I)'] with M the averaging and h the noises of a slot.
    noise = symmetric(steps.averaging.second_moment(steps.noise / np.outer(scales, scales)))
    X = fixed_point(second_moment_map(steps.averaging, steps.scaled), noise[None], value)[0]
    nodes = np.arange(N)
    blocks = X.reshape(N, n, N, n)[nodes, :, nodes]
    return symmetric(blocks * np.outer(scale, scale))
