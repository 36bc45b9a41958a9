"""All classes from which a scenario is built in Python.

They are ``Scenario``, ``Network``, ``Filtering``, ``Belief`` and ``Channel``; the class of every
kind that a scenario file can name (``kinds()`` lists them); the base classes of users' own classes;
``setting``, which declares fields of these, and the rules of fields.
"""

from __future__ import annotations

from netkf.algorithms.baselines import Central, Local
from netkf.algorithms.belief_propagation import BeliefPropagation
from netkf.algorithms.block_belief_propagation import BlockBeliefPropagation
from netkf.algorithms.block_cross_covariances import BlockCrossCovariances
from netkf.algorithms.block_intersection import BlockIntersection
from netkf.algorithms.consensus_innovations import ConsensusInnovations
from netkf.algorithms.constant_gain import ConstantGain
from netkf.algorithms.covariance_intersection import CovarianceIntersection
from netkf.algorithms.diffusion import DiffusionFilter
from netkf.algorithms.diffusion_kalman import DiffusionKalman
from netkf.algorithms.event_triggered import EventTriggeredCi
from netkf.algorithms.filter import (
    Estimate,
    Exchange,
    Filter,
    Increments,
    Message,
    Model,
    NetworkInfo,
    NodeInfo,
    PairReading,
    Reading,
    State,
)
from netkf.algorithms.gates import Gate
from netkf.algorithms.gossip import Gossip
from netkf.algorithms.hybrid import Hybrid
from netkf.algorithms.information_consensus import Hcmci, Icf
from netkf.algorithms.intermittent import Intermittent
from netkf.algorithms.kalman_consensus import Kcf
from netkf.algorithms.one_bit import OneBit
from netkf.algorithms.partition import Partition
from netkf.algorithms.push_sum import PushSum
from netkf.algorithms.stochastic_trigger import StochasticTrigger
from netkf.algorithms.track_fusion import BarShalomCampo, InverseIntersection, OptimisedIntersection
from netkf.algorithms.traits import Analysis, Needs, Timing, Weights
from netkf.core.clock import Clock
from netkf.core.fields import (
    boolean,
    choice,
    covariance,
    integer,
    matrix,
    number,
    positive,
    probability,
    setting,
    square,
    text,
    vector,
)
from netkf.core.laws import Chain, Lattice, WaitingLaw
from netkf.network.channels import Channel
from netkf.network.clocks import LinkClock, OnReadings, Periodic, Poisson, RecordedClock, Renewal
from netkf.network.contacts import Contacts
from netkf.network.delays import (
    ConstantDelay,
    Delay,
    ExponentialDelay,
    LognormalDelay,
    NoDelay,
    UniformDelay,
)
from netkf.network.graph_files import EdgelistGraph, GmlGraph, GraphFile, GraphmlGraph
from netkf.network.graphs import (
    Complete,
    CsvGraph,
    Cycle,
    Edges,
    ErdosRenyi,
    Geometric,
    Graph,
    Grid,
    PathGraph,
    RangeGraph,
    Regular,
    Star,
    Topology,
)
from netkf.network.lives import Change, Crashes, DutyCycle, Life, RecordedLife
from netkf.network.losses import (
    Bernoulli,
    DistanceLoss,
    GilbertElliott,
    KernelLoss,
    Logistic,
    Loss,
    NoLoss,
    PerLink,
    SharedLoss,
    Transmission,
)
from netkf.network.matchings import Broadcast, Matching, RecordedSlots, SlotActivation
from netkf.network.node_clocks import NodeClock
from netkf.network.quantise import Quantisation
from netkf.network.radio import Energy, Radio
from netkf.network.recorded import RecordedDelay, RecordedLoss
from netkf.network.scheduled import Hopping, ScheduledLoss
from netkf.plants.blocks import Block
from netkf.plants.curves import NonlinearDiffusion
from netkf.plants.diffusion import Diffusion
from netkf.plants.faults import Biased, Drifting, Fault, Outliers, Stuck
from netkf.plants.inputs import ConstantInput, Input, RecordedInput, SineInput
from netkf.plants.linear import LinearPlant
from netkf.plants.maps import NonlinearPlant
from netkf.plants.nonlinear import BearingSensor, NonlinearSensor, RangeBearingSensor, RangeSensor
from netkf.plants.plant import Plant
from netkf.plants.recorded import (
    RecordedDiffusion,
    RecordedPlant,
    RecordedSensor,
    UnknownDiffusion,
    UnknownPlant,
)
from netkf.plants.regressors import RegressorSensor
from netkf.plants.relative import (
    RelativeBearingSensor,
    RelativeRangeBearingSensor,
    RelativeRangeSensor,
    RelativeSensor,
)
from netkf.plants.sampling import RecordedSampling
from netkf.plants.sensors import LinearSensor, Sensor
from netkf.scenario.model import Belief, Filtering, Metrics, Network
from netkf.scenario.registry import KINDS
from netkf.scenario.scenario import Scenario
from netkf.scenario.stamps import Time


def kinds() -> dict[str, dict[str, type]]:
    """Return the classes by family ("plant", "filter", ...) and kind, as scenario files name them.

    Where a further key chooses among classes of one kind, the name is "kind key=value".
    """
    return {family: dict(classes) for family, classes in KINDS.items()}


def __dir__() -> list[str]:
    return sorted(__all__)


__all__ = [
    "Analysis",
    "BarShalomCampo",
    "BearingSensor",
    "Belief",
    "BeliefPropagation",
    "Bernoulli",
    "Biased",
    "Block",
    "BlockBeliefPropagation",
    "BlockCrossCovariances",
    "BlockIntersection",
    "Broadcast",
    "Central",
    "Chain",
    "Change",
    "Channel",
    "Clock",
    "Complete",
    "ConsensusInnovations",
    "ConstantDelay",
    "ConstantGain",
    "ConstantInput",
    "Contacts",
    "CovarianceIntersection",
    "Crashes",
    "CsvGraph",
    "Cycle",
    "Delay",
    "Diffusion",
    "DiffusionFilter",
    "DiffusionKalman",
    "DistanceLoss",
    "Drifting",
    "DutyCycle",
    "EdgelistGraph",
    "Edges",
    "Energy",
    "ErdosRenyi",
    "Estimate",
    "EventTriggeredCi",
    "Exchange",
    "ExponentialDelay",
    "Fault",
    "Filter",
    "Filtering",
    "Gate",
    "Geometric",
    "GilbertElliott",
    "GmlGraph",
    "Gossip",
    "Graph",
    "GraphFile",
    "GraphmlGraph",
    "Grid",
    "Hcmci",
    "Hopping",
    "Hybrid",
    "Icf",
    "Increments",
    "Input",
    "Intermittent",
    "InverseIntersection",
    "Kcf",
    "KernelLoss",
    "Lattice",
    "Life",
    "LinearPlant",
    "LinearSensor",
    "LinkClock",
    "Local",
    "Logistic",
    "LognormalDelay",
    "Loss",
    "Matching",
    "Message",
    "Metrics",
    "Model",
    "Needs",
    "Network",
    "NetworkInfo",
    "NoDelay",
    "NoLoss",
    "NodeClock",
    "NodeInfo",
    "NonlinearDiffusion",
    "NonlinearPlant",
    "NonlinearSensor",
    "OnReadings",
    "OneBit",
    "OptimisedIntersection",
    "Outliers",
    "PairReading",
    "Partition",
    "PathGraph",
    "PerLink",
    "Periodic",
    "Plant",
    "Poisson",
    "PushSum",
    "Quantisation",
    "Radio",
    "RangeBearingSensor",
    "RangeGraph",
    "RangeSensor",
    "Reading",
    "RecordedClock",
    "RecordedDelay",
    "RecordedDiffusion",
    "RecordedInput",
    "RecordedLife",
    "RecordedLoss",
    "RecordedPlant",
    "RecordedSampling",
    "RecordedSensor",
    "RecordedSlots",
    "RegressorSensor",
    "Regular",
    "RelativeBearingSensor",
    "RelativeRangeBearingSensor",
    "RelativeRangeSensor",
    "RelativeSensor",
    "Renewal",
    "Scenario",
    "ScheduledLoss",
    "Sensor",
    "SharedLoss",
    "SineInput",
    "SlotActivation",
    "Star",
    "State",
    "StochasticTrigger",
    "Stuck",
    "Time",
    "Timing",
    "Topology",
    "Transmission",
    "UniformDelay",
    "UnknownDiffusion",
    "UnknownPlant",
    "WaitingLaw",
    "Weights",
    "boolean",
    "choice",
    "covariance",
    "integer",
    "kinds",
    "matrix",
    "number",
    "positive",
    "probability",
    "setting",
    "square",
    "text",
    "vector",
]
