"""The push-sum filter: distributed Kalman filtering on links that fail, paper P Fig. 1 (Battilotti,
Cacace and d'Angelo 2023).

In slots node i does the steps of P Fig. 1:

1. It starts with a mass: weight w (1 at a leader, 0 elsewhere), number n~ = 1 and information
   C~ = H' R^-1 H of its own sensors.
2. Push-sum, once a slot: it sends its share, mass / (degree + 1), to each neighbour, and keeps its
   own and those that failed links did not deliver (3)-(5). So the sums of w, n~ and C~ over all
   nodes are conserved, and n~ / w and C~ / w (6) tend to the number N of nodes and the
   information G of all sensors: its estimates N^(i) and G^(i) of the network.
3. It predicts, and P <- (P^-1 + G^(i))^-1 (7).
4. It corrects its estimate by its own reading, with N^(i) times the gain (8): the result is z.
5. It averages z with those of its neighbours in ``gamma`` steps (9).

With asymptotic gains N, G and P_inf (12) are known from the start, and step 2 is left out.
Differences from the paper: sums that (3)-(5) lost in print are those that conserve mass. The stop
rule of step 2.3 is a choice, since it also fires when all links of a node are down.

With ``running_sums`` a node sends, instead of shares, the total of all shares so far: a lost
message loses no mass. Under clocks the filter is that of ``algorithms.running_sums``.

Kernels simulate L runs at once (lanes, the last axis) in B blocks, with the structs of
``kernels.slots``: ``nodes`` (estimates and roots of H filters), ``readings`` (whitened, so that
noise has variance 1), ``plan`` (the events of S slots), ``links``, ``samples`` (output) and
``scratch``. Estimates are relative to an origin near the true state, which moves in some slots
(``rebase``, ``shift``), so that large states cost no digits. A kernel ``*_single`` runs one node
in one run, for the SimPy engine: both engines round alike.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from netkf.algorithms import running_sums
from netkf.algorithms.filter import Exchange, Filter, Message, NodeInfo, Reading
from netkf.algorithms.kernels.mass import (
    add_gain,
    average,
    correct_root,
    keep_share,
    learn_network,
    split_mass,
)
from netkf.algorithms.kernels.root_update import lower_root
from netkf.algorithms.kernels.slots import (
    ARRIVING,
    SENDING,
    ReadingBlock,
    SlotLinks,
    SlotNodes,
    SlotPlan,
    SlotSamples,
    SlotScratch,
    drop_silent,
    predict_all,
    predict_mean,
    rebase,
    slot_scratch,
    star_of,
    store_sample_of_slot,
    whiten_reading,
)
from netkf.algorithms.kernels.stopping import NEVER, PAPER, RULES, MassStep, has_stopped
from netkf.algorithms.models import SlotModel, first_root
from netkf.algorithms.registry import built_in
from netkf.algorithms.running_sums import Offer, RunningSums
from netkf.algorithms.starts import check_information, information_notes
from netkf.core.errors import ScenarioError
from netkf.core.fields import boolean, field, integer, node_id, number, one_of, positive
from netkf.linalg.arrays import FloatArray, square_root, symmetric
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import (
    LANES,
    ONE,
    aligned,
    any_lane,
    blocks_of,
    in_lanes,
    load,
    load_flags,
    select,
    spread,
    store,
)

MASS, AVERAGE = 0, 1
"""The two exchanges of a slot, steps 2 and 5: their numbers, ``phase`` in methods."""

MAX_STEPS = 100_000
"""The largest ``gamma``: a larger one is a mistake."""
MAX_DOUBLINGS = 60
"""Iterations of ``_steady_prediction``; k of them reach 2^k slots."""
UNITS, SAME = 3.0, 1e-4
"""Factor of other units in which P_inf is computed once more, and relative difference up to which
both results are one covariance and not rounding errors.
"""


class NetworkInformation(NamedTuple):
    """A node's estimate of the network: the ``information`` (n, n) of all sensors, G^(i) of
    paper P (6), and the ``number`` of nodes, N^(i); with asymptotic gains the ``root`` (n, n) of
    P_inf.
    """

    information: FloatArray
    number: float
    root: FloatArray | None = None


class NodeSums(NamedTuple):
    """Running sums of one node in slots: the total (2 + n^2,) of all shares that it has ever
    ``offered`` to each of its neighbours, and the last totals that it ``heard``, by sender.
    """

    offered: FloatArray
    heard: Mapping[int, FloatArray]


class PushSumState(NamedTuple):
    """The state of a node in slots; under clocks it is a ``RunningSums``.

    xhat, root : estimate (n,), z of steps 4 and 5, and root (n, n) of its covariance
    model : of the plant and the node's sensors
    mass : (2 + n^2,), weight w, number n~ and information C~ of paper P (3)-(5)
    network : the node's estimate of the network, from its mass
    stopped : whether the stop rule has frozen that estimate
    degree : number of its links, failed ones included
    sums : running sums, if mass is exchanged by them, else None
    """

    xhat: FloatArray
    root: FloatArray
    model: Any
    mass: FloatArray
    network: NetworkInformation
    stopped: bool
    degree: int
    sums: NodeSums | None = None

    @property
    def P(self) -> FloatArray:
        """The covariance ``root root'`` (n, n) of the estimate."""
        return self.root @ self.root.T


class PushSumArrays(NamedTuple):
    """Arrays and settings of H nodes for B blocks of L runs; a mass has m = 2 + n n numbers.

    mass, degree : (B, H, m, L) masses, and numbers (H,) of each node's links, failed ones included
    information, number : estimates of the network, G^(i) (B, H, n, n, L) and N^(i) (B, H, L)
    alone : (H, n, n), information of each node's own sensors
    rule, tolerance, delta, gamma, asymptotic : settings of ``PushSum``; ``rule`` is its stop rule,
                                                an index in RULES
    limit : (n, n), root of P_inf, with asymptotic gains
    running : whether masses are exchanged by running sums
    offered, heard : then the totals that nodes have offered (B, H, m, L), and those last heard on
                     each of W directions (B, W, m, L)
    share, before : scratch, shares (H, m, L) that nodes send, and a mass (m, L) before a step
    new_information, new_number : scratch, paper P (6) of this slot (n, n, L) and (1, L)
    silent : scratch (L,), 1 where a node has stopped in an earlier slot
    stop : scratch of the stop rule, for one lane
    """

    mass: FloatArray
    degree: np.ndarray
    information: FloatArray
    number: FloatArray
    alone: FloatArray
    rule: int
    tolerance: float
    delta: float
    gamma: int
    asymptotic: bool
    limit: FloatArray
    share: FloatArray
    before: FloatArray
    new_information: FloatArray
    new_number: FloatArray
    silent: np.ndarray
    stop: MassStep
    running: bool
    offered: FloatArray
    heard: FloatArray


@kernel
def drop_mass_of_stopped(
    arrays: PushSumArrays, plan: SlotPlan, links: SlotLinks, samples: SlotSamples, b: int, s: int
) -> None:
    """Drop the messages with mass of nodes of block ``b`` that stopped before slot ``s``: by the
    paper's stop rule they send none. Writes 0 into ``plan.sent[b, s, MASS]`` (H, L) and
    ``plan.up[b, s, MASS]`` (W, L). Nothing happens under another rule in ``arrays``.

    Axes: W directed links, H nodes, L runs side by side.
    """
    if arrays.rule == PAPER and not arrays.asymptotic:
        silence_stopped(plan, samples, b, s)
        drop_silent(plan, links, b, s, MASS)


@kernel
def push_sum_slots(
    nodes: SlotNodes,
    readings: ReadingBlock,
    plan: SlotPlan,
    links: SlotLinks,
    samples: SlotSamples,
    scratch: SlotScratch,
    arrays: PushSumArrays,
) -> None:
    """Simulate H push-sum filters over the S slots of a plan, P Fig. 1, in B blocks of L runs: in
    each slot they predict, exchange mass, correct by their readings and average estimates.

    Changes ``nodes.xhat`` (B, H, n, L), ``nodes.root`` (B, H, n, n, L) and the masses and network
    estimates in ``arrays`` in place, and writes ``samples``. ``plan.part`` says which part of a
    slot is simulated: up to the messages that are sent (SENDING), from their arrival on (ARRIVING),
    or both.
    """
    for b in range(plan.up.shape[0]):
        for s in range(plan.up.shape[1]):
            if plan.exchanged[s] and plan.part != ARRIVING:
                drop_mass_of_stopped(arrays, plan, links, samples, b, s)
            if plan.part == SENDING:
                continue
            # Step 3. With asymptotic gains the covariance is P_inf, and ``correct`` predicts the
            # mean.
            if plan.sensed[s] and not arrays.asymptotic:
                predict_all(nodes, scratch, b)
            # Step 2 before the correction, so that the gain uses the mass of this slot.
            if plan.exchanged[s] and not arrays.asymptotic:
                exchange_mass(arrays, plan, links, samples, scratch, b, s)
            if plan.sensed[s]:
                for h in range(len(nodes.rows)):
                    correct(nodes, readings, scratch, arrays, b, s, h)
            if plan.exchanged[s]:
                for step in range(1, 1 + arrays.gamma):
                    # Row 0 of ``up`` is the exchange of mass; averaging has the rows after it.
                    average(
                        scratch.lanes, nodes.xhat, b, links, plan.up, s, step, scratch.xhat,
                        1.0 / arrays.delta,
                    )  # fmt: skip
            if plan.sample[s] >= 0:
                write_conserved_sums(arrays, links, samples, scratch, b)
            store_sample_of_slot(nodes, plan, samples, scratch, b, s)
            rebase(nodes, readings, scratch, b, s)


@kernel
def write_conserved_sums(
    arrays: PushSumArrays, links: SlotLinks, samples: SlotSamples, scratch: SlotScratch, b: int
) -> None:
    """Write each node's part of the sums that exchanges conserve in block ``b``, of the weight w
    (total 1) and of the number n~ (total N), from the masses in ``arrays`` into
    ``samples.conserved[b]`` (H, 2, L); with running sums including the mass under way to it.

    Runs report how far the sums drift. Axes: H nodes, L runs side by side.
    """
    for h in range(len(arrays.degree)):
        for k in range(2):
            value = load(scratch.lanes, arrays.mass, b, h, k)
            if arrays.running:
                # Mass under way to node h: offered by each neighbour, minus the part that was
                # heard.
                for m in range(links.first[h], links.first[h + 1]):
                    offered = load(scratch.lanes, arrays.offered, b, links.sender[m], k)
                    value += offered - load(scratch.lanes, arrays.heard, b, m, k)
            store(scratch.lanes, samples.conserved, b, h, k, value)


@kernel
def exchange_mass(
    arrays: PushSumArrays,
    plan: SlotPlan,
    links: SlotLinks,
    samples: SlotSamples,
    scratch: SlotScratch,
    b: int,
    s: int,
) -> None:
    """Exchange mass once in slot ``s`` of block ``b``, paper P steps 2.1 to 2.3: all H nodes send
    shares of their mass (weight, number of nodes and information), add those that arrive to what
    they keep, and update their estimates of the network.

    Changes in block ``b`` of ``arrays`` ``mass``, ``information``, ``number`` and the running sums,
    and writes the slot into ``samples.stopped[b]`` (H, L) where a node stops. Axes: L runs side by
    side.
    """
    H, slot = len(arrays.degree), plan.first + s
    # All shares are computed before any mass changes.
    for h in range(H):
        split_mass(scratch.lanes, arrays.mass, b, h, arrays.degree[h], arrays.share)
    if arrays.running:
        add_to_totals(arrays, scratch, b)
    for h in range(H):
        # Until a node stops, ``stopped`` is later than all slots.
        for q in range(len(scratch.lanes)):
            arrays.silent[q] = samples.stopped[b, h, q] < slot
        if arrays.running:
            receive_totals(arrays, plan, links, scratch, b, s, h)
            # Running sums have no stop rule: the number of shares does not matter.
            update_network_estimate(
                arrays, samples, scratch, b, h, spread(scratch.lanes, 0.0), slot
            )
        else:
            received = mix_mass(arrays, plan, links, scratch, b, s, h)
            update_network_estimate(arrays, samples, scratch, b, h, received, slot)


@kernel
def silence_stopped(plan: SlotPlan, samples: SlotSamples, b: int, s: int) -> None:
    """Write 0 into ``plan.sent[b, s, MASS]`` (H, L) for nodes of block ``b`` that stopped before
    slot ``s``: they send no mass, paper P step 2.3.

    Axes: H nodes, L runs side by side.
    """
    for h in range(plan.sent.shape[3]):
        for q in range(plan.sent.shape[4]):
            if samples.stopped[b, h, q] < plan.first + s:
                plan.sent[b, s, MASS, h, q] = 0


@kernel
def add_to_totals(arrays: PushSumArrays, scratch: SlotScratch, b: int) -> None:
    """Add the share of each of H nodes of block ``b``, ``arrays.share`` (H, m, L), to the total of
    all its shares so far, ``arrays.offered[b]`` (H, m, L): its message to each neighbour. A share
    is a part of a node's mass, of m = 2 + n n numbers.

    Axes: L runs side by side.
    """
    for h in range(len(arrays.degree)):
        for i in range(arrays.mass.shape[2]):
            before = load(scratch.lanes, arrays.offered, b, h, i)
            total = before + load(scratch.lanes, arrays.share, h, i)
            store(scratch.lanes, arrays.offered, b, h, i, total)


@kernel
def receive_totals(
    arrays: PushSumArrays,
    plan: SlotPlan,
    links: SlotLinks,
    scratch: SlotScratch,
    b: int,
    s: int,
    h: int,
) -> None:
    """Set the mass of node ``h`` of block ``b``, ``arrays.mass[b, h]`` (m, L), to the growth of the
    totals that arrive in slot ``s``, plus its own share. Totals that arrive replace the last ones
    in ``arrays.heard[b]`` (W, m, L). A mass has m = 2 + n n numbers.

    Axes: W directed links, L runs side by side.
    """
    lanes, mass = scratch.lanes, arrays.mass
    for i in range(mass.shape[2]):
        store(lanes, mass, b, h, i, 0.0)
    for m in range(links.first[h], links.first[h + 1]):
        arrived = load_flags(lanes, plan.up, b, s, 0, links.direction[m])
        for i in range(mass.shape[2]):
            # A lost total does no harm: the next one contains it.
            last = load(lanes, arrays.heard, b, m, i)
            total = load(lanes, arrays.offered, b, links.sender[m], i)
            gain = select(arrived, total - last, 0.0)
            store(lanes, mass, b, h, i, load(lanes, mass, b, h, i) + gain)
            store(lanes, arrays.heard, b, m, i, select(arrived, total, last))
    for i in range(mass.shape[2]):
        own = load(lanes, arrays.share, h, i)
        store(lanes, mass, b, h, i, own + load(lanes, mass, b, h, i))


@kernel(inlined=True)
def mix_mass(
    arrays: PushSumArrays,
    plan: SlotPlan,
    links: SlotLinks,
    scratch: SlotScratch,
    b: int,
    s: int,
    h: int,
) -> Any:
    """Set the mass of node ``h`` of block ``b``, ``arrays.mass[b, h]`` (m, L), m = 2 + n n, to the
    shares that it keeps and receives in slot ``s``, paper P (3)-(5); return the number (L,) of
    shares that arrived. The mass from before is left in ``arrays.before`` (m, L).

    Axes: L runs side by side.
    """
    lanes, mass, received = scratch.lanes, arrays.mass, spread(scratch.lanes, 0.0)
    # The mass before is kept for the stop rule.
    for i in range(mass.shape[2]):
        store(lanes, arrays.before, i, load(lanes, mass, b, h, i))
        store(lanes, mass, b, h, i, 0.0)
    for m in range(links.first[h], links.first[h + 1]):
        arrived = load_flags(lanes, plan.up, b, s, 0, links.direction[m])
        received += select(arrived, 1.0, 0.0)
        for i in range(mass.shape[2]):
            share = select(arrived, load(lanes, arrays.share, links.sender[m], i), 0.0)
            store(lanes, mass, b, h, i, load(lanes, mass, b, h, i) + share)
    # By the paper's rule a stopped node leaves the exchange and keeps its mass. By the safe rule it
    # goes on mixing, since other nodes still need its mass.
    has_stopped_before = load_flags(lanes, arrays.silent)
    if arrays.rule == PAPER and any_lane(has_stopped_before):
        for i in range(mass.shape[2]):
            mixed, before = load(lanes, mass, b, h, i), load(lanes, arrays.before, i)
            store(lanes, mass, b, h, i, select(has_stopped_before, before, mixed))
    # Its own share, once for itself and once for each neighbour whose share did not arrive.
    times = (arrays.degree[h] + 1.0) - received
    if arrays.rule != PAPER:
        keep_share(lanes, mass, b, h, arrays.share, times, False)
    else:
        keep_share(lanes, mass, b, h, arrays.share, times, has_stopped_before)
    return received


@kernel(inlined=True)
def update_network_estimate(
    arrays: PushSumArrays,
    samples: SlotSamples,
    scratch: SlotScratch,
    b: int,
    h: int,
    received: Any,
    slot: int,
) -> None:
    """Update the network estimate of node ``h`` of block ``b`` from its mass, paper P (6): the
    number of nodes and the information of all sensors. Apply the stop rule; ``received`` (L,) is
    the number of shares that arrived in slot number ``slot``.

    Changes ``arrays.information[b, h]`` (n, n, L) and ``arrays.number[b, h]`` (L,), except where
    the node stopped before, and writes the slot into ``samples.stopped[b, h]`` (L,) where it stops
    now. Axes: L runs side by side.
    """
    lanes, information = scratch.lanes, arrays.new_information
    learn_network(lanes, arrays.mass, b, h, arrays.alone, information, arrays.new_number)
    # The stop rule compares with the former G and N, so they are replaced only afterwards.
    if arrays.rule != NEVER:
        store(lanes, scratch.row, 0, received)
        for q in range(len(lanes)):
            all_up = scratch.row[0, q] == arrays.degree[h]
            if arrays.silent[q] == 0 and stops(arrays, b, h, q, all_up):
                samples.stopped[b, h, q] = slot
    # A node that stopped in an earlier slot keeps its network estimate.
    frozen = load_flags(lanes, arrays.silent)
    n = information.shape[0]
    for i in range(n):
        for j in range(n):
            former, present = (
                load(lanes, arrays.information, b, h, i, j),
                load(lanes, information, i, j),
            )
            store(lanes, arrays.information, b, h, i, j, select(frozen, former, present))
    former, present = load(lanes, arrays.number, b, h), load(lanes, arrays.new_number, 0)
    store(lanes, arrays.number, b, h, select(frozen, former, present))


@kernel
def stops(arrays: PushSumArrays, b: int, h: int, q: int, all_up: bool) -> bool:
    """Return True if node ``h`` of block ``b`` freezes its network estimate in this slot, in lane
    ``q``, one of L runs; ``all_up``: all its links were up. Compares the new mass and estimates in
    ``arrays`` with the former ones; overwrites the scratch ``arrays.stop``.
    """
    stop, n = arrays.stop, arrays.new_information.shape[0]
    for i in range(arrays.mass.shape[2]):
        stop.mass[i], stop.before[i] = arrays.mass[b, h, i, q], arrays.before[i, q]
    for i in range(n):
        for j in range(n):
            stop.information[i, j] = arrays.new_information[i, j, q]
            stop.former[i, j] = arrays.information[b, h, i, j, q]
    stop.number[0], stop.former_number[0] = arrays.new_number[0, q], arrays.number[b, h, q]
    return has_stopped(arrays.rule, arrays.tolerance, stop, all_up)


@kernel(inlined=True)
def correct(
    nodes: SlotNodes,
    readings: ReadingBlock,
    scratch: SlotScratch,
    arrays: PushSumArrays,
    b: int,
    s: int,
    h: int,
) -> None:
    """Correct filter ``h`` of block ``b`` by its reading of slot ``s``, steps 3 and 4, with the
    information and the number of nodes of the whole network, as it estimates them: paper P (7) and
    (8). With asymptotic gains also predict its mean.

    Changes ``nodes.xhat[b, h]`` (n, L) and ``nodes.root[b, h]`` (n, n, L). Axes: L runs side by
    side.
    """
    n, lanes = nodes.xhat.shape[2], scratch.lanes
    if arrays.asymptotic:
        # xhat <- F xhat, and P_inf for the root.
        predict_mean(nodes, scratch, b, h)
        for i in range(n):
            for j in range(i + 1):
                store(lanes, nodes.root, b, h, i, j, arrays.limit[i, j])
    else:
        # P (7), from the prediction's root and what the node knows of the network.
        correct_root(nodes.root, b, h, arrays.information, scratch.moved, scratch)
    if nodes.rows[h] > 0:
        # P (8): N^(i) times the gain of the node's own reading.
        number = load(lanes, arrays.number, b, h)
        add_gain(
            lanes, nodes.xhat, nodes.root, b, h, number, readings.y, s, readings.H, nodes.rows[h],
            scratch.row, scratch.gains,
        )  # fmt: skip


@kernel
def add_gain_single(
    x: FloatArray,
    root: FloatArray,
    number: float,
    y: FloatArray,
    H: FloatArray,
    scratch: FloatArray,
) -> None:
    """Correct the estimate x (1, 1, n, 1) of one filter in one run in place, paper P (8):
    ``x += number S S' H' (y - H x)`` with its root S (1, 1, n, n, 1), the ``number`` N^(i) of nodes
    that it believes in, and a whitened reading y (1, 1, 1, p, 1), H (1, 1, 1, p, n, 1); ``scratch``
    is (2, n, 1).
    """
    add_gain(ONE, x, root, 0, 0, number, y, 0, H, y.shape[3], scratch[0], scratch[1])


@kernel
def split_mass_single(mass: FloatArray, degree: int, share: FloatArray) -> None:
    """Write into ``share`` (1, m, 1) the ``mass`` (1, 1, m, 1) of one node in one run over
    ``degree`` + 1, its message to each of ``degree`` neighbours; m = 2 + n n numbers: weight,
    number of nodes and information.
    """
    split_mass(ONE, mass, 0, 0, degree, share)


@kernel
def keep_share_single(mass: FloatArray, share: FloatArray, times: int) -> None:
    """Add ``times`` times its own ``share`` (1, m, 1) to the ``mass`` (1, 1, m, 1) that one node
    received in one run, in place, paper P (3)-(5); m = 2 + n n numbers: weight, number of nodes and
    information.
    """
    keep_share(ONE, mass, 0, 0, share, times, False)


@kernel
def learn_network_single(
    mass: FloatArray, alone: FloatArray, information: FloatArray, number: FloatArray
) -> None:
    """Write the information of all sensors, C~ / w, into ``information`` (n, n, 1) and the number
    of nodes, n~ / w, into ``number`` (1, 1), as one node estimates them in one run from its
    ``mass`` (1, 1, 2 + n n, 1) of w, n~ and C~, paper P (6). While its weight w is 0 these are its
    own information ``alone`` (1, n, n) and 1.
    """
    learn_network(ONE, mass, 0, 0, alone, information, number)


@kernel
def correct_root_single(
    root: FloatArray, information: FloatArray, remainder: FloatArray, scratch: SlotScratch
) -> None:
    """Replace the root (1, 1, n, n, 1) of one filter's P in one run by that of ``(P^-1 + G)^-1``,
    paper P (7), with the information G = ``information`` (1, 1, n, n, 1) that it believes all
    sensors give; ``remainder`` (n, n, 1) and ``scratch`` are scratch.
    """
    correct_root(root, 0, 0, information, remainder, scratch)


@built_in("push-sum")
@dataclass(frozen=True, eq=False)
class PushSum(Filter):
    """In slots Battilotti et al., P Fig. 1, whose samples show estimates after readings; under node
    clocks broadcast rounds by running sums (``algorithms.running_sums``), which use none of the
    settings. All methods serve both: under clocks the state is a ``RunningSums``.

    gamma      averaging steps a slot
    delta      the averaging gain is 1 / delta, P (9)
    leader     the node whose weight starts at 1
    asymptotic whether gains come from the limits N and P_inf, P (12), from slot 1 on; no mass is
               exchanged
    links      "fresh": links fail anew in each averaging step; "held": once for all of a slot
    stop       "never"; "paper": P step 2.3, the node sends no more mass once its C~ moved by less
               than ``tolerance`` (spectral norm); "safe": it goes on exchanging but freezes G^(i)
               and N^(i) once they moved by less than ``tolerance`` (relative) while all its links
               were up and its weight positive
    running_sums  mass is exchanged by totals (Hadjicostis, Vaidya and Dominguez-Garcia, IEEE Trans.
               Automatic Control 61, 2016): a message holds all that its sender ever offered, so
               that a lost one, even in one direction alone, only delays mass
    """

    gamma: int = field(integer(low=1, high=MAX_STEPS), default=None)
    delta: float = field(positive, default=None)
    leader: int = field(node_id(low=0), default=0)
    asymptotic: bool = field(boolean, default=False)
    links: str = field(one_of("fresh", "held"), default="fresh")
    stop: str = field(one_of(*RULES), default="never")
    tolerance: float = field(number(low=0.0), default=1e-6)
    running_sums: bool = field(boolean, default=False)

    paper: ClassVar[str] = "push_sum"
    combination: ClassVar[str] = "sums"
    # Until others hear of its samples, a node counts them as if all nodes had taken them.
    P_by_design: ClassVar[tuple[str, str]] = ("", "smaller")
    fixed_sensors: ClassVar[bool] = True
    every_reading: ClassVar[bool] = True
    inverts_under_clocks: ClassVar[bool] = True
    ways_between_all: ClassVar[bool] = True
    schedule: ClassVar[tuple[str, ...]] = ("exchange", "predict", "sense", "exchange")
    clocks: ClassVar[tuple[str, ...]] = ("nodes",)
    needs_samples: ClassVar[bool] = True
    slot_kernel = staticmethod(push_sum_slots)

    def sends_in_slots(self, phase: int, has_sensor: bool) -> bool:
        """Return True if nodes send messages in the exchange with number ``phase``, with a sensor
        or without: not in that of mass if the gains are asymptotic.
        """
        return phase == AVERAGE or not self.asymptotic

    def payload_numbers(self, n: int, rows: int, phase: int) -> int:
        """Return the size of a message about n states in numbers of 64 bits: mass w, n~, C~, or an
        estimate z; under clocks (``phase`` -1) a weight, an information P^-1 and P^-1 xhat, which
        for a plant with modes of different rates of decay is in n more numbers for each further
        rate.
        """
        if phase == AVERAGE:
            return n
        return n * (n + 1) // 2 + (2 if phase == MASS else 1 + n)

    def slot_stopping(self) -> int:
        """Return the number of the exchange of a slot after which nodes may freeze their network
        estimates: that of mass, or -1 if none ever does.
        """
        # Without exchanges of mass there is nothing to stop.
        return MASS if not self.asymptotic and self.stop != "never" else -1

    def moves_estimates(self, phase: int) -> bool:
        """Return True for the exchange of estimates, False for that of mass; ``phase`` is the
        number of the exchange in a slot.
        """
        return phase == AVERAGE

    def decides_in_slots(self) -> bool:
        """Return True under the paper's stop rule, by which a node that has stopped sends no
        mass: the compiled kernel then writes who sends into ``SlotPlan.sent``.
        """
        return not self.asymptotic and self.stop == "paper"

    def slot_arrays(
        self, states: Sequence[Any], infos: Sequence[NodeInfo], runs: int
    ) -> tuple[PushSumArrays]:
        """Return the arrays of the compiled ``slot_kernel`` for ``runs`` runs of H nodes that start
        in these ``states`` and have the degrees in ``infos``: masses and network estimates of all
        runs, settings, and scratch.
        """
        network_estimates = [state.network for state in states]
        alone = np.stack([state.model.information for state in states])
        (H, n), blocks = alone.shape[:2], blocks_of(runs)
        # Unused without asymptotic gains, but kernels need an array of the right shape.
        limit = np.zeros((n, n)) if network_estimates[0].root is None else network_estimates[0].root
        mass = np.stack([state.mass for state in states])
        m, running = mass.shape[1], self._keeps_totals
        W = sum(info.degree for info in infos) if running else 0
        shapes = (m,), (m,), (n, n), (n, n), (1,), (1,), (n, n)  # of MassStep's fields
        return (
            PushSumArrays(
                mass=in_lanes(mass, blocks),
                degree=np.array([state.degree for state in states], dtype=np.int64),
                information=in_lanes(
                    np.stack([one.information for one in network_estimates]), blocks
                ),
                number=in_lanes(
                    np.array([one.number for one in network_estimates], dtype=np.float64), blocks
                ),
                alone=alone,
                rule=RULES.index(self.stop),
                tolerance=self.tolerance,
                # In slots check_scenario() demands a delta.
                delta=self.delta or math.inf,
                gamma=self.steps(AVERAGE),
                asymptotic=self.asymptotic,
                limit=np.ascontiguousarray(limit),
                share=aligned((H, m, LANES)),
                before=aligned((m, LANES)),
                new_information=aligned((n, n, LANES)),
                new_number=aligned((1, LANES)),
                silent=np.zeros(LANES, dtype=np.uint8),
                stop=MassStep(*(np.zeros(shape) for shape in shapes)),
                running=running,
                offered=aligned((blocks, H if running else 0, m, LANES)),
                heard=aligned((blocks, W, m, LANES)),
            ),
        )

    def init(self, model: Any, mean: FloatArray, cov: FloatArray, node: NodeInfo) -> Any:
        """Return the state at time 0, P step 1, with estimate ``mean`` (n,) and covariance ``cov``
        (n, n): the leader has the weight; with asymptotic gains every node knows the limits. A
        ``RunningSums`` under clocks, else a ``PushSumState``.
        """
        if not isinstance(model, SlotModel):
            # A model without slots: clocks, where running sums are kept.
            return running_sums.start(model, mean, cov, node)
        information = model.information
        # P step 1: w is 1 at the leader and 0 elsewhere, n~ = 1, C~ = the node's own information.
        weight = 1.0 if node.node == self.leader else 0.0
        mass = np.concatenate([[weight, 1.0], information.reshape(-1)])
        network_estimate = NetworkInformation(information, 1.0)
        # With asymptotic gains every node knows G = node.information, of all sensors, and N.
        if self.asymptotic:
            root = asymptotic_root(model.F, model.Q, node.information)
            network_estimate = NetworkInformation(node.information, float(node.nodes), root)
        sums = NodeSums(np.zeros(mass.shape), {}) if self._keeps_totals else None
        return PushSumState(
            xhat=mean,
            root=first_root(cov),
            model=model,
            mass=mass,
            network=network_estimate,
            stopped=False,
            degree=node.degree,
            sums=sums,
        )

    @property
    def _keeps_totals(self) -> bool:
        """True if the mass of slots is exchanged by running sums."""
        return self.running_sums and not self.asymptotic

    def predict(self, state: Any, gap: float) -> Any:
        """Return the state ``gap`` seconds later, with estimate and covariance predicted (P
        step 3); under clocks also the totals of information that the node has sent and heard, which
        then refer to the plant's state of that time.
        """
        if isinstance(state, RunningSums):
            return running_sums.predict_sums(state, gap)
        return super().predict(state, gap)

    def steps(self, phase: int) -> int:
        """Return the steps of exchange number ``phase`` of a slot: 1 for the mass, ``gamma`` for
        the estimates.
        """
        # gamma is None under clocks, which have no steps.
        return self.gamma or 1 if phase == AVERAGE else 1

    def redraws_links(self, phase: int, step: int) -> bool:
        """Return True if links draw new outcomes in repetition ``step`` of exchange number
        ``phase`` of a slot: always, unless links that are "held" keep the outcome of the first one.
        """
        return self.links == "fresh" or step == 0

    def emit(self, state: Any, exchange: Exchange) -> tuple[Any, Any]:
        """Return the state after sending and the payload: in the first exchange of a slot the
        node's share of its mass (2 + n n,), step 2.1, or with running sums the total of all shares
        so far, in the second z (n,), step 5.1; under clocks an ``Offer``.
        """
        if isinstance(state, RunningSums):
            return running_sums.offer(state)
        if exchange.phase == AVERAGE:
            # The average is of z, which is the corrected estimate.
            return state, state.xhat
        if state.sums is not None:
            offered = state.sums.offered + share(state.mass, state.degree)
            return state._replace(sums=state.sums._replace(offered=offered)), offered
        # None sends nothing; links draw their outcomes all the same.
        silent = self.asymptotic or (self.stop == "paper" and state.stopped)
        return state, None if silent else share(state.mass, state.degree)

    def absorb(self, state: Any, messages: Sequence[Message], exchange: Exchange) -> Any:
        """Return the state after all messages of a step: in the first exchange of a slot with the
        new mass and network estimate, steps 2.2 and 2.3, in the second with its estimate averaged
        with those of its neighbours, step 5.2; under clocks with the growth of all totals added.
        """
        if isinstance(state, RunningSums):
            return running_sums.absorb_totals(state, messages)
        received = [message.payload for message in messages]
        # P step 5.2.
        if exchange.phase == AVERAGE:
            return state._replace(
                xhat=average_estimates(state.xhat, received, self.delta or math.inf)
            )
        if self.asymptotic or (self.stop == "paper" and state.stopped):
            return state
        if state.sums is not None:
            return self._learn_network(
                _heard_totals(state, state.sums, messages), state.mass, False
            )
        # P steps 2.2, (3)-(5), and 2.3, (6) with the stop rule.
        mass = conserve_mass(state.mass, received, state.degree)
        all_up = len(received) == state.degree
        return self._learn_network(state._replace(mass=mass), state.mass, all_up)

    def _learn_network(self, state: PushSumState, before: FloatArray, all_up: bool) -> PushSumState:
        """Return the ``state`` after an exchange of mass with the network estimate that follows
        from its mass, paper P (6), and with ``stopped`` by the stop rule. ``before`` (2 + n n,) is
        the mass before the exchange; ``all_up``: all links of the node were up.
        """
        # Frozen by the safe rule: the mass was mixed, but the estimate is not updated any more.
        if state.stopped:
            return state
        estimate, former = network(state.mass, state.model), state.network
        step = MassStep(
            before,
            state.mass,
            former.information,
            estimate.information,
            np.array([former.number]),
            np.array([estimate.number]),
            np.empty(estimate.information.shape),
        )
        stopped = has_stopped(RULES.index(self.stop), self.tolerance, step, all_up)
        return state._replace(network=estimate, stopped=stopped)

    def update(self, state: Any, reading: Reading) -> Any:
        """Return the state after a reading, paper P (7) and (8), from the prediction of the slot;
        under clocks after a Kalman update that counts the reading N / w times.
        """
        if isinstance(state, RunningSums):
            return running_sums.update_sums(state, reading)
        root = state.network.root
        # Without asymptotic gains P (7) with the node's G; with them P_inf.
        if root is None:
            root = correct_root_alone(state.root, state.network.information)
        y, H, R = reading[:3]
        xhat = correct_estimate(state.xhat, root, state.network.number, y, H, R)
        return state._replace(xhat=xhat, root=root)

    def stopped(self, state: Any) -> bool:
        """Return True if the node's estimate of the network, G^(i) and N^(i), is frozen."""
        return not isinstance(state, RunningSums) and bool(state.stopped)

    def conserved(self, state: Any) -> Mapping[str, float | Sequence[float]]:
        """Return the weight w and the number n~ of a node by name, whose sums over all nodes are 1
        and N; with running sums each as a list of terms, which adds to the node's mass the totals
        that it offered to its neighbours and subtracts those it heard: mass under way counts.
        """
        if isinstance(state, RunningSums):
            return running_sums.weights(state)
        if state.sums is None:
            return {"weight": float(state.mass[0]), "number": float(state.mass[1])}
        return {
            name: [
                float(state.mass[k]),
                float(state.sums.offered[k]) * state.degree,
                *(-float(total[k]) for total in state.sums.heard.values()),
            ]
            for k, name in enumerate(("weight", "number"))
        }

    def shift(self, state: Any, offset: FloatArray) -> Any:
        """Return the state with ``offset`` (n,) added to the estimate, for a move of the origin:
        averaging weights sum to one, so that nothing else changes.
        """
        if isinstance(state, RunningSums):
            return running_sums.shift(state, offset)
        return state._replace(xhat=state.xhat + offset)

    def shift_payload(self, payload: Any, offset: FloatArray) -> Any:
        """Return the payload of a message under way, for a move of the origin by which estimates
        change by ``offset`` (n,): mass does not change.
        """
        if isinstance(payload, Offer):
            return running_sums.shift_offer(payload, offset)
        # A mass is longer than an estimate: 2 + n^2 > n entries.
        return payload + offset if len(payload) == len(offset) else payload

    def check_scenario(self, scenario: Any) -> None:
        """Raise ScenarioError where the settings do not fit a ``netkf.Scenario`` in slots: the
        leader is no node, gamma or delta is missing or averaging would not contract, rounding of
        information would take the first covariance, or P_inf does not exist.
        """
        if not scenario.slotted:
            return
        self._check_leader(scenario)
        for name in ("gamma", "delta"):
            if getattr(self, name) is None:
                rule = "is missing for a plant in slots"
                raise ScenarioError(f"filter.{name}", rule, None, f"add {name} = ...")
        self._check_gain(scenario.topology.laplacian_radius)
        if self.running_sums and self.stop != "never":
            rule = "must be never with running sums, which a node that stops would freeze"
            raise ScenarioError("filter.stop", rule, self.stop, 'write stop = "never"')
        check_information(scenario)
        # P (12) may have no solution, as for an unstable plant that the sensors do not see.
        if self.asymptotic:
            F, Q = scenario.slot_belief
            self._check_limit(F, Q, scenario.node_infos[0].information)

    def _check_limit(self, F: FloatArray, Q: FloatArray, information: FloatArray) -> None:
        """Raise ScenarioError unless P_inf exists and gives gains to the readings: F and Q (n, n),
        and the ``information`` (n, n) of all sensors.
        """
        root = asymptotic_root(F, Q, information)
        if root is None:
            raise ScenarioError(
                "filter.asymptotic",
                "needs a steady covariance of the centralised filter, and there is none",
                True,
                "add sensors, or set it to false",
            )
        if information.any() and not (root.T @ information).any():
            raise ScenarioError(
                "filter.asymptotic",
                "needs process noise: without it P_inf is 0, and so are all gains",
                True,
                "set it to false",
            )

    def _check_leader(self, scenario: Any) -> None:
        """Raise ScenarioError unless the leader is a node of the graph."""
        nodes = scenario.nodes
        if self.leader not in scenario.topology.index:
            ids = ", ".join(map(str, nodes)) if len(nodes) <= 8 else f"{nodes[0]} .. {nodes[-1]}"
            rule, remedy = "must be a node of the graph", f"node ids here are {ids}"
            raise ScenarioError("filter.leader", rule, self.leader, remedy)

    def _check_gain(self, radius: float) -> None:
        """Raise ScenarioError unless averaging with ``delta`` contracts; ``radius`` is rho(L), the
        largest eigenvalue of the graph's Laplacian.
        """
        # Averaging contracts if and only if all eigenvalues of I - L / delta but one lie inside
        # (-1, 1).
        if self.delta <= 0.5 * radius * (1.0 + 1e-12):
            raise ScenarioError(
                "filter.delta",
                f"must be above rho(L) / 2 = {0.5 * radius:.6g}, or averaging does not contract",
                self.delta,
                f"give more than rho(L) = {radius:.6g}",
            )

    def scenario_notes(self, scenario: Any) -> tuple[str, ...]:
        """Return one line each: delta is below rho(L); rounding of information; settings of slots
        are not used under clocks.
        """
        if not scenario.slotted:
            fields = dataclasses.fields(self)
            changed_settings = [
                f"filter.{f.name}" for f in fields if getattr(self, f.name) != f.default
            ]
            reason = "not used under clocks, where push-sum keeps running sums"
            return (f"{', '.join(changed_settings)}: {reason}",) if changed_settings else ()
        # Contraction is enough to run; the theorems ask for more.
        radius = scenario.topology.laplacian_radius
        notes = information_notes(scenario)
        if self.delta >= radius:
            return notes
        return (
            *notes,
            f"filter.delta = {self.delta:g} is below rho(L) = {radius:.6g}: averaging contracts, "
            "but P Theorems 3, 5 and 6 ask for more than rho(L)",
        )


def _heard_totals(state: PushSumState, sums: NodeSums, messages: Sequence[Message]) -> PushSumState:
    """Return the state after an exchange of mass in slots by running sums: its mass (2 + n n,) is
    the share it keeps plus the growth of the totals in ``messages``, which become the last ones
    heard in its ``sums``.
    """
    heard, nothing = dict(sums.heard), np.zeros(state.mass.shape)
    gained = [message.payload - heard.get(message.sender, nothing) for message in messages]
    heard |= {message.sender: message.payload for message in messages}
    mass = share(state.mass, state.degree) + sum(gained, nothing)
    return state._replace(mass=mass, sums=sums._replace(heard=heard))


def correct_estimate(
    predicted: FloatArray,
    root: FloatArray,
    number: float,
    y: FloatArray,
    H: FloatArray,
    R: FloatArray,
) -> FloatArray:
    """Return the estimate (n,) of paper P (8): the prediction ``predicted`` (n,) plus ``number``
    times the gain of the reading y (p,), H (p, n), R (p, p), which may have no rows; ``root``
    (n, n) is that of the covariance after the reading, paper P (7).
    """
    n, x = len(predicted), np.array(predicted, dtype=np.float64)
    if len(y):
        # The kernel takes readings whose noise has variance 1.
        y, H = whiten_reading(y, H, R)
        add_gain_single(
            x.reshape(1, 1, n, 1),
            np.ascontiguousarray(root).reshape(1, 1, n, n, 1),
            number,
            y.reshape(1, 1, 1, -1, 1),
            H.reshape(1, 1, 1, -1, n, 1),
            np.empty((2, n, 1)),
        )
    return x


def share(mass: FloatArray, degree: int) -> FloatArray:
    """Return the mass (2 + n n,), weight, number of nodes and information, that a node of
    ``degree`` neighbours sends to each of them: ``mass`` over degree + 1.
    """
    part = np.empty(mass.shape)
    split_mass_single(mass.reshape(1, 1, -1, 1), degree, part.reshape(1, -1, 1))
    return part


def conserve_mass(mass: FloatArray, received: Sequence[FloatArray], degree: int) -> FloatArray:
    """Return the mass (2 + n n,) by paper P (3)-(5): the shares ``received`` and the node's own
    share of its former ``mass``, which it keeps once for itself and once for each link of its
    ``degree`` that failed.
    """
    total = np.array(sum(received, np.zeros(mass.shape)))
    # The same kernels as in slots, on arrays of one node: both engines round alike.
    own = share(mass, degree).reshape(1, -1, 1)
    keep_share_single(total.reshape(1, 1, -1, 1), own, degree + 1 - len(received))
    return total


def network(mass: FloatArray, model: SlotModel) -> NetworkInformation:
    """Return a node's network estimate, paper P (6): the information of all sensors C~ / w (n, n)
    and the number of nodes n~ / w, from its ``mass`` (2 + n n,); while its weight is exactly 0 its
    own information, by ``model``, and 1.
    """
    alone = model.information
    information, number = np.empty((*alone.shape, 1)), np.empty((1, 1))
    learn_network_single(mass.reshape(1, 1, -1, 1), alone[None], information, number)
    return NetworkInformation(information[:, :, 0], float(number[0, 0]))


def correct_root_alone(root: FloatArray, information: FloatArray) -> FloatArray:
    """Return the root (n, n) of ``(P^-1 + G)^-1 = P (I + G P)^-1``, paper P (7), for the lower
    triangular ``root`` (n, n) of P, possibly singular, and the information G = ``information``
    (n, n). For the SimPy engine and the asymptotic gains, one node of one run at a time.
    """
    # The kernel takes arrays with axes of blocks, nodes and lanes, here of length 1 each.
    n = len(root)
    result, information_lanes = (np.array(a).reshape(1, 1, n, n, 1) for a in (root, information))
    correct_root_single(
        result, information_lanes, np.empty((n, n, 1)), slot_scratch(1, n, False, ONE)
    )
    return np.asarray(result.reshape(n, n))


def average_estimates(z: FloatArray, received: Sequence[FloatArray], delta: float) -> FloatArray:
    """Return ``z + sum_j (z_j - z) / delta`` (n,), paper P (9), for a node's ``z`` (n,) and the
    estimates z_j (n,) that it ``received``.
    """
    # The kernel of slots on a star: the node itself, and one link from each sender; it does not use
    # weights of links.
    x = np.stack([z, *received])[None, :, :, None]
    links, up = star_of([0.0] * len(received))
    average(ONE, x, 0, links, up, 0, 0, np.empty((1, len(z), 1)), 1.0 / delta)
    return np.asarray(x[0, 0, :, 0])


def asymptotic_root(F: FloatArray, Q: FloatArray, information: FloatArray) -> FloatArray | None:
    """Return the root of P_inf (n, n), paper P (12): the steady covariance of a filter with F and Q
    (n, n) that has all the ``information`` (n, n) in each slot, after its reading; None if there is
    none.
    """
    P = _steady_prediction(F, Q, information)
    # Without a steady state P doubles until rounding of G stops it, at a P made of rounding errors,
    # which are others in other units.
    again = _steady_prediction(F, Q / UNITS, UNITS * information)
    if P is None or again is None:
        return None
    if np.abs(UNITS * again - P).max() > SAME * np.abs(P).max():
        return None
    # P is the predicted covariance: use the reading to get that of P (12).
    return correct_root_alone(lower_root(square_root(P)), information)


def _steady_prediction(F: FloatArray, Q: FloatArray, information: FloatArray) -> FloatArray | None:
    """Return the steady predicted covariance (n, n) of a filter with F and Q (n, n) that has all
    the ``information`` (n, n) in each slot; None if the iteration finds none.

    By structure-preserving doubling: k steps give the covariance of 2^k slots (Chu, Fan, Lin and
    Wang, Int. J. Control 77, 2004).
    """
    # With W = (I + G P)^-1: A <- A W A, G <- G + A W G A', P <- P + A' P W A, from F', the
    # information G and P = Q.
    A, G, P = F.T, information, Q
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(MAX_DOUBLINGS):
            try:
                # One solve for (I + G P)^-1 [A, G].
                solved = np.linalg.solve(np.eye(len(F)) + G @ P, np.concatenate([A, G], axis=1))
            except np.linalg.LinAlgError:
                return None
            left, right = solved[:, : len(F)], solved[:, len(F) :]
            # P grows towards the steady predicted covariance; it overflows if there is none.
            next_P = symmetric(P + A.T @ P @ left)
            if not np.isfinite(next_P).all():
                return None
            # Rounding would make G and P unsymmetric, and doubling would amplify that.
            A, G, step, P = A @ left, symmetric(G + A @ right @ A.T), next_P - P, next_P
            if np.abs(step).max() <= 1e-15 * np.abs(P).max():
                return P
    return None
