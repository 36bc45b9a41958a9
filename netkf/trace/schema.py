"""Names and types of recorded events, and the columns of tables."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

KINDS = (
    "sense", "tick", "send", "deliver", "lost", "late", "absorb", "swap", "round", "stop", "crash",
    "restart", "diverged", "transmit", "link", "join", "leave", "refuse", "clip",
)  # fmt: skip
"""Event kinds; a row stores the index of its kind in this tuple.

sense    node took the reading that ends at t
tick     the link node - peer activated
send     node sent message number ``message`` to peer
lost     that message (node to peer) was lost by the channel
deliver  node received message number ``message`` from peer, ``age`` seconds after it was sent
late     the same, but it was not used and counts as lost: in slots its exchange had ended, under
         clocks the filter refused it, for example as too old
absorb   node used all messages of t in one reset; ``age`` is that of the oldest message
swap     node replaced its estimate and covariance by those of peer
round    a step of exchange number ``phase`` of the slot begins, in which every node sends
stop     node has permanently frozen its network estimate in exchange number ``phase``
crash    node is down from now on (network.lives): what arrives meanwhile is lost
restart  it is up again
diverged the estimate of node or its squared error was no longer finite, or its covariance no longer
         finite and positive semidefinite
transmit node transmitted once, as its transmission number ``message``, to all that may hear it
link     the link node - peer of a range graph is up (``message`` 1) or down (0), and was not when
         it was looked at last; it is down before the first look
refuse   a gate refused a reading of one of node's sensors, or one that peer sent to node
clip     a message that node sends has ``message`` numbers that are, with their dither, beyond the
         range of network.quantise
join, leave  as restart and crash, of a node that a table lets join and leave the network
"""

CODES = {kind: code for code, kind in enumerate(KINDS)}

(SENSE, TICK, SEND, DELIVER, LOST, LATE, ABSORB, SWAP, ROUND, STOP, CRASH, RESTART, DIVERGED,
 TRANSMIT, LINK, JOIN, LEAVE, REFUSE, CLIP) = range(len(KINDS))  # fmt: skip

EVENT = np.dtype(
    [
        ("t", "<f8"),
        ("kind", "u1"),
        ("node", "<i8"),
        ("peer", "<i8"),
        ("message", "<i8"),
        ("phase", "<i4"),
        ("age", "<f8"),
    ]
)
"""One event; -1 or nan in columns that do not apply to its kind."""


EVENT_COLUMNS = ("run", "seq", "t", "kind", "node", "peer", "message", "phase", "age")


def rows_of(log: np.ndarray, *kinds: str) -> np.ndarray:
    """Return the EVENT rows of a ``log`` (E,) that are of one of ``kinds``."""
    wanted = np.logical_or.reduce([log["kind"] == CODES[kind] for kind in kinds])
    # A mask would copy rows field by field, which takes twenty times as long.
    return np.take(log, np.flatnonzero(wanted))


def join_rows(blocks: Sequence[np.ndarray]) -> np.ndarray:
    """Return ``blocks`` of EVENT rows as one array."""
    # As bytes: numpy would copy them field by field.
    joined = [np.empty(0, dtype=np.uint8), *(rows.view(np.uint8) for rows in blocks)]
    return np.concatenate(joined).view(EVENT)


def state_columns(n: int) -> list[str]:
    """Return the columns of the table of states of n-dimensional plants.

    P is given by the rows of its upper triangle.
    """
    states = [f"{name}{i}" for name in ("x", "xhat") for i in range(n)]
    return ["run", "t", "node", *states, *_upper_names("P", n), "sq_error", "nees"]


def ensemble_columns(n: int) -> list[str]:
    """Return the columns of the table of an ensemble of n-dimensional plants.

    They are means over ``runs`` of P, of E = (x - xhat)(x - xhat)' and of NEES, each followed by
    its standard error.
    """
    P, E = _upper_names("P", n), _upper_names("E", n)
    matrices = [*P, *(f"{name}_se" for name in P), *E, *(f"{name}_se" for name in E)]
    return ["t", "node", "runs", *matrices, "nees", "nees_se"]


def _upper_names(name: str, n: int) -> list[str]:
    join = "" if n <= 10 else "_"
    return [f"{name}{i}{join}{j}" for i in range(n) for j in range(i, n)]
