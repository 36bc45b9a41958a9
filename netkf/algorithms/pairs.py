"""Pairs (xhat, root), estimate and root of its covariance, of a node and of those it hears, stacked
for filters that combine them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from netkf.algorithms.filter import Message
from netkf.linalg.arrays import FloatArray


def pairs_now(state: Any, messages: Sequence[Message]) -> tuple[FloatArray, FloatArray]:
    """Return estimates (k, n) and roots (k, n, n): the node's own first, from ``state``, then those
    in the payloads of k - 1 ``messages``.

    Under clocks a message may be old: its pair is predicted to now without readings.
    """
    pairs = [(state.xhat, state.root)]
    pairs += [state.model.extrapolate(m.payload.xhat, m.payload.root, m.age) for m in messages]
    means, roots = (np.stack(part) for part in zip(*pairs, strict=True))
    return means, roots


def weighted_pairs(
    state: Any, messages: Sequence[Message]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return weights (k,), estimates (k, n) and roots (k, n, n) of a node, first, and its k - 1
    ``messages``; the node's own weight is 1 minus those of the messages, but not negative.
    """
    own = max(0.0, 1.0 - sum(message.weight for message in messages))
    return np.array([own, *(message.weight for message in messages)]), *pairs_now(state, messages)
