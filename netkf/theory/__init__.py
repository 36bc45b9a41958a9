"""What the papers promise, computed: functions on scenarios and on plain matrices."""

from netkf.theory.assumptions import assumptions
from netkf.theory.bounds import covariance_bound
from netkf.theory.errors import error_covariance
from netkf.theory.limits import central_covariance, limit_covariance, true_limit_covariance
from netkf.theory.matrices import riccati_flow
from netkf.theory.steady import steady_covariance_bound

__all__ = [
    "assumptions",
    "central_covariance",
    "covariance_bound",
    "error_covariance",
    "limit_covariance",
    "riccati_flow",
    "steady_covariance_bound",
    "true_limit_covariance",
]
