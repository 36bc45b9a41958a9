"""Recording of samples that compiled code has taken."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from netkf.engines.base import Progress
from netkf.engines.soundness import sound_mask
from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario
from netkf.trace.recorder import Recorder
from netkf.trace.run import StateSamples


def entries_of(scenario: Scenario) -> np.ndarray:
    """Return the entries (F, w) of the state that each filter models, -1 beyond the last."""
    pooled, count = scenario.node_filter.timing.pooled, len(scenario.nodes)
    if scenario.views is None or pooled:
        return np.tile(np.arange(scenario.plant.n), (1 if pooled else count, 1))
    entries = np.full((count, scenario.model_width), -1)
    for h, view in enumerate(scenario.model_views or ()):
        entries[h, : len(view)] = view
    return entries


def by_node(
    scenario: Scenario, xhat: FloatArray, P: FloatArray, error: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return samples (..., F, w) and (..., F, w, w) of filters as those of nodes, which are nan
    beyond the states that a node estimates; one for all nodes estimates all states.
    """
    if scenario.views is None:
        return xhat, P, error
    shape = *xhat.shape[:-2], len(scenario.nodes), scenario.width
    made = [np.full(s, np.nan) for s in (shape, (*shape, scenario.width), shape)]
    for k, view in enumerate(scenario.views):
        n, pooled = len(view), scenario.node_filter.timing.pooled
        h, own = (0, view) if pooled else (k, np.arange(n))
        made[0][..., k, :n], made[2][..., k, :n] = xhat[..., h, own], error[..., h, own]
        made[1][..., k, :n, :n] = P[..., h, own[:, None], own]
    return made[0], made[1], made[2]


def record_samples(
    scenario: Scenario,
    recorder: Recorder,
    progress: Progress,
    samples: StateSamples,
    pass_rows_on: Callable[[int], None],
) -> bool:
    """Record K samples of F filters, of one for all nodes if filters are pooled, up to the first
    that is not sound (``sound_mask``), at which the run ends as diverged. Return True if all are
    sound. ``pass_rows_on`` is called with the index of that sample, to record the events before it.
    """
    times, x, xhat, P, error = samples
    # The loop may stop for other reasons than samples.
    if not len(times):
        return True
    known = error if scenario.plant.truth_known else None
    if scenario.views is None:
        sound_filters = sound_mask(xhat, P, error=known, of_roots=True)
    else:
        masks = []
        for k, n in enumerate(map(len, scenario.views)):
            own = None if known is None else known[:, k, :n]
            masks.append(sound_mask(xhat[:, k, :n], P[:, k, :n, :n], error=own, of_roots=True))
        sound_filters = np.stack(masks, axis=1)
    sound = sound_filters.all(axis=1)
    # The trace shows a row for each node, though all of them share a pooled filter.
    if scenario.node_filter.timing.pooled and scenario.views is None:
        nodes = len(scenario.nodes)
        xhat, P, error = (np.repeat(values, nodes, axis=1) for values in (xhat, P, error))
        sound_filters = np.repeat(sound_filters, nodes, axis=1)
    # argmin finds the first False.
    last = len(times) - 1 if sound.all() else int(np.argmin(sound))
    after, time = last + 1, float(times[last])
    recorder.samples(times[:after], x[:after], xhat[:after], P[:after], error[:after])
    progress(time)
    if sound.all():
        return True
    # Events up to the sample come first, and then which nodes have diverged.
    pass_rows_on(last)
    broken = np.flatnonzero(~sound_filters[last]).tolist()
    recorder.end_as_diverged(time, [scenario.nodes[k] for k in broken])
    return False
