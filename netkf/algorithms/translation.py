"""How a node reads a message of a node that estimates other blocks of the state."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from netkf.core.contracts import ContractError
from netkf.linalg.arrays import FloatArray

REMEDY = "let needs say how it is read, Needs(translate=...), or let all nodes estimate the same"


class Common(NamedTuple):
    """The states that a sender and a receiver both estimate.

    theirs, mine : their entries (k,) in the state of the sender, and in that of the receiver
    before : ``before(x)`` is the state (n,) of the receiver from which x (n,) follows in the time
             that the message took
    """

    theirs: np.ndarray
    mine: np.ndarray
    before: Callable[[FloatArray], FloatArray]


def read_vector(payload: Any, own: Any, common: Common) -> Any:
    """Return a ``payload`` that is one vector of the sender's states as one of the receiver's: of
    states that the sender does not estimate it says what the receiver would have said, ``own``, so
    that differences between both vanish there.

    Raises ContractError for other payloads.
    """
    fields = getattr(payload, "fields", None)
    if fields is not None and own is not None and len(fields) == 1:
        (name,) = fields
        read = read_vector(getattr(payload, name), getattr(own, name), common)
        return own._replace(**{name: read})
    for one in (payload, own):
        # Of several columns, see ``Analysis.affine``, both have as many.
        if not isinstance(one, np.ndarray) or not one.ndim or one.shape[1:] != own.shape[1:]:
            raise ContractError(
                "a message between nodes that estimate different blocks must be one vector of the "
                f"state, and this one is a {type(one).__name__}: {REMEDY}"
            )
    read = common.before(own).copy()
    read[common.mine] = payload[common.theirs]
    return read


def state_before(model: Any, x: FloatArray, age: float) -> FloatArray:
    """Return the state (n,) of which ``x`` (n,) is the prediction ``age`` seconds later."""
    nothing, earlier = np.zeros((len(x), len(x))), x
    # One step of Newton's method where the model is linear; none in slots.
    for _ in range(8):
        excess = model.extrapolate(earlier, nothing, age)[0] - x
        if age <= 0.0 or np.abs(excess).max() <= 1e-14 * np.abs(x).max():
            break
        earlier = earlier - np.linalg.lstsq(model.transition(earlier, age), excess, rcond=0.0)[0]
    return earlier
