"""H(12) with symmetric matrices stored as upper triangles, rows of m = n (n + 1) / 2 numbers.

The terms then have their natural cost: one sparse product over neighbours for all entries at once,
one small matrix for A P + P A', the same at all nodes, and P G P only at nodes with a sensor.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy

from netkf.linalg.arrays import FloatArray
from netkf.theory.hybrid.coupled import CoupledRiccati
from netkf.theory.hybrid.dense import FullMatrix, SparseOrFull
from netkf.theory.hybrid.samples import PoissonSamples

MAX_PACKED = 16  # states up to which the linear maps of nodes are matrices of packed rows
ELIMINATION_WORK = 3e9  # multiplications up to which elimination is taken


class PackedRiccati:
    """The right-hand side of H(12) and its linearisation, on rows ``Y`` (N, m).

    ``leaving`` (N,) is the sum of c_ij over j, per second.
    """

    def __init__(self, equations: CoupledRiccati) -> None:
        """Pack the coefficients: symmetric (n, n) become rows of m = n (n + 1) / 2 numbers."""
        self.equations = equations
        n = len(equations.A)
        self._i, self._j = np.triu_indices(n)
        self.m = len(self._i)
        # Entry (i, j) of a symmetric matrix is at indices[i, j] of its row.
        indices = np.zeros((n, n), dtype=np.int64)
        indices[self._i, self._j] = indices[self._j, self._i] = np.arange(self.m)
        self._indices = indices.reshape(-1)
        # The symmetric unit matrices: a linear map on rows is known from its values on these.
        self._basis = np.zeros((self.m, n, n))
        self._basis[np.arange(self.m), self._i, self._j] = 1.0
        self._basis[np.arange(self.m), self._j, self._i] = 1.0
        self._lyapunov = self._lyapunov_maps()
        self._set_drift(equations.A, equations.Q)
        self._predicted = self.pack(equations.T @ self._basis @ equations.T.T)
        self.start = self.pack(equations.start)
        self._q = self.pack(equations.q)
        # P_i leaves at the rate of all arrivals: - sum_j c_ij P_i.
        flows = [equations.coupling, *(s.heard for s in equations.samples)]
        self.leaving = np.asarray(sum(flow.sum(axis=1) for flow in flows)).reshape(-1)
        self._exchange: Any
        if self.is_full:
            self._exchange = equations.coupling.toarray() - np.diag(self.leaving)
        else:
            leave = scipy.sparse.diags_array(self.leaving)
            self._exchange = scipy.sparse.csr_array(equations.coupling - leave)
        self._sensed = np.flatnonzero(np.abs(equations.G).max(axis=(1, 2)) > 0.0)

    @property
    def is_full(self) -> bool:
        """True if the coupling is a full matrix, and there are few unknowns."""
        return isinstance(self.equations.coupling, FullMatrix)

    def shift(self, A: FloatArray, Q: FloatArray) -> PackedRiccati:
        """Return the equations with another drift A (n, n) and noise Q, per second."""
        shifted = copy.copy(self)
        shifted.equations = self.equations._replace(A=A, Q=Q)
        shifted._set_drift(A, Q)
        return shifted

    def _set_drift(self, A: FloatArray, Q: FloatArray) -> None:
        """Set the map (m, m) of rows by A P + P A', and the rows of the noise Q."""
        drift_map = self.lyapunov_maps(A[None])[0]
        # Of many states most entries are 0.
        sparse = len(A) > MAX_PACKED
        self._drift_map = scipy.sparse.csr_array(drift_map) if sparse else drift_map
        self._Q = self.pack(Q)

    def _lyapunov_maps(self) -> Any:
        """Return the map (n n, m m) of F to the map of rows by F X + X F'."""
        n, m = len(self.equations.A), self.m
        indices, k, row = self._indices.reshape(n, n), np.arange(n), np.arange(m)[:, None]
        # Entry (i, j) of a row of F X + X F' is the sum over k of F_ik X_kj + F_jk X_ik.
        i, j = self._i[:, None], self._j[:, None]
        entries = np.concatenate([i * n + k, j * n + k])
        maps = np.concatenate([indices[k, j] * m + row, indices[k, i] * m + row])
        places = entries.reshape(-1), maps.reshape(-1)
        if self.is_full and n <= MAX_PACKED // 2:
            matrix = np.zeros((n * n, m * m))
            np.add.at(matrix, places, 1.0)
            return matrix
        arrays = np.ones(entries.size), places
        return scipy.sparse.csr_array(scipy.sparse.coo_array(arrays, shape=(n * n, m * m)))

    def lyapunov_maps(self, F: FloatArray) -> FloatArray:
        """Return the maps (N, m, m) of rows by ``F X + X F'`` for F (N, n, n)."""
        return np.asarray(F.reshape(len(F), -1) @ self._lyapunov).reshape(-1, self.m, self.m)

    @cached_property
    def eliminates_cheaply(self) -> bool:
        """True if elimination has little fill-in: the network has small cuts everywhere."""
        coupling = scipy.sparse.csr_array(self.equations.coupling)
        order = scipy.sparse.csgraph.reverse_cuthill_mckee(coupling)
        index = np.empty(len(order), dtype=np.int64)
        index[order] = np.arange(len(order))
        i, j = coupling.nonzero()
        width = int(np.abs(index[i] - index[j]).max(initial=0)) + 1
        return len(order) * self.m * (width * self.m) ** 2 <= ELIMINATION_WORK

    @cached_property
    def arriving_matrix(self) -> Any:
        """Sparse or full matrix (N m, N m) of the arrivals at the ticks of link clocks."""
        if self.is_full:
            return np.kron(self.equations.coupling.toarray(), self._predicted.T)
        matrix = scipy.sparse.kron(self.equations.coupling, self._predicted.T, "csr")
        return scipy.sparse.csr_array(matrix)

    def pack(self, P: FloatArray) -> FloatArray:
        """Return the upper triangles (..., m) of symmetric P (..., n, n), row by row."""
        return np.ascontiguousarray(P[..., self._i, self._j])

    def unpack(self, Y: FloatArray) -> FloatArray:
        """Return the symmetric matrices (..., n, n) of which Y (..., m) are the upper triangles."""
        n = len(self.equations.A)
        return np.asarray(Y[..., self._indices].reshape(*Y.shape[:-1], n, n))

    def predict(self, Y: FloatArray) -> FloatArray:
        """Return the rows (N, m) of ``T P T' + q``: those of Y (N, m) predicted over the delay."""
        return np.asarray(Y @ self._predicted + self._q)

    def slope(self, Y: FloatArray, sent: FloatArray | None = None) -> FloatArray:
        """Return dY/dt (N, m) of rows Y (N, m); ``sent`` is Y a delay ago, Y itself if None."""
        if sent is None:
            change = self._exchange @ Y + Y @ self._drift_map + self._Q
        else:
            change = Y @ self._drift_map + self._Q - self.leaving[:, None] * Y
            change += self.equations.coupling @ self.predict(sent)
        P = self.unpack(Y[self._sensed])
        change[self._sensed] -= self.pack(P @ self.equations.G[self._sensed] @ P)
        for group in self.equations.samples:
            self._add_samples(
                change, group, self.unpack(Y), None if sent is None else self.unpack(sent)
            )
        return np.asarray(change)

    def series(
        self, Y: FloatArray, span: float, order: int, sent: FloatArray | None = None
    ) -> FloatArray:
        """Return Taylor coefficients (order + 1, N, m) in seconds / ``span``, without samples;
        ``sent`` are those of Y a delay ago, Y itself if None.
        """
        series = np.empty((order + 1, *Y.shape))
        series[0] = Y
        # Coefficient k of P G P is the sum over i of (P_i G) P_k-i, one product of block matrices:
        # a row of P_0 G ... P_k G times a column of P_k ... P_0.
        sensed, n = len(self._sensed), len(self.equations.A)
        gains, P = np.empty((sensed, n, order, n)), np.empty((sensed, order, n, n))
        for k in range(order):
            change = series[k] @ self._drift_map
            if sent is None:
                change += self._exchange @ series[k]
            else:
                arriving = self.predict(sent[k]) if k == 0 else sent[k] @ self._predicted
                change += self.equations.coupling @ arriving - self.leaving[:, None] * series[k]
            if k == 0:
                change += self._Q
            P[:, order - 1 - k] = present = self.unpack(series[k, self._sensed])
            gains[:, :, k] = present @ self.equations.G[self._sensed]
            row = gains[:, :, : k + 1].reshape(sensed, n, (k + 1) * n)
            column = P[:, order - 1 - k :].reshape(sensed, (k + 1) * n, n)
            change[self._sensed] -= self.pack(row @ column)
            np.multiply(change, span / (k + 1), out=series[k + 1])
        return series

    def _add_samples(
        self, change: FloatArray, group: PoissonSamples, P: FloatArray, sent: FloatArray | None
    ) -> None:
        """Add ``s (g(P) - P)`` of a ``group`` of Poisson samples to ``change`` (N, m), in place."""
        # g is the update by a sample; also the arrivals of what was ``sent`` (N, n, n) at samples.
        decrease = self.pack(group.sample_decrease(P))
        np.subtract.at(change, group.nodes, group.rate[:, None] * decrease)
        if not group.heard.nnz:
            return
        if sent is None:
            arriving = self.pack(P)[group.nodes] - decrease
        else:
            updated = self.pack(sent)[group.nodes] - self.pack(group.sample_decrease(sent))
            arriving = self.predict(updated)
        change += group.heard @ arriving

    def linear(self, P: FloatArray) -> LinearisedRiccati:
        """Return H(12) linearised at ``P`` (N, n, n): gains have no first-order effect."""
        drifts = self._drifts()
        drifts[self._sensed] -= P[self._sensed] @ self.equations.G[self._sensed]
        own, heard = [], [(self.equations.coupling, np.arange(len(P)), self._predicted[None])]
        for group in self.equations.samples:
            K, closed = group.update_gains(P)
            # A sample maps X to (I - K H) X (I - K H)' = X - K H X - X (K H)' + K H X (K H)'.
            loss = (K @ group.H)[:, None]
            np.subtract.at(drifts, group.nodes, group.rate[:, None, None] * loss[:, 0])
            maps = self.pack(loss @ self._basis @ np.swapaxes(loss, -1, -2))
            own.append((group.nodes, group.rate[:, None, None] * maps))
            if group.heard.nnz:
                maps = self.pack(closed[:, None] @ self._basis @ np.swapaxes(closed, 1, 2)[:, None])
                heard.append((group.heard, group.nodes, maps @ self._predicted))
        return LinearisedRiccati(drifts, own, heard, self)

    def linear_with_gains(self, corrections: FloatArray) -> LinearisedRiccati:
        """Return the map of P with gains whose ``L_i H_i`` are ``corrections`` (N, n, n)."""
        heard = [(self.equations.coupling, np.arange(len(corrections)), self._predicted[None])]
        return LinearisedRiccati(self._drifts() - corrections, [], heard, self)

    def _drifts(self) -> FloatArray:
        """Return the drifts (N, n, n) without gains: A less half the rate at which P leaves."""
        A = self.equations.A
        return np.asarray(A - 0.5 * self.leaving[:, None, None] * np.eye(len(A)))


@dataclass(frozen=True)
class LinearisedRiccati:
    """H(12) linearised at some P, as a linear map on rows X (N, m).

    drifts : (N, n, n) F_i of each node's own ``F_i X_i + X_i F_i'``
    own    : what samples add to that: nodes (S,), and maps (S, m, m) of their rows
    heard  : for each kind of arrival the rates (N, S), the indices (S,) of the senders, and maps
             (S, m, m), or one map (1, m, m), of the sender's row
    packed : the equations
    """

    drifts: FloatArray
    own: list[tuple[np.ndarray, FloatArray]]
    heard: list[tuple[SparseOrFull, np.ndarray, FloatArray]]
    packed: PackedRiccati

    @cached_property
    def blocks(self) -> FloatArray:
        """The map (N, m, m) of each row by itself, ``X_i B_i``."""
        blocks = self.packed.lyapunov_maps(self.drifts)
        for nodes, maps in self.own:
            np.add.at(blocks, nodes, maps)
        return blocks

    def remaining(self, X: FloatArray) -> FloatArray:
        """Return what the nodes' own rows add per second, (N, m), for rows X (N, m)."""
        if self.drifts.shape[1] <= MAX_PACKED:
            return np.asarray(np.einsum("ik,ikl->il", X, self.blocks))
        half = self.drifts @ self.packed.unpack(X)
        change = self.packed.pack(half + np.swapaxes(half, 1, 2))
        for nodes, maps in self.own:
            np.add.at(change, nodes, (X[nodes, None] @ maps)[:, 0])
        return change

    def arriving(self, X: FloatArray) -> FloatArray:
        """Return what messages add per second at each node, (N, m), for rows X (N, m)."""
        total = np.zeros_like(X)
        for rates, nodes, maps in self.heard:
            sent, equations = X[nodes], self.packed.equations
            if rates is not equations.coupling or equations.delay > 0.0:  # else the map is I
                sent = sent @ maps[0] if len(maps) == 1 else (sent[:, None] @ maps)[:, 0]
            total += rates @ sent
        return total

    def change(self, X: FloatArray) -> FloatArray:
        """Return what rows X (N, m) change per second, (N, m)."""
        return np.asarray(self.remaining(X) + self.arriving(X))

    def shared_map(self) -> FloatArray:
        """Return the map (N, m, m) of a row that all nodes share."""
        total = self.blocks.copy()
        for rates, _, maps in self.heard:
            if len(maps) == 1:
                total += np.asarray(rates.sum(axis=1)).reshape(-1, 1, 1) * maps
            else:
                total += (rates @ maps.reshape(len(maps), -1)).reshape(total.shape)
        return total

    def full_matrix(self) -> FloatArray:
        """Return the map as a full matrix (N m, N m), with the arrivals."""
        size, m = len(self.blocks), self.packed.m
        operator, nodes = np.zeros((size, m, size, m)), np.arange(size)
        operator[nodes, :, nodes] = np.swapaxes(self.blocks, 1, 2)
        for rates, senders, maps in self.heard:
            if rates is self.packed.equations.coupling:
                operator += self.packed.arriving_matrix.reshape(operator.shape)
                continue
            # Several senders may be the same node, with a map (m, m) for each of its sensors.
            for rate, sender, one in zip(rates.toarray().T, senders, maps, strict=True):
                operator[:, :, sender] += rate[:, None, None] * one.T
        return operator.reshape(size * m, size * m)

    def matrix(self, arriving: bool = True) -> scipy.sparse.csc_array:
        """Return the map as a sparse matrix (N m, N m), with the arrivals or block diagonal."""
        size, m = len(self.blocks), self.packed.m
        shape = (size * m, size * m)
        transposed = np.ascontiguousarray(np.swapaxes(self.blocks, 1, 2))
        bsr_arrays = (transposed, np.arange(size), np.arange(size + 1))
        operator = scipy.sparse.csr_array(scipy.sparse.bsr_array(bsr_arrays, shape=shape))
        for rates, nodes, maps in self.heard if arriving else ():
            if rates is self.packed.equations.coupling:
                operator = operator + scipy.sparse.csr_array(self.packed.arriving_matrix)
                continue
            # Each rate multiplies a map (m, m) of its own, at the block (receiver, sender).
            entries = scipy.sparse.coo_array(rates)
            transposed = np.swapaxes(maps, 1, 2)[entries.col] * entries.data[:, None, None]
            rows = entries.row[:, None, None] * m + np.arange(m)[None, :, None]
            columns = nodes[entries.col][:, None, None] * m + np.arange(m)[None, None, :]
            indices = np.broadcast_arrays(rows, columns)
            coo_arrays = (transposed.reshape(-1), tuple(index.reshape(-1) for index in indices))
            arrivals = scipy.sparse.coo_array(coo_arrays, shape=shape)
            operator = operator + scipy.sparse.csr_array(arrivals)
        return scipy.sparse.csc_array(operator)
