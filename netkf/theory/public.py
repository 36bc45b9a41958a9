"""The public functions of ``netkf.theory``, which imports them when the first is used."""

from netkf.theory.assumption_rows import assumptions as assumptions
from netkf.theory.common.requirements import guard_functions as _guard_functions
from netkf.theory.diffusion.information import TrackingLevel as TrackingLevel
from netkf.theory.diffusion.information import information_level as information_level
from netkf.theory.diffusion.information import tracking_level as tracking_level
from netkf.theory.errors import error_covariance as error_covariance
from netkf.theory.gossip.invariant import SwitchedSamples as SwitchedSamples
from netkf.theory.gossip.invariant import switched_samples as switched_samples
from netkf.theory.gossip.matchings import detecting_walk as detecting_walk
from netkf.theory.gossip.matchings import mean_matching as mean_matching
from netkf.theory.hybrid.bounds import covariance_bound as covariance_bound
from netkf.theory.hybrid.constant_gains import constant_gain_bound as constant_gain_bound
from netkf.theory.hybrid.limits import central_covariance as central_covariance
from netkf.theory.hybrid.limits import limit_covariance as limit_covariance
from netkf.theory.hybrid.limits import true_limit_covariance as true_limit_covariance
from netkf.theory.hybrid.link_rates import LinkRate as LinkRate
from netkf.theory.hybrid.link_rates import link_rate_for as link_rate_for
from netkf.theory.hybrid.link_rates import link_rate_threshold as link_rate_threshold
from netkf.theory.hybrid.steady import steady_covariance_bound as steady_covariance_bound
from netkf.theory.intermittent.averages import MeanBounds as MeanBounds
from netkf.theory.intermittent.averages import PathAverage as PathAverage
from netkf.theory.intermittent.averages import mean_covariance_bounds as mean_covariance_bounds
from netkf.theory.intermittent.averages import path_average as path_average
from netkf.theory.intermittent.riccati import critical_certificate as critical_certificate
from netkf.theory.intermittent.riccati import critical_probability as critical_probability
from netkf.theory.intermittent.riccati import invariant_samples as invariant_samples
from netkf.theory.intermittent.riccati import lyapunov_step as lyapunov_step
from netkf.theory.intermittent.riccati import riccati_step as riccati_step
from netkf.theory.intermittent.riccati import steady_covariance as steady_covariance
from netkf.theory.intermittent.riccati import support as support
from netkf.theory.intermittent.scalar_law import scalar_law as scalar_law
from netkf.theory.mean_square import mean_square_radius as mean_square_radius
from netkf.theory.mean_square import steady_error_covariance as steady_error_covariance
from netkf.theory.numerics.matrices import riccati_flow as riccati_flow
from netkf.theory.one_bit.covariances import one_bit_update as one_bit_update
from netkf.theory.push_sum.broadcasts import leader_agreement as leader_agreement
from netkf.theory.push_sum.broadcasts import mass_totals as mass_totals
from netkf.theory.push_sum.certified_gamma import CorollaryTwo as CorollaryTwo
from netkf.theory.push_sum.certified_gamma import corollary_2 as corollary_2
from netkf.theory.push_sum.certified_gamma import exact_minimum_gamma as exact_minimum_gamma
from netkf.theory.push_sum.certified_gamma import gamma_constants as gamma_constants
from netkf.theory.push_sum.certified_gamma import minimum_gamma as minimum_gamma
from netkf.theory.push_sum.disconnection import Probability as Probability
from netkf.theory.push_sum.disconnection import (
    disconnection_probability as disconnection_probability,
)
from netkf.theory.push_sum.limits import consensus_gain_bound as consensus_gain_bound
from netkf.theory.push_sum.limits import push_sum_limits as push_sum_limits
from netkf.theory.push_sum.mean_square import LargeGamma as LargeGamma
from netkf.theory.push_sum.mean_square import large_gamma_limits as large_gamma_limits
from netkf.theory.push_sum.mean_square import push_sum_covariances as push_sum_covariances
from netkf.theory.push_sum.mean_square import push_sum_error_covariance as push_sum_error_covariance
from netkf.theory.push_sum.mean_square import push_sum_noise as push_sum_noise
from netkf.theory.push_sum.mean_square import push_sum_radius as push_sum_radius
from netkf.theory.push_sum.mean_square import push_sum_stability as push_sum_stability
from netkf.theory.stochastic_trigger.errors import trigger_rate as trigger_rate

_NAMES = {name: value for name, value in sorted(globals().items()) if not name.startswith("_")}
# Every function whose first parameter is a scenario refuses anything else with one error message.
PUBLIC = _NAMES | _guard_functions(_NAMES)
