"""How often the links of a range graph are up, and in how many parts the network falls."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from netkf.linalg.arrays import FloatArray
from netkf.network.graphs import node_columns
from netkf.scenario.scenario import Scenario
from netkf.trace.recorder import Sink


class ConnectivitySink(Sink):
    """Counts, at the samples of a run, the links that are up and the components that they make.

    up         : (L,) samples at which each link is up
    components : number of components at each sample
    """

    thread_safe: ClassVar[bool] = True

    def __init__(self, scenario: Scenario) -> None:
        self._topology, self._positions = scenario.topology, scenario.positions
        index = self._topology.index
        self._ends = np.array([(index[i], index[j]) for i, j in self._topology.links]).reshape(
            -1, 2
        )
        self.up, self.components = np.zeros(len(self._ends), dtype=np.int64), list[int]()

    def events(self, rows: np.ndarray) -> None:
        """Ignore events."""

    def states(
        self, t: FloatArray, x: FloatArray, xhat: FloatArray, P: FloatArray, error: FloatArray
    ) -> None:
        """Look at all links at T times t (T,) in seconds with the true states x (T, n)."""
        links, radius, size = self._topology.links, self._topology.radius, len(self._topology.nodes)
        assert radius is not None
        for time, state in zip(t.tolist(), x, strict=True):
            distances = [self._positions.distance(link, time, state) for link in links]
            up = np.array(distances, dtype=np.float64) <= radius
            ends = tuple(self._ends[up].T)
            graph = coo_array((np.ones(len(ends[0])), ends), shape=(size, size))
            self.components.append(int(connected_components(graph, directed=False)[0]))
            self.up += up

    def entry(self) -> dict[str, Any]:
        """Return the entry of summary.json: the share of samples at which the network is connected,
        the mean number of its components, and the share at which each link is up.
        """
        count = len(self.components)
        parts = np.array(self.components)
        links = [
            {**node_columns(i), "peer": j, "up": up / max(count, 1)}
            for (i, j), up in zip(self._topology.links, self.up.tolist(), strict=True)
        ]
        return {
            "samples": count,
            "connected": float((parts == 1).mean()) if count else None,
            "components": float(parts.mean()) if count else None,
            "links": links,
        }
