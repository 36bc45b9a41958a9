"""What the papers promise, computed: functions on scenarios and on plain matrices."""

from netkf.theory.assumptions import assumptions
from netkf.theory.bounds import covariance_bound
from netkf.theory.errors import error_covariance
from netkf.theory.gossip import detecting_walk, mean_matching
from netkf.theory.information import information_level
from netkf.theory.intermittent import (
    critical_certificate,
    critical_probability,
    invariant_samples,
    lyapunov_step,
    riccati_step,
    steady_covariance,
    support,
)
from netkf.theory.limits import central_covariance, limit_covariance, true_limit_covariance
from netkf.theory.matrices import riccati_flow
from netkf.theory.scalar_law import scalar_law
from netkf.theory.steady import steady_covariance_bound

__all__ = [
    "assumptions",
    "central_covariance",
    "covariance_bound",
    "critical_certificate",
    "critical_probability",
    "detecting_walk",
    "error_covariance",
    "information_level",
    "invariant_samples",
    "limit_covariance",
    "lyapunov_step",
    "mean_matching",
    "riccati_flow",
    "riccati_step",
    "scalar_law",
    "steady_covariance",
    "steady_covariance_bound",
    "support",
    "true_limit_covariance",
]


def __dir__() -> list[str]:
    return sorted(__all__)
