"""Statistics of many runs: computed for batches of runs, merged by the tree over replicas."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from netkf.engines.base import Engine, batch_sink, silent
from netkf.ensembles.merge_tree import MergeTree, aligned_pieces
from netkf.ensembles.moments import Moments, merge_moments, moments_of
from netkf.ensembles.reduction import reduce_batch
from netkf.linalg.arrays import FloatArray
from netkf.rng.streams import Streams
from netkf.runs.quantities import NetworkSink, sample_names, sample_quantities
from netkf.runs.simulate import collect_run
from netkf.scenario.scenario import Scenario
from netkf.trace.batch import RunBatch
from netkf.trace.nees import traces as traces_of
from netkf.trace.nees import without_padding
from netkf.trace.recorder import MemorySink, Recorder, Sink
from netkf.trace.schema import KINDS

MESSAGES = ("sent", "delivered", "lost", "in_flight", "transmissions")
PARTS = ("samples", "averages", "messages", "quantities")
"""Attributes of RunStatistics that are Moments."""


class Trace(NamedTuple):
    """All data of one run: events as EVENT rows, samples as in ``netkf.Run``."""

    replica: int
    log: np.ndarray
    times: FloatArray
    x: FloatArray
    xhat: FloatArray
    P: FloatArray
    error: FloatArray


class RunStatistics(NamedTuple):
    """Statistics of some runs of a scenario with N nodes; u = n (n + 1) / 2.

    samples       : (T, N (2 u + 1)) moments at each time, for each node of the upper triangles of
                    P and of e e', e the error, and of NEES
    averages      : (1, (N + 1) 3) moments over runs of the mean square error, mean trace of P and
                    mean NEES over the samples after time 0, for each node and all nodes
    quantities    : (1, (N + 1) K) moments of the quantities ``ensemble_names`` of runs
    messages      : (1, 5) moments of the counts MESSAGES; transmissions are nan in slots
    totals        : (2,) number of events and of diverged runs
    conserved     : for each conserved sum its moments at start and end (1, 2), and the largest
                    relative drift
    rounding_from : seconds, time of the first sample of any run at which rounding blurs the errors,
                    else inf
    fingerprint   : digest of the events of replica 0, once the statistics of all runs are merged
    traces        : traces that were kept, in the order of replicas
    """

    samples: Moments
    averages: Moments
    quantities: Moments
    messages: Moments
    totals: np.ndarray
    conserved: dict[str, tuple[Moments, float]]
    rounding_from: float
    fingerprint: str
    traces: tuple[Trace, ...] = ()

    @property
    def runs(self) -> int:
        """Number of runs."""
        return int(self.averages.size[0])


def merge(a: RunStatistics, b: RunStatistics) -> RunStatistics:
    """Return the statistics of the runs of ``a`` and ``b`` together; the replicas of ``a`` come
    directly before those of ``b``, as in the binary tree over replicas.
    """
    # A conserved sum keeps the drift of largest size, with its sign.
    conserved = {
        name: (merge_moments(sums, b.conserved[name][0]), max(drift, b.conserved[name][1], key=abs))
        for name, (sums, drift) in a.conserved.items()
    }
    return RunStatistics(
        **{name: merge_moments(getattr(a, name), getattr(b, name)) for name in PARTS},
        totals=a.totals + b.totals,
        conserved=conserved,
        rounding_from=min(a.rounding_from, b.rounding_from),
        fingerprint=a.fingerprint,
        traces=a.traces + b.traces,
    )


def block_statistics(
    scenario: Scenario, seed: int, replicas: range, engine: Engine, traces: int = 0
) -> RunStatistics:
    """Simulate a block of ``replicas`` with ``seed``, and return the statistics of their runs,
    merged in the binary tree over replicas.

    Of the first ``traces`` replicas of the ensemble (not of the block) events and samples are kept.
    """
    tree, count = MergeTree(merge), 0
    for batch, network, batch_traces in _batches(scenario, seed, replicas, engine, traces):
        # The nodes (level, k) of the tree that consist of runs of this batch.
        pieces = list(aligned_pieces(count, count + len(batch)))
        values = run_values(batch, scenario, network, count)
        for number, (level, k) in enumerate(pieces):
            piece = merge_runs(values, number)
            tree.add(k, piece._replace(fingerprint=batch.fingerprint, traces=batch_traces), level)
        count += len(batch)
    result: RunStatistics = tree.result()
    return result


def _batches(
    scenario: Scenario, seed: int, replicas: range, engine: Engine, traces: int
) -> Iterator[tuple[RunBatch, FloatArray | None, tuple[Trace, ...]]]:
    """Yield batches of the runs of ``replicas``, with quantities of networks, and with traces."""
    for replica in range(replicas.start, min(traces, replicas.stop)):
        memory = MemorySink()
        batch, network, recorder = _recorded_run(scenario, seed, replica, engine, memory)
        run = collect_run(
            scenario, memory, recorder, seed, replica, engine.name, str(batch.status[0])
        )
        trace = Trace(replica, run.log, run.times, run.x, run.xhat, run.P, run.error)
        yield batch, network, (trace,)
    untraced = range(max(replicas.start, traces), replicas.stop)
    if untraced:
        batches = simulate_batches(scenario, seed, untraced, engine, untraced.start == 0)
        for batch, network in batches:
            yield batch, network, ()


def simulate_batches(
    scenario: Scenario, seed: int, replicas: range, engine: Engine, fingerprint: bool = False
) -> Iterator[tuple[RunBatch, FloatArray | None]]:
    """Yield batches of the runs of ``replicas``, simulated with ``seed``, with the quantities
    NETWORK (R, N + 1, 6) of each of its R runs, None unless the scenario wants them.
    """
    if not scenario.metrics.network:
        for batch in engine.run_many(scenario, seed, replicas, fingerprint=fingerprint):
            yield batch, None
        return
    for replica in replicas:
        yield _recorded_run(scenario, seed, replica, engine)[:2]


def _recorded_run(
    scenario: Scenario, seed: int, replica: int, engine: Engine, *sinks: Sink
) -> tuple[RunBatch, FloatArray | None, Recorder]:
    sink, wanted = batch_sink(scenario, range(replica, replica + 1)), scenario.metrics.network
    network = [NetworkSink(scenario, seed, replica)] if wanted else []
    recorder = Recorder([sink, *network, *sinks])
    status = engine.run(scenario, Streams(seed, replica), recorder, silent)
    sink.finish(recorder, status)
    values = network[0].values(status == "complete")[None] if network else None
    return sink.batch(), values, recorder


class RunValues(NamedTuple):
    """Values of the R runs of a batch, and the K pieces in which they are merged.

    pieces   : K slices of the runs, each a node of the tree over all runs
    samples  : moments (T, F (2 u + 1)) of F filters for each piece
    copies   : number of nodes for which a filter stands: N for a pooled filter, else 1
    averages : (R, N + 1, 3) squared error, trace of P and NEES, of each node and of all
    quantities : (R, N + 1, K) those of ``ensemble_names``, of each node and of all
    messages : (R, 5) the counts MESSAGES
    events, diverged, rounding_from : (R,) number of events; True if the run diverged; first sample
               time (s) at which rounding blurs the errors, else inf
    sums     : (R, 2) each conserved sum at start and end
    """

    pieces: Sequence[slice]
    samples: Sequence[Moments]
    copies: int
    averages: FloatArray
    quantities: FloatArray
    messages: FloatArray
    events: np.ndarray
    diverged: np.ndarray
    rounding_from: FloatArray
    sums: dict[str, FloatArray]


def run_values(
    batch: RunBatch, scenario: Scenario, network: FloatArray | None = None, first: int = 0
) -> RunValues:
    """Return what statistics need of the R runs of a batch, with the quantities ``network`` if they
    are wanted; ``first`` is the index of its first run in the binary tree over all runs.
    """
    # The largest nodes of the tree that consist of runs of this batch.
    indices = [(k << level, level) for level, k in aligned_pieces(first, first + len(batch))]
    slices = [slice(at - first, at - first + (1 << level)) for at, level in indices]
    reduced, nodes = reduce_batch(batch, slices), len(scenario.nodes)
    # A pooled filter, which has the readings of all nodes, is stored once and stands for each node.
    copies, averages = nodes // batch.error.shape[2], reduced.averages
    if copies > 1:
        averages = np.repeat(averages, nodes, axis=1)
    # accumulate() adds in order; sum() may add in another one, and would give other bits.
    overall = np.add.accumulate(averages, axis=1)[:, -1:] / nodes
    return RunValues(
        pieces=slices,
        samples=reduced.samples,
        copies=copies,
        averages=np.concatenate([averages, overall], axis=1),
        quantities=_quantities(batch, scenario, reduced.spans, copies, network),
        messages=count_messages(batch.counts, scenario.slotted),
        events=batch.counts.sum(axis=1),
        diverged=batch.diverged,
        rounding_from=reduced.rounding_from,
        sums=dict(batch.sums),
    )


def _quantities(
    batch: RunBatch, scenario: Scenario, spans: np.ndarray, copies: int, network: FloatArray | None
) -> FloatArray:
    """Return ``RunValues.quantities`` over the samples ``spans`` (R, 3)."""
    if scenario.plant.truth_known:
        error, _ = without_padding(batch.error, batch.P)
        squares, ends = np.einsum("rtfi,rtfi->rtf", error, error), spans[:, 1]
    else:
        squares, ends = traces_of(batch.P), spans[:, 2]
    # Runs with the same samples, mostly all, together.
    found = np.empty((len(batch), len(scenario.nodes) + 1, len(sample_names(scenario))))
    for first, end in sorted(set(zip(spans[:, 0].tolist(), ends.tolist(), strict=True))):
        runs = (spans[:, 0] == first) & (ends == end)
        part = squares[:, first:end] if runs.all() else squares[runs, first:end]
        # A quantile of all nodes is between samples of all, though one filter stands for them.
        of_nodes = part if copies == 1 else np.repeat(part, copies, axis=2)
        found[runs] = sample_quantities(scenario, of_nodes)
    return found if network is None else np.concatenate([found, network], axis=2)


def merge_runs(values: RunValues, piece: int) -> RunStatistics:
    """Return the statistics of ``values.pieces[piece]``, without fingerprint and traces."""
    runs = values.pieces[piece]
    samples, parts = values.samples[piece], (values.averages, values.quantities, values.messages)
    columns = [part[runs].reshape(len(part[runs]), -1) for part in parts]
    # One value per run: every run has size 1. All columns in one call.
    sizes = np.ones((len(columns[0]), 1))
    whole = moments_of(np.concatenate(columns, axis=1)[:, None], sizes.copy())
    ends = np.cumsum([0, *(part.shape[1] for part in columns)]).tolist()
    averages, quantities, messages = (
        Moments(whole.size, whole.mean[:, first:end], whole.M2[:, first:end])
        for first, end in itertools.pairwise(ends)
    )
    # Moments of each conserved sum at the start and end, and its largest relative drift.
    conserved = {
        name: (
            moments_of(np.array(sums[runs, None]), sizes.copy()),
            float(max((sums[runs, 1] - sums[runs, 0]) / sums[runs, 0], key=abs)),
        )
        for name, sums in values.sums.items()
    }
    if values.copies > 1:
        # All nodes have the estimate of one pooled filter.
        mean, M2 = (np.tile(moment, values.copies) for moment in (samples.mean, samples.M2))
        samples = Moments(samples.size, mean, M2)
    return RunStatistics(
        samples=samples,
        averages=averages,
        quantities=quantities,
        messages=messages,
        totals=np.array([values.events[runs].sum(), values.diverged[runs].sum()]),
        conserved=conserved,
        rounding_from=float(values.rounding_from[runs].min()),
        fingerprint="",
    )


def count_messages(counts: np.ndarray, slotted: bool) -> FloatArray:
    """Return the numbers MESSAGES (R, 5) of R runs from numbers of events by kind, ``counts`` (R,
    len(KINDS)). Transmissions are nan if runs are ``slotted``: slots have no transmit events.
    """
    events = dict(zip(KINDS, counts.T.astype(np.float64), strict=True))
    sent, delivered, lost = events["send"], events["deliver"], events["lost"] + events["late"]
    # Without broadcasts every message is a transmission of its own.
    under_clocks = np.where(events["transmit"] > 0.0, events["transmit"], sent)
    transmissions = np.full(len(counts), math.nan) if slotted else under_clocks
    return np.stack([sent, delivered, lost, sent - delivered - lost, transmissions], axis=1)
