"""Who is up now: nodes that crash, sleep, join and leave."""

from __future__ import annotations

from functools import partial
from typing import Any

from netkf.engines.base import Rank
from netkf.engines.simpy.timeline import Process, Timeline
from netkf.network.lives import Lifetime, lifetimes
from netkf.rng.streams import Streams
from netkf.scenario.scenario import Scenario
from netkf.trace.recorder import NAN, Recorder
from netkf.trace.schema import CODES


class Membership:
    """Which nodes are up now; all of them without ``network.lives``."""

    def __init__(self, scenario: Scenario, streams: Streams, recorder: Recorder) -> None:
        self._recorder, self._index = recorder, scenario.topology.index
        self._fresh_estimate, self._horizon = scenario.fresh_estimate, scenario.horizon
        self._lives = lifetimes(scenario, streams)
        self._down = {node for node, life in self._lives.items() if not life.up}

    def up(self, *nodes: int) -> bool:
        """Return True if one of these nodes (ids) is up."""
        return not self._down.issuperset(nodes)

    def processes(self, timeline: Timeline, nodes: dict[int, Any]) -> list[Process]:
        """Return a process for each node that goes up or down in the run."""
        for node in self._down:
            nodes[node].set_up(False, 0.0)
        return [
            self._live(timeline, node, life, nodes[node])
            for node, life in self._lives.items()
            if life.changes
        ]

    def _live(self, timeline: Timeline, node: int, life: Lifetime, carrier: Any) -> Process:
        for change in life.changes:
            # Before anything else of this instant, but for a move of the origin.
            yield timeline.at(change.time, Rank.LIFE, self._index[node])
            code = CODES[change.kind]
            if change.time < self._horizon:
                self._recorder.append((change.time, code, node, -1, -1, -1, NAN))
            carrier.set_up(change.up, change.time)
            if change.up:
                self._down.remove(node)
                if life.forgets:
                    carrier.restart(change.time, partial(self._fresh_estimate, node))
            else:
                self._down.add(node)
                carrier.inbox.clear()
