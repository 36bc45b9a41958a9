"""Runs in slots: make the messages, truth and readings of many slots, then simulate the filters.

A call of a kernel takes S slots of R runs, which are side by side in B blocks of L lanes
(linalg.lanes).
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from netkf.algorithms.filter import compiled_kernels
from netkf.core.memory import ReusableMemory, keep_freed_memory
from netkf.engines.base import Progress
from netkf.engines.compiled.quantiser import dither_of
from netkf.engines.compiled.samples import by_node, record_samples
from netkf.engines.compiled.slot_events import SlotBlock, SlotEvents
from netkf.engines.compiled.slot_filters import SlotFilters
from netkf.engines.compiled.slot_loop import WHOLE, SlotSamples
from netkf.engines.compiled.slot_messages import SlotMessages, SlotTimes
from netkf.engines.compiled.slot_readings import SlotReadings
from netkf.engines.compiled.slot_setup import BATCH_BYTES, SlotSetup, slot_setup
from netkf.engines.compiled.slot_transmissions import SlotTransmissions
from netkf.engines.compiled.slot_truth import SlotTruth
from netkf.linalg.arrays import FloatArray
from netkf.linalg.lanes import LANES, aligned, blocks_of, by_run
from netkf.rng.streams import Streams
from netkf.scenario.scenario import Scenario
from netkf.trace.batch import COMPLETE, DIVERGED, RunBatch
from netkf.trace.recorder import Recorder
from netkf.trace.run import StateSamples

NEVER, _ALL = np.iinfo(np.int64).max, np.zeros((0, 0), dtype=np.int64)
_samples = ReusableMemory(BATCH_BYTES)


class SampledStates(NamedTuple):
    """T samples of R runs with H filters each, in the coordinates of the plant.

    x : (R, T, n), states of the plant
    xhat, error : (R, T, H, w), estimates and x - xhat, nan where a filter has fewer states than w
    P : (R, T, H, w, w)
    """

    x: FloatArray
    xhat: FloatArray
    P: FloatArray
    error: FloatArray


class SlotRuns:
    """R runs of one scenario, simulated side by side, some slots at a time. ``store_all``: keep the
    samples of all slots, for the results of a batch.
    """

    def __init__(self, scenario: Scenario, streams: Streams, store_all: bool = False) -> None:
        self.setup: SlotSetup = slot_setup(scenario)
        self._scenario = scenario
        # One run, or the replicas of a batch.
        self.runs = runs = streams.runs
        self._slot = 0
        setup, blocks = self.setup, blocks_of(runs)
        # A batch stores the samples of the whole runs, a single run those of a block at a time.
        self.samples = self._empty_samples(len(setup.samples)) if store_all else None
        self._total = aligned((blocks, LANES))
        self._transmissions = messages = SlotTransmissions(scenario, setup, streams)
        lives = [one.lives for one in messages.tables] if scenario.network.lives else []
        self._truth = SlotTruth(scenario, setup, streams)
        self._readings = readings = SlotReadings(scenario, setup, streams, lives)
        kernels = compiled_kernels(setup.algorithm, clocked=False)
        assert kernels is not None
        self._filters = SlotFilters(
            setup, kernels, blocks, active=min(runs, LANES), pairs=readings.pairs
        )
        if readings.nonlinear is not None:
            self._filters.set_rows(readings.nonlinear)
        self._filters.quantiser.with_streams(dither_of(scenario, streams))
        arrays = self._filters.records.arrays
        self._conserved = arrays.get("conserved", aligned((blocks, setup.estimators, 2, LANES)))
        if setup.conserved_names:
            self._filters.observe()
        self._at_start = self._sums(1)
        # A node that never stops does so in a slot that no run reaches.
        never = np.full((blocks, setup.estimators, LANES), NEVER)
        stopped = arrays.get("stopped", never)
        self.events = SlotEvents(scenario, setup, messages, stopped, runs)

    @property
    def over(self) -> bool:
        """Return True if all slots have been simulated."""
        return self._slot >= self.setup.slots

    def following(self, max_events: int) -> tuple[SlotBlock, SampledStates]:
        """Simulate the next slots in all R runs, with about ``max_events`` events at most (0: no
        limit); return the samples of these slots, or of all slots so far.
        """
        count = self._transmissions.count_slots(self._slot, max_events)
        times = self._next_times(count)
        messages = self._transmissions.messages(times)
        local, absolute, rebased = self._truth.states(self._slot, count)
        drawn, believed = self._truth.is_drawn, self._scenario.origin_response
        y, H = self._readings.draw(times, local, rebased)
        sampled = np.flatnonzero(times.sample >= 0)
        samples = self.samples if self.samples is not None else self._empty_samples(len(sampled))
        # Kernels take flat entries for each sample. Explicit lengths, since reshape(-1) fails for
        # the empty arrays of a block without a sample.
        x, xhat, P, error = (a.reshape(*a.shape[:2], math.prod(a.shape[2:])) for a in samples)
        kernel_samples = SlotSamples(
            x=x, xhat=xhat, P=P, error=error, absolute=absolute, local=local,
            framed=drawn and absolute is not local, total=self._total,
            **self._filters.sample_scratch,
            entries=np.maximum(self.setup.entries, 0) if self.setup.views is not None else _ALL,
        )  # fmt: skip
        decided = self._simulate(times, messages, (y, H, rebased), kernel_samples)
        if not drawn and believed is not None:
            # Recorded states may be unknown, where coordinates begin is not.
            moved = believed.states(times.first + sampled)[:, self.setup.entries]
            samples.xhat[:, times.sample[sampled]] += moved
        return SlotBlock(sampled, times, messages, *decided), samples

    def _simulate(
        self,
        times: SlotTimes,
        messages: SlotMessages,
        readings: tuple[FloatArray, FloatArray, np.ndarray],
        samples: SlotSamples,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Simulate the filters; return ``refused`` and ``clipped`` of ``SlotPlan``."""
        filters, count, (y, H, rebased) = self._filters, len(times.start), readings
        gated = sum(map(len, self.setup.gated_parts)) if self.setup.gate is not None else 0
        transmissions, begin = self._transmissions, WHOLE
        unread = transmissions.missed_readings(times, messages)
        speaks = transmissions.senders(times, messages, unread)
        drawn: dict[str, Any] = {
            "first": self._slot,
            "sensed": times.sensed,
            "exchanged": times.exchanged,
            "sample": times.sample,
            "rebased": rebased,
            "up": messages.up,
            "sent": messages.sent,
            "uniform": transmissions.uniforms(messages.sent),
            "refused": np.zeros((len(self._total), count, gated, LANES), dtype=np.uint8),
            "speaks": speaks,
            "clipped": np.zeros(speaks.shape, dtype=np.int32),
        }
        # Nodes begin again before the first slot of a block.
        for h in transmissions.restarts(self._slot):
            # By how much its prior differs in the coordinates of this slot.
            start = self._slot - (not self.setup.algorithm.timing.predicts)
            filters.restart(h, self._scenario.prior_shift(self.setup.infos[h].node, start))

        def decide(step: int, up: np.ndarray) -> np.ndarray:
            nonlocal begin
            messages.up[0, 0, ..., 0] = up
            filters.simulate(y, H, samples, **drawn, begin=begin, stop=step)
            begin = step
            sent: np.ndarray = messages.sent[0, 0, step, :, 0] & ~unread[0, step]
            return sent

        # Filters decide who sends, and Python makes the messages: step by step.
        if transmissions.tables and self.setup.decides:
            messages.up[0, ..., 0] = transmissions.decided(times, decide)
        filters.simulate(y, H, samples, **drawn, begin=begin, stop=WHOLE)
        if len(messages.sent):
            # Only now, since the kernel decides for all nodes that are asked, readings or not.
            messages.sent[:, unread] = 0
        if self.setup.pairs is not None:
            self.setup.pairs.nonlinear.raise_error()
        self._slot += count
        return drawn["refused"], drawn["clipped"]

    def _empty_samples(self, count: int) -> SampledStates:
        """Return space for ``count`` samples of all R runs, in memory that is reused."""
        runs, setup = self.runs, self.setup
        filter_shape = runs, count, setup.estimators, setup.width
        shapes = (runs, count, setup.n), filter_shape, (*filter_shape, setup.width), filter_shape
        offsets = np.cumsum([math.prod(shape) for shape in shapes])
        # One allocation for all: numpy requests huge pages for large ones, which are cheap to get.
        arrays = np.split(_samples.array(int(offsets[-1])), offsets[:-1])
        return SampledStates(*(a.reshape(shape) for a, shape in zip(arrays, shapes, strict=True)))

    @property
    def broken(self) -> np.ndarray:
        """(R,) bool: runs with an estimate or covariance that is not finite."""
        return np.asarray(~np.isfinite(by_run(self._total, self.runs)))

    def _next_times(self, count: int) -> SlotTimes:
        """Return what happens in the next ``count`` slots, and when they begin."""
        setup, algorithm = self.setup, self.setup.algorithm
        slots = np.arange(self._slot, self._slot + count)
        recorded, active, exchanged = setup.activity(slots)
        # Filters that do not predict use no reading in slot 0: its sample is their initial state.
        sensed = active & ((slots > 0) | algorithm.timing.predicts)
        sample = np.full(count, -1, dtype=np.int64)
        first, last = np.searchsorted(setup.samples, (self._slot, self._slot + count))
        # Indices count from the first sample of the run, or of these slots.
        indices = np.arange(first, last) - (first if self.samples is None else 0)
        sample[setup.samples[first:last] - self._slot] = indices
        start = self._scenario.slot_plant.slot_times(slots)
        return SlotTimes(
            first=self._slot, start=start, recorded=recorded, sensed=sensed, exchanged=exchanged,
            sample=sample, predicts=algorithm.timing.predicts,
        )  # fmt: skip

    def conserved(self) -> dict[str, FloatArray]:
        """Return by name the sums that exchanges conserve: (R, 2), at the start and at the end."""
        # All runs start alike.
        return {
            name: np.array([[*self._at_start[name], value] for value in now])
            for name, now in self._sums(self.runs).items()
        }

    def _sums(self, runs: int) -> dict[str, list[float]]:
        """Return by name the sums that exchanges conserve at the last sample, of so many runs."""
        sums = by_run(self._conserved, runs)
        # fsum, so that the sums add no rounding of their own to that of the exchanges.
        return {
            name: [math.fsum(column) for column in sums[:, :, k].tolist()]
            for k, name in enumerate(self.setup.conserved_names)
        }


def run_slots(scenario: Scenario, streams: Streams, recorder: Recorder, progress: Progress) -> str:
    """Simulate one run in slots, see ``Engine.run``."""
    runs = SlotRuns(scenario, streams)
    recorder.exact_errors, recorder.unknown = scenario.exact_errors, scenario.unknown_samples
    try:
        while not runs.over:
            if not _record_block(scenario, runs, recorder, progress):
                return DIVERGED
    finally:
        recorder.flush()
    return COMPLETE


def _record_block(
    scenario: Scenario, runs: SlotRuns, recorder: Recorder, progress: Progress
) -> bool:
    # A limited number of rows at a time: memory does not grow with the length of the run.
    block, sampled = runs.following(MAX_EVENT_ROWS)
    rows, rows_before = runs.events.rows(block)
    if len(block.sampled):
        # Start and present value of each conserved sum.
        sums = runs.conserved()
        recorder.sums = {name: (float(v[0, 0]), float(v[0, 1])) for name, v in sums.items()}
    # One run: index 0 of all arrays.
    x, xhat, P, error = (values[0] for values in sampled)
    xhat, P, error = by_node(scenario, xhat, P, error)
    times = block.times.start[block.sampled]

    def pass_rows_on(k: int) -> None:
        recorder.extend(rows[: rows_before[k]])

    samples = StateSamples(times, x, xhat, P, error)
    sound = record_samples(scenario, recorder, progress, samples, pass_rows_on)
    if sound:
        recorder.extend(rows)
    return sound


MAX_EVENT_ROWS = 1 << 15
"""Rows of events of a block of slots, about."""


def slot_batches(
    scenario: Scenario, seed: int, replicas: range, fingerprint: bool
) -> Iterator[RunBatch]:
    """Yield the results of consecutive ``replicas``, as many runs at a time as fit the memory; with
    ``fingerprint`` the hash of the events of the first run.
    """
    keep_freed_memory()
    setup = slot_setup(scenario)
    # As many runs side by side as fit the memory.
    size = setup.batch_runs()
    for first in range(replicas.start, replicas.stop, size):
        count = min(size, replicas.stop - first)
        with_fingerprint = fingerprint and first == replicas.start
        yield slot_batch(scenario, seed, range(first, first + count), with_fingerprint)


def slot_batch(scenario: Scenario, seed: int, replicas: range, fingerprint: bool) -> RunBatch:
    """Simulate R consecutive ``replicas`` side by side. A run that diverges goes on to the end with
    invalid numbers, which ``with_ends`` replaces.
    """
    runs = SlotRuns(scenario, Streams(seed, replicas.start, len(replicas)), store_all=True)
    assert runs.samples is not None
    # The hash that trace.recorder computes: the rows of the first run are hashed, not stored.
    events_hash = hashlib.sha256()
    while not runs.over:
        with np.errstate(over="ignore", invalid="ignore"):
            block, _ = runs.following(max_events=0)
        runs.events.count(block)
        for rows in runs.events.rows_in_parts(block) if fingerprint else ():
            events_hash.update(rows.data)
    x, xhat, P, error = runs.samples
    broken = runs.broken
    if scenario.plant.truth_known:
        with np.errstate(over="ignore", invalid="ignore"):
            broken |= ~np.isfinite(np.einsum("rtfn,rtfn->r", error, error))
    xhat, P, error = by_node(scenario, xhat, P, error)
    return RunBatch(
        replicas=replicas,
        times=runs.setup.sample_times,
        x=x,
        xhat=xhat,
        P=P,
        error=error,
        lengths=np.full(len(replicas), x.shape[1]),
        counts=runs.events.counts,
        status=np.where(broken, DIVERGED, COMPLETE),
        sums=runs.conserved(),
        exact_errors=scenario.exact_errors,
        fingerprint=events_hash.hexdigest() if fingerprint else "",
    )


def with_ends(batch: RunBatch, alone: Callable[[range, bool], Iterator[RunBatch]]) -> RunBatch:
    """Return the batch with every run that diverges replaced by the same run simulated
    ``alone(replicas, fingerprint)``, which ends where it diverges.
    """
    for r in np.flatnonzero(batch.diverged).tolist():
        # Only the first run of a batch has a fingerprint.
        fingerprint = r == 0 and bool(batch.fingerprint)
        (single,) = alone(batch.replicas[r : r + 1], fingerprint)
        if fingerprint:
            batch = replace(batch, fingerprint=single.fingerprint)
        for name in ("x", "xhat", "P", "error", "lengths", "counts", "status"):
            getattr(batch, name)[r] = getattr(single, name)[0]
        for name, values in batch.sums.items():
            values[r] = single.sums[name][0]
    return batch
