"""Recording of samples that compiled code has taken."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from netkf.engines.base import Progress
from netkf.engines.soundness import sound_mask
from netkf.scenario.scenario import Scenario
from netkf.trace.recorder import NAN, Recorder
from netkf.trace.run import StateSamples
from netkf.trace.schema import CODES

DIVERGED = CODES["diverged"]


def record_samples(
    scenario: Scenario,
    recorder: Recorder,
    progress: Progress,
    samples: StateSamples,
    pass_rows_on: Callable[[int], None],
) -> bool:
    """Record K samples (times (K,), x (K, n), xhat (K, F, n), ... of F filters) up to the first one
    that is not sound, at which the run ends as diverged: an estimate or the square of an error is
    not finite, or a covariance not positive semidefinite. Return True if all are sound.

    ``pass_rows_on`` is called with the index of the first sample that is not sound, to record the
    events before it; later ones are dropped. If filters are pooled, ``samples`` have one estimator
    for all nodes (F = 1), and are recorded for each of them. ``progress`` is called with the
    simulated seconds reached.
    """
    times, x, xhat, P, error = samples
    # The loop may stop for other reasons than samples.
    if not len(times):
        return True
    known = error if scenario.plant.truth_known else None
    sound_filters = sound_mask(xhat, P, error=known, of_roots=True)
    sound = sound_filters.all(axis=1)
    # The trace shows a row for each node, though all of them share a pooled filter.
    if scenario.node_filter.timing.pooled:
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
    for node in (scenario.nodes[k] for k in np.flatnonzero(~sound_filters[last])):
        recorder.append((time, DIVERGED, node, -1, -1, -1, NAN))
    return False
