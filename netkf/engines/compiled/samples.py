"""Samples that were taken in compiled code, on their way to the recorder."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from netkf.engines.base import Progress
from netkf.engines.soundness import sound
from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario
from netkf.trace.recorder import NAN, Recorder
from netkf.trace.schema import CODES

DIVERGED = CODES["diverged"]


def recorded(
    scenario: Scenario,
    recorder: Recorder,
    progress: Progress,
    times: FloatArray,
    x: FloatArray,
    local: FloatArray,
    xhat: FloatArray,
    P: FloatArray,
    pass_rows_on: Callable[[int], None],
) -> bool:
    """Record the states x (T, n), which are ``local`` (T, n) in the coordinates of the estimates,
    xhat (T, H, n) and P (T, H, n, n) of H hosts at these times up to the first that is not sound;
    whether there is none. ``pass_rows_on`` is given the place of that
    one: what happened after it did not happen.
    """
    # The loop may stop for other reasons than samples.
    if not len(times):
        return True
    intact = sound(xhat, P).all(axis=1)
    # The trace shows a row for each node, though all of them share a pooled filter.
    if scenario.filter.algorithm.pooled:
        nodes = len(scenario.nodes)
        xhat, P = np.repeat(xhat, nodes, axis=1), np.repeat(P, nodes, axis=1)
    # argmin finds the first False.
    last = len(times) - 1 if intact.all() else int(np.argmin(intact))
    after, time = last + 1, float(times[last])
    # In local coordinates: the difference of absolute states would lose digits.
    error = local[:after, None] - xhat[:after]
    # Absolute estimates, for the trace only.
    far = xhat[:after] if local is x else xhat[:after] + (x - local)[:after, None]
    recorder.samples(times[:after], x[:after], far, P[:after], error)
    progress(time)
    if intact.all():
        return True
    # Events up to the sample come first, and then which nodes have diverged.
    pass_rows_on(last)
    lost = ~sound(xhat[last], P[last])
    for node in (scenario.nodes[k] for k in np.flatnonzero(lost)):
        recorder.append((time, DIVERGED, node, -1, -1, -1, NAN))
    return False
