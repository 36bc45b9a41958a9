"""Where nodes are: at fixed places, at those of a table, or where the true state says."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from netkf.core.csv_files import read_columns, read_header
from netkf.core.errors import ScenarioError
from netkf.core.fields import SourceFile
from netkf.core.instants import TimeGrid
from netkf.core.repeated_rows import RowUse, count_rows, first_rows
from netkf.linalg.arrays import FloatArray, IntArray
from netkf.network.graphs import Link, Topology, demand_nodes


@dataclass(frozen=True, eq=False)
class PositionTable:
    """The rows of a table ``node,x,y``, which hold all the time, or ``t,node,x,y``, each of which
    holds until the next of its node.

    path     : name of the file
    row_keys : node and time of each row, in seconds, 0 without a column t
    rows     : increasing times (K,) and points (K, 2) of each node
    timed    : it has a column t
    """

    path: str
    row_keys: Sequence[tuple[int, float]]
    rows: Mapping[int, tuple[FloatArray, FloatArray]]
    timed: bool

    @property
    def points(self) -> dict[int, tuple[float, float]]:
        """The first point of each node."""
        return {node: (x, y) for node, (_, xy) in self.rows.items() for x, y in xy[:1].tolist()}

    def use(self, horizon: float) -> RowUse:
        """Return the use of the rows by a run to the ``horizon``: of those that hold at a time."""
        last = {node: times[times <= 0.0].max() for node, (times, _) in self.rows.items()}
        return count_rows(
            self.path, self.row_keys, lambda key: last[key[0]] <= key[1] and key[1] < horizon
        )


def read_positions(source: SourceFile, topology: Topology, grid: TimeGrid) -> PositionTable:
    """Read a table of positions with times on the ``grid``; raises ScenarioError for an unknown
    node, two places at one time, and a first row after 0.
    """
    timed = "t" in read_header(source)
    columns = read_columns(source, ("t", "node", "x", "y") if timed else ("node", "x", "y"))
    nodes = columns.integers("node")
    demand_nodes(columns, (*topology.index, *topology.left_out))
    t = grid.snap(columns["t"]) if timed else np.zeros(len(nodes))
    keys = list(zip(nodes, t.tolist(), strict=True))
    points = np.column_stack([columns["x"], columns["y"]])
    rule = "a node must have one position" + (" at a time" if timed else "")
    first = first_rows(columns, keys, [tuple(p) for p in points.tolist()], rule)
    indices: dict[int, list[int]] = {}
    for key in sorted(first):
        indices.setdefault(key[0], []).append(first[key])
    for node, of_node in indices.items():
        if t[of_node[0]] > 0.0:
            rule = f"{columns.where(of_node[0])}: the first place of node {node} must be at t <= 0"
            remedy = "add a row for t = 0, or set [time] origin"
            raise ScenarioError("path", rule, float(t[of_node[0]]), remedy)
    rows = {node: (t[of_node], points[of_node]) for node, of_node in indices.items()}
    return PositionTable(source.name, keys, rows, timed)


class Positions:
    """Where nodes are at any time of a run.

    fixed   : a point (D,) of each node that does not move
    table   : those that move by a table; their rows hold until the next
    entries : by node, which entries (D,) of the true state are its coordinates
    """

    def __init__(
        self,
        fixed: Mapping[int, Sequence[float]],
        table: PositionTable | None = None,
        entries: Mapping[int, IntArray] | None = None,
    ) -> None:
        self._fixed = {node: tuple(point) for node, point in fixed.items()}
        self._rows = {} if table is None or not table.timed else table.rows
        self._entries = entries or {}

    @property
    def of_state(self) -> bool:
        """True if the true state says where some nodes are."""
        return bool(self._entries)

    @property
    def moving(self) -> bool:
        """True if some nodes move."""
        return bool(self._entries or self._rows)

    def has(self, node: int) -> bool:
        """Return True if it is known where a node (id) is."""
        return node in self._entries or node in self._rows or node in self._fixed

    def at(self, node: int, time: float, x: FloatArray | None) -> tuple[float, ...]:
        """Return the point of ``node`` (id) at ``time`` (s), by its state ``x`` if ``of_state``."""
        if node in self._entries:
            assert x is not None
            return tuple(x[self._entries[node]].tolist())
        if node in self._rows:
            times, points = self._rows[node]
            return tuple(points[np.searchsorted(times, time, side="right") - 1].tolist())
        return self._fixed[node]

    def distance(self, link: Link, time: float = 0.0, x: FloatArray | None = None) -> float:
        """Return the distance between the ends of a ``link``, see ``at``."""
        return math.dist(self.at(link[0], time, x), self.at(link[1], time, x))
