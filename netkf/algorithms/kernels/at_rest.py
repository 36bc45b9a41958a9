"""The surroundings of nodes before any event: fields of a run that are alike in all engines."""

from __future__ import annotations

from typing import Any

import numpy as np

from netkf.algorithms.kernels.gates import no_gate
from netkf.algorithms.kernels.nonlinear_rows import no_nonlinear
from netkf.algorithms.kernels.pairs import no_pairs
from netkf.algorithms.kernels.run import ALIKE, ALL, scratch_of
from netkf.linalg.lanes import aligned


def run_at_rest(n: int, L: int, messages: int) -> dict[str, Any]:
    """Return by name the fields of a ``SlotRun``, or what stands for one, of n states and L lanes
    with room for so many ``messages``; links, readings, model and size are for the caller.
    """
    sends = aligned((L,), np.uint8)
    sends[:] = 1
    return {
        **empty_inbox(L, messages),
        "sends": sends,
        "uniform": aligned((L,)),
        "common": ALIKE,
        "pairs": no_pairs(),
        "nonlinear": no_nonlinear(),
        "gate": no_gate(),
        "receiver": ALL,
        **dict.fromkeys(("slot", "phase", "step"), -1),
        **dict.fromkeys(("reading", "first_y", "first_H", "count"), 0),
        **dict.fromkeys(("gap", "now"), 0.0),
        **scratch_of(n, L),
    }


def empty_inbox(L: int, messages: int) -> dict[str, Any]:
    """Return by name the inbox of a run with L lanes, with room for so many ``messages``."""
    arrived = aligned((messages, L), np.uint8)
    arrived[:] = 1
    return {
        "message": np.zeros(messages, dtype=np.int64),
        "link": np.zeros(messages, dtype=np.int64),
        "message_weight": np.zeros(messages),
        "age": np.zeros(messages),
        "heard": np.full(messages, -1),
        "arrived": arrived,
    }
