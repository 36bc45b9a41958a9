"""What a filter says of itself beside its methods: small values, each with a default for all."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from netkf.algorithms.translation import Common, read_vector
from netkf.linalg.arrays import FloatArray


@dataclass(frozen=True)
class Needs:
    """What a filter needs of a scenario, which is refused by name before a run where it lacks it.

    inverts : covariances must never be singular
    inverts_under_clocks : the same, in continuous time only
    one_model : why it cannot follow changes of the plant, the end of a sentence; "": it can
    one_model_under_clocks : the same, in continuous time only
    memory : why its nodes may not forget what they know, the end of a sentence; "": they may
    samples : it cannot use increment sensors
    fixed_sensors : it computes with H before there are readings, so H must not vary: no nonlinear
                    sensors, regressors or columns phi
    linear_plant : it computes with F (or A) otherwise than by predictions, so the plant must be
                   linear
    every_reading : in slots its gains and P count a reading of every sensor in every slot, so that
                    no row of a recorded sensor may be missing
    awake : in slots its P counts the readings of nodes that are down, too
    common_start : all nodes must begin with the same mean and the same covariance
    ways_between_all : a directed graph must lead from every node to every other one
    reads_what_it_sends : a node uses of its readings only what it sends, so that every node with a
                          sensor must be heard by another one
    network : its nodes are given ``NodeInfo.network``
    one_way : in slots links may go one way, and the graph need not be connected
    blocks : its nodes may estimate different blocks of ``[[plants]]``: its messages say of which
             they speak, and it knows what to do with readings of a block that a node does not
             estimate (``Reading.pairs``)
    coupled : it knows the plant of all blocks, so that those that a node does not estimate may
              drive the others: its states and readings are of the whole state, the node's own
              blocks first, and ``NodeInfo.whole`` says which blocks there are
    translate : without ``blocks``, how a node reads a message of one that estimates other blocks,
                ``translate(payload, own, common)``: ``own`` is the payload that the node itself
                would send, ``common`` says which states both estimate (``translation.Common``). By
                default payloads are one vector of the state
    own_blocks : each block must be estimated by one node alone, and first errors of different nodes
                 must be independent
    check : ``check(scenario)`` raises ScenarioError where settings of the filter do not fit a
            ``netkf.Scenario``
    notes : ``notes(scenario)`` returns notes on the filter for the user, one line each
    """

    inverts: bool = False
    inverts_under_clocks: bool = False
    one_model: str = ""
    one_model_under_clocks: str = ""
    memory: str = ""
    samples: bool = False
    fixed_sensors: bool = False
    linear_plant: bool = False
    every_reading: bool = False
    awake: bool = False
    common_start: bool = False
    ways_between_all: bool = False
    reads_what_it_sends: bool = False
    network: bool = False
    one_way: bool = False
    blocks: bool = False
    coupled: bool = False
    translate: Callable[[Any, Any, Common], Any] = read_vector
    own_blocks: bool = False
    check: Callable[[Any], None] | None = None
    notes: Callable[[Any], tuple[str, ...]] | None = None


def unless_all_arrive(note: str) -> Callable[[Any], tuple[str, ...]]:
    """Return ``Needs.notes`` that has a ``note`` where messages may be lost or late."""
    return lambda scenario: () if scenario.delivers_all else (note,)


def metropolis(degree: int, peer_degree: int) -> float:
    """Return the Metropolis weight of a message, ``1 / (1 + max degree)``: the node hears
    ``degree`` others, the sender ``peer_degree``.
    """
    return 1.0 / (1.0 + max(degree, peer_degree))


@dataclass(frozen=True, eq=False)
class Weights:
    """The weights that nodes give to messages.

    of : ``of(degree, peer_degree)`` returns the weight that a node that hears ``degree`` others
         gives to a message of one that hears ``peer_degree`` others
    matrix : (N, N) weights of N nodes in the order of their ids instead: entry [l, i] is the weight
             that node i gives to a message of node l
    largest_degree : the largest number of neighbours for which the weights make sense
    """

    of: Callable[[int, int], float] = metropolis
    matrix: FloatArray | None = None
    largest_degree: float = math.inf


def estimate_numbers(n: int, _rows: int, _phase: int) -> float:
    """Return the size of an estimate of n states with one triangle of its covariance."""
    return n + n * (n + 1) // 2


def nothing_conserved(_: Any) -> Mapping[str, float | Sequence[float]]:
    """Return no quantities: exchanges conserve nothing that is known."""
    return {}


def never(_: Any) -> bool:
    """Return False: a node goes on learning about the network."""
    return False


def always(*_: object) -> bool:
    """Return True."""
    return True


@dataclass(frozen=True)
class Analysis:
    """What theory, checks and comparisons know of a filter; no state depends on it.

    paper : name of its packages in netkf.theory and netkf.checks, "" if there are none
    source : who published it, where its paper's folder holds several filters
    swaps : nodes exchange their whole states: what a node had before it heard a message is gone
    tells_estimates : ``tells_estimates(phase)``, False if messages of exchange number ``phase`` of
                      a slot (-1 under clocks) tell of nothing but the sender's reading of that
                      instant
    P_by_design : how P compares with the covariance of its error given the events, in slots and
                  under clocks: "larger", "smaller", "equal", or "" if nothing is proved
    payload_numbers : ``payload_numbers(n, rows, phase)``, the size, in numbers of 64 bits, of a
                      message that a node with ``rows`` rows of readings sends about n states in
                      exchange number ``phase`` of a slot (-1 under clocks), which comparisons of
                      filters report; by default that of an estimate with its covariance
    conserved : ``conserved(state)`` returns quantities by name, each a number or the terms of a
                sum, whose sums over all nodes no exchange should change; a run reports their drift
    conserves_despite_loss : nor do messages that are lost in slots, on one direction of a link only
    stopped : ``stopped(state)``, True once the node has permanently frozen its network estimate:
              what it computes of all nodes by exchanges, as number and information in push-sum
    wrapped : the filter that this one runs on its nodes, if it runs another, else None
    affine : its verbs in Python are affine in estimates, readings and payloads once P is known, and
             take them with several columns, (n, C) and (p, C), so that exact errors follow
    """

    paper: str = ""
    source: str = ""
    swaps: bool = False
    tells_estimates: Callable[[int], bool] = always
    P_by_design: tuple[str, str] = ("", "")
    payload_numbers: Callable[[int, int, int], float] = estimate_numbers
    conserved: Callable[[Any], Mapping[str, float | Sequence[float]]] = nothing_conserved
    conserves_despite_loss: bool = False
    stopped: Callable[[Any], bool] = never
    wrapped: Any = None
    affine: bool = False


CLOCKS = ("links", "directions", "nodes", "readings")
"""What may make a node transmit in continuous time, see network.clocks."""


def once(_: int) -> int:
    """Return 1: an exchange is not repeated."""
    return 1


@dataclass(frozen=True)
class Timing:
    """When a filter reads, predicts and exchanges, in slots and under clocks.

    schedule : phases of a slot in their order, of "predict", "sense" and "exchange"; None: not in
               slots. "predict" comes first if samples show filtered estimates, after "sense" if
               they show predictions
    clocks : what may make its nodes transmit in continuous time, of CLOCKS; (): nothing
    predicts : a sample in slots is the prediction with which the slot begins, else the estimate
               after the slot's exchanges
    first_slot : the first slot in which nodes exchange. Messages are numbered from it, and losses
                 belong to numbers: filters meet the same losses if their first slots and exchanges
                 are the same. None: that of built-in filters, see ``first_exchange``
    pairwise : in slots nodes exchange in pairs (a matching), else all with all neighbours
    talks : nodes exchange messages
    pooled : one filter reads the sensors of all nodes at once, and its estimate is every node's
    newest_only : of several messages of one sender at one instant the newest counts
    max_age : seconds beyond which a message that arrives is too late to use, under clocks
    randomised : in slots ``emit`` is given a number ``Exchange.uniform``, from the stream "trigger"
                 of the node, which nothing else draws from
    decides : in slots ``emit`` may decide by what it knows to send nothing
    steps : ``steps(phase)``, how often exchange number ``phase`` of a slot, from 0, is repeated, at
            equal intervals
    redraws : ``redraws(phase, step)``, whether links draw anew if messages arrive in repetition
              ``step``, from 0, of an exchange; else each keeps its last outcome. The very first
              step always draws
    sends : ``sends(phase, has_sensor)``, False if a node with a sensor, or without one, sends
            nothing in an exchange. In a slot in which recorded sensors of a node have no row it
            counts as one without
    interval : ``interval(state)`` returns the seconds of increments that ``update`` may use at once
               from a state on; None: as kernels or the model say. A large covariance shrinks fast,
               and the weights of readings change as fast: on the time scale 1 / trace(P G), G =
               H' R^-1 H, after a first guess or after a reset by a neighbour that knew less
    stopping : number of the exchange of a slot after which a node may freeze its network estimate
               for good (``Analysis.stopped``), -1 if there is none
    """

    schedule: tuple[str, ...] | None = ("predict", "sense", "exchange")
    clocks: tuple[str, ...] = CLOCKS
    predicts: bool = False
    first_slot: int | None = None
    pairwise: bool = False
    talks: bool = True
    pooled: bool = False
    newest_only: bool = True
    max_age: float = math.inf
    randomised: bool = False
    decides: bool = False
    steps: Callable[[int], int] = once
    redraws: Callable[[int, int], bool] = always
    sends: Callable[[int, bool], bool] = always
    interval: Callable[[Any], float] | None = None
    stopping: int = -1

    @property
    def exchanges(self) -> int:
        """The number of exchanges of a slot, without their repetitions; 0 for filters without."""
        return (self.schedule or ()).count("exchange")

    @property
    def first_exchange(self) -> int:
        """The first slot with an exchange: ``first_slot``, by default 0 for filters that predict
        and broadcast, else 1, because slot 0 has no reading.
        """
        if self.first_slot is not None:
            return self.first_slot
        return 0 if self.predicts and not self.pairwise else 1
