"""Which filters exchange estimates and nothing else, as the texts of their verbs say.

What two nodes make of each other's messages then depends on their estimates and on the weights of
the links alone, so that an engine may compute it for many pairs of nodes side by side, whenever
and wherever these exchange.
"""

from __future__ import annotations

import builtins
import inspect
import math
from collections.abc import Callable
from functools import cache
from typing import Any, cast

import numpy as np

from netkf.algorithms.kernels.run import SlotRun, carry, carry_mean
from netkf.algorithms.records import Kernels, Record

INBOX = ("count", "message", "link", "message_weight", "arrived", "age")
SCRATCH = ("row", "gains", "moved_mean", "moved", "noise", "whitened", "total")
OF_MESSAGES = frozenset(("lanes", "size", "model", *INBOX, *SCRATCH))
"""Fields of a run that an exchange of estimates may use; ``model`` predicts late messages."""
_OTHERS = frozenset(SlotRun.__annotations__) - OF_MESSAGES
_OF_MODULES = frozenset((*dir(math), *dir(np), *dir(builtins)))


def exchanges_estimates(kernels: Kernels, record: Record) -> bool:
    """Return True if nodes are Kalman filters on own readings that know nothing but their
    estimates, and whose ``emit`` and ``absorb`` use nothing but those and the weights of messages.
    """
    own = {name: getattr(kernels, name) for name in ("record", "emit", "absorb", "unrolled")}
    known = {"xhat", "root", "payload", *record.node, *record.payload}
    return (
        kernels == Kernels(**own)
        and set(record.node) <= set(record.transient)
        and not record.past
        and not record.link
        and _names(kernels) <= {*known, *record.scratch, *record.settings, *OF_MESSAGES}
    )


@cache
def _names(kernels: Kernels) -> frozenset[str]:
    """Return the names in ``emit``, ``absorb`` and kernels that they call, but of ``linalg``."""
    found, texts = set[str](), [_text(kernels.emit), _text(kernels.absorb)]
    for text in texts:  # grows
        for name in text.__code__.co_names:
            value = None if name in _OTHERS else text.__globals__.get(name)
            if value is None:
                if name in _OTHERS or name not in _OF_MODULES:
                    found.add(name)
            elif hasattr(value, "loops") or hasattr(value, "__wrapped__"):
                if (inner := _text(value)) not in texts:
                    texts.append(inner)
            elif not _is_harmless(value):
                found.add(name)
    return frozenset(found)


def _text(kernel: Any) -> Callable[..., Any]:
    """Return the Python function of a kernel, also of one that is not compiled."""
    return cast(Callable[..., Any], getattr(kernel, "loops", None) or inspect.unwrap(kernel))


def _is_harmless(value: Any) -> bool:
    """Return True for numbers, modules of functions, what predicts late messages, and helpers."""
    is_constant = isinstance(value, int | float | tuple) or value in (math, np, carry, carry_mean)
    return is_constant or getattr(value, "__module__", "").startswith("netkf.linalg.")
