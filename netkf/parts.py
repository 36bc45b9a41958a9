"""All classes from which a scenario is built in Python.

They are ``Scenario``, ``Network``, ``Filtering``, ``Belief`` and ``Channel``; the class of every
kind that a scenario file can name (``kinds()`` lists them); the base classes of users' own classes;
``setting``, which declares fields of these, and the rules of fields.
"""

from netkf.algorithms.baselines import Central as Central
from netkf.algorithms.baselines import Local as Local
from netkf.algorithms.belief_propagation import BeliefPropagation as BeliefPropagation
from netkf.algorithms.block_belief_propagation import (
    BlockBeliefPropagation as BlockBeliefPropagation,
)
from netkf.algorithms.block_cross_covariances import BlockCrossCovariances as BlockCrossCovariances
from netkf.algorithms.block_intersection import BlockIntersection as BlockIntersection
from netkf.algorithms.consensus_innovations import ConsensusInnovations as ConsensusInnovations
from netkf.algorithms.constant_gain import ConstantGain as ConstantGain
from netkf.algorithms.covariance_intersection import (
    CovarianceIntersection as CovarianceIntersection,
)
from netkf.algorithms.diffusion import DiffusionFilter as DiffusionFilter
from netkf.algorithms.diffusion_kalman import DiffusionKalman as DiffusionKalman
from netkf.algorithms.event_triggered import EventTriggeredCi as EventTriggeredCi
from netkf.algorithms.filter import Estimate as Estimate
from netkf.algorithms.filter import Exchange as Exchange
from netkf.algorithms.filter import Filter as Filter
from netkf.algorithms.filter import Increments as Increments
from netkf.algorithms.filter import Message as Message
from netkf.algorithms.filter import Model as Model
from netkf.algorithms.filter import NetworkInfo as NetworkInfo
from netkf.algorithms.filter import NodeInfo as NodeInfo
from netkf.algorithms.filter import PairReading as PairReading
from netkf.algorithms.filter import Reading as Reading
from netkf.algorithms.filter import State as State
from netkf.algorithms.gates import Gate as Gate
from netkf.algorithms.gossip import Gossip as Gossip
from netkf.algorithms.hybrid import Hybrid as Hybrid
from netkf.algorithms.information_consensus import Hcmci as Hcmci
from netkf.algorithms.information_consensus import Icf as Icf
from netkf.algorithms.intermittent import Intermittent as Intermittent
from netkf.algorithms.kalman_consensus import Kcf as Kcf
from netkf.algorithms.one_bit import OneBit as OneBit
from netkf.algorithms.partition import Partition as Partition
from netkf.algorithms.push_sum import PushSum as PushSum
from netkf.algorithms.stochastic_trigger import StochasticTrigger as StochasticTrigger
from netkf.algorithms.track_fusion import BarShalomCampo as BarShalomCampo
from netkf.algorithms.track_fusion import InverseIntersection as InverseIntersection
from netkf.algorithms.track_fusion import OptimisedIntersection as OptimisedIntersection
from netkf.algorithms.traits import Analysis as Analysis
from netkf.algorithms.traits import Needs as Needs
from netkf.algorithms.traits import Timing as Timing
from netkf.algorithms.traits import Weights as Weights
from netkf.core.clock import Clock as Clock
from netkf.core.fields import boolean as boolean
from netkf.core.fields import choice as choice
from netkf.core.fields import covariance as covariance
from netkf.core.fields import integer as integer
from netkf.core.fields import matrix as matrix
from netkf.core.fields import number as number
from netkf.core.fields import positive as positive
from netkf.core.fields import probability as probability
from netkf.core.fields import setting as setting
from netkf.core.fields import square as square
from netkf.core.fields import text as text
from netkf.core.fields import vector as vector
from netkf.core.laws import Chain as Chain
from netkf.core.laws import Lattice as Lattice
from netkf.core.laws import WaitingLaw as WaitingLaw
from netkf.network.channels import Channel as Channel
from netkf.network.clocks import LinkClock as LinkClock
from netkf.network.clocks import OnReadings as OnReadings
from netkf.network.clocks import Periodic as Periodic
from netkf.network.clocks import Poisson as Poisson
from netkf.network.clocks import RecordedClock as RecordedClock
from netkf.network.clocks import Renewal as Renewal
from netkf.network.contacts import Contacts as Contacts
from netkf.network.delays import ConstantDelay as ConstantDelay
from netkf.network.delays import Delay as Delay
from netkf.network.delays import ExponentialDelay as ExponentialDelay
from netkf.network.delays import LognormalDelay as LognormalDelay
from netkf.network.delays import NoDelay as NoDelay
from netkf.network.delays import UniformDelay as UniformDelay
from netkf.network.graph_files import EdgelistGraph as EdgelistGraph
from netkf.network.graph_files import GmlGraph as GmlGraph
from netkf.network.graph_files import GraphFile as GraphFile
from netkf.network.graph_files import GraphmlGraph as GraphmlGraph
from netkf.network.graphs import Complete as Complete
from netkf.network.graphs import CsvGraph as CsvGraph
from netkf.network.graphs import Cycle as Cycle
from netkf.network.graphs import Edges as Edges
from netkf.network.graphs import ErdosRenyi as ErdosRenyi
from netkf.network.graphs import Geometric as Geometric
from netkf.network.graphs import Graph as Graph
from netkf.network.graphs import Grid as Grid
from netkf.network.graphs import PathGraph as PathGraph
from netkf.network.graphs import RangeGraph as RangeGraph
from netkf.network.graphs import Regular as Regular
from netkf.network.graphs import Star as Star
from netkf.network.graphs import Topology as Topology
from netkf.network.lives import Change as Change
from netkf.network.lives import Crashes as Crashes
from netkf.network.lives import DutyCycle as DutyCycle
from netkf.network.lives import Life as Life
from netkf.network.lives import RecordedLife as RecordedLife
from netkf.network.losses import Bernoulli as Bernoulli
from netkf.network.losses import DistanceLoss as DistanceLoss
from netkf.network.losses import GilbertElliott as GilbertElliott
from netkf.network.losses import KernelLoss as KernelLoss
from netkf.network.losses import Logistic as Logistic
from netkf.network.losses import Loss as Loss
from netkf.network.losses import NoLoss as NoLoss
from netkf.network.losses import PerLink as PerLink
from netkf.network.losses import SharedLoss as SharedLoss
from netkf.network.losses import Transmission as Transmission
from netkf.network.matchings import Broadcast as Broadcast
from netkf.network.matchings import Matching as Matching
from netkf.network.matchings import RecordedSlots as RecordedSlots
from netkf.network.matchings import SlotActivation as SlotActivation
from netkf.network.node_clocks import NodeClock as NodeClock
from netkf.network.quantise import Quantisation as Quantisation
from netkf.network.radio import Energy as Energy
from netkf.network.radio import Radio as Radio
from netkf.network.recorded import RecordedDelay as RecordedDelay
from netkf.network.recorded import RecordedLoss as RecordedLoss
from netkf.network.scheduled import Hopping as Hopping
from netkf.network.scheduled import ScheduledLoss as ScheduledLoss
from netkf.plants.blocks import Block as Block
from netkf.plants.curves import NonlinearDiffusion as NonlinearDiffusion
from netkf.plants.diffusion import Diffusion as Diffusion
from netkf.plants.faults import Biased as Biased
from netkf.plants.faults import Drifting as Drifting
from netkf.plants.faults import Fault as Fault
from netkf.plants.faults import Outliers as Outliers
from netkf.plants.faults import Stuck as Stuck
from netkf.plants.inputs import ConstantInput as ConstantInput
from netkf.plants.inputs import Input as Input
from netkf.plants.inputs import RecordedInput as RecordedInput
from netkf.plants.inputs import SineInput as SineInput
from netkf.plants.linear import LinearPlant as LinearPlant
from netkf.plants.maps import NonlinearPlant as NonlinearPlant
from netkf.plants.nonlinear import BearingSensor as BearingSensor
from netkf.plants.nonlinear import NonlinearSensor as NonlinearSensor
from netkf.plants.nonlinear import RangeBearingSensor as RangeBearingSensor
from netkf.plants.nonlinear import RangeSensor as RangeSensor
from netkf.plants.plant import Plant as Plant
from netkf.plants.recorded import RecordedDiffusion as RecordedDiffusion
from netkf.plants.recorded import RecordedPlant as RecordedPlant
from netkf.plants.recorded import RecordedSensor as RecordedSensor
from netkf.plants.recorded import UnknownDiffusion as UnknownDiffusion
from netkf.plants.recorded import UnknownPlant as UnknownPlant
from netkf.plants.regressors import RegressorSensor as RegressorSensor
from netkf.plants.relative import RelativeBearingSensor as RelativeBearingSensor
from netkf.plants.relative import RelativeRangeBearingSensor as RelativeRangeBearingSensor
from netkf.plants.relative import RelativeRangeSensor as RelativeRangeSensor
from netkf.plants.relative import RelativeSensor as RelativeSensor
from netkf.plants.sampling import RecordedSampling as RecordedSampling
from netkf.plants.sensors import LinearSensor as LinearSensor
from netkf.plants.sensors import Sensor as Sensor
from netkf.scenario.model import Belief as Belief
from netkf.scenario.model import Filtering as Filtering
from netkf.scenario.model import Metrics as Metrics
from netkf.scenario.model import Network as Network
from netkf.scenario.registry import KINDS as _KINDS
from netkf.scenario.scenario import Scenario as Scenario
from netkf.scenario.time_grid import Time as Time


def kinds() -> dict[str, dict[str, type]]:
    """Return the classes by family ("plant", "filter", ...) and kind, as scenario files name them.

    Where a further key chooses among classes of one kind, the name is "kind key=value".
    """
    return {family: dict(classes) for family, classes in _KINDS.items()}


def __dir__() -> list[str]:
    return __all__


__all__ = [name for name in sorted(globals()) if not name.startswith("_")]
