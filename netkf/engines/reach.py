"""Who hears whom while nodes move: by their distances at the present instant of a run."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from netkf.linalg.arrays import FloatArray
from netkf.network.graphs import Link
from netkf.scenario.scenario import Scenario
from netkf.trace.recorder import NAN
from netkf.trace.schema import LINK


class Reach:
    """The distances of nodes in one run, whose true state is ``truth``, and the links that are up,
    at times ``now`` in seconds; ``append`` takes the rows of links that come up or go down.

    ``slot`` is the present one in slots, where nodes are where its state says; else None.
    """

    def __init__(self, scenario: Scenario, truth: Any, append: Callable[[Any], None]) -> None:
        self._truth, self._append = truth, append
        self._positions = scenario.positions
        self._radius, self._links = scenario.topology.radius, scenario.topology.links
        self.slot: int | None = 0 if scenario.slotted else None
        # Links that are up, as far as anyone has looked.
        self._up: set[Link] = set()
        # The present, and where the nodes are that have been asked for: most in many pairs.
        self._present: tuple[float, int | None] | None = None
        self._x: FloatArray | None = None
        self._points: dict[int, tuple[float, ...]] = {}

    def distance(self, i: int, j: int, now: float) -> float:
        """Return the distance of two nodes now."""
        if self._present != (now, self.slot):
            self._present = now, self.slot
            self._points.clear()
            if self._positions.of_state:
                self._x = self._truth.absolute(now if self.slot is None else self.slot)
        points = self._points
        for node in (i, j):
            if node not in points:
                points[node] = self._positions.at(node, now, self._x)
        return math.dist(points[i], points[j])

    def is_up(self, i: int, j: int, now: float) -> bool:
        """Return True if the link of two nodes is up."""
        return self._radius is None or self.distance(min(i, j), max(i, j), now) <= self._radius

    def connects(self, i: int, j: int, now: float) -> bool:
        """Return True if the link of two nodes is up; record if it was not when looked at last."""
        link, is_up = (min(i, j), max(i, j)), self.is_up(i, j, now)
        if self._radius is not None and is_up != (link in self._up):
            self._append((now, LINK, *link, int(is_up), -1, NAN))
            self._up ^= {link}
        return is_up

    def look_at_all(self, slot: int | None, now: float) -> None:
        """Record all links that changed since the last look, in ``slot``, None under clocks."""
        self.slot = slot
        if self._radius is not None:
            for link in self._links:
                self.connects(*link, now)
