"""Asynchronous Gaussian belief propagation on the graph of the network.

Each node has a copy of the state, and links say that the copies at their ends are equal. A message
to a neighbour is the sum of the node's own evidence and of that of all its *other* neighbours
(Weiss and Freeman, "Correctness of belief propagation in Gaussian graphical models of arbitrary
topology", Neural Computation 13, 2001). On a tree no reading can arrive on two ways: a node's
belief is the Kalman filter with all readings that have reached it, in any order of the messages.
On a graph with loops readings return to where they came from and count again: P is too small.

Evidence is information about coordinates e of the state ``x = W e``, as a root [Z, z] (n, n + 1)
with Z lower triangular: ``Z (e - c) = z + v``, cov(v) = I, relative to a centre c (n,), so that the
information is ``Z' Z`` and its estimate ``c + Z^-1 z``. Independent pieces add up: their rows are
stacked, and made triangular again.

What is kept is predicted with the plant. Pulled back by the inverse transition, the information
about a mode that decays would soon be so large that the others lose their digits; so W follows the
plant (``modes.ModeFrame``): such modes are those of time 0, and information about them stays as it
is. Where nothing is kept, W is the identity.

The centre is the prediction of the present slot or instant; with the next one, the belief.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from netkf.algorithms.filter import Filter, NodeInfo
from netkf.algorithms.kernels.constant_gains import fill_inverse_transition
from netkf.algorithms.kernels.estimates import copy_vector, transform_root
from netkf.algorithms.kernels.information import clear_part, copy_information_root
from netkf.algorithms.kernels.intersection import finish_lanes, invert_lanes, merge_lanes
from netkf.algorithms.kernels.run import ALL as ALL_RECEIVERS
from netkf.algorithms.kernels.run import carry_mean, predict_estimate, shift_product, shift_vector
from netkf.algorithms.kernels.square_root import lower_root
from netkf.algorithms.models import SlotModel
from netkf.algorithms.modes import ModeFrame, flow_frame, slot_frame, still_frame
from netkf.algorithms.records import Kernels, Record, triangle_numbers
from netkf.algorithms.registry import built_in
from netkf.algorithms.traits import Analysis, Needs, Timing
from netkf.core.errors import ScenarioError
from netkf.core.fields import field, integer, one_of
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import Lanes, load, load_flags, select, spread, store
from netkf.linalg.small import copy_matrix, multiply_square
from netkf.linalg.structs import Size

MAX_STEPS = 10_000
"""Far beyond the diameter of any tree of use: a larger value is a mistake."""
MAX_LOSS = float(np.log(1e6))
"""Largest factor, as a logarithm, by which evidence about some modes may outgrow that of others."""
SLOT, ALL = "slot", "all"
"""Values of ``BeliefPropagation.memory``."""

# A ``part`` is evidence [Z, z] (n, n + 1, L), see ``kernels.information``.


@kernel
def add_part(lanes: Lanes, size: Size, out: FloatArray, part: FloatArray, work: FloatArray) -> None:
    """Add the independent evidence ``part`` to ``out``; ``work`` is scratch of that shape."""
    copy_information_root(lanes, part, work)
    merge_lanes(lanes, size, out, work)


@kernel
def predict_part(
    lanes: Lanes, size: Size, part: FloatArray, back: FloatArray, out: FloatArray, work: FloatArray
) -> None:
    """Predict a part to a later state of a plant without noise, ``Z <- Z back``, with the inverse
    transition ``back`` (n, n); the caller predicts the centre. Two parts are scratch.
    """
    # Z (x - c) = Z back (x+ - c+) for x+ - c+ = back^-1 (x - c); Z back is not triangular, so its
    # rows are merged one by one into a triangular root.
    n = len(part)
    clear_part(lanes, out)
    for k in range(n):
        # Merge row k of [Z back, z], as the last row of a lower triangular root.
        clear_part(lanes, work)
        for j in range(n):
            entry = spread(lanes, 0.0)
            for i in range(k + 1):
                entry += load(lanes, part, k, i) * back[i, j]
            store(lanes, work, n - 1, j, entry)
        store(lanes, work, n - 1, n, load(lanes, part, k, n))
        merge_lanes(lanes, size, out, work)
    copy_information_root(lanes, out, part)


@kernel
def move_part(lanes: Lanes, part: FloatArray, step: FloatArray) -> None:
    """Move the centre of a part by ``step`` (n, L)."""
    n = len(part)
    for i in range(n):
        mean = load(lanes, part, i, n)
        # Z (x - c - step) = Z (x - c) - Z step.
        for j in range(i + 1):
            mean -= load(lanes, part, i, j) * load(lanes, step, j)
        store(lanes, part, i, n, mean)


@kernel
def set_growing(record: Any, lanes: Lanes, centre: FloatArray, x: FloatArray) -> None:
    """Set the entries of a centre e (n, L) that are of the present, those of growing modes, to
    those of the state ``x`` (n, L); the others are of time 0 (``modes.ModeFrame``).
    """
    for i in range(record.growing):
        total = spread(lanes, 0.0)
        for j in range(len(record.inverse)):
            total += record.inverse[i, j] * load(lanes, x, j)
        store(lanes, centre, i, total)


@kernel
def fill_transition(record: Any, generator: FloatArray, gap: float) -> None:
    """Write the transition over ``gap`` seconds, in slots one slot, into ``record.maps[0]``; under
    clocks that of ``-generator`` (n, n).
    """
    if record.clocked == 1:
        fill_inverse_transition(generator, generator, gap, record.maps)
    else:
        copy_matrix(record.maps[0], generator)


@kernel
def read_frame(record: Any, h: int) -> None:
    """Copy W of node ``h``, the same in all lanes, to ``record.W``; it is I if nothing is kept."""
    n = len(record.W)
    for i in range(n if record.keeps == 1 else 0):
        for j in range(n):
            record.W[i, j] = record.frame[h, i, j, 0]


@kernel
def predict(record: Any, h: int, run: Any) -> None:
    """Predict the belief, and the evidence if messages are kept; else the predicted belief is the
    prior, and all other evidence is dropped.
    """
    lanes, n, first, stop = run.lanes, len(run.size), run.first[h], run.first[h + 1]
    if record.keeps == 1:
        move_evidence(record, h, run)
    predict_estimate(run.model, run, record.xhat, record.root, h, h)
    copy_vector(lanes, run.size, record.base, h, record.xhat, h, True)
    set_growing(record, lanes, record.centre[h], record.base[h])
    if record.keeps == 0:
        # Relative to itself the prediction is [S^-1, 0] for P = S S'.
        clear_part(lanes, record.prior[h])
        invert_lanes(lanes, run.size, record.prior, h, record.root, h)
        clear_part(lanes, record.own[h])
        for w in range(first, stop):
            clear_part(lanes, record.received[w])
        return
    if record.growing < n:
        read_frame(record, h)
        fill_transition(record, record.forward, run.gap)
        multiply_square(record.W, record.maps[1], record.W, record.maps[0])
        for i in range(n):
            for j in range(n):
                store(lanes, record.frame, h, i, j, record.maps[1, i, j])
    if record.growing > 0:
        # The inverse transition of the modes that grow.
        fill_transition(record, record.back, run.gap)
        back = record.maps[0]
        predict_part(lanes, run.size, record.prior[h], back, run.total, run.whitened)
        predict_part(lanes, run.size, record.own[h], back, run.total, run.whitened)
        for w in range(first, stop):
            predict_part(lanes, run.size, record.received[w], back, run.total, run.whitened)
    if record.clocked == 1:
        record.elapsed[h, 0] += run.gap


@kernel
def move_evidence(record: Any, h: int, run: Any) -> None:
    """Make the belief of node ``h`` the centre of its evidence."""
    lanes, step = run.lanes, record.step[h]
    move_part(lanes, record.prior[h], step)
    move_part(lanes, record.own[h], step)
    for w in range(run.first[h], run.first[h + 1]):
        move_part(lanes, record.received[w], step)
    for i in range(len(run.size)):
        moved = load(lanes, record.centre, h, i) + load(lanes, step, i)
        store(lanes, record.centre, h, i, moved)
        store(lanes, step, i, 0.0)


@kernel
def update(record: Any, h: int, run: Any) -> None:
    """Add the reading of node ``h`` to its own evidence: the rows ``[H W, y - H base]``. In slots
    the belief follows after the exchange.
    """
    lanes, n, r, W, work = run.lanes, len(run.size), run.reading, record.W, run.whitened
    y, matrix = run.first_y + r, run.first_H + run.matrix[r]
    read_frame(record, h)
    for k in range(run.rows[r]):
        # Merge one row, as the last row of a lower triangular root.
        clear_part(lanes, work)
        innovation = load(lanes, run.y, y, k)
        for j in range(n):
            innovation -= load(lanes, run.H, matrix, k, j) * load(lanes, record.base, h, j)
            entry = spread(lanes, 0.0)
            for i in range(n):
                entry += load(lanes, run.H, matrix, k, i) * W[i, j]
            store(lanes, work, n - 1, j, entry)
        store(lanes, work, n - 1, n, innovation)
        merge_lanes(lanes, run.size, record.own[h], work)
    if record.clocked == 1:
        believe(record, h, run)


@kernel
def believe(record: Any, h: int, run: Any) -> None:
    """Compute the belief of node ``h`` from its prior and all evidence."""
    # From all evidence, and not as an update of the old belief: on an unstable plant the old one
    # may be so far off that digits are lost.
    lanes, n, total, work, W = run.lanes, len(run.size), run.total, run.whitened, record.W
    copy_information_root(lanes, record.prior[h], total)
    add_part(lanes, run.size, total, record.own[h], work)
    for w in range(run.first[h], run.first[h + 1]):
        add_part(lanes, run.size, total, record.received[w], work)
    if record.keeps == 0:
        # root = Z^-1 and xhat = base + Z^-1 z in all lanes (False: none keeps its estimate).
        finish_lanes(lanes, run.size, record.root, record.xhat, h, record.base, total, work, False)
        return
    step = record.step
    for i in range(n):
        store(lanes, step, h, i, 0.0)
    finish_lanes(lanes, run.size, record.root, step, h, step, total, work, False)
    # root = W Z^-1, made triangular, and xhat = base + W Z^-1 z.
    read_frame(record, h)
    for i in range(n):
        moved = load(lanes, record.base, h, i)
        for j in range(n):
            moved += W[i, j] * load(lanes, step, h, j)
        store(lanes, record.xhat, h, i, moved)
    transform_root(lanes, run.size, record.root, h, W, record.zeros, (run.moved, run.noise))


@kernel
def emit(record: Any, h: int, m: int, run: Any) -> None:
    """Send each neighbour the sum of the evidence of node ``h``, its own and that of all other
    neighbours: what came from the receiver would count twice.
    """
    lanes, evidence, work = run.lanes, record.payload.evidence, run.whitened
    first, stop = run.first[h], run.first[h + 1]
    if run.receiver != ALL_RECEIVERS:
        write_centre(record, h, m, run)
        copy_information_root(lanes, record.own[h], evidence[m])
        for w in range(first, stop):
            if w != run.receiver:
                add_part(lanes, run.size, evidence[m], record.received[w], work)
        return
    D = stop - first
    for k in range(D + 1):
        write_centre(record, h, m + k, run)
        copy_information_root(lanes, record.own[h], evidence[m + k])
    if record.keeps == 0 and run.step == 0:
        # Nothing was received so far.
        return
    # The sum without link k is a prefix sum plus a suffix sum: nothing is subtracted.
    suffix, prefix = record.suffix, evidence[m + D]
    for k in range(D - 1, 0, -1):
        copy_information_root(lanes, record.received[first + k], suffix[k])
        if k < D - 1:
            add_part(lanes, run.size, suffix[k], suffix[k + 1], work)
    for k in range(D):
        copy_information_root(lanes, prefix, evidence[m + k])
        if k < D - 1:
            add_part(lanes, run.size, evidence[m + k], suffix[k + 1], work)
        add_part(lanes, run.size, prefix, record.received[first + k], work)


@kernel
def write_centre(record: Any, h: int, m: int, run: Any) -> None:
    """Write the centre of the evidence of node ``h`` into payload ``m``, as a state and as an e."""
    copy_vector(run.lanes, run.size, record.payload.xhat, m, record.base, h, True)
    copy_vector(run.lanes, run.size, record.payload.centre, m, record.centre, h, True)


@kernel
def absorb(record: Any, h: int, run: Any) -> None:
    """Replace the evidence of each sender by that of its message, unless the one that node ``h``
    has was sent later, and compute the belief, in slots after the last step.
    """
    for k in range(run.count):
        m, w = run.message[k], run.link[k]
        if record.clocked == 1:
            # Messages may overtake each other: an older one holds nothing that the newer lacks.
            sent = max(record.elapsed[h, 0] - run.age[k], 0.0)
            if record.heard_at[w, 0] > sent:
                continue
            record.heard_at[w, 0] = sent
            predict_message(record, m, run, run.age[k])
        replace_evidence(record, h, m, w, run, load_flags(run.lanes, run.arrived, k))
    if record.clocked == 1 or run.step == record.steps - 1:
        believe(record, h, run)


@kernel
def predict_message(record: Any, m: int, run: Any, age: float) -> None:
    """Predict payload ``m``, sent ``age`` seconds ago, to now."""
    payload, lanes = record.payload, run.lanes
    carry_mean(run.model, run, payload.xhat, m, age)
    if age > 0.0 and record.growing > 0:
        fill_transition(record, record.back, age)
        predict_part(lanes, run.size, payload.evidence[m], record.maps[0], run.total, run.whitened)
    set_growing(record, lanes, payload.centre[m], payload.xhat[m])


@kernel
def replace_evidence(record: Any, h: int, m: int, w: int, run: Any, arrived: Any) -> None:
    """Replace the evidence received on link ``w`` by that of payload ``m``, relative to the centre
    of node ``h``, in the lanes in which it has ``arrived``.
    """
    lanes, n, received = run.lanes, len(run.size), record.received
    evidence, before, after = record.payload.evidence, record.payload.centre, record.centre
    for i in range(n):
        mean = load(lanes, evidence, m, i, n)
        # Z (x - c') = Z (x - c) + Z (c - c').
        for j in range(i + 1):
            entry = load(lanes, evidence, m, i, j)
            mean += entry * (load(lanes, before, m, j) - load(lanes, after, h, j))
            former = load(lanes, received, w, i, j)
            store(lanes, received, w, i, j, select(arrived, entry, former))
        former = load(lanes, received, w, i, n)
        store(lanes, received, w, i, n, select(arrived, mean, former))


@kernel
def shift(record: Any, h: int, run: Any) -> None:
    """Move the estimate and the centre of evidence: evidence is relative to it."""
    shift_vector(run, record.xhat, h)
    shift_vector(run, record.base, h)
    set_growing(record, run.lanes, record.centre[h], record.base[h])


@kernel
def shift_payload(record: Any, m: int, run: Any) -> None:
    """Move the centre in payload ``m``, as a state and, which may have been rounded, as an e."""
    shift_vector(run, record.payload.xhat, m)
    shift_product(run, record.inverse, record.growing, record.payload.centre, m)


def belief_propagation_record(
    filtering: BeliefPropagation, infos: Sequence[NodeInfo], models: Sequence[Any]
) -> Record:
    """Return what a node knows: evidence ``prior``, ``own`` and ``received`` by link, relative
    to the state ``base``, as an e ``centre``. Where messages are kept, ``frame`` is W, ``step``
    the way from the centre to the belief, as an e, ``heard_at`` the time ``elapsed`` at which
    the evidence of a link was sent.
    """
    n, model, keeps = len(models[0].information), models[0], filtering._keeps(models[0])
    frame, clocked = filtering._frame(model), not isinstance(model, SlotModel)
    # Exponentials are computed of generators with a minus.
    sign = -1.0 if clocked else 1.0
    part, kept = (n, n + 1), n if keeps else 0
    node = {"prior": part, "own": part, "base": (n,), "centre": (n,)}
    return Record(
        node={**node, "frame": (kept, kept), "step": (kept,), "elapsed": ()},
        link={"received": part, "heard_at": ()},
        payload={"evidence": part, "xhat": (n,), "centre": (n,)},
        numbers={"evidence": triangle_numbers(n, 1)[0]},
        scratch={"suffix": (1 + max(info.degree for info in infos), *part)},
        settings={
            "steps": filtering.steps,
            "keeps": int(keeps),
            "clocked": int(clocked),
            "growing": frame.growing,
            "inverse": np.ascontiguousarray(frame.inverse),
            "forward": np.ascontiguousarray(sign * frame.forward),
            "back": np.ascontiguousarray(sign * frame.back),
            "W": np.eye(n),
            "zeros": np.zeros((n, n)),
            "maps": np.zeros((3, n, n)),
        },
    )


def begin_belief_propagation(
    filtering: BeliefPropagation, node: Mapping[str, np.ndarray], _info: NodeInfo, model: Any
) -> None:
    """Begin with a prior only: nothing was read or heard."""
    frame = filtering._frame(model)
    node["base"][:], node["centre"][:] = node["xhat"], frame.inverse @ node["xhat"]
    if not filtering._keeps(model):
        # The first prediction writes the prior; before it P may be singular.
        return
    # [Z, 0] with Z' Z = W' P^-1 W, both triangles turned round for a lower Z.
    weighted = np.linalg.solve(node["root"], frame.basis)
    node["prior"][:, :-1] = lower_root(weighted.T[::-1]).T[::-1, ::-1]
    node["frame"][:] = frame.basis


MODES = (
    "whose evidence that lasts is kept in coordinates of the modes of one plant: in others those "
    "that have decayed would mix with the rest, and lose their digits"
)


@built_in("belief-propagation")
@dataclass(frozen=True, eq=False)
class BeliefPropagation(Filter):
    """Nodes send each neighbour the sum of their own evidence and of that of all other neighbours.

    steps   messages on each directed link in a slot; with as many as the diameter of the tree, and
            no losses, every node has the estimate of the central filter
    memory  "slot": messages are about the readings of one slot, and what a node then believes is
            its prior of the next one; "all": about all readings so far, for plants without process
            noise. Under clocks always as with "all"

    On a tree P is the covariance of the error for whatever is lost, late or out of order; with
    loops it is too small. With process noise, which enters them all, messages about older readings
    would no longer be independent, and must not be kept.
    """

    steps: int = field(integer(low=1, high=MAX_STEPS), default=1)
    memory: str = field(one_of(SLOT, ALL), default=SLOT)

    analysis = Analysis(paper="belief_propagation")
    kernels = Kernels(
        predict=predict, update=update, emit=emit, absorb=absorb, shift=shift,
        shift_payload=shift_payload, addressed=True, record=belief_propagation_record,
        begin=begin_belief_propagation,
    )  # fmt: skip

    def _keeps(self, model: Any) -> bool:
        """Return whether messages are kept from slot to slot, or under clocks."""
        return not isinstance(model, SlotModel) or self.memory == ALL

    def _frame(self, model: Any) -> ModeFrame:
        if not isinstance(model, SlotModel):
            return flow_frame(model.A)
        return slot_frame(model.F) if self.memory == ALL else still_frame(len(model.F))

    @property
    def timing(self) -> Timing:
        """The only exchange of a slot has ``steps`` steps."""
        return Timing(steps=lambda _: self.steps)

    @property
    def needs(self) -> Needs:
        """Its demands on a scenario."""
        return Needs(
            one_way=True,
            samples=True,
            inverts=True,
            linear_plant=self.memory == ALL,
            one_model=MODES if self.memory == ALL else "",
            one_model_under_clocks=MODES,
            check=self._check_scenario,
            notes=self._scenario_notes,
        )

    def _check_scenario(self, scenario: Any) -> None:
        """Raise ScenarioError where messages that are kept depend on each other, or lose digits."""
        if scenario.slotted and self.memory == SLOT:
            return
        key, (A, Q) = "Q" if scenario.slotted else "B", scenario.estimated_pieces[0][0]
        # Process noise that two messages share would count as independent evidence.
        if Q.any():
            slots = 'memory = "slot"'
            raise ScenarioError(
                f"plant.{key}",
                "must be zero where belief propagation keeps messages: process noise enters all of "
                "them, and they would not be independent",
                float(np.abs(Q).max()),
                f"write {slots}" if scenario.slotted else f"use a plant in slots with {slots}",
            )
        key = "F" if scenario.slotted else "A"
        frame = slot_frame(A) if scenario.slotted else flow_frame(A)
        steps = scenario.horizon / (scenario.slot_plant.period if scenario.slotted else 1.0)
        if frame.excess * steps > MAX_LOSS:
            raise ScenarioError(
                f"plant.{key}",
                "has modes that grow and modes that decay in nearly one direction, between which "
                "evidence that is kept loses its digits",
                A.tolist(),
                f"use a horizon below {MAX_LOSS / frame.excess * scenario.horizon / steps:.3g}",
            )

    def _scenario_notes(self, scenario: Any) -> tuple[str, ...]:
        """Return a note where the graph of a ``netkf.Scenario`` has loops: P is too small."""
        if is_forest(scenario):
            return ()
        return (
            "belief-propagation: the graph has loops, on which readings return and count again; P "
            "is too small",
        )

    shift = Filter.shift  # evidence is relative to the belief


def is_forest(scenario: Any) -> bool:
    """Return True if the links of a ``netkf.Scenario``, whatever their directions, form no loop;
    then the P of belief propagation is right.
    """
    topology = scenario.topology
    # A graph is a forest if and only if it has as many links as nodes less components.
    pairs = {frozenset(link) for link in topology.directions}
    return len(pairs) == len(topology.nodes) - len(topology.components)
