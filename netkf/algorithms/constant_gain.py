"""The hybrid filter of Tanwani (CDC 2021), paper H, with constant gains, Remark 1: simpler, and
never better than Riccati gains.

    dxhat = A xhat dt + L (dy - H xhat dt),   dP/dt = (A - L H) P + P (A - L H)' + L R L' + Q

for increments; a sample or a reading in slots moves the estimate by ``L (y - H xhat)`` and P to
``(I - L H) P (I - L H)' + L R L'``. Messages reset estimate and P to convex combinations with
those of the senders, paper H (7) and (9).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from netkf.algorithms.filter import Filter, NodeInfo
from netkf.algorithms.kernels.constant_gains import correct_by_moments
from netkf.algorithms.kernels.estimates import copy_root, copy_vector, transform_root
from netkf.algorithms.kernels.gains import stack_gains
from netkf.algorithms.kernels.neighbours import combine_convex
from netkf.algorithms.kernels.root_flow import FlowTable, stack_tables
from netkf.algorithms.kernels.run import (
    ClockTables,
    carry_mean,
    clock_tables,
    longest_interval,
    move,
    predict_estimate,
)
from netkf.algorithms.kernels.square_root import lower_root
from netkf.algorithms.models import FlowModel
from netkf.algorithms.records import Kernels, Record
from netkf.algorithms.registry import built_in
from netkf.algorithms.traits import Analysis, Needs
from netkf.core.errors import ScenarioError
from netkf.core.fields import SourceFile, either, field, has_depth, list_of, matrix
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.generic import drop_lane
from netkf.linalg.lanes import any_lane, load, magnitude, spread, store
from netkf.linalg.structs import Struct


class ClosedLoops(Struct):
    """The closed loops of H nodes that read increments of at most p rows.

    A : the plant (S, n, n) in each of S pieces between its changes
    L, H : gains (H, n, p) and rows (H, p, n)
    closed, rate : A - L H (S, H, n, n), and the rate (H,) in 1/s at which increments move x
    tables : A - L H tabulated, and in ``models`` the row (H,) of each node, -1: no increments
    maps : scratch (6, n, n)
    """

    A: FloatArray
    L: FloatArray
    H: FloatArray
    closed: FloatArray
    rate: FloatArray
    tables: ClockTables
    maps: FloatArray


@kernel
def use_sample(record: Any, h: int, run: Any) -> None:
    """Update node ``h``: ``x += L (y - H x)``, and P to ``(I - L H) P (I - L H)' + L R L'``."""
    lanes, n, r = run.lanes, len(run.size), run.reading
    first, matrix = run.first_y + r, run.first_H + run.matrix[r]
    # A node that is down, or whose gate takes nothing, has no reading, which zeros stand for.
    weights = spread(lanes, 0.0)
    for i in range(run.rows[r]):
        for j in range(n):
            weights += magnitude(load(lanes, run.H, matrix, i, j))
    unread = weights == 0.0
    if not any_lane(weights > 0.0):
        return
    if any_lane(unread):
        copy_root(lanes, run.size, record.former, 0, record.root, h, True)
    # All innovations refer to the estimate before the reading: L is the gain of all its rows.
    copy_vector(lanes, run.size, record.mean, 0, record.xhat, h, True)
    for i in range(run.rows[r]):
        innovation = load(lanes, run.y, first, i)
        for j in range(n):
            innovation -= load(lanes, run.H, matrix, i, j) * load(lanes, record.mean, 0, j)
        for j in range(n):
            moved = load(lanes, record.xhat, h, j) + record.gain[h, j, i] * innovation
            store(lanes, record.xhat, h, j, moved)
    scratch = run.moved, run.noise
    transform_root(lanes, run.size, record.root, h, record.remaining[h], record.noise[h], scratch)
    if any_lane(unread):
        copy_root(lanes, run.size, record.root, h, record.former, 0, unread)


@kernel
def predict_closed_loop(record: Any, h: int, run: Any) -> None:
    """Predict node ``h``: the estimate by A, P by ``A - L H``, which counts noise of increments."""
    tables = record.loops.tables
    if tables.models[h] < 0:
        predict_estimate(run.model, run, record.xhat, record.root, h, h)
        return
    copy_vector(run.lanes, run.size, record.mean, 0, record.xhat, h, True)
    carry_mean(run.model, run, record.mean, 0, run.gap)
    root, x = drop_lane(record.root), drop_lane(record.xhat)
    tables.piece = run.model.piece
    move(tables, run, tables.models[h], root, x, h, run.gap)
    copy_vector(run.lanes, run.size, record.xhat, h, record.mean, 0, True)


@kernel
def use_sample_or_increments(record: Any, h: int, run: Any) -> None:
    """Update node ``h`` by a sample, or by the increments of the gap."""
    if run.model.increments == 0:
        use_sample(record, h, run)
        return
    loops, piece = record.loops, run.model.piece
    moments = run.model.moments[: run.model.gains.moments[run.model.models[h]]]
    correct_by_moments(
        drop_lane(record.xhat), h, loops.A[piece], loops.closed[piece, h], loops.H[h], loops.L[h],
        moments, run.gap, loops.maps,
    )  # fmt: skip


@kernel
def closed_loop_interval(record: Any, h: int, _run: Any) -> float:
    """Return the seconds of increments for one update: 1 / |L H|, the time scale of the gain."""
    return longest_interval(record.loops.rate[h])


def constant_gain_record(
    filtering: ConstantGain, infos: Sequence[NodeInfo], models: Sequence[Any]
) -> Record:
    """Return the gain matrices of all nodes for readings, and their closed loops under clocks."""
    N, n = len(infos), len(models[0].information)
    gains = [filtering.gain_of(info.place) for info in infos]
    settings: dict[str, Any] = {
        "gain": np.zeros((N, n, max(1, *(gain.shape[1] for gain in gains)))),
        "remaining": np.zeros((N, n, n)),
        "noise": np.zeros((N, n, n)),
    }
    for k, (info, L) in enumerate(zip(infos, gains, strict=True)):
        H, R = info.sampled
        if len(H):
            # Readings come whitened, with the inverse of the root of R.
            white = np.asarray(L @ np.linalg.cholesky(R))
            settings["gain"][k, :, : len(H)] = white
            settings["remaining"][k], settings["noise"][k] = np.eye(n) - L @ H, lower_root(white)
    if isinstance(models[0], FlowModel):
        settings["loops"] = _closed_loops(models, gains)
    return Record(
        payload={"xhat": (n,), "root": (n, n)},
        scratch={"mean": (1, n), "former": (1, n, n)},
        settings=settings,
    )


@built_in("constant-gain")
@dataclass(frozen=True, eq=False)
class ConstantGain(Filter):
    """Constant gains for the node's own readings and convex resets with Metropolis weights.

    gain  L (n, p): one for all nodes with sensors, or a list with one per node in the order of ids,
          of which those of nodes without sensors are not used

    In slots the estimate moves at each reading and then resets to the convex combination with the
    neighbours that it hears; samples are filtered. P is no smaller than the covariance of the
    error, as with Riccati gains, which make it smallest (H (15)).
    """

    gain: FloatArray | tuple[FloatArray, ...] = field(
        either(matrix, list_of(matrix, "matrices"), has_depth(3))
    )

    analysis = Analysis(paper="constant_gain", P_by_design=("larger", "larger"))
    kernels = Kernels(
        update=use_sample,
        absorb=combine_convex,
        under_clocks=Kernels(
            predict=predict_closed_loop,
            update=use_sample_or_increments,
            absorb=combine_convex,
            interval=closed_loop_interval,
        ),
        record=constant_gain_record,
    )

    def gain_of(self, index: int) -> FloatArray:
        """Return the gain (n, p) of the node with this ``index`` in the order of ids, from 0."""
        return self.gain[index] if isinstance(self.gain, tuple) else self.gain

    shift = Filter.shift  # affine: the weights sum to one

    @property
    def needs(self) -> Needs:
        """Its demands on a scenario."""
        return Needs(
            one_way=True,
            fixed_sensors=True,
            linear_plant=True,
            every_reading=True,
            check=self._check_scenario,
        )

    def _check_scenario(self, scenario: Any) -> None:
        for k, sensor in enumerate(scenario.sensors):
            # A node may have several rows at one instant, and a gain weighs one reading.
            if not scenario.slotted and isinstance(getattr(sensor, "path", None), SourceFile):
                raise ScenarioError(
                    f"{scenario.sensor_key(k)}.kind",
                    "must not be recorded for the constant-gain filter in continuous time",
                    "recorded",
                    "use linear sensors, slots, or another filter",
                )
        nodes, n = scenario.nodes, scenario.width
        if isinstance(self.gain, tuple) and len(self.gain) != len(nodes):
            rule = f"must be one matrix, or one for each of {len(nodes)} nodes"
            raise ScenarioError(
                "filter.gain", rule, f"{len(self.gain)} matrices", "add or remove some"
            )
        for index, node in enumerate(nodes):
            placed = scenario.placed_sensors.get(node, ())
            kinds = [getattr(scenario.sensors[one.entry], "sampling", None) for one in placed]
            if not scenario.slotted and len(placed) > 1 and any(kinds):
                raise ScenarioError(
                    "filter.gain",
                    f"node {node} has several sensors, and one that takes samples must be its only "
                    "one",
                    None,
                    "give it one sensor, or another filter",
                )
            p = sum(len(scenario.sensors[placed_sensor.entry].H) for placed_sensor in placed)
            shape = self.gain_of(index).shape
            if p and shape != (n, p):
                key = f"filter.gain[{index}]" if isinstance(self.gain, tuple) else "filter.gain"
                rule = f"must be {n} x {p}, because node {node} has {p} rows of readings"
                raise ScenarioError(key, rule, f"{shape[0]} x {shape[1]}", "one column per row")


def _closed_loops(models: Sequence[FlowModel], gains: Sequence[FloatArray]) -> ClosedLoops:
    """Return the closed loops of the nodes with these models and gains (n, p)."""
    pieces = list(zip(*(getattr(model, "pieces", (model,)) for model in models), strict=True))
    N, n = len(models), len(models[0].A)
    p = max(1, *(gain.shape[1] for gain in gains))
    L, H, closed = np.zeros((N, n, p)), np.zeros((N, p, n)), np.zeros((len(pieces), N, n, n))
    rate, rows = np.zeros(N), np.full(N, -1, dtype=np.int64)
    tables: list[FlowTable] = []
    reading = [k for k, model in enumerate(models) if len(model.H)]
    rows[reading] = np.arange(len(reading))
    for s, present in enumerate(pieces):
        for k in reading:
            model, gain = present[k], gains[k]
            loop = closed_loop(model, gain)
            L[k, :, : gain.shape[1]], H[k, : len(model.H)], closed[s, k] = gain, model.H, loop.A
            # The rate at which increments move the estimate.
            rate[k] = np.linalg.norm(gain @ model.H)
            tables.append(loop.flow)
        # Without closed loops any table will do, as no node uses it.
        tables += [] if reading else [present[0].unobserved_flow]
    changes = np.array(getattr(models[0], "changes", ()), dtype=np.float64)
    gains_of_none = stack_gains([models[0].gains])
    return ClosedLoops(
        A=np.array([present[0].A for present in pieces]),
        L=L,
        H=H,
        closed=closed,
        rate=rate,
        tables=clock_tables(np.zeros(n), stack_tables(tables), rows, gains_of_none, changes),
        maps=np.zeros((6, n, n)),
    )


def closed_loop(model: FlowModel, gain: FloatArray) -> FlowModel:
    """Return a model without readings whose P (n, n) moves as that of a filter of ``model`` with
    the constant ``gain`` L (n, p) for increments: drift ``A - L H``, noise ``Q + L R L'``.
    """
    # H and R without rows: the readings are in the drift and the noise already.
    noise, nothing = model.Q + gain @ model.R @ gain.T, model.H[:0]
    closed = np.ascontiguousarray(model.A - gain @ model.H)
    return FlowModel(closed, noise, nothing, model.R[:0, :0], model.horizon, model.interval)
