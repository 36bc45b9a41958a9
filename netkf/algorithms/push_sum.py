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
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from netkf.algorithms import running_sums
from netkf.algorithms.filter import Filter, NodeInfo
from netkf.algorithms.kernels.estimates import (
    add_covariance_product,
    copy_vector,
    rotate,
    transform_mean,
)
from netkf.algorithms.kernels.run import predict_estimate, write_innovation
from netkf.algorithms.kernels.square_root import lower_root
from netkf.algorithms.kernels.triggers import is_positive
from netkf.algorithms.models import SlotModel
from netkf.algorithms.records import Kernels, Record, packed_numbers
from netkf.algorithms.registry import built_in
from netkf.algorithms.starts import check_information, information_notes
from netkf.algorithms.traits import Analysis, Needs, Timing
from netkf.core.errors import ScenarioError
from netkf.core.fields import boolean, field, integer, node_id, number, one_of, positive
from netkf.linalg.arrays import FloatArray, is_definite, square_root, symmetric
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import (
    ONE,
    Lanes,
    any_lane,
    load,
    load_flags,
    root_of,
    select,
    spread,
    store,
)
from netkf.linalg.structs import Size

MASS, AVERAGE = 0, 1
"""The two exchanges of a slot, steps 2 and 5: their numbers, ``phase`` in methods."""
RULES = ("never", "safe", "paper")
NEVER, SAFE, PAPER = range(3)
"""When a node freezes its network estimate. The rule of the paper also fires when all links of a
node fail in one step, and then freezes a wrong one.
"""

NEVER_STOPPED = np.iinfo(np.int64).max
"""A slot that no run reaches, for a node that never stops."""
ROUNDING = 2.0**-52
"""Spacing of floating-point numbers at 1: share of a diagonal entry that counts as 0."""
MAX_STEPS = 100_000
"""The largest ``gamma``: a larger one is a mistake."""
MAX_DOUBLINGS = 60
"""Iterations of ``_steady_prediction``; k of them reach 2^k slots."""
UNITS, SAME = 3.0, 1e-4
"""Factor of other units in which P_inf is computed once more, and relative difference up to which
both results are one covariance and not rounding errors.
"""


@kernel
def predict(record: Any, h: int, run: Any) -> None:
    """Step 3. With asymptotic gains the covariance is P_inf, and only the mean is predicted."""
    if record.asymptotic == 1:
        transform_mean(run.lanes, run.size, record.xhat, h, run.model.F, run.moved_mean)
    else:
        predict_estimate(run.model, run, record.xhat, record.root, h, h)


@kernel
def emit(record: Any, h: int, m: int, run: Any) -> None:
    """Send z (n,), step 5.1, or mass: the share of the node's mass, step 2.1, or by running sums
    the total of all shares so far.
    """
    lanes, mass, payload = run.lanes, record.mass, record.payload
    if run.phase == AVERAGE:
        copy_vector(lanes, run.size, payload.xhat, m, record.xhat, h, True)
        return
    awake = load_flags(lanes, run.sends)
    for i in range(mass.shape[1]):
        before = load(lanes, mass, h, i)
        share = before / (record.degree[h, 0] + 1)
        if record.running == 1:
            # What is offered leaves the node now; one that is down offers nothing.
            store(lanes, mass, h, i, select(awake, share, before))
            share = load(lanes, record.offered, h, i) + select(awake, share, 0.0)
            store(lanes, record.offered, h, i, share)
        store(lanes, payload.mass, m, i, share)
    # Asymptotic gains need no mass, and by the paper's rule a stopped node sends none.
    for q in range(len(lanes)):
        if record.asymptotic == 1 or (record.rule == PAPER and record.stopped[h, q] < run.slot):
            run.sends[q] = 0


@kernel
def absorb(record: Any, h: int, run: Any) -> None:
    """Average estimates, step 5.2, or take in mass and learn from it what the network is, steps 2.2
    and 2.3.
    """
    if run.phase == AVERAGE:
        average(record, h, run)
    elif record.asymptotic == 0:
        # Until a node stops, ``stopped`` is later than all slots.
        for q in range(len(run.lanes)):
            record.silent[q] = record.stopped[h, q] < run.slot
        if record.running == 1:
            receive_totals(record, h, run)
        else:
            mix_mass(record, h, run)
        learn_network(record, h, run)


@kernel(inlined=True)
def average(record: Any, h: int, run: Any) -> None:
    """Do one averaging step, P (9): ``z_i += sum_j (z_j - z_i) / delta``."""
    # It contracts differences if delta exceeds half the largest eigenvalue of the Laplacian.
    lanes, x, heard = run.lanes, record.xhat, record.payload.xhat
    for i in range(len(run.size)):
        own, total = load(lanes, x, h, i), spread(lanes, 0.0)
        for k in range(run.count):
            arrived = load_flags(lanes, run.arrived, k)
            total += select(arrived, load(lanes, heard, run.message[k], i) - own, 0.0)
        store(lanes, x, h, i, own + record.factor * total)


@kernel
def mix_mass(record: Any, h: int, run: Any) -> None:
    """Set the mass of node h to the shares that it keeps and receives, P (3)-(5), and write the
    number of shares that arrived into ``run.row[0]``; the mass before is left in ``record.before``.
    """
    lanes, mass, degree = run.lanes, record.mass, record.degree[h, 0]
    received = spread(lanes, 0.0)
    for k in range(run.count):
        received += select(load_flags(lanes, run.arrived, k), 1.0, 0.0)
    # Its own share, once for itself and once for each neighbour whose share did not arrive, so
    # that the sums of w, n~ and C~ over the network are conserved.
    times = (degree + 1.0) - received
    # By the paper's rule a stopped node leaves the exchange and keeps its mass; by the safe rule it
    # goes on mixing, since other nodes still need its mass.
    frozen = load_flags(lanes, record.silent)
    for i in range(mass.shape[1]):
        before, total = load(lanes, mass, h, i), spread(lanes, 0.0)
        store(lanes, record.before, i, before)
        for k in range(run.count):
            arrived = load_flags(lanes, run.arrived, k)
            total += select(arrived, load(lanes, record.payload.mass, run.message[k], i), 0.0)
        mixed = times * (before / (degree + 1)) + total
        if record.rule == PAPER:
            mixed = select(frozen, before, mixed)
        store(lanes, mass, h, i, mixed)
    store(lanes, run.row, 0, received)


@kernel
def receive_totals(record: Any, h: int, run: Any) -> None:
    """Add the growth of totals, which replace the last ones heard, to the mass of node h."""
    lanes, mass, heard = run.lanes, record.mass, record.heard
    for i in range(mass.shape[1]):
        total = spread(lanes, 0.0)
        for k in range(run.count):
            # A lost total does no harm: the next one contains it.
            arrived, w = load_flags(lanes, run.arrived, k), run.link[k]
            last = load(lanes, heard, w, i)
            offered = load(lanes, record.payload.mass, run.message[k], i)
            total += select(arrived, offered - last, 0.0)
            store(lanes, heard, w, i, select(arrived, offered, last))
        store(lanes, mass, h, i, load(lanes, mass, h, i) + total)


@kernel
def learn_network(record: Any, h: int, run: Any) -> None:
    """Learn the information of all sensors G = C~ / w and the number of nodes N = n~ / w from the
    mass of node h, P (6), unless it stopped before, and apply the stop rule. While its weight w is
    exactly 0 these are its own information and 1.
    """
    # w is 0 until the first mass from the leader arrives, which begins with all the weight.
    lanes, mass, n, new = run.lanes, record.mass, len(run.size), record.new_information
    weight = load(lanes, mass, h, 0)
    is_empty = weight == 0.0
    for i in range(n):
        # One triangle is computed and mirrored: G is symmetric bit for bit.
        for j in range(i + 1):
            # The mean of both triangles, since C~ is symmetric only up to rounding. Where w is 0
            # these are nan or infinite: kernels do not raise, and ``select`` discards them.
            upper = load(lanes, mass, h, 2 + i * n + j) / weight
            lower = load(lanes, mass, h, 2 + j * n + i) / weight
            value = select(is_empty, record.alone[h, i, j], 0.5 * (upper + lower))
            store(lanes, new, i, j, value)
            store(lanes, new, j, i, value)
    number = select(is_empty, 1.0, load(lanes, mass, h, 1) / weight)
    store(lanes, record.new_number, 0, number)
    # The stop rule compares with the former G and N, so they are replaced only afterwards.
    if record.rule != NEVER:
        for q in range(len(lanes)):
            all_up = run.row[0, q] == record.degree[h, 0]
            if record.silent[q] == 0 and stops(record, h, q, all_up):
                record.stopped[h, q] = run.slot
    frozen = load_flags(lanes, record.silent)
    for i in range(n):
        for j in range(n):
            last = load(lanes, record.information, h, i, j)
            store(lanes, record.information, h, i, j, select(frozen, last, load(lanes, new, i, j)))
    store(lanes, record.number, h, select(frozen, load(lanes, record.number, h), number))


@kernel
def stops(record: Any, h: int, q: int, all_up: bool) -> bool:
    """Return True if node h freezes its network estimate in this slot, in lane ``q``: by the rule
    of the paper if it has information, which moved by less than the tolerance; by the safe rule if
    its network estimate did while all its links were up (``all_up``) and its weight is positive.
    """
    mass, tolerance = record.mass, record.tolerance
    if record.rule == PAPER:
        # A mass of zero, before information has reached the node, does not change either.
        has_mass = False
        for i in range(2, mass.shape[1]):
            has_mass = has_mass or mass[h, i, q] != 0.0
        return has_mass and moved_within(record.before, mass, h, q, tolerance, record.work)
    # In an outage estimates do not change either.
    if not (all_up and mass[h, 0, q] > 0.0):
        return False
    former, number = record.number[h, q], record.new_number[0, q]
    information = record.new_information
    return has_converged(record.information, h, information, q, former, number, tolerance)


@kernel
def moved_within(
    before: FloatArray, mass: FloatArray, h: int, q: int, bound: float, work: FloatArray
) -> bool:
    """Return True if the change D (n, n) of the information, entries 2 and on, from the mass
    ``before`` (2 + n n, L) to ``mass[h]`` has a spectral norm below ``bound`` in lane ``q``: both
    ``bound I - D`` and ``bound I + D`` are positive definite. ``work`` (n, n) is scratch.
    """
    n = len(work)
    for sign in (-1.0, 1.0):
        for i in range(n):
            for j in range(n):
                index = 2 + i * n + j
                work[i, j] = sign * (mass[h, index, q] - before[index, q])
            work[i, i] += bound
        if not is_positive(ONE, work):
            return False
    return True


@kernel
def has_converged(
    former: FloatArray,
    h: int,
    information: FloatArray,
    q: int,
    former_number: float,
    number: float,
    tolerance: float,
) -> bool:
    """Return True if N^(i), from ``former_number`` to ``number``, and G^(i), from ``former[h]``
    (n, n, L) to ``information`` (n, n, L), changed by at most ``tolerance`` (relative; Frobenius
    norm) in lane ``q``.
    """
    # ``not <`` rejects nan.
    if not abs(number - former_number) < tolerance * number:
        return False
    change = square = 0.0
    for i in range(len(information)):
        for j in range(len(information)):
            entry = information[i, j, q]
            change += (entry - former[h, i, j, q]) ** 2
            square += entry * entry
    # <=, so that an information of 0 that stays 0 has converged.
    return math.sqrt(change) <= tolerance * math.sqrt(square)


@kernel
def update(record: Any, h: int, run: Any) -> None:
    """Correct node h by its reading, steps 3 and 4, with the information and the number of nodes of
    the whole network as it estimates them: P (7) and (8).
    """
    lanes, r = run.lanes, run.reading
    if record.asymptotic == 1:
        for i in range(len(run.size)):
            for j in range(i + 1):
                store(lanes, record.root, h, i, j, record.limit[i, j])
    else:
        scratch = run.moved, run.moved_mean, run.row, run.gains
        correct_root(lanes, run.size, record.root, h, record.information, scratch)
    if run.rows[r] > 0:
        # ``x += N P H' R^-1 (y - H x)``, P (8)
        x, number = record.xhat, load(lanes, record.number, h)
        write_innovation(run, x[h], run.row)
        add_covariance_product(lanes, run.size, x, h, number, record.root, run.row, run.gains)


@kernel(inlined=True)
def correct_root(
    lanes: Lanes,
    size: Size,
    root: FloatArray,
    h: int,
    information: FloatArray,
    scratch: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
) -> None:
    """Replace ``root[h]`` by the root of ``(P^-1 + G)^-1 = P (I + G P)^-1``, P (7), with the
    information G = ``information[h]`` (n, n, L); ``scratch`` are (n, n, L) and three (n, L).
    """
    # G = sum v v' by Cholesky, first the row of which most is left. Each v' is used as an
    # observation with noise of variance 1: nothing is inverted, and P may be singular.
    remainder, v, row, gains = scratch
    n = len(size)
    for i in range(n):
        for j in range(n):
            store(lanes, remainder, i, j, load(lanes, information, h, i, j))
    for _ in range(n):
        pivot, share = fullest_row(lanes, remainder, information, h, v)
        # The remainder is rounding of G: G has no further rank to use. ``>`` also ends on nan.
        useful = share > ROUNDING * n
        if not any_lane(useful):
            return
        # v' = this row / sqrt(pivot), the next one of the Cholesky factor; zeros, which change
        # nothing, in lanes whose remainder is rounding.
        scale = select(useful, root_of(pivot), 1.0)
        for i in range(n):
            store(lanes, v, i, select(useful, load(lanes, v, i) / scale, 0.0))
        for j in range(n):
            total = spread(lanes, 0.0)
            for i in range(j, n):
                total += load(lanes, v, i) * load(lanes, root, h, i, j)
            store(lanes, row, j, total)
        # P <- P - P v v' P / (1 + v' P v) on the root. P (8) corrects the estimate.
        rotate(lanes, size, root, h, row, gains)
        # Deflate, remainder -= v v'.
        for i in range(n):
            for j in range(n):
                entry = load(lanes, remainder, i, j) - load(lanes, v, i) * load(lanes, v, j)
                store(lanes, remainder, i, j, entry)


@kernel(inlined=True)
def fullest_row(
    lanes: Lanes, remainder: FloatArray, information: FloatArray, h: int, v: FloatArray
) -> tuple[Any, Any]:
    """Write the row of ``remainder`` (n, n, L) whose diagonal entry is the largest share of that of
    ``information[h]`` into ``v`` (n, L), lane by lane; return that entry and the share (L,).
    """
    # Shares, unlike the entries themselves, do not depend on the units of the states.
    nothing = spread(lanes, 0.0)
    pivot = share = nothing
    for i in range(len(remainder)):
        left, whole = load(lanes, remainder, i, i), load(lanes, information, h, i, i)
        own = select(whole > 0.0, left / whole, nothing)
        more = own > share
        pivot, share = select(more, left, pivot), select(more, own, share)
        for j in range(len(remainder)):
            store(lanes, v, j, select(more, load(lanes, remainder, i, j), load(lanes, v, j)))
    return pivot, share


@kernel
def observe(record: Any, h: int, run: Any) -> None:
    """Write the parts of node h in the sums of the weight w and the number n~ over the network,
    which exchanges conserve; by running sums with the mass under way to it.
    """
    lanes = run.lanes
    for k in range(2):
        value = load(lanes, record.mass, h, k)
        if record.running == 1:
            for w in range(run.first[h], run.first[h + 1]):
                offered = load(lanes, record.offered, run.sender[w], k)
                value += offered - load(lanes, record.heard, w, k)
        store(lanes, record.conserved, h, k, value)


def push_sum_message_size(n: int, _rows: int, phase: int) -> int:
    """Return the numbers in a message about n states: mass w, n~, C~, or an estimate z; under
    clocks (``phase`` -1) a weight, an information P^-1 and P^-1 xhat, which for a plant with modes
    of different rates of decay is in n more numbers for each further rate.
    """
    if phase == AVERAGE:
        return n
    return n * (n + 1) // 2 + (2 if phase == MASS else 1 + n)


def has_frozen(state: Any) -> bool:
    """Return True if the node's estimate of the network, G^(i) and N^(i), is frozen."""
    return hasattr(state, "stopped") and bool(state.stopped < NEVER_STOPPED)


def mass_terms(state: Any) -> Mapping[str, float | Sequence[float]]:
    """Return the weight w and the number n~ of a node by name, whose sums over all nodes are 1 and
    N; with running sums each as a list of terms, which adds to the node's mass the totals that it
    offered to its neighbours and subtracts those it heard: mass under way counts.
    """
    if not hasattr(state, "mass"):
        return running_sums.weights(state)
    if not len(state.offered):
        return {"weight": float(state.mass[0]), "number": float(state.mass[1])}
    degree = int(state.degree)
    return {
        name: [
            float(state.mass[k]),
            float(state.offered[k]) * degree,
            *(-state.heard[:, k]).tolist(),
        ]
        for k, name in enumerate(("weight", "number"))
    }


def push_sum_record(filtering: PushSum, infos: Sequence[NodeInfo], models: Sequence[Any]) -> Record:
    """Return masses, network estimates and settings in slots, running sums under clocks."""
    if not isinstance(models[0], SlotModel):
        return running_sums.record(infos, models)
    n = len(models[0].information)
    m, running = 2 + n * n, filtering.running_sums and not filtering.asymptotic
    limit = np.zeros((n, n))
    if filtering.asymptotic:
        # Every node knows G, of all sensors. _check_scenario() refuses where there is no P_inf.
        found = asymptotic_root(models[0].F, models[0].Q, infos[0].information)
        limit = limit if found is None else found
    return Record(
        node={
            "mass": (m,),
            "information": (n, n),
            "number": (),
            "stopped": ((), np.int64),
            "degree": ((), np.int64),
            "offered": (m if running else 0,),
            "conserved": (2,),
        },
        link={"heard": (m if running else 0,)},
        payload={"mass": (m,), "xhat": (n,)},
        numbers={"mass": packed_numbers(n, 2)},
        scratch={
            "before": (m,),
            "new_information": (n, n),
            "new_number": (1,),
            "silent": ((), np.uint8),
        },
        settings={
            "work": np.zeros((n, n)),
            "alone": np.stack([model.information for model in models]),
            "limit": np.ascontiguousarray(limit),
            "rule": RULES.index(filtering.stop),
            "tolerance": float(filtering.tolerance),
            # In slots _check_scenario() demands a delta.
            "factor": 1.0 / (filtering.delta or math.inf),
            "asymptotic": int(filtering.asymptotic),
            "running": int(running),
        },
    )


def begin_push_sum(
    filtering: PushSum, node: Mapping[str, np.ndarray], info: NodeInfo, model: Any
) -> None:
    """Set one node to P step 1: w is 1 at the leader and 0 elsewhere, n~ = 1, C~ is its own
    information; with asymptotic gains it knows the limits.
    """
    if not isinstance(model, SlotModel):
        node["weight"][...] = 1.0
        return
    node["mass"][:2] = 1.0 if info.node == filtering.leader else 0.0, 1.0
    node["mass"][2:] = model.information.reshape(-1)
    node["information"][:] = info.information if filtering.asymptotic else model.information
    node["number"][...] = info.nodes if filtering.asymptotic else 1.0
    node["stopped"][...], node["degree"][...] = NEVER_STOPPED, info.degree


SLOTS = Kernels(
    record=push_sum_record, begin=begin_push_sum, predict=predict, update=update, emit=emit,
    absorb=absorb, observe=observe, under_clocks=running_sums.KERNELS,
)  # fmt: skip
LIMIT = "whose asymptotic gains are the limit of one plant, and wrong until the next has its own"
PARTS = (
    "whose totals keep information under way in parts by the rates at which modes decay: those of "
    "other modes do not follow from them"
)
DECIDING = replace(SLOTS, decides=True, depends_on_data=False)


@built_in("push-sum")
@dataclass(frozen=True, eq=False)
class PushSum(Filter):
    """In slots Battilotti et al., P Fig. 1, whose samples show estimates after readings; under node
    clocks broadcast rounds by running sums (``algorithms.running_sums``), which use none of the
    settings. All methods serve both; the fields of their states differ.

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

    @property
    def analysis(self) -> Analysis:
        """Its paper, how P errs, its mass and the size of its messages."""
        return Analysis(
            paper="push_sum",
            # Until others hear of its samples, a node counts them as if all nodes had taken them.
            P_by_design=("", "smaller"),
            payload_numbers=push_sum_message_size,
            conserved=mass_terms,
            conserves_despite_loss=self.running_sums,
            stopped=has_frozen,
        )

    @property
    def kernels(self) -> Kernels:  # type: ignore[override]
        """The verbs; by the paper's stop rule a node decides whether to send mass."""
        return DECIDING if not self.asymptotic and self.stop == "paper" else SLOTS

    @property
    def timing(self) -> Timing:
        """Mass once a slot, unless gains are asymptotic, and estimates ``gamma`` times, on links
        that are "fresh" or "held"; nodes may freeze their network estimate after that of mass.
        """
        # gamma is None under clocks, which have no steps.
        steps, held, asymptotic = self.gamma or 1, self.links != "fresh", self.asymptotic
        return Timing(
            schedule=("exchange", "predict", "sense", "exchange"),
            clocks=("nodes",),
            steps=lambda phase: steps if phase == AVERAGE else 1,
            redraws=lambda _, step: step == 0 or not held,
            sends=lambda phase, _: phase == AVERAGE or not asymptotic,
            stopping=MASS if not asymptotic and self.stop != "never" else -1,
        )

    shift = Filter.shift  # averaging weights sum to one

    @property
    def needs(self) -> Needs:
        """Its demands on a scenario."""
        return Needs(
            fixed_sensors=True,
            linear_plant=True,
            every_reading=True,
            awake=True,
            inverts_under_clocks=True,
            one_model=LIMIT if self.asymptotic else "",
            one_model_under_clocks=PARTS,
            memory="whose mass is in all nodes: what one forgets is missing, or counted twice",
            ways_between_all=True,
            samples=True,
            check=self._check_scenario,
            notes=self._scenario_notes,
        )

    def _check_scenario(self, scenario: Any) -> None:
        if not scenario.slotted:
            return
        nodes = scenario.nodes
        if self.leader not in scenario.topology.index:
            ids = ", ".join(map(str, nodes)) if len(nodes) <= 8 else f"{nodes[0]} .. {nodes[-1]}"
            rule, remedy = "must be a node of the graph", f"node ids here are {ids}"
            raise ScenarioError("filter.leader", rule, self.leader, remedy)
        for name in ("gamma", "delta"):
            if getattr(self, name) is None:
                rule = "is missing for a plant in slots"
                raise ScenarioError(f"filter.{name}", rule, None, f"add {name} = ...")
        # Averaging contracts if and only if all eigenvalues of I - L / delta but one lie inside
        # (-1, 1).
        radius = scenario.topology.laplacian_radius
        if self.delta <= 0.5 * radius * (1.0 + 1e-12):
            raise ScenarioError(
                "filter.delta",
                f"must be above rho(L) / 2 = {0.5 * radius:.6g}, or averaging does not contract",
                self.delta,
                f"give more than rho(L) = {radius:.6g}",
            )
        if self.running_sums and self.stop != "never":
            rule = "must be never with running sums, which a node that stops would freeze"
            raise ScenarioError("filter.stop", rule, self.stop, 'write stop = "never"')
        check_information(scenario)
        # P (12) may have no solution, as for an unstable plant that the sensors do not see.
        if self.asymptotic:
            F, Q = scenario.estimated_pieces[0][0]
            self._check_limit(F, Q, scenario.node_infos[0].information)

    def _check_limit(self, F: FloatArray, Q: FloatArray, information: FloatArray) -> None:
        """Raise ScenarioError unless P_inf exists and gives gains to the readings."""
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

    def _scenario_notes(self, scenario: Any) -> tuple[str, ...]:
        if not scenario.slotted:
            fields = dataclasses.fields(self)
            changed_settings = [
                f"filter.{f.name}" for f in fields if getattr(self, f.name) != f.default
            ]
            reason = "not used under clocks, where push-sum keeps running sums"
            unused = (f"{', '.join(changed_settings)}: {reason}",) if changed_settings else ()
            return (*unused, *digit_notes(scenario))
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


def digit_notes(scenario: Any) -> tuple[str, ...]:
    """Return a note where sums keep the information of a P that was nearly singular at first."""
    driven = all(is_definite(Q) for (_, Q), *_ in scenario.estimated_pieces)
    if driven or scenario.singular_start is None:
        return ()
    return (
        "push-sum: P begins singular and the noise does not drive every state, so that the first "
        "rounds tell of so much information that later sums lose digits; give filter.cov",
    )


def corrected_root(root: FloatArray, information: FloatArray) -> FloatArray:
    """Return the root (n, n) of ``(P^-1 + G)^-1``, P (7), for the lower triangular ``root`` (n, n)
    of P, possibly singular, and the information G = ``information`` (n, n).
    """
    n = len(root)
    result, G = (np.array(a, dtype=np.float64).reshape(1, n, n, 1) for a in (root, information))
    _correct_one(np.zeros(n), result, G, np.zeros((n, n, 1)), np.zeros((3, n, 1)))
    return np.asarray(result.reshape(n, n))


@kernel
def _correct_one(
    size: FloatArray, root: FloatArray, information: FloatArray, remainder: FloatArray, work: Any
) -> None:
    correct_root(ONE, size, root, 0, information, (remainder, work[0], work[1], work[2]))


def asymptotic_root(F: FloatArray, Q: FloatArray, information: FloatArray) -> FloatArray | None:
    """Return the root of P_inf (n, n), paper P (12): the steady covariance of a filter with F and Q
    (n, n) that has all the ``information`` (n, n) in each slot, after its reading, or None.
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
    return corrected_root(lower_root(square_root(P)), information)


def _steady_prediction(F: FloatArray, Q: FloatArray, information: FloatArray) -> FloatArray | None:
    """Return the steady predicted covariance by doubling (Chu et al. 2004), or None."""
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
