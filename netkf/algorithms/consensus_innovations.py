"""Consensus plus innovations with optimal gains: Das and Moura, "Consensus+Innovations distributed
Kalman filter with optimized gains", IEEE Trans. Signal Processing 65, 2017.

With ``G = sum_i H_i' R_i^-1 H_i`` of all sensors each node estimates the state x and the
pseudo-state y = G x, of which its pseudo-observation ``H_i' R_i^-1 z_i`` shows a part:

    yhat+ = yhat + sum_l B_il (yhat_l - yhat) + M_i (H_i' R_i^-1 z_i - H_i' R_i^-1 H_i G^+ yhat)
    xhat+ = xhat + K_i (yhat+ - G xhat)

then both are predicted, ``xhat = F xhat+`` and ``yhat = G F (G^+ yhat+ + (I - G^+ G) xhat+)``. The
gains are those of the Gauss-Markov theorem: B
and M minimise the mean square error of yhat+, and K that of xhat+; where several do, they are those
of least norm (``optimal_gain``). They follow from the joint
covariance of the errors of all nodes, in which nothing depends on data, and which is computed as if
no message were lost and no reading were missing (``GainSequence``).

The text of the paper was not at hand: its construction (pseudo-states, gains by the Gauss-Markov
theorem) is followed, without the numbers of its equations. The null space of G lies in that of each
``H_i' R_i^-1 H_i``, so that the innovation needs no term in ``(I - G^+ G) xhat``.
"""

from __future__ import annotations

import bisect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from netkf.algorithms.filter import Filter, NodeInfo
from netkf.algorithms.kernels.estimates import copy_vector, transform_mean
from netkf.algorithms.kernels.run import absorb as nothing
from netkf.algorithms.kernels.run import shift_product, shift_vector, write_innovation
from netkf.algorithms.kernels.square_root import lower_root
from netkf.algorithms.records import Kernels, Record
from netkf.algorithms.registry import built_in
from netkf.algorithms.traits import Analysis, Needs, Timing
from netkf.linalg.arrays import FloatArray, cached_by_entries, square_root
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import load, load_flags, select, spread, store

NEGLIGIBLE = 1e-6
"""Standard deviation of a difference, relative to those of its terms, that counts as rounding."""
UNSEEN = 1e-32
"""Information about a component of the state, relative to the largest, that counts as 0."""
CONVERGED = 1e-14
"""Relative change of covariances in a slot, of a few roundings, below which gains are constant."""


class ConsensusGains(NamedTuple):
    """The gains of one node in one slot; or of N nodes in K slots, with W directions by receiver
    and sender.

    B : (d, n, n) for the d nodes that it hears, in the order of their indices; or (K, W, n, n)
    M, K : (n, n), of the pseudo-observation in yhat, and of the pseudo-state in xhat; or
           (K, N, n, n), as is ``root``
    root : lower triangular root (n, n) of the covariance of x - xhat at the end of the slot
    """

    B: FloatArray
    M: FloatArray
    K: FloatArray
    root: FloatArray


def pseudo_inverse(information: FloatArray) -> FloatArray:
    """Return a pseudo-inverse of G = ``information`` (n, n), that of all sensors, of pseudo-states
    ``G x``: the one of least norm in units in which the diagonal of G is 1.
    """
    # Sensors may leave directions unobserved: G is singular then, and G^+ G projects on the others.
    # Which ones must not depend on the units of states; any generalised inverse serves.
    sizes = np.diagonal(information)
    units = np.sqrt(np.where(sizes > UNSEEN * sizes.max(), sizes, 1.0))
    units = units[:, None] * units
    return np.asarray(np.linalg.pinv(information / units, hermitian=True) / units)


class GainSequence:
    """The gains of all nodes from slot 1 on, computed on demand.

    The errors ``x - xhat_i`` of all N nodes, then ``y - yhat_i``, are linear in independent inputs
    of variance 1 (x(0), plant noise, sensor noise): ``_errors`` (2 N n, inputs) holds the
    coefficients, so that covariances are products of its rows, and differences of nearly equal
    estimates lose no digits.
    """

    def __init__(
        self,
        F: FloatArray,
        Q: FloatArray,
        cov: FloatArray,
        information: FloatArray,
        heard: tuple[tuple[int, ...], ...],
        changes: Sequence[int],
    ) -> None:
        """Set the errors at the start of a network: ``F`` and ``Q`` (S, n, n) are those of the
        pieces of the plant before and after each of the ``changes`` (slots), ``cov`` (n, n) is the
        covariance of x(0); ``information`` and ``heard`` are those of ``NetworkInfo``.
        """
        self._F, self._changes = F, changes
        self._n, self._neighbours, self._information = len(cov), heard, information
        n, N = self._n, len(heard)
        self._G = information.sum(axis=0)
        self._inverse = pseudo_inverse(self._G)
        # Columns of zeros, as of nodes without a sensor, add no noise: leave them out.
        roots = map(square_root, self._information)
        self._noises = [root[:, root.any(axis=0)] for root in roots]
        # x and w enter all errors of xhat by I, and all errors of yhat by G: (2 N n, n).
        stacked = np.concatenate([np.tile(np.eye(n), (N, 1)), np.tile(self._G, (N, 1))])
        # All nodes start from the same mean: only x(0) - mean makes errors, as does w later.
        self._errors = stacked @ square_root(cov)
        self._driven = [stacked @ square_root(one) for one in Q]
        self._gains: list[tuple[ConsensusGains, ...]] = []
        self._converged = False

    def at(self, slot: int) -> tuple[ConsensusGains, ...]:
        """Return the gains of each of N nodes in a ``slot``, counted from 1."""
        # Gains do not depend on readings: each slot is computed once.
        while len(self._gains) < slot and not self._converged:
            self._gains.append(self._predict_errors())
            if len(self._gains) > 1 + max(self._changes, default=0):
                roots = (np.stack([one.root for one in gains]) for gains in self._gains[-2:])
                former, present = (S @ np.swapaxes(S, 1, 2) for S in roots)
                change = np.abs(present - former).max()
                self._converged = bool(change <= CONVERGED * np.abs(present).max())
        return self._gains[min(slot, len(self._gains)) - 1]

    def table(
        self, first: int, count: int, places: Sequence[int]
    ) -> tuple[np.ndarray, ConsensusGains]:
        """Return the table rows (count,) of ``count`` slots from number ``first`` on, and the table
        of the gains of the nodes with the indices ``places``.

        Slots after convergence share one row. Slot 0 gets that of slot 1: nothing happens in it.
        """
        slots = np.maximum(np.arange(first, first + count), 1)
        self.at(int(slots[-1]))
        slots = np.minimum(slots, len(self._gains))
        slot_gains = self._gains[slots[0] - 1 : slots[-1]]
        # Flat, slot by slot and node by node: the B of all nodes of a slot become its W directions.
        node_gains = [gains[place] for gains in slot_gains for place in places]
        K, N, n = len(slot_gains), len(places), self._n
        B, *other_gains = (
            np.concatenate([getattr(one, name).reshape(-1, n, n) for one in node_gains])
            for name in ConsensusGains._fields
        )
        table = ConsensusGains(
            B.reshape(K, -1, n, n), *(part.reshape(K, N, n, n) for part in other_gains)
        )
        return slots - slots[0], table

    def _predict_errors(self) -> tuple[ConsensusGains, ...]:
        nodes = range(len(self._neighbours))
        x, y = self._errors.reshape(2, len(nodes), self._n, -1)
        # Slot number k is predicted from k - 1 on.
        piece = bisect.bisect_right(self._changes, len(self._gains))
        F, G, inverse = self._F[piece], self._G, self._inverse
        predicted = np.stack([F @ x, G @ (F @ (inverse @ y + x - inverse @ (G @ x)))])
        self._errors = np.hstack([predicted.reshape(self._errors.shape), self._driven[piece]])
        # The order of the filter: yhat from the exchange, then xhat from the new yhat.
        gains = self._correct_pseudo_states()
        K = [self._correct_state(i) for i in nodes]
        # Only products of rows matter: QR reduces the inputs to as many as there are rows.
        self._errors = np.asarray(np.linalg.qr(self._errors.T, mode="r")).T
        roots = [lower_root(np.ascontiguousarray(self._state_error(i))) for i in nodes]
        return tuple(ConsensusGains(B, M, K[i], roots[i]) for i, (B, M) in enumerate(gains))

    def _state_error(self, i: int) -> FloatArray:
        """Return the error (n, inputs) of the xhat of node ``i``: a view to write to."""
        return self._errors[i * self._n : (i + 1) * self._n]

    def _pseudo_error(self, i: int) -> FloatArray:
        """Return the error (n, inputs) of the yhat of node ``i``, an index from 0."""
        return self._state_error(len(self._neighbours) + i)

    def _correct_pseudo_states(self) -> list[tuple[FloatArray, FloatArray]]:
        n, N, first = self._n, len(self._neighbours), self._errors.shape[1]
        inputs = sum(noise.shape[1] for noise in self._noises)
        self._errors = np.hstack([self._errors, np.zeros((len(self._errors), inputs))])
        gains, corrected = [], []
        for i, neighbours in enumerate(self._neighbours):
            e = self._pseudo_error(i)
            observed = self._information[i] @ self._inverse
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
        """Correct the error of xhat of node ``i``, and return the gain K (n, n)."""
        G, e, e_y = self._G, self._state_error(i), self._pseudo_error(i)
        theta = G @ e - e_y
        K = optimal_gain(e, theta, np.square(G) @ variances(e) + variances(e_y))
        e -= K @ theta
        return K


def variances(errors: FloatArray) -> FloatArray:
    """Return the variances (k,) of ``errors`` (k, inputs), linear in independent unit inputs."""
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


gain_sequence = cached_by_entries(8)(GainSequence)
"""The gains of a network, which all of its nodes and runs share."""


@kernel
def predict(record: Any, h: int, run: Any) -> None:
    """Predict the estimates of node ``h``, of the pseudo-state and of the state; the root follows
    from the gains.
    """
    lanes, x, y, F, inverse = run.lanes, record.xhat, record.pseudo, run.model.F, record.inverse
    # y - G x, of which G^+ is a difference of states.
    write_matvec(run, record.G, x, h, run.gains)
    for i in range(len(run.size)):
        store(lanes, run.gains, i, load(lanes, y, h, i) - load(lanes, run.gains, i))
    for i in range(len(run.size)):
        total = load(lanes, x, h, i)
        for j in range(len(run.size)):
            total += inverse[i, j] * load(lanes, run.gains, j)
        store(lanes, y, h, i, total)
    transform_mean(lanes, run.size, y, h, F, run.moved_mean)
    transform_mean(lanes, run.size, y, h, record.G, run.moved_mean)
    transform_mean(lanes, run.size, x, h, F, run.moved_mean)


@kernel
def write_matvec(run: Any, matrix: FloatArray, x: FloatArray, k: int, out: FloatArray) -> None:
    """Write the product of a ``matrix`` (n, n) and ``x[k]`` into ``out`` (n, L)."""
    for i in range(len(run.size)):
        total = spread(run.lanes, 0.0)
        for j in range(len(run.size)):
            total += matrix[i, j] * load(run.lanes, x, k, j)
        store(run.lanes, out, i, total)


@kernel
def emit(record: Any, h: int, m: int, run: Any) -> None:
    """Send the estimate of the pseudo-state."""
    copy_vector(run.lanes, run.size, record.payload.pseudo, m, record.pseudo, h, True)


@kernel
def absorb(record: Any, h: int, run: Any) -> None:
    """Correct the estimate of the pseudo-state by messages and the own reading, and that of the
    state by it: ``yhat+ = yhat + sum_l B_l (yhat_l - yhat) + M z`` and
    ``xhat+ = xhat + K (yhat+ - G xhat)``. A lost message takes its gain with it.
    """
    lanes, n, x, y = run.lanes, len(run.size), record.xhat, record.pseudo
    t, corrected = record.table_row[run.slot - record.first_slot], run.moved_mean
    # The pseudo-innovation ``H' R^-1 (reading - H G^+ yhat)``.
    write_matvec(run, record.inverse, y, h, run.row)
    write_innovation(run, run.row, run.gains)
    for i in range(n):
        total = load(lanes, y, h, i)
        for j in range(n):
            total += record.M[t, h, i, j] * load(lanes, run.gains, j)
        store(lanes, corrected, i, total)
    for k in range(run.count):
        w, m, arrived = run.link[k], run.message[k], load_flags(lanes, run.arrived, k)
        for i in range(n):
            total = spread(lanes, 0.0)
            for j in range(n):
                heard = load(lanes, record.payload.pseudo, m, j)
                total += record.B[t, w, i, j] * (heard - load(lanes, y, h, j))
            store(lanes, corrected, i, load(lanes, corrected, i) + select(arrived, total, 0.0))
    for i in range(n):
        total = load(lanes, corrected, i)
        store(lanes, y, h, i, total)
        for j in range(n):
            total -= record.G[i, j] * load(lanes, x, h, j)
        store(lanes, run.row, i, total)
    for i in range(n):
        total = load(lanes, x, h, i)
        for j in range(n):
            total += record.K[t, h, i, j] * load(lanes, run.row, j)
            if j <= i:
                store(lanes, record.root, h, i, j, record.roots[t, h, i, j])
        store(lanes, x, h, i, total)


@kernel
def shift(record: Any, h: int, run: Any) -> None:
    """Move the estimates of state and pseudo-state: gains multiply differences."""
    shift_vector(run, record.xhat, h)
    shift_product(run, record.G, len(run.size), record.pseudo, h)


@kernel
def shift_payload(record: Any, m: int, run: Any) -> None:
    """Move the pseudo-state in payload ``m``."""
    shift_product(run, record.G, len(run.size), record.payload.pseudo, m)


def consensus_innovations_record(
    _: Any, infos: Sequence[NodeInfo], models: Sequence[Any]
) -> Record:
    """Return pseudo-states of nodes and messages, their matrices, and room for gains."""
    network = infos[0].network
    assert network is not None
    n, H = len(models[0].information), len(infos)
    G = network.information.sum(axis=0)
    pieces = getattr(models[0], "pieces", models[:1])
    return Record(
        node={"pseudo": (n,), "start": (n, n)},
        payload={"pseudo": (n,)},
        settings={
            "G": G,
            "inverse": np.ascontiguousarray(pseudo_inverse(G)),
            "B": np.zeros((1, 1, n, n)),
            **{name: np.zeros((1, H, n, n)) for name in ("M", "K", "roots")},
            "F": np.array([piece.F for piece in pieces]),
            "Q": np.array([piece.Q for piece in pieces]),
            "changes": np.array(getattr(models[0], "slots", ()), dtype=np.int64),
            "table_row": np.zeros(1, dtype=np.int64),
            "first_slot": -1,
        },
    )


def begin_consensus_innovations(
    _: Any, node: Mapping[str, np.ndarray], info: NodeInfo, _model: Any
) -> None:
    """Set the first pseudo-state, and keep the covariance from which gains follow."""
    assert info.network is not None
    node["pseudo"][:] = info.network.information.sum(axis=0) @ node["xhat"]
    node["start"][:] = node["root"] @ node["root"].T


def prepare_consensus_innovations(
    _: Any, record: Any, infos: Sequence[NodeInfo], _models: Any, first: int, count: int
) -> None:
    """Set the gains of the slots, which follow from the network and its start."""
    network = infos[0].network
    assert network is not None
    if record.first_slot == first and len(record.table_row) == count:
        return
    matrices = record.F, record.Q, record.start[0, ..., 0]
    changes = tuple(record.changes.tolist())
    sequence = gain_sequence(*matrices, network.information, network.heard, changes)
    record.table_row, gains = sequence.table(first, count, [info.place for info in infos])
    record.B, record.M, record.K, record.roots = map(np.ascontiguousarray, gains)
    record.first_slot = first


@built_in("consensus-innovations")
@dataclass(frozen=True, eq=False)
class ConsensusInnovations(Filter):
    """Each node moves its estimate of the pseudo-state towards those of the neighbours and its own
    observation, and its estimate of the state towards that, with gains that are optimal for the
    whole network; all nodes know its sensors and links.

    P is the covariance of the error if no message is lost. A term whose message is lost is left
    out, and P is then too small.
    """

    analysis = Analysis(paper="consensus_innovations", payload_numbers=lambda n, *_: n)
    timing = Timing(clocks=())
    kernels = Kernels(
        predict=predict,
        update=nothing,  # a reading is used in the exchange of its slot
        emit=emit,
        absorb=absorb,
        shift=shift,
        shift_payload=shift_payload,
        record=consensus_innovations_record,
        begin=begin_consensus_innovations,
        prepare=prepare_consensus_innovations,
    )

    @property
    def needs(self) -> Needs:
        """Its demands on a scenario."""
        return Needs(
            one_way=True, fixed_sensors=True, linear_plant=True, every_reading=True, awake=True,
            common_start=True, network=True, notes=self._scenario_notes,
        )  # fmt: skip

    def _scenario_notes(self, scenario: Any) -> tuple[str, ...]:
        """Return a note where messages may be lost or held back, which makes P too small."""
        if scenario.delivers_all and scenario.filter.algorithm is self:
            return ()
        return (
            "consensus-innovations: gains and P count all messages; P is too small where some do "
            "not arrive",
        )

    shift = Filter.shift  # affine: gains multiply differences
