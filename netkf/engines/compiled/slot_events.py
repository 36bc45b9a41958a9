"""The events of R runs in slots: rows of the first one, and how many of each kind all have."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from netkf.engines.compiled.gates import with_clips, with_refusals
from netkf.engines.compiled.slot_messages import (
    EventRows,
    SlotMessages,
    SlotTimes,
    TracedNodes,
    Tracing,
    count_arrivals,
    count_sends,
    make_rows,
)
from netkf.engines.compiled.slot_setup import SlotSetup
from netkf.engines.compiled.slot_steps import step_times
from netkf.engines.compiled.slot_tables import COLUMNS
from netkf.engines.compiled.slot_transmissions import SlotTransmissions
from netkf.linalg.lanes import LANES, MANY, aligned, blocks_of, by_run
from netkf.scenario.scenario import Scenario
from netkf.trace.recorder import LONG
from netkf.trace.schema import (
    ABSORB,
    CLIP,
    DELIVER,
    EVENT,
    KINDS,
    LOST,
    REFUSE,
    ROUND,
    SEND,
    SENSE,
    STOP,
    SWAP,
    TICK,
)


class SlotBlock(NamedTuple):
    """What S slots of R runs decided: indices ``sampled`` (T,) of the slots with a sample, the
    times of the slots, their messages, and ``SlotPlan.refused`` and ``clipped``.
    """

    sampled: np.ndarray
    times: SlotTimes
    messages: SlotMessages
    refused: np.ndarray
    clipped: np.ndarray


class SlotEvents:
    """The events of R runs of one scenario, of some slots after the other.

    counts : (R, KINDS), how many of each kind so far, see ``count``
    """

    def __init__(
        self,
        scenario: Scenario,
        setup: SlotSetup,
        transmissions: SlotTransmissions,
        stopped: np.ndarray,
        runs: int,
    ) -> None:
        """``stopped`` (B, N, L) has the slot in which each node stops, once it does."""
        self._scenario, self._setup, self._transmissions = scenario, setup, transmissions
        self._stopped, self._runs = stopped, runs
        self.counts = np.zeros((runs, len(KINDS)), dtype=np.int64)

    def rows(self, block: SlotBlock) -> tuple[np.ndarray, np.ndarray]:
        """Return the first run's EVENT rows (K,), and how many precede each sample, (T,)."""
        tables = self._transmissions.tables
        if tables:
            # Tables know the events, but not in which slot nodes stopped, and what gates refused.
            rows, before_sample = tables[0].events(block.sampled, self._stopped[0, :, 0])
        else:
            before_sample = np.zeros(len(block.sampled), dtype=np.int64)
            rows = self._drawn_rows(block, 0, len(block.times.start), before_sample)
        return self._with_decisions(block, rows, before_sample)

    def _with_decisions(
        self, block: SlotBlock, rows: np.ndarray, before_sample: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return EVENT rows with those of gates and of clipped messages, see ``rows``."""
        times, scenario = block.times, self._scenario
        rows, before = with_refusals(scenario, times, block.refused, rows, before_sample)
        if not block.clipped.any():
            return rows, before
        steps = step_times(scenario, self._setup, times.first, len(times.start))
        return with_clips(self._setup, steps, block.clipped, rows, before)

    def rows_in_parts(self, block: SlotBlock) -> Iterator[np.ndarray]:
        """Yield the EVENT rows of the first run of a batch, some slots of the block at a time."""
        if self._transmissions.tables:
            yield self.rows(block)[0]
            return
        size = max(1, LONG // max(1, self._setup.rows_of(1)))
        # Samples of a batch are counted from the first of the run.
        before_sample = np.zeros(len(self._setup.samples), dtype=np.int64)
        count = len(block.times.start)
        for first in range(0, count, size):
            rows = self._drawn_rows(block, first, min(first + size, count), before_sample)
            yield self._with_decisions(block, rows, before_sample)[0]

    def _drawn_rows(
        self, block: SlotBlock, first: int, stop: int, before: np.ndarray
    ) -> np.ndarray:
        setup, channels = self._setup, self._transmissions.channels
        sent, stopped = self._transmissions.sent, self._stopped
        # Space for the largest number of rows.
        table = np.empty(setup.rows_of(stop - first), dtype=EVENT)
        # Kernels write the columns where the records have them.
        columns: Any = [table[name] for name in COLUMNS]
        nodes = TracedNodes(setup.nodes, setup.sensing, setup.links, sent, stopped)
        trace = Tracing(
            setup.stages, block.times, channels, nodes, block.messages,
            EventRows._make([*columns, before]), setup.algorithm.timing.pairwise,
        )  # fmt: skip
        count = make_rows(trace, first, stop)
        return table[:count]

    def count(self, block: SlotBlock) -> None:
        """Add the events of a block to ``self.counts`` (R, KINDS)."""
        setup, times, counts = self._setup, block.times, self.counts
        for r, tables in enumerate(self._transmissions.tables):
            counts[r] += tables.take_counts()
        if not self._transmissions.tables:
            self._count_drawn(block)
        refused = block.refused[:, times.recorded & times.sensed]
        counts[:, REFUSE] += by_run(refused.sum(axis=(1, 2), dtype=np.int64), self._runs)
        if block.clipped.size:
            clipped = block.clipped[:, times.recorded] > 0
            counts[:, CLIP] += by_run(clipped.sum(axis=(1, 2, 3), dtype=np.int64), self._runs)
        if setup.stages.stopping >= 0:
            since = by_run(self._stopped, self._runs) - times.first
            counts[:, STOP] += ((since >= 0) & (since < times.recorded.sum())).sum(axis=1)

    def _count_drawn(self, block: SlotBlock) -> None:
        setup, times, messages, counts = self._setup, block.times, block.messages, self.counts
        recorded, pairwise = times.recorded, setup.algorithm.timing.pairwise
        sensed, exchanged = recorded & times.sensed, recorded & times.exchanged
        sensing = len(setup.sensing) * int((setup.stages.step < 0).sum())
        counts[:, SENSE] += sensing * int(sensed.sum())
        if pairwise:
            counts[:, TICK] += messages.pair_count[:, recorded].sum(axis=(1, 2))
        else:
            counts[:, ROUND] += len(setup.fresh) * int(exchanged.sum())
        if pairwise or len(messages.sent):
            sends = np.zeros(self._runs, dtype=np.int64)
            count_sends(self._transmissions.channels, messages, exchanged, sends)
            counts[:, SEND] += sends
        else:
            counts[:, SEND] += int(setup.talks.sum()) * int(exchanged.sum())
        arrivals = aligned((blocks_of(self._runs), 2, LANES))
        count_arrivals(MANY, setup.links, messages.up, recorded, arrivals)
        arrived, receiving = by_run(arrivals, self._runs).astype(np.int64).T
        counts[:, DELIVER] += arrived
        counts[:, LOST] = counts[:, SEND] - counts[:, DELIVER]
        counts[:, SWAP if pairwise else ABSORB] += arrived if pairwise else receiving
