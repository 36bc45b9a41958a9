"""What a filter says of itself beside its methods: small values, each with a default for all."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from netkf.linalg.arrays import FloatArray


@dataclass(frozen=True)
class Needs:
    """What a filter needs of a scenario, which is refused by name before a run where it lacks it.

    inverts : covariances must never be singular
    inverts_under_clocks : the same, in continuous time only
    samples : it cannot use increment sensors
    fixed_sensors : it computes with H before there are readings, so H must not vary: no nonlinear
                    sensors, regressors or columns phi
    every_reading : in slots its gains and P count a reading of every sensor in every slot, so that
                    no row of a recorded sensor may be missing
    common_start : all nodes must begin with the same mean and the same covariance
    ways_between_all : a directed graph must lead from every node to every other one
    reads_what_it_sends : a node uses of its readings only what it sends, so that every node with a
                          sensor must be heard by another one
    network : its nodes are given ``NodeInfo.network``
    one_way : in slots links may go one way, and the graph need not be connected
    check : ``check(scenario)`` raises ScenarioError where settings of the filter do not fit a
            ``netkf.Scenario``
    notes : ``notes(scenario)`` returns notes on the filter for the user, one line each
    """

    inverts: bool = False
    inverts_under_clocks: bool = False
    samples: bool = False
    fixed_sensors: bool = False
    every_reading: bool = False
    common_start: bool = False
    ways_between_all: bool = False
    reads_what_it_sends: bool = False
    network: bool = False
    one_way: bool = False
    check: Callable[[Any], None] | None = None
    notes: Callable[[Any], tuple[str, ...]] | None = None


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
    """Return the size of an estimate of n states with its covariance, of which one triangle
    counts.
    """
    return n + n * (n + 1) // 2


def nothing_conserved(_: Any) -> Mapping[str, float | Sequence[float]]:
    """Return no quantities: exchanges conserve nothing that is known."""
    return {}


def never(_: Any) -> bool:
    """Return False: a node goes on learning about the network."""
    return False


@dataclass(frozen=True)
class Analysis:
    """What theory, checks and comparisons know of a filter; nothing that a run depends on.

    paper : name of its packages in netkf.theory and netkf.checks, "" if there are none
    combination : how it combines messages: "convex", "intersection", "swap", "shares", "readings",
                  "sums", "none", ...; "" if only its methods define it
    P_by_design : how P compares with the covariance of its error in slots and under clocks:
                  "larger", "smaller", or "" if they are equal or nothing is proved
    payload_numbers : ``payload_numbers(n, rows, phase)``, the size, in numbers of 64 bits, of a
                      message that a node with ``rows`` rows of readings sends about n states in
                      exchange number ``phase`` of a slot (-1 under clocks), which comparisons of
                      filters report; by default that of an estimate with its covariance
    conserved : ``conserved(state)`` returns quantities by name, each a number or the terms of a
                sum, whose sums over all nodes no exchange should change; a run reports their drift
    stopped : ``stopped(state)``, True once the node has permanently frozen its network estimate:
              what it computes of all nodes by exchanges, as number and information in push-sum
    wrapped : the filter that this one runs on its nodes, if it runs another, else None
    """

    paper: str = ""
    combination: str = ""
    P_by_design: tuple[str, str] = ("", "")
    payload_numbers: Callable[[int, int, int], float] = estimate_numbers
    conserved: Callable[[Any], Mapping[str, float | Sequence[float]]] = nothing_conserved
    stopped: Callable[[Any], bool] = never
    wrapped: Any = None
