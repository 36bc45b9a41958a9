"""Who hears whom while nodes move: by their distances at the present instant of a run."""

from __future__ import annotations

from typing import Any

from netkf.engines.simpy.timeline import Timeline
from netkf.network.graphs import Link
from netkf.scenario.scenario import Scenario
from netkf.trace.recorder import NAN, Recorder
from netkf.trace.schema import CODES

LINK = CODES["link"]


class Reach:
    """The distances of nodes in one run, whose true state is ``truth``, and the links that are up.

    ``slot`` is the present one in slots, where nodes are where its state says; else None.
    """

    def __init__(
        self, scenario: Scenario, timeline: Timeline, recorder: Recorder, truth: Any
    ) -> None:
        self._timeline, self._recorder, self._truth = timeline, recorder, truth
        self._positions, self._loss = scenario.positions, scenario.network.channel.loss
        self._radius, self._links = scenario.topology.radius, scenario.topology.links
        self.slot: int | None = 0 if scenario.slotted else None
        # Links that are up, as far as anyone has looked.
        self._up: set[Link] = set()

    def _distance(self, i: int, j: int) -> float:
        now, x = self._timeline.now, None
        if self._positions.of_state:
            x = self._truth.absolute(now if self.slot is None else self.slot)
        return self._positions.distance((i, j), now, x)

    def delivery(self, link: Link) -> float:
        """Return the probability that a message that is sent now arrives, by the distance of its
        ends.
        """
        return self._loss.at_distance(self._distance(*link))

    def connects(self, i: int, j: int) -> bool:
        """Return True if the link of two nodes is up; record if it was not when looked at last."""
        if self._radius is None:
            return True
        link = (min(i, j), max(i, j))
        is_up = self._distance(*link) <= self._radius
        if is_up != (link in self._up):
            self._recorder.append((self._timeline.now, LINK, *link, int(is_up), -1, NAN))
            self._up ^= {link}
        return is_up

    def look_at_all(self, slot: int | None) -> None:
        """Record all links that have changed since they were looked at last; ``slot`` is the
        present one, None under clocks.
        """
        self.slot = slot
        if self._radius is not None:
            for link in self._links:
                self.connects(*link)
