"""Models: what a node assumes about the plant and its own sensors, in continuous time
(``FlowModel``) and in slots (``SlotModel``).

Covariances are carried as roots S, ``P = S S'``. An increment sensor gives dy, the integral of its
output over an interval; a sample is a reading at one instant. Tables hold what a kernel needs to
compute a flow over any gap without matrix exponentials at run time.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from netkf.algorithms.kernels.estimates import transform_root, update_by_row
from netkf.algorithms.kernels.gains import GainTable, gain_table
from netkf.algorithms.kernels.maps import MapTables, move_estimate, settle_root, spread_of
from netkf.algorithms.kernels.rates import DIFFERENCE, RateTables, move_by_rate, scratch_of_rates
from netkf.algorithms.kernels.root_flow import FlowTable, flow_root, flow_table, gain_update_root
from netkf.algorithms.kernels.run import CLOSE, longest_interval
from netkf.algorithms.kernels.square_root import lower_root
from netkf.linalg.arrays import (
    FloatArray,
    IntArray,
    cached_by_entries,
    enlarged,
    square_root,
    symmetric,
)
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import ONE, aligned
from netkf.linalg.vector_functions import VectorFunction

shared_flow_table = cached_by_entries(32)(flow_table)
"""The flow table of a model, shared by equal ones: it takes some 30 ms, and at most 256 KiB."""


@dataclass(frozen=True, eq=False)
class FlowModel:
    """Continuous time: ``dx = A x dt + dw``, ``cov(dw) = Q dt``; increment sensors
    ``dy = H x dt + dv``, ``cov(dv) = R dt``.

    ``A, Q`` (n, n), ``H`` (p, n), ``R`` (p, p), p may be 0; ``horizon`` is the longest gap and
    ``interval`` the longest time over which readings are used at once, both in seconds.
    """

    A: FloatArray
    Q: FloatArray
    H: FloatArray
    R: FloatArray
    horizon: float
    interval: float

    reads: ClassVar[bool] = True
    """False while the node is down, whose sensors give no increments then; of a node that may be
    down engines say it by ``ChangingFlowModel.set_reading``.
    """

    @cached_property
    def information(self) -> FloatArray:
        """The information rate ``G = H' R^-1 H`` (n, n) of the node's sensors, per second."""
        return np.asarray(self.H.T @ np.linalg.solve(self.R, self.H))

    @cached_property
    def gains(self) -> GainTable:
        """Table of the gains with which this node's increments update its estimate."""
        return gain_table(self.A, self.Q, self.H, self.R, self.interval)

    @cached_property
    def flow(self) -> FlowTable:
        """Table for the root (n, n) of P after any gap, with this node's increments."""
        return shared_flow_table(self.A, self.Q, self.H, self.R, self.horizon)

    @cached_property
    def unobserved_flow(self) -> FlowTable:
        """Table for the root (n, n) of P after any gap, without readings."""
        nothing = np.zeros((0, len(self.A)))
        return shared_flow_table(self.A, self.Q, nothing, np.zeros((0, 0)), self.horizon)

    def predict(
        self, xhat: FloatArray, root: FloatArray, gap: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return the estimate (n,) and the root (n, n) of its covariance ``gap`` seconds after
        ``xhat`` (n,) and ``root`` (n, n); the root counts the increments, the estimate not yet.
        """
        root, xhat = flow_root(self.flow, lower(root), as_floats(xhat), gap)
        return xhat, root

    def extrapolate(
        self, xhat: FloatArray, root: FloatArray, age: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return the estimate (n,) and the root (n, n) of its covariance ``age`` seconds after
        ``xhat`` (n,) and ``root`` (n, n), without readings.
        """
        if age <= 0.0:
            return xhat, root
        root, xhat = flow_root(self.unobserved_flow, lower(root), as_floats(xhat), age)
        return xhat, root

    def transition(self, xhat: FloatArray, gap: float) -> FloatArray:
        """Return the derivative (n, n) of the predicted estimate with respect to ``xhat`` (n,)."""
        eye = np.eye(len(xhat))
        return np.stack([self.predict(e, np.zeros_like(eye), gap)[0] for e in eye], axis=1)

    def gain_update(
        self, xhat: FloatArray, root: FloatArray, moments: FloatArray, gap: float
    ) -> FloatArray:
        """Return the estimate (n,) after the increments of the last ``gap`` seconds, from the
        prediction ``xhat`` (n,) and ``root`` (n, n) at the end of the gap; see
        algorithms/kernels/gains.

        ``moments`` (2 p,) are ``int dy`` and then ``int (2 (s - a) / gap - 1) dy`` over the gap,
        which begins at time a.
        """
        return gain_update_root(self.gains, lower(root), as_floats(xhat), moments, gap)

    def max_interval(self, root: FloatArray) -> float:
        """Return the longest interval (s) for this root (n, n) of P, see ``Timing.interval``."""
        # trace(P G) = |R^-1/2 H S|^2, without forming P = S S' and G = H' R^-1 H.
        HS = self.flow.whitened_H[0] @ root
        return longest_interval(float((HS * HS).sum()))


@dataclass(frozen=True, eq=False)
class SlotModel:
    """Slots: ``x[k+1] = F x[k] + w``, cov(w) = Q; ``y = H x + v``, cov(v) = R.

    ``F, Q`` (n, n), ``H`` (p, n), ``R`` (p, p), p may be 0. Where H differs from slot to slot this
    is the first one; each reading brings its own. A slot lasts ``period`` seconds.
    """

    F: FloatArray
    Q: FloatArray
    H: FloatArray
    R: FloatArray
    period: float = 1.0

    @cached_property
    def root_Q(self) -> FloatArray:
        """Lower triangular root (n, n) of the process noise, ``root_Q root_Q' = Q``."""
        return lower_root(square_root(self.Q))

    @cached_property
    def information(self) -> FloatArray:
        """The information ``H' R^-1 H`` (n, n) of a reading of the node's sensors."""
        return symmetric(self.H.T @ np.linalg.solve(self.R, self.H))

    def predict(
        self, xhat: FloatArray, root: FloatArray, gap: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return the estimate (n,) and the root (n, n) of its covariance after one slot for each
        period of the ``gap`` in seconds, from ``xhat`` (n,) and ``root`` (n, n).
        """
        # round: a gap of whole periods may be off by rounding of clock times.
        for _ in range(round(gap / self.period)):
            xhat, root = self.F @ xhat, predict_root(root, self.F, self.root_Q)
        return xhat, root

    def extrapolate(
        self, xhat: FloatArray, root: FloatArray, age: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return ``xhat`` (n,) and ``root`` (n, n) unchanged, whatever the ``age``: a message is
        used in the slot in which it was sent.
        """
        return xhat, root

    def transition(self, xhat: FloatArray, gap: float) -> FloatArray:
        """Return the derivative (n, n) of the predicted estimate with respect to ``xhat`` (n,)."""
        eye = np.eye(len(xhat))
        return self.predict(eye, np.zeros_like(eye), gap)[0]

    def gain_update(
        self, xhat: FloatArray, root: FloatArray, moments: FloatArray, gap: float
    ) -> FloatArray:
        """Raise TypeError: there are no increments in slots."""
        raise TypeError("increments belong to continuous time")

    def max_interval(self, root: FloatArray) -> float:
        """Return the longest measurement interval in seconds: infinity, whatever the ``root``
        (n, n): slots have no increments that an interval would limit.
        """
        return math.inf


@dataclass(frozen=True, eq=False, kw_only=True)
class MapModel(SlotModel):
    """Slots of a plant that need not be linear: ``x[k+1] = f(x[k], u[k], t_k) + w``; F is nan.

    ``f`` and ``jacobian`` are the map and its Jacobian, ``u`` (S, m) the input of slots 0 to S - 1
    as filters know it, and ``linearise`` is how they predict, "ekf", "ukf" or "ckf". Q is the
    first of ``noises``, of which the next one holds from each of the ``noise_slots`` on.
    """

    f: VectorFunction
    jacobian: VectorFunction
    u: FloatArray
    linearise: str
    noises: Sequence[FloatArray]
    noise_slots: IntArray

    slot: ClassVar[int] = 0
    """The slot from which ``predict`` begins; engines say it by ``move_to``, of a copy."""

    def move_to(self, time: float) -> None:
        """Predict from the slot that begins at ``time`` (seconds) on."""
        self.__dict__["slot"] = round(time / self.period)

    def tables(
        self, lanes: int = 1, active: int = 1, delay: int = 0, width: int | None = None
    ) -> MapTables:
        """Return the model as kernels take it, for so many ``lanes`` with ``active`` runs and
        records of ``width`` states, by default as many as it has; see ``MapTables`` for ``delay``.
        """
        n, width = len(self.Q), width or len(self.Q)
        distance, weight, center = spread_of(self.linearise, n)
        return MapTables(
            f=self.f.address,
            jacobian=self.jacobian.address,
            delay=delay,
            active=active,
            period=self.period,
            distance=distance,
            weight=weight,
            center=center,
            u=np.array(self.u, order="C"),
            roots=np.stack([enlarged(first_root(Q), width, width) for Q in self.noises]),
            changes=np.array(self.noise_slots),
            x=np.zeros(n),
            moved=np.zeros(n),
            J=np.zeros((n, n)),
            J_lanes=aligned((width, width, lanes)),
            points=np.zeros((2 * n + 1, n)),
            work=np.zeros((n, 3 * n + 1)),
        )

    def transition(self, xhat: FloatArray, gap: float) -> FloatArray:
        """Return the product (n, n) of the Jacobians along the prediction from ``xhat`` (n,)."""
        Phi, x = np.eye(len(xhat)), np.array(xhat)
        for k in range(self.slot, self.slot + round(gap / self.period)):
            u, t = self.u[min(k, len(self.u) - 1)], k * self.period
            Phi = self.jacobian(x, u, t, self.period) @ Phi
            x = self.f(x, u, t, self.period)
        return Phi

    def raise_error(self) -> None:
        """Raise the error of a user's f or Jacobian, if a call has failed."""
        for function in (self.f, self.jacobian):
            function.raise_error()

    def predict(
        self, xhat: FloatArray, root: FloatArray, gap: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return the estimate and the root of its covariance, see ``SlotModel.predict``."""
        n = len(xhat)
        x, S = np.array(xhat, float).reshape(1, n, 1), np.array(lower(root)).reshape(1, n, n, 1)
        tables = self.tables()
        scratch = np.empty((n, n, 1)), np.empty((n, n, 1))
        for k in range(round(gap / self.period)):
            move_estimate(tables, np.zeros(n), ONE, x, S, 0, self.slot + k, scratch)
        self.raise_error()
        return x.reshape(n), S.reshape(n, n)


class ChangingFlowModel(FlowModel):
    """A model in continuous time whose matrices change: the ``pieces`` of it, of which the first
    holds before ``changes[0]`` seconds, the second before ``changes[1]``, and so on. All fields are
    those of the present piece. Engines predict to each change, let the next piece ``begin``, and
    say the time of what comes next by ``move_to``.
    """

    pieces: Sequence[FlowModel]
    changes: Sequence[float]
    piece: int
    now: float

    def __init__(self, pieces: Sequence[FlowModel], changes: Sequence[float]) -> None:
        self.__dict__.update(pieces=pieces, changes=changes, now=0.0)
        self.begin(0)

    def set_reading(self, reads: bool) -> None:
        """Count increments in predictions from now on, or no more."""
        self.__dict__["reads"] = reads

    def move_to(self, time: float) -> None:
        """Make ``time`` (seconds) the end of predictions."""
        self.__dict__["now"] = time

    def begin(self, piece: int) -> None:
        """Go to a piece, by number."""
        for name in ("information", "gains", "flow", "unobserved_flow"):
            self.__dict__.pop(name, None)
        self.__dict__.update(vars(self.pieces[piece]), piece=piece)

    def predict(
        self, xhat: FloatArray, root: FloatArray, gap: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return estimate and root as ``FlowModel.predict``, ``gap`` seconds up to now."""
        if not self.reads:
            return self.extrapolate(xhat, root, gap)
        for model, length in self._parts(gap):
            xhat, root = model.predict(xhat, root, length)
        return xhat, root

    def extrapolate(
        self, xhat: FloatArray, root: FloatArray, age: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return estimate and root as ``FlowModel.extrapolate``, ``age`` seconds up to now."""
        for model, length in self._parts(age):
            xhat, root = model.extrapolate(xhat, root, length)
        return xhat, root

    def _parts(self, gap: float) -> Iterator[tuple[FlowModel, float]]:
        """Yield the pieces of the last ``gap`` seconds, and how long each of them holds."""
        edges = self.changes[: self.piece]
        first = bisect.bisect_right(edges, (self.now - gap) * (1.0 + CLOSE))
        for change, model in zip(edges[first:], self.pieces[first:], strict=False):
            yield model, change - (self.now - gap)
            gap = self.now - change
        yield self.pieces[self.piece], gap


class ChangingSlotModel(SlotModel):
    """A model in slots whose matrices change: the ``pieces`` of it, of which the first holds before
    slot number ``slots[0]``, the second before ``slots[1]``, and so on. ``F`` and ``Q`` are those
    by which the next prediction moves; engines say its slot by ``move_to``.
    """

    pieces: Sequence[SlotModel]
    slots: Sequence[int]
    piece: int
    slot: int

    def __init__(self, pieces: Sequence[SlotModel], slots: Sequence[int]) -> None:
        self.__dict__.update(pieces=pieces, slots=slots)
        self.move_to(0)

    def move_to(self, slot: int) -> None:
        """Go to the piece by which the prediction of ``slot`` moves."""
        piece = bisect.bisect_right(self.slots, slot)
        self.__dict__.update(slot=slot, piece=piece)
        self.__dict__.pop("root_Q", None)
        self.__dict__.update(vars(self.pieces[piece]))

    def predict(
        self, xhat: FloatArray, root: FloatArray, gap: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return the estimate (n,) and the root (n, n) as ``SlotModel.predict``: over several slots
        the last of them is the present one.
        """
        count = round(gap / self.period)
        for slot in range(self.slot + 1 - count, self.slot + 1):
            piece = self.pieces[bisect.bisect_right(self.slots, slot)]
            xhat, root = piece.predict(xhat, root, piece.period)
        return xhat, root


def changing_models(pieces: Sequence[Sequence[Any]], changes: Sequence[Any]) -> list[Any]:
    """Return nodes' models from those of each piece, between ``changes``, in seconds or slots."""
    if len(pieces) == 1:
        return list(pieces[0])
    cls: Any = ChangingSlotModel if isinstance(pieces[0][0], SlotModel) else ChangingFlowModel
    return [cls(of_node, changes) for of_node in zip(*pieces, strict=True)]


@dataclass(frozen=True, eq=False, kw_only=True)
class RateModel(FlowModel):
    """Continuous time of a plant that need not be linear: ``dx = f(x, u(t), t) dt + dw``, cov(dw) =
    Q dt; A is nan, and there are no increment sensors.

    ``f`` and ``jacobian`` are the rate of change and its Jacobian, ``step`` is the longest step of
    their integration (s), ``tables_of_input`` has the ``times``, ``values`` and ``sine`` of the
    input as filters know it (``RateTables``), and ``linearise`` is how they predict. Q is the
    first of ``noises``, of which the next one holds from each of the ``noise_times`` (s) on.
    """

    f: VectorFunction
    jacobian: VectorFunction
    step: float
    tables_of_input: tuple[FloatArray, FloatArray, FloatArray]
    linearise: str
    noises: Sequence[FloatArray]
    noise_times: FloatArray

    now: ClassVar[float] = 0.0
    """The end of predictions in seconds; engines say it by ``move_to``, of a copy."""

    def move_to(self, time: float) -> None:
        """Make ``time`` (seconds) the end of predictions."""
        self.__dict__["now"] = time

    def tables(self) -> RateTables:
        """Return the model as kernels take it."""
        distance, weight, center = spread_of(self.linearise, len(self.Q))
        times, values, sine = (np.array(part, order="C") for part in self.tables_of_input)
        return RateTables(
            f=self.f.address,
            jacobian=self.jacobian.address,
            step=self.step,
            distance=distance,
            weight=weight,
            center=center,
            times=times,
            values=values,
            sine=sine,
            Q=np.stack(self.noises),
            changes=np.array(self.noise_times),
            piece=0,
            **scratch_of_rates(len(self.Q), values.shape[1]),
        )

    @cached_property
    def _rate_tables(self) -> RateTables:
        return self.tables()

    def __getstate__(self) -> dict[str, Any]:
        """Return what can be pickled: the addresses in tables mean nothing elsewhere."""
        return {name: value for name, value in self.__dict__.items() if name != "_rate_tables"}

    def raise_error(self) -> None:
        """Raise the error of a user's f or Jacobian, if a call has failed."""
        for function in (self.f, self.jacobian):
            function.raise_error()

    def predict(
        self, xhat: FloatArray, root: FloatArray, gap: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return the estimate and the root of its covariance, see ``FlowModel.predict``."""
        n = len(xhat)
        x, S = np.array(xhat, float).reshape(1, n, 1), np.array(lower(root)).reshape(1, n, n, 1)
        move_by_rate(self._rate_tables, x, S, 0, self.now, gap)
        self.raise_error()
        return x.reshape(n), S.reshape(n, n)

    def extrapolate(
        self, xhat: FloatArray, root: FloatArray, age: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return the estimate and the root of its covariance, see ``FlowModel.extrapolate``."""
        if age <= 0.0:
            return xhat, root
        return self.predict(xhat, root, age)

    def transition(self, xhat: FloatArray, gap: float) -> FloatArray:
        """Return the derivative (n, n) of the prediction at ``xhat``, by central differences."""
        still, columns = np.zeros((len(xhat),) * 2), []
        for e in np.diag(DIFFERENCE * np.maximum(1.0, np.abs(xhat))):
            after, before = (self.predict(xhat + d, still, gap)[0] for d in (e, -e))
            columns.append((after - before) / (2.0 * e.sum()))
        return np.stack(columns, axis=1)


def lower(root: FloatArray) -> FloatArray:
    """Return a lower triangular root (n, n) of ``root root'``, as kernels read it: a user's class
    may have made another one, such as the symmetric one.
    """
    S = as_floats(root)
    return lower_root(S) if np.triu(S, 1).any() else S


def root_of_points(root: FloatArray) -> FloatArray:
    """Return the lower triangular root (n, n) of ``root root'`` that sigma points go along."""
    n = len(root)
    S = np.array(lower(root)).reshape(1, n, n, 1)
    settle_root(S, 0, 0, n)
    return S.reshape(n, n)


def as_floats(values: Any) -> FloatArray:
    """Return an array as kernels read it, of a user's values: float32 or integers are others."""
    return np.ascontiguousarray(values, dtype=np.float64)


def first_root(cov: FloatArray) -> FloatArray:
    """Return lower triangular S (n, n) with ``S S' = cov`` (n, n), which may be singular."""
    return lower_root(square_root(cov))


def first_roots(covariances: Sequence[FloatArray]) -> FloatArray:
    """Return the roots (N, n, n) of N initial covariances (n, n), many of which are equal."""
    keys = [cov.tobytes() for cov in covariances]
    roots = {key: first_root(cov) for key, cov in dict(zip(keys, covariances, strict=True)).items()}
    return np.stack([roots[key] for key in keys])


@kernel
def _transform(
    root: FloatArray, F: FloatArray, root_Q: FloatArray, scratch: tuple[FloatArray, FloatArray]
) -> None:
    """Predict ``root`` (1, n, n, 1) by a slot."""
    transform_root(ONE, F[0], root, 0, F, root_Q, scratch)


def predict_root(root: FloatArray, F: FloatArray, root_Q: FloatArray) -> FloatArray:
    """Return the lower triangular root (n, n) of ``F S S' F' + Q`` for the ``root`` S and the lower
    triangular ``root_Q`` (n, n each), for one filter in Python.
    """
    n = len(F)
    moved = np.array(lower(root)).reshape(1, n, n, 1)
    _transform(moved, F, root_Q, (np.empty((n, n, 1)), np.empty((n, n, 1))))
    return np.asarray(moved.reshape(n, n))


def whiten_reading(y: FloatArray, H: FloatArray, R: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the whitened reading ``L^-1 y`` (p,) and ``L^-1 H`` (p, n) of a reading y (p,) with H
    (p, n) and noise covariance ``R = L L'`` (p, p), so that the noise of its rows is white.
    """
    # One solve for y and H together.
    whitened = np.linalg.solve(np.linalg.cholesky(as_floats(R)), np.column_stack([y, H]))
    return np.ascontiguousarray(whitened[:, 0]), np.ascontiguousarray(whitened[:, 1:])


@kernel
def _use_rows(
    x: FloatArray, root: FloatArray, y: FloatArray, H: FloatArray,
    scratch: tuple[FloatArray, FloatArray],
) -> None:  # fmt: skip
    """Update ``x`` (1, n, 1) and ``root`` (1, n, n, 1) with whitened rows y (1, p, 1)."""
    for i in range(y.shape[1]):
        update_by_row(ONE, x[0], x, root, 0, y, H, (0, 0, i), True, scratch)


def sample_update(
    xhat: FloatArray, root: FloatArray, y: FloatArray, H: FloatArray, R: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the estimate (n,) and the root (n, n) of its covariance after a sample ``y = H x + v``
    (p,) of p > 0 rows, H (p, n), cov(v) = R (p, p), from ``xhat`` (n,) and ``root`` (n, n) before;
    or several estimates (n, C) after samples (p, C), see ``Analysis.affine``.
    """
    if xhat.ndim == 2:
        S = sample_update(np.zeros(len(xhat)), root, np.zeros(len(y)), H, R)[1]
        gain = S @ S.T @ np.linalg.solve(R, H).T
        return xhat + gain @ (y - H @ xhat), S
    (p, n), (white_y, white_H) = H.shape, whiten_reading(y, H, R)
    x, S = np.array(xhat, float).reshape(1, n, 1), np.array(lower(root)).reshape(1, n, n, 1)
    scratch = np.empty((n, 1)), np.empty((n, 1))
    _use_rows(x, S, white_y.reshape(1, p, 1), white_H.reshape(1, p, n, 1), scratch)
    return x.reshape(n), S.reshape(n, n)
