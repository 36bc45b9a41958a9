"""Consensus plus innovations with optimal gains: Das and Moura, "Consensus+Innovations distributed
Kalman filter with optimized gains", IEEE Trans. Signal Processing 65, 2017.

With ``G = sum_i H_i' R_i^-1 H_i`` of all sensors each node estimates the state x and the
pseudo-state y = G x, of which its pseudo-observation ``H_i' R_i^-1 z_i`` shows a part:

    yhat+ = yhat + sum_l B_il (yhat_l - yhat) + M_i (H_i' R_i^-1 z_i - H_i' R_i^-1 H_i G^+ yhat)
    xhat+ = xhat + K_i (yhat+ - G xhat)

then both are predicted, ``xhat = F xhat+`` and ``yhat = G F (G^+ yhat+ + (I - G^+ G) xhat+)``
(``kernels.pseudo_states`` computes both steps). The gains are those of the Gauss-Markov theorem: B
and M minimise the mean square error of yhat+, and K that of xhat+; where several do, they are those
of least norm (``optimal_gain``). They follow from the joint
covariance of the errors of all nodes, in which nothing depends on data, and which is computed as if
no message were lost and no reading were missing (``GainSequence``). ``pseudo_slots`` simulates many
runs in the compiled engine, in place of the methods of ``ConsensusInnovations``; the types of its
arguments are described in ``kernels.slots``.

The text of the paper was not at hand: its construction (pseudo-states, gains by the Gauss-Markov
theorem) is followed, without the numbers of its equations. The null space of G lies in that of each
``H_i' R_i^-1 H_i``, so that the innovation needs no term in ``(I - G^+ G) xhat``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, ClassVar, NamedTuple

import numpy as np

from netkf.algorithms.filter import Exchange, Filter, Message, NodeInfo, Reading
from netkf.algorithms.kernels.pseudo_states import (
    correct_pseudo,
    correct_state,
    fill_pseudo_innovation,
    predict_pseudo,
    shift_pseudo,
)
from netkf.algorithms.kernels.root_update import lower_root
from netkf.algorithms.kernels.slots import (
    ReadingBlock,
    SlotLinks,
    SlotNodes,
    SlotPlan,
    SlotSamples,
    SlotScratch,
    block_of_reading,
    predict_mean,
    rebase,
    star_of,
    store_sample_of_slot,
    whiten_reading,
)
from netkf.algorithms.registry import built_in
from netkf.linalg.arrays import FloatArray, square_root
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import LANES, ONE, aligned, blocks_of, in_lanes, store

NEGLIGIBLE = 1e-6
"""Standard deviation of a difference, relative to those of its terms, that counts as rounding."""
CONVERGED = 1e-14
"""Relative change of covariances in a slot, of a few roundings, below which gains are constant."""


class Design(NamedTuple):
    """Everything that determines the gains of a network; hashable, as the key of a cache.

    n, nodes : numbers of states and of nodes
    F, Q, cov : matrices (n, n) as bytes; ``cov`` is that of x(0)
    information : H' R^-1 H (N, n, n) of the nodes, as bytes
    heard : for each node the indices of the nodes that it hears
    """

    n: int
    nodes: int
    F: bytes
    Q: bytes
    cov: bytes
    information: bytes
    heard: tuple[tuple[int, ...], ...]


class NodeGains(NamedTuple):
    """The gains of one node in one slot.

    B : (d, n, n) for the d nodes that it hears, in the order of their indices
    M, K : (n, n), of the pseudo-observation in yhat, and of the pseudo-state in xhat
    predicted, root : lower triangular roots (n, n) of the covariance of x - xhat, after the
                      prediction to the slot and at its end
    """

    B: FloatArray
    M: FloatArray
    K: FloatArray
    predicted: FloatArray
    root: FloatArray


class SlotGains(NamedTuple):
    """Gains of all N nodes in K slots, see ``NodeGains``.

    B : (K, W, n, n) of the W directions, by receiver and sender
    M, K, root : (K, N, n, n)
    """

    B: FloatArray
    M: FloatArray
    K: FloatArray
    root: FloatArray


class PseudoStates(NamedTuple):
    """Matrices (n, n) of the pseudo-state ``G x``.

    G : information of all sensors together
    inverse : its pseudo-inverse G^+
    A, coupling : of the prediction ``A yhat + coupling xhat``: ``A = G F G^+`` and
                  ``coupling = G F (I - G^+ G)``
    """

    G: FloatArray
    inverse: FloatArray
    A: FloatArray
    coupling: FloatArray


def pseudo_states(F: FloatArray, information: FloatArray) -> PseudoStates:
    """Return the matrices (n, n) of the pseudo-state ``G x``: G = ``information`` (n, n), that of
    all sensors, its pseudo-inverse, and those of its prediction by the transition F (n, n).
    """
    # Sensors may leave directions unobserved: G is singular then, and G^+ G projects on the others.
    inverse = np.asarray(np.linalg.pinv(information, hermitian=True))
    projector = inverse @ information
    return PseudoStates(
        information,
        inverse,
        information @ F @ inverse,
        information @ F @ (np.eye(len(F)) - projector),
    )


class GainSequence:
    """The gains of all nodes from slot 1 on, computed on demand.

    The errors ``x - xhat_i`` of all N nodes, then ``y - yhat_i``, are linear in independent inputs
    of variance 1 (x(0), plant noise, sensor noise): ``_errors`` (2 N n, inputs) holds the
    coefficients, so that covariances are products of its rows, and differences of nearly equal
    estimates lose no digits.
    """

    def __init__(self, design: Design) -> None:
        """Set the errors at the start of the network of a ``design``; no gain is computed yet."""
        n, N = design.n, design.nodes
        self._n = n
        self._neighbours = design.heard
        self._F = np.frombuffer(design.F).reshape(n, n)
        self._information = np.frombuffer(design.information).reshape(N, n, n)
        self._pseudo = pseudo_states(self._F, self._information.sum(axis=0))
        # Columns of zeros, as of nodes without a sensor, add no noise: leave them out.
        self._noises = [without_zeros(square_root(matrix)) for matrix in self._information]
        # x and w enter all errors of xhat by I, and all errors of yhat by G: (2 N n, n).
        stacked = np.concatenate([np.tile(np.eye(n), (N, 1)), np.tile(self._pseudo.G, (N, 1))])
        # All nodes start from the same mean: only x(0) - mean makes errors, as does w later.
        self._errors = stacked @ square_root(np.frombuffer(design.cov).reshape(n, n))
        self._driven = stacked @ square_root(np.frombuffer(design.Q).reshape(n, n))
        self._gains: list[tuple[NodeGains, ...]] = []
        self._converged = False

    def at(self, slot: int) -> tuple[NodeGains, ...]:
        """Return the gains of each of N nodes in a ``slot``, counted from 1."""
        # Gains do not depend on readings: each slot is computed once.
        while len(self._gains) < slot and not self._converged:
            self._gains.append(self._advance_slot())
            self._converged = len(self._gains) > 1 and self._has_converged(*self._gains[-2:])
        return self._gains[min(slot, len(self._gains)) - 1]

    def table(self, first: int, count: int) -> tuple[np.ndarray, SlotGains]:
        """Return the table rows (count,) of ``count`` slots from number ``first`` on, and the table
        of gains.

        Slots after convergence share one row. Slot 0 gets that of slot 1, since nothing happens in
        it. For the compiled engine.
        """
        slots = np.maximum(np.arange(first, first + count), 1)
        self.at(int(slots[-1]))
        slots = np.minimum(slots, len(self._gains))
        slot_gains = self._gains[slots[0] - 1 : slots[-1]]
        # Flat, slot by slot and node by node: the B of all nodes of a slot become its W directions.
        node_gains = [one for gains in slot_gains for one in gains]
        K, N, n = len(slot_gains), len(self._neighbours), self._n
        B, *other_gains = (
            np.concatenate([getattr(one, name).reshape(-1, n, n) for one in node_gains])
            for name in SlotGains._fields
        )
        table = SlotGains(
            B.reshape(K, -1, n, n), *(part.reshape(K, N, n, n) for part in other_gains)
        )
        return slots - slots[0], table

    @staticmethod
    def _has_converged(before: tuple[NodeGains, ...], now: tuple[NodeGains, ...]) -> bool:
        """Return True if no covariance of any node has changed by more than rounding between the
        gains of two slots, ``before`` and ``now``.
        """
        roots = (np.stack([one.root for one in gains]) for gains in (before, now))
        former, present = (S @ np.swapaxes(S, 1, 2) for S in roots)
        return bool(np.abs(present - former).max() <= CONVERGED * np.abs(present).max())

    def _advance_slot(self) -> tuple[NodeGains, ...]:
        """Advance ``_errors`` (2 N n, inputs) by one slot, and return the gains of each of N nodes
        in it.
        """
        nodes = range(len(self._neighbours))
        self._errors = np.hstack([self._predict(), self._driven])
        predicted = [self._covariance_root(i) for i in nodes]
        # The order of the filter: yhat from the exchange, then xhat from the new yhat.
        gains = self._correct_pseudo_states()
        K = [self._correct_state(i) for i in nodes]
        # Only products of rows matter: QR reduces the inputs to as many as there are rows.
        self._errors = np.asarray(np.linalg.qr(self._errors.T, mode="r")).T
        return tuple(
            NodeGains(B, M, K[i], predicted[i], self._covariance_root(i))
            for i, (B, M) in enumerate(gains)
        )

    def _predict(self) -> FloatArray:
        """Return the errors after F, (2 N n, inputs): those of all xhat, and then of all yhat."""
        # e_x <- F e_x and e_y <- coupling e_x + A e_y, with the plant's noise added by the caller.
        x, y = self._errors.reshape(2, len(self._neighbours), self._n, -1)
        predicted = np.stack([self._F @ x, self._pseudo.coupling @ x + self._pseudo.A @ y])
        return predicted.reshape(self._errors.shape)

    def _state_error(self, i: int) -> FloatArray:
        """Return the error (n, inputs) of the xhat of node ``i``, an index from 0: a view that may
        be written to.
        """
        return self._errors[i * self._n : (i + 1) * self._n]

    def _pseudo_error(self, i: int) -> FloatArray:
        """Return the error (n, inputs) of the yhat of node ``i``, an index from 0."""
        return self._state_error(len(self._neighbours) + i)

    def _covariance_root(self, i: int) -> FloatArray:
        """Return the lower triangular root (n, n) of P of node ``i``, an index from 0."""
        return lower_root(np.ascontiguousarray(self._state_error(i)))

    def _correct_pseudo_states(self) -> list[tuple[FloatArray, FloatArray]]:
        """Correct the errors of all yhat in ``_errors`` at once; return for each node B (d, n, n)
        for the d nodes that it hears, and M (n, n).
        """
        n, N, first = self._n, len(self._neighbours), self._errors.shape[1]
        inputs = sum(noise.shape[1] for noise in self._noises)
        self._errors = np.hstack([self._errors, np.zeros((len(self._errors), inputs))])
        gains, corrected = [], []
        for i, neighbours in enumerate(self._neighbours):
            e = self._pseudo_error(i)
            observed = self._information[i] @ self._pseudo.inverse
            innovation = observed @ e
            # Its noise H' R^-1 v has the covariance H' R^-1 H, in inputs (columns) of its own.
            stop = first + self._noises[i].shape[1]
            innovation[:, first:stop] = self._noises[i]
            first = stop
            # yhat_i is corrected by the differences yhat_l - yhat_i = e_i - e_l to its neighbours'
            # and by the innovation.
            theta = np.concatenate([*(e - self._pseudo_error(j) for j in neighbours), innovation])
            sizes = [variances(e) + variances(self._pseudo_error(j)) for j in neighbours]
            sizes.append(np.square(observed) @ variances(e) + np.diag(self._information[i]))
            gain = optimal_gain(e, theta, np.concatenate(sizes))  # [B_i1, ..., B_id, M_i]
            # All yhat are corrected at once, from those before the exchange.
            corrected.append(e - gain @ theta)
            split = np.stack(np.split(gain, len(neighbours) + 1, axis=1))
            gains.append((split[:-1], split[-1]))
        self._errors[N * n :] = np.concatenate(corrected)
        return gains

    def _correct_state(self, i: int) -> FloatArray:
        """Correct the error of xhat of node ``i`` (an index from 0) in ``_errors`` by
        ``yhat_i - G xhat_i``, which is ``G e - e_y``; return the gain K (n, n).
        """
        G, e, e_y = self._pseudo.G, self._state_error(i), self._pseudo_error(i)
        theta = G @ e - e_y
        K = optimal_gain(e, theta, np.square(G) @ variances(e) + variances(e_y))
        e -= K @ theta
        return K


def without_zeros(matrix: FloatArray) -> FloatArray:
    """Return the columns (n, k) of ``matrix`` (n, n) that are not zero: a root of the same matrix
    with fewer inputs.
    """
    return np.asarray(matrix[:, matrix.any(axis=0)])


def variances(errors: FloatArray) -> FloatArray:
    """Return the variances (k,) of k ``errors`` (k, inputs), given by their coefficients of
    independent inputs with variance 1.
    """
    return np.asarray(np.square(errors).sum(axis=1))


def optimal_gain(e: FloatArray, theta: FloatArray, terms: FloatArray) -> FloatArray:
    """Return the gain ``E[e theta'] E[theta theta']^+`` (n, k) that corrects errors e (n, inputs)
    by differences theta (k, inputs), both given by their coefficients of independent inputs with
    variance 1; ``terms`` (k,) are the sums of the variances of the terms of each difference.

    Where differences depend on each other many gains are optimal, and estimates from which a
    message is missing depend on the choice. It is that of least norm for differences in units of
    the standard deviation of their terms, so that neither units nor the order of states and nodes
    matter. Singular values of these differences up to NEGLIGIBLE count as rounding; around it they
    lose their weight steeply, but without a jump.
    """
    # Relative to its terms the difference of equal estimates is rounding, and counts as 0 below.
    scale = np.divide(1.0, np.sqrt(terms), out=np.zeros_like(terms), where=terms > 0.0)
    # E[e theta'] = e theta' for errors given by independent unit inputs; the pseudo-inverse comes
    # from the singular values of theta, which has half the condition of E[theta theta'].
    U, S, V = np.linalg.svd(scale[:, None] * theta, full_matrices=False)
    # 1 / S for all that is larger than NEGLIGIBLE, and 0 for all that is smaller.
    inverse = S**7 / (S**8 + NEGLIGIBLE**8)
    return np.asarray((e @ V.T * inverse) @ (U.T * scale))


@lru_cache(maxsize=8)
def gain_sequence(design: Design) -> GainSequence:
    """Return the gains of the network of a ``design``, which all of its nodes and runs share; they
    are kept for 8 designs.
    """
    return GainSequence(design)


class PseudoState(NamedTuple):
    """The state of a node.

    xhat, root : estimate (n,) and root (n, n) of its covariance
    model : of the plant and the node's sensors
    yhat : estimate (n,) of the pseudo-state
    pseudo : matrices of pseudo-states
    reading : whitened y (p,) and H (p, n) of this slot, noise variance 1, or None
    slot : number of the slot
    design, node_index : the network and the node's index in it, from which the gains follow
    """

    xhat: FloatArray
    root: FloatArray
    model: Any
    yhat: FloatArray
    pseudo: PseudoStates
    reading: tuple[FloatArray, FloatArray] | None
    slot: int
    design: Design
    node_index: int

    @property
    def P(self) -> FloatArray:
        """The covariance ``root root'`` (n, n) of the estimate."""
        return self.root @ self.root.T

    @property
    def gains(self) -> NodeGains:
        """The node's gains of this slot, from the sequence that all nodes of the design share."""
        return gain_sequence(self.design).at(self.slot)[self.node_index]


class PseudoEstimate(NamedTuple):
    """A payload: the sender's ``yhat`` (n,) and index. G (n, n), which all nodes know, is not sent:
    ``shift_payload`` needs it.
    """

    yhat: FloatArray
    node_index: int
    G: FloatArray


class PseudoArrays(NamedTuple):
    """Arrays of all H nodes for B blocks of L runs.

    pseudo, gains : matrices of pseudo-states, and the gains of the slots being simulated
    table_row : row (S,) of each of the S slots in ``gains``
    yhat : estimates of pseudo-states (B, H, n, L)
    corrected : (H, n, L), scratch
    state, z : (n, L), scratch
    """

    pseudo: PseudoStates
    gains: SlotGains
    table_row: np.ndarray
    yhat: FloatArray
    corrected: FloatArray
    state: FloatArray
    z: FloatArray


@kernel
def pseudo_slots(
    nodes: SlotNodes,
    readings: ReadingBlock,
    plan: SlotPlan,
    links: SlotLinks,
    samples: SlotSamples,
    scratch: SlotScratch,
    arrays: PseudoArrays,
) -> None:
    """Simulate H filters by consensus plus innovations over the S slots of a plan, in B blocks of L
    runs: in each slot they predict, then correct their estimates of the pseudo-state ``G x`` by
    readings and messages, and those of the state by these.

    Changes ``nodes.xhat`` (B, H, n, L), ``nodes.root`` (B, H, n, n, L) and ``arrays.yhat``
    (B, H, n, L) in place and writes ``samples`` in the slots that have one.
    """
    for b in range(plan.up.shape[0]):
        for s in range(plan.up.shape[1]):
            if plan.sensed[s]:
                for h in range(len(nodes.rows)):
                    predict_pseudo(
                        scratch.lanes, nodes.xhat, arrays.yhat, b, h, arrays.pseudo.A,
                        arrays.pseudo.coupling, scratch.moved_mean,
                    )  # fmt: skip
                    predict_mean(nodes, scratch, b, h)
                correct_all(nodes, readings, plan, links, scratch, arrays, b, s)
            store_sample_of_slot(nodes, plan, samples, scratch, b, s)
            # Keep xhat and, alike, yhat relative to an origin near the true state.
            rebase(nodes, readings, scratch, b, s)
            shift_pseudo(scratch.lanes, arrays.yhat, readings, arrays.pseudo.G, b, s)


@kernel
def correct_all(
    nodes: SlotNodes,
    readings: ReadingBlock,
    plan: SlotPlan,
    links: SlotLinks,
    scratch: SlotScratch,
    arrays: PseudoArrays,
    b: int,
    s: int,
) -> None:
    """Correct all H filters of block ``b`` by their readings and messages of slot ``s``: changes
    ``nodes.xhat[b]`` and the estimates ``arrays.yhat[b]`` (H, n, L) of the pseudo-state G x, and
    sets ``nodes.root[b]`` (H, n, n, L) to the roots that belong to the gains.

    Axes: L runs side by side.
    """
    lanes, k = scratch.lanes, arrays.table_row[s]
    # yhat+ of each filter, into ``corrected``: innovation z, then B and M.
    for h in range(len(nodes.rows)):
        fill_pseudo_innovation(
            lanes, arrays.yhat, b, h, nodes.rows[h], arrays.pseudo.inverse, readings, s,
            arrays.state, arrays.z,
        )  # fmt: skip
        correct_pseudo(
            lanes, arrays.yhat, b, h, links, plan.up, s, arrays.gains.B[k], arrays.gains.M[k],
            arrays.z, arrays.corrected,
        )  # fmt: skip
    # yhat <- yhat+ and xhat <- xhat + K (yhat+ - G xhat), only after all filters have used the
    # estimates from before the exchange.
    for h in range(len(nodes.rows)):
        correct_state(
            lanes, nodes.xhat, arrays.yhat, b, h, arrays.gains.K[k], arrays.pseudo.G,
            arrays.corrected, arrays.state,
        )  # fmt: skip
        for i in range(nodes.xhat.shape[2]):
            for j in range(i + 1):
                store(lanes, nodes.root, b, h, i, j, arrays.gains.root[k, h, i, j])


@kernel
def predict_pseudo_single(
    x: FloatArray, y: FloatArray, A: FloatArray, coupling: FloatArray, work: FloatArray
) -> None:
    """Replace the estimate y (1, 1, n, 1) of the pseudo-state G x of one node in one run by its
    prediction ``A y + coupling x``, with the estimate x (1, 1, n, 1) of the state; A and
    ``coupling`` (n, n) as in ``PseudoStates``, ``work`` (n, 1) is scratch.
    """
    predict_pseudo(ONE, x, y, 0, 0, A, coupling, work)


@kernel
def correct_single(
    x: FloatArray,
    readings: ReadingBlock,
    links: SlotLinks,
    up: Any,
    arrays: PseudoArrays,
) -> None:
    """Correct one node in one run by its reading and messages: its estimate x (1, 1, n, 1) and that
    of the pseudo-state, ``arrays.yhat[0, 0]``, are changed in place. The entries 1 to H - 1 of
    ``arrays.yhat`` (1, H, n, 1) are those of its senders, and ``up`` (1, 1, 1, W, 1) flags their
    messages.

    Axes: W directed links. For ``correct_estimates``.
    """
    gains, pseudo = arrays.gains, arrays.pseudo
    y, state, z = arrays.yhat, arrays.state, arrays.z
    fill_pseudo_innovation(ONE, y, 0, 0, readings.y.shape[3], pseudo.inverse, readings, 0, state, z)
    correct_pseudo(ONE, y, 0, 0, links, up, 0, gains.B[0], gains.M[0], z, arrays.corrected)
    correct_state(ONE, x, y, 0, 0, gains.K[0], pseudo.G, arrays.corrected, state)


@built_in("consensus-innovations")
@dataclass(frozen=True, eq=False)
class ConsensusInnovations(Filter):
    """Each node moves its estimate of the pseudo-state towards those of the neighbours and its own
    observation, and its estimate of the state towards that, with gains that are optimal for the
    whole network; all nodes know its sensors and links.

    P is the covariance of the error if no message is lost. A term whose message is lost is left
    out, and P is then too small.
    """

    paper: ClassVar[str] = "consensus_innovations"
    combination: ClassVar[str] = "pseudo-states"
    clocks: ClassVar[tuple[str, ...]] = ()
    one_way: ClassVar[bool] = True
    fixed_sensors: ClassVar[bool] = True
    every_reading: ClassVar[bool] = True
    common_start: ClassVar[bool] = True
    needs_network: ClassVar[bool] = True
    slot_kernel = staticmethod(pseudo_slots)

    def slot_arrays(
        self, states: Sequence[Any], infos: Sequence[NodeInfo], runs: int
    ) -> tuple[PseudoArrays]:
        """Return the arrays of the compiled ``slot_kernel`` for ``runs`` runs of H nodes that start
        in these ``states``: the first pseudo-states (B, H, n, L) in B blocks of L runs, the gains
        of slot 0, and scratch.
        """
        H, n = len(states), len(states[0].xhat)
        yhat = in_lanes(np.stack([state.yhat for state in states]), blocks_of(runs))
        scratch = [aligned(shape) for shape in ((H, n, LANES), (n, LANES), (n, LANES))]
        rows, gains = gain_sequence(states[0].design).table(0, 1)
        return (PseudoArrays(states[0].pseudo, gains, rows, yhat, *scratch),)

    def slot_gains(
        self, states: Sequence[Any], arrays: tuple[Any, ...], first: int, count: int
    ) -> tuple[PseudoArrays]:
        """Return ``arrays`` with the gains of ``count`` slots from number ``first`` on, which
        follow from the network and its start, the ``design`` of all ``states``.
        """
        rows, gains = gain_sequence(states[0].design).table(first, count)
        return (arrays[0]._replace(table_row=rows, gains=gains),)

    def scenario_notes(self, scenario: Any) -> tuple[str, ...]:
        """Return a note for the user where messages of a ``netkf.Scenario`` may be lost, or held
        back by a trigger, which makes P too small; else nothing.
        """
        if scenario.delivers_all and scenario.filter.algorithm is self:
            return ()
        return (
            "consensus-innovations: gains and P count all messages; P is too small where some do "
            "not arrive",
        )

    def payload_numbers(self, n: int, rows: int, phase: int) -> int:
        """Return n, the size of a message in numbers of 64 bits: an estimate of the
        pseudo-state.
        """
        return n

    def init(self, model: Any, mean: FloatArray, cov: FloatArray, node: NodeInfo) -> PseudoState:
        """Return the first state of a node, with estimate ``mean`` (n,) and covariance ``cov``
        (n, n); the node knows the whole network, ``node.network``.
        """
        network = node.network
        assert network is not None
        # Bytes, so that the design can be the key of a cache that all nodes share.
        F, Q, start, information = (
            np.asarray(part, dtype=np.float64).tobytes()
            for part in (model.F, model.Q, cov, network.information)
        )
        size = len(mean), len(network.information)
        design = Design(*size, F, Q, start, information, network.heard)
        pseudo = pseudo_states(model.F, network.information.sum(axis=0))
        root = lower_root(square_root(cov))
        return PseudoState(
            xhat=mean,
            root=root,
            model=model,
            yhat=pseudo.G @ mean,
            pseudo=pseudo,
            reading=None,
            slot=0,
            design=design,
            node_index=node.place,
        )

    def predict(self, state: PseudoState, gap: float) -> PseudoState:
        """Return the state ``gap`` seconds later: the estimates of the state and of the
        pseudo-state are predicted, the root follows from the gains of the new slot, and no reading
        is kept.
        """
        slot, n = state.slot, len(state.xhat)
        xhat, yhat = state.xhat, state.yhat.reshape(1, 1, n, 1).copy()
        # A gap is a whole number of slots. yhat first: it needs the xhat of the same slot.
        for _ in range(round(gap / state.model.period)):
            x = np.array(xhat).reshape(1, 1, n, 1)
            predict_pseudo_single(x, yhat, state.pseudo.A, state.pseudo.coupling, np.empty((n, 1)))
            xhat, slot = state.model.F @ xhat, slot + 1
        state = state._replace(xhat=xhat, yhat=yhat.reshape(n), slot=slot, reading=None)
        return state._replace(root=state.gains.predicted)

    def update(self, state: PseudoState, reading: Reading) -> PseudoState:
        """Return the state with the reading, whitened, kept for the exchange of the slot."""
        if not len(reading.y):
            return state
        return state._replace(reading=whiten_reading(reading.y, reading.H, reading.R))

    def emit(self, state: PseudoState, exchange: Exchange) -> tuple[PseudoState, PseudoEstimate]:
        """Return the state, unchanged, and the payload: the prediction ``yhat`` (n,) of the
        pseudo-state G x.
        """
        return state, PseudoEstimate(state.yhat, state.node_index, state.pseudo.G)

    def absorb(
        self, state: PseudoState, messages: Sequence[Message], exchange: Exchange
    ) -> PseudoState:
        """Return the state of a node at the end of the slot: messages and the node's own reading
        correct its estimate of the pseudo-state, this corrects its estimate of the state, and the
        root of P is the one that follows from the gains of the slot.
        """
        # A lost message takes its gain with it: only the B of senders that were heard are used.
        gains, order = state.gains, state.design.heard[state.node_index]
        senders = [order.index(message.payload.node_index) for message in messages]
        received_gains = gains._replace(B=gains.B[senders])
        received = [message.payload.yhat for message in messages]
        xhat, yhat = correct_estimates(state, received_gains, received)
        return state._replace(xhat=xhat, yhat=yhat, root=gains.root)

    def shift(self, state: PseudoState, offset: FloatArray) -> PseudoState:
        """Return the state for coordinates with another origin, to which engines change: with
        ``offset`` (n,) added to the estimate of the plant's state x, G ``offset`` to that of the
        pseudo-state G x, and H ``offset`` to the reading. Gains multiply differences, and do not
        change.
        """
        reading = state.reading
        if reading is not None:
            y, H = reading
            reading = y + H @ offset, H
        return state._replace(
            xhat=state.xhat + offset, yhat=state.yhat + state.pseudo.G @ offset, reading=reading
        )

    def shift_payload(self, payload: PseudoEstimate, offset: FloatArray) -> PseudoEstimate:
        """Return the payload of a message under way with G ``offset`` added to its pseudo-state,
        for a move of the origin by which states change by ``offset`` (n,).
        """
        return payload._replace(yhat=payload.yhat + payload.G @ offset)


def correct_estimates(
    state: PseudoState, gains: NodeGains, received: Sequence[FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Return the estimates xhat (n,) of the state and yhat (n,) of the pseudo-state of a node after
    an exchange in which it ``received`` the estimates (n,) of pseudo-states; ``gains.B`` (d, n, n)
    holds the gain of each of these d.
    """
    # The kernel takes blocks, nodes and lanes: the node itself is number 0, its senders follow.
    n, y = len(state.xhat), np.stack([state.yhat, *received])[None, :, :, None]
    links, up = star_of([1.0] * len(received))
    readings = block_of_reading(*(state.reading or (np.zeros(0), np.zeros((0, n)))))
    # A table of one slot (K = 1) and one node (N = 1), of which the W links are those received on.
    gain_arrays = SlotGains(*(np.array(getattr(gains, name)) for name in SlotGains._fields))
    table = SlotGains(gain_arrays.B[None], *(part[None, None] for part in gain_arrays[1:]))
    x = np.array(state.xhat).reshape(1, 1, n, 1)
    scratch = np.empty((1, n, 1)), np.empty((n, 1)), np.empty((n, 1))
    arrays = PseudoArrays(state.pseudo, table, np.zeros(1, dtype=np.int64), y, *scratch)
    correct_single(x, readings, links, up, arrays)
    return x.reshape(n), np.ascontiguousarray(y[0, 0, :, 0])
