"""Consensus on information: HCMCI with its special cases, and the information-weighted filter.

Nodes exchange pairs (Omega, q) = (P^-1, P^-1 xhat) of information and replace them by convex
combinations of their own and their neighbours', ``steps`` times a slot. The filters differ in what
they combine and in how often they count it:

* CI, consensus on information: the pair after the node's reading (Battistelli and Chisci,
  Automatica 50, 2014).
* CM, consensus on measurements: the pair of the reading alone, counted ``novelty_weight`` times.
* HCMCI: both, each by itself (Battistelli, Chisci, Mugnai, Farina and Graziano, "Consensus-based
  linear and nonlinear filtering", IEEE Trans. Automatic Control 60, 2015).
* ICF: the sum of the pair of the reading and 1/N of that of the prediction, counted N times (Kamal,
  Farrell and Roy-Chowdhury, "Information weighted consensus filters and their application in
  distributed camera networks", IEEE Trans. Automatic Control 58, 2013).

A node holds K such pairs, ``parts``, and a ``Recipe`` says how the filters differ. A pair is stored
as a root [Z, z] (n, n + 1), ``Omega = Z' Z`` and ``q = Omega c + Z' z``, relative to a centre c,
the node's prediction, so that differences of near states lose no digits.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from netkf.algorithms.diffusion import DiffusionFilter, diffusion_filter_record
from netkf.algorithms.filter import Filter, NodeInfo
from netkf.algorithms.kernels.estimates import copy_vector
from netkf.algorithms.kernels.information import add_reading_pair, copy_information_root, weigh_part
from netkf.algorithms.kernels.intersection import (
    finish_lanes,
    invert_lanes,
    merge_lanes,
    write_information_root,
)
from netkf.algorithms.kernels.neighbours import received_weight
from netkf.algorithms.models import SlotModel
from netkf.algorithms.records import Kernels, Record, triangle_numbers
from netkf.algorithms.registry import built_in
from netkf.algorithms.starts import check_information, information_notes
from netkf.algorithms.traits import CLOCKS, Analysis, Needs, Timing
from netkf.core.errors import ScenarioError
from netkf.core.fields import field, integer, one_of, positive
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import load_flags, select, spread

MAX_STEPS = 10_000  # consensus has converged long before: a larger value is a mistake
INFORMATION, MEASUREMENTS, HYBRID = "information", "measurements", "hybrid"


class Recipe(NamedTuple):
    """How the K pairs of a node begin a slot, and how its estimate follows from them after the last
    step: the information of the estimate is a sum.

    shares : (K, 2), multiples of the information of the prediction and of the reading in each pair
    counts : (K + 1,), multiples of each pair in the sum, then of the node's own prediction
    """

    shares: FloatArray
    counts: FloatArray


def recipe(shares: Sequence[Sequence[float]], counts: Sequence[float]) -> Recipe:
    """Return a recipe from plain numbers: ``shares``, K rows of 2, and K + 1 ``counts``."""
    return Recipe(np.array(shares, dtype=np.float64), np.array(counts, dtype=np.float64))


@kernel
def begin_pairs(record: Any, h: int, run: Any) -> None:
    """Make the pairs with which node ``h`` begins a slot, of its prediction and its reading."""
    lanes, shares, x = run.lanes, record.shares, record.xhat
    invert_lanes(lanes, run.size, record.inverse, h, record.root, h)
    for k in range(len(shares)):
        write_information_root(lanes, run.size, run.total, shares[k, 0], record.inverse, x, h, x, h)
        if shares[k, 1] > 0.0:
            add_reading_pair(run, run.total, shares[k, 1], run.reading, x, h, run.whitened)
        copy_information_root(lanes, run.total, record.parts[h, k])


@kernel
def emit_pairs(record: Any, h: int, m: int, run: Any) -> None:
    """Send the pairs of node ``h``, and the prediction to which they are relative."""
    copy_vector(run.lanes, run.size, record.payload.xhat, m, record.xhat, h, True)
    for k in range(len(record.shares)):
        copy_information_root(run.lanes, record.parts[h, k], record.payload.parts[m, k])


@kernel
def mix_pairs(record: Any, h: int, run: Any) -> None:
    """Replace each pair of node ``h`` by the convex combination of it and those that arrive; after
    the last step compute the estimate. Until then it is the prediction, to which all pairs are
    relative.
    """
    lanes, payload, total, work = run.lanes, record.payload, run.total, run.whitened
    x, parts, own = record.xhat, record.parts, 1.0 - received_weight(run)
    # Rounding may leave the own weight a little below 0, which has no root.
    own = select(own > 0.0, own, 0.0)
    for p in range(len(record.shares)):
        weigh_part(lanes, total, own, parts, h, p, x, x, h)
        for k in range(run.count):
            # A weight of 0 adds no information.
            if run.message_weight[k] > 0.0:
                share = select(load_flags(lanes, run.arrived, k), run.message_weight[k], 0.0)
                weigh_part(lanes, work, share, payload.parts, run.message[k], p, payload.xhat, x, h)
                merge_lanes(lanes, run.size, total, work)
        copy_information_root(lanes, total, parts[h, p])
    if run.step == record.steps - 1:
        # The information of the estimate is the sum of the prediction's and that of the pairs.
        counts, K = record.counts, len(record.shares)
        write_information_root(lanes, run.size, total, counts[K], record.inverse, x, h, x, h)
        for p in range(K):
            weigh_part(lanes, work, spread(lanes, counts[p]), parts, h, p, x, x, h)
            merge_lanes(lanes, run.size, total, work)
        finish_lanes(lanes, run.size, record.root, x, h, x, total, work, False)


def information_consensus_record(
    filtering: InformationConsensus, infos: Sequence[NodeInfo], models: Sequence[Any]
) -> Record:
    """Return in slots the pairs of nodes, the inverse roots of their predictions, and the
    recipe; under clocks that of covariance intersection, one step of consensus on information.
    """
    if not isinstance(models[0], SlotModel):
        return diffusion_filter_record(DiffusionFilter(on_loss="keep-own"), infos, models)
    n = len(models[0].information)
    shares, counts = filtering.recipe(infos[0].nodes)
    pairs = {"parts": (len(shares), n, n + 1)}
    return Record(
        node={**pairs, "inverse": (n, n)},
        payload={"xhat": (n,), **pairs},
        numbers={"parts": triangle_numbers(n, len(shares))},
        settings={"shares": shares, "counts": counts, "steps": filtering.steps},
    )


@dataclass(frozen=True, eq=False)
class InformationConsensus(Filter):
    """Consensus on information pairs, ``steps`` times a slot; ``recipe`` says which pairs.

    The weights are Metropolis', ``1 / (1 + max degree)`` for each link; the weight of a message
    that does not come stays with the node itself, so that weights always sum to one.
    """

    steps: int = field(integer(low=1, high=MAX_STEPS), default=1)

    kernels = Kernels(
        update=begin_pairs,
        emit=emit_pairs,
        absorb=mix_pairs,
        under_clocks=DiffusionFilter.kernels,
        record=information_consensus_record,
    )

    @property
    def timing(self) -> Timing:
        """Slots only: the one exchange has ``steps`` steps."""
        return Timing(clocks=(), steps=lambda _: self.steps)

    @abstractmethod
    def recipe(self, nodes: int) -> Recipe:
        """Return for N ``nodes`` which pairs a slot begins with, and how often each counts."""

    @property
    def analysis(self) -> Analysis:
        """Its paper, and the size of a message."""
        return Analysis(paper="information_consensus", payload_numbers=self._message_size)

    def _message_size(self, n: int, rows: int, phase: int) -> int:
        """Return the size of K pairs (Omega, q) in numbers of 64 bits; K is 1 under clocks."""
        pairs = 1 if phase < 0 else len(self.recipe(2).shares)
        return pairs * (n + n * (n + 1) // 2)

    shift = Filter.shift  # affine: pairs are relative to the estimate


@built_in("hcmci")
@dataclass(frozen=True, eq=False)
class Hcmci(InformationConsensus):
    """Hybrid consensus on measurements and on information, with CM and CI as special cases.

    steps           consensus steps a slot, L of the paper
    consensus       "hybrid": the pairs of the prediction and of the reading, each by itself;
                    "information" (CI): that of both together, P is never below the covariance of
                    the error; "measurements" (CM): that of the reading alone
    novelty_weight  how often the pair of the readings counts after the last step, omega of the
                    paper; by default N, the number of nodes, which is right in the limit of many
                    steps, where that pair is the average of all readings

    Under clocks only "information" is allowed: all messages of an instant are one step of it.
    """

    consensus: str = field(one_of(HYBRID, INFORMATION, MEASUREMENTS), default=HYBRID)
    novelty_weight: float | None = field(positive, default=None)

    def recipe(self, nodes: int) -> Recipe:
        """Return the recipe for a network of N ``nodes`` and the variant that was chosen: from
        which shares of prediction and reading the pairs begin, and how often each counts in the
        estimate.
        """
        omega = float(nodes) if self.novelty_weight is None else self.novelty_weight
        # Rows: shares of prediction and reading in a pair; then how often each pair counts, and the
        # prediction itself.
        if self.consensus == INFORMATION:
            return recipe([[1.0, 1.0]], [1.0, 0.0])
        if self.consensus == MEASUREMENTS:
            return recipe([[0.0, 1.0]], [omega, 1.0])
        return recipe([[1.0, 0.0], [0.0, 1.0]], [1.0, omega, 0.0])

    @property
    def timing(self) -> Timing:
        """The timing of its base, and all clocks."""
        return replace(super().timing, clocks=CLOCKS)

    @property
    def analysis(self) -> Analysis:
        """The facts of its base; consensus on information has a P that is never too small."""
        by_design = ("larger", "larger") if self.consensus == INFORMATION else ("", "")
        return replace(super().analysis, P_by_design=by_design)

    @property
    def needs(self) -> Needs:
        """Its demands on a scenario: those of its base, and settings that fit it."""
        return Needs(
            one_way=True, inverts=True, check=self._check_scenario, notes=self._scenario_notes
        )

    def _scenario_notes(self, scenario: Any) -> tuple[str, ...]:
        notes, parts = information_notes(scenario), len(scenario.topology.components)
        if parts == 1 or self.consensus == INFORMATION or self.novelty_weight is not None:
            return notes
        rule = (
            f"readings count {len(scenario.nodes)} times, for all nodes, but the graph has {parts}"
        )
        remedy = "give novelty_weight, the nodes of a part"
        return (*notes, f"hcmci: {rule} parts: P is overconfident; {remedy}")

    def _check_scenario(self, scenario: Any) -> None:
        check_information(scenario)
        if not scenario.slotted and self.consensus != INFORMATION:
            raise ScenarioError(
                "filter.consensus",
                "must be information in continuous time, where nodes do not read at one instant",
                self.consensus,
                'write consensus = "information", or use a plant in slots',
            )
        if self.consensus == INFORMATION and self.novelty_weight is not None:
            raise ScenarioError(
                "filter.novelty_weight",
                "has no meaning for consensus on information, which counts a reading once",
                self.novelty_weight,
                'leave it out, or write consensus = "hybrid"',
            )


@built_in("icf")
@dataclass(frozen=True, eq=False)
class Icf(InformationConsensus):
    """Information-weighted consensus filter, Kamal et al. 2013, Algorithm 2, in slots.

    steps  steps of average consensus a slot, K of the paper

    With the same weights of links it is HCMCI with novelty weight N, which sends twice as much.
    """

    needs = Needs(inverts=True, check=check_information, notes=information_notes)

    def recipe(self, nodes: int) -> Recipe:
        """Return the recipe for a network of N ``nodes``: pairs ``V = P^-1 / N + H' R^-1 H``, of
        which N times the average is the new P^-1.
        """
        return recipe([[1.0 / nodes, 1.0]], [float(nodes), 0.0])
