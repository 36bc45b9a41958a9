"""The public functions of ``netkf.theory``, which imports them when the first is used."""

from netkf.theory.assumption_rows import assumptions
from netkf.theory.common.requirements import guard_functions
from netkf.theory.diffusion.information import TrackingLevel, information_level, tracking_level
from netkf.theory.errors import error_covariance
from netkf.theory.gossip.invariant import SwitchedSamples, switched_samples
from netkf.theory.gossip.matchings import detecting_walk, mean_matching
from netkf.theory.hybrid.bounds import covariance_bound
from netkf.theory.hybrid.constant_gains import constant_gain_bound
from netkf.theory.hybrid.limits import central_covariance, limit_covariance, true_limit_covariance
from netkf.theory.hybrid.link_rates import LinkRate, link_rate_for, link_rate_threshold
from netkf.theory.hybrid.steady import steady_covariance_bound
from netkf.theory.intermittent.averages import (
    MeanBounds,
    PathAverage,
    mean_covariance_bounds,
    path_average,
)
from netkf.theory.intermittent.riccati import (
    critical_certificate,
    critical_probability,
    invariant_samples,
    lyapunov_step,
    riccati_step,
    steady_covariance,
    support,
)
from netkf.theory.intermittent.scalar_law import scalar_law
from netkf.theory.mean_square import mean_square_radius, steady_error_covariance
from netkf.theory.numerics.matrices import riccati_flow
from netkf.theory.one_bit.covariances import one_bit_update
from netkf.theory.push_sum.broadcasts import leader_agreement, mass_totals
from netkf.theory.push_sum.certified_gamma import (
    CorollaryTwo,
    corollary_2,
    exact_minimum_gamma,
    gamma_constants,
    minimum_gamma,
)
from netkf.theory.push_sum.disconnection import Probability, disconnection_probability
from netkf.theory.push_sum.limits import consensus_gain_bound, push_sum_limits
from netkf.theory.push_sum.mean_square import (
    LargeGamma,
    large_gamma_limits,
    push_sum_covariances,
    push_sum_error_covariance,
    push_sum_noise,
    push_sum_radius,
    push_sum_stability,
)
from netkf.theory.stochastic_trigger.errors import trigger_rate

__all__ = [
    "CorollaryTwo",
    "LargeGamma",
    "LinkRate",
    "MeanBounds",
    "PathAverage",
    "Probability",
    "SwitchedSamples",
    "TrackingLevel",
    "assumptions",
    "central_covariance",
    "consensus_gain_bound",
    "constant_gain_bound",
    "corollary_2",
    "covariance_bound",
    "critical_certificate",
    "critical_probability",
    "detecting_walk",
    "disconnection_probability",
    "error_covariance",
    "exact_minimum_gamma",
    "gamma_constants",
    "information_level",
    "invariant_samples",
    "large_gamma_limits",
    "leader_agreement",
    "limit_covariance",
    "link_rate_for",
    "link_rate_threshold",
    "lyapunov_step",
    "mass_totals",
    "mean_covariance_bounds",
    "mean_matching",
    "mean_square_radius",
    "minimum_gamma",
    "one_bit_update",
    "path_average",
    "push_sum_covariances",
    "push_sum_error_covariance",
    "push_sum_limits",
    "push_sum_noise",
    "push_sum_radius",
    "push_sum_stability",
    "riccati_flow",
    "riccati_step",
    "scalar_law",
    "steady_covariance",
    "steady_covariance_bound",
    "steady_error_covariance",
    "support",
    "switched_samples",
    "tracking_level",
    "trigger_rate",
    "true_limit_covariance",
]

# Every function whose first parameter is a scenario refuses anything else with one error message.
_FUNCTIONS = {name: globals()[name] for name in __all__}
PUBLIC = _FUNCTIONS | guard_functions(_FUNCTIONS)
