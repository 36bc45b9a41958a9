"""Event-triggered consensus on information: Battistelli, Chisci and Selvi, "A distributed Kalman
filter with event-triggered communication and guaranteed stability", Automatica 93, 2018.

In each slot a node predicts, updates with its reading, sends its estimate unless its neighbours can
predict it well enough (they keep a copy of what it sent last), and combines by covariance
intersection (Xie, Gan and Liu, paper D (8) and (9)): ``P^-1 = sum w_j P_j^-1`` and
``P^-1 x = sum w_j P_j^-1 x_j``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from netkf.algorithms.filter import Filter, NodeInfo
from netkf.algorithms.information_consensus import INFORMATION, Hcmci
from netkf.algorithms.kernels.intersection import (
    finish_lanes,
    invert_lanes,
    merge_lanes,
    write_information_root,
)
from netkf.algorithms.kernels.run import copy_estimate, predict_copy, predict_estimate, shift_vector
from netkf.algorithms.kernels.triggers import is_near
from netkf.algorithms.records import Kernels, Record
from netkf.algorithms.registry import built_in
from netkf.algorithms.traits import Analysis, Needs, Timing, unless_all_arrive
from netkf.core.fields import Rule, field, number, tuple_of
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import any_lane, load, load_flags, select, spread, store_flags


@kernel
def predict(record: Any, h: int, run: Any) -> None:
    """Predict node ``h``, and the copies of estimates as their senders do: so they stay the same at
    both ends.
    """
    predict_estimate(run.model, run, record.xhat, record.root, h, h)
    if any_lane(load_flags(run.lanes, record.has_sent, h)):
        predict_copy(run.model, run, record.sent_x, record.sent_root, h)
    for w in range(run.first[h], run.first[h + 1]):
        if any_lane(load_flags(run.lanes, record.has_copy, w)):
            predict_copy(run.model, run, record.copy_x, record.copy_root, w)


@kernel
def emit(record: Any, h: int, m: int, run: Any) -> None:
    """Send the estimate of node ``h``, unless the neighbours' copy of it is near enough."""
    lanes, payload, x, root = run.lanes, record.payload, record.xhat, record.root
    near = is_near(run, x, root, h, record.sent_x, record.sent_root, h, record.alpha, record.ratio)
    known = load_flags(lanes, record.has_sent, h)
    store_flags(lanes, record.awake, h, load_flags(lanes, run.sends))
    silent = select(known, select(near, 1.0, 0.0), 0.0) > 0.0
    sent = select(silent, 0.0, select(load_flags(lanes, run.sends), 1.0, 0.0)) > 0.0
    store_flags(lanes, run.sends, sent)
    store_flags(lanes, record.has_sent, h, select(sent, 1.0, select(known, 1.0, 0.0)) > 0.0)
    copy_estimate(run, record.sent_x, record.sent_root, h, x, root, h, sent)
    copy_estimate(run, payload.xhat, payload.root, m, x, root, h, True)


@kernel
def absorb(record: Any, h: int, run: Any) -> None:
    """Combine the estimate of node ``h`` with those that arrive and with the copies of silent
    neighbours' estimates, whose covariances are enlarged, by covariance intersection.
    """
    lanes, payload, x, first = run.lanes, record.payload, record.xhat, run.first
    copy_x, copy_root, inverse = record.copy_x, record.copy_root, record.copy_inverse
    for w in range(first[h], first[h + 1]):
        store_flags(lanes, record.fresh, w, spread(lanes, 0.0) > 0.0)
    # The estimates that arrive replace the copies of their links.
    for k in range(run.count):
        w, m, arrived = run.link[k], run.message[k], load_flags(lanes, run.arrived, k)
        copy_estimate(run, copy_x, copy_root, w, payload.xhat, payload.root, m, arrived)
        for q in range(len(lanes)):
            if run.arrived[k, q] == 1:
                record.has_copy[w, q] = record.fresh[w, q] = 1
                record.weight[w, q] = run.message_weight[k]
    # The weight of a neighbour that was never heard is 0: it stays with the node itself.
    copied = spread(lanes, 0.0)
    for w in range(first[h], first[h + 1]):
        copied += load(lanes, record.weight, w)
    # A node that is down hears no silence.
    copied = select(load_flags(lanes, record.awake, h), copied, 0.0)
    store_flags(lanes, record.awake, h, spread(lanes, 0.0) > 0.0)
    # A node without any copy keeps its estimate, without rounding.
    if not any_lane(copied > 0.0):
        return
    own = select(copied < 1.0, 1.0 - copied, 0.0)
    invert_lanes(lanes, run.size, record.inverse, h, record.root, h)
    write_information_root(lanes, run.size, run.total, own, record.inverse, x, h, x, h)
    for w in range(first[h], first[h + 1]):
        if any_lane(load_flags(lanes, record.has_copy, w)):
            # The covariance of a silent neighbour's copy is enlarged by 1 / share.
            share = select(load_flags(lanes, record.fresh, w), 1.0, record.share)
            invert_lanes(lanes, run.size, inverse, w, copy_root, w)
            weight = share * load(lanes, record.weight, w)
            write_information_root(lanes, run.size, run.whitened, weight, inverse, copy_x, w, x, h)
            merge_lanes(lanes, run.size, run.total, run.whitened)
    finish_lanes(lanes, run.size, record.root, x, h, x, run.total, run.whitened, copied == 0.0)


@kernel
def shift(record: Any, h: int, run: Any) -> None:
    """Move the estimate of node ``h`` and all copies: the triggers look at differences."""
    shift_vector(run, record.xhat, h)
    shift_vector(run, record.sent_x, h)
    for w in range(run.first[h], run.first[h + 1]):
        shift_vector(run, record.copy_x, w)


def _is_information_consensus(value: Any) -> Filter:
    """Return ``value`` if it is an ``Hcmci`` with one step; else raise."""
    if not isinstance(value, Hcmci) or type(value) is not Hcmci:
        raise TypeError
    if value.consensus != INFORMATION or value.steps != 1:
        raise ValueError
    return value


INNER = Rule(
    "must be consensus on information with one step a slot",
    _is_information_consensus,
    'write inner = { kind = "hcmci", consensus = "information" }',
)
NOT_NEGATIVE = number(low=0.0)
THRESHOLDS = tuple_of(
    NOT_NEGATIVE,
    NOT_NEGATIVE,
    description="two numbers [estimate, covariance] that are not negative",
)


def event_triggered_ci_record(
    filtering: EventTriggeredCi, _infos: Sequence[NodeInfo], models: Sequence[Any]
) -> Record:
    """Return what nodes sent last, what they heard last on each link, and the thresholds."""
    n, flag = len(models[0].information), ((), np.uint8)
    alpha, delta = filtering.thresholds
    return Record(
        node={
            **{"sent_x": (n,), "sent_root": (n, n), "inverse": (n, n)},
            **{"has_sent": flag, "awake": flag},
        },
        link={
            **{"copy_x": (n,), "copy_root": (n, n), "copy_inverse": (n, n)},
            **{"has_copy": flag, "fresh": flag, "weight": ()},
        },
        payload={"xhat": (n,), "root": (n, n)},
        settings={
            "alpha": float(alpha),
            "ratio": 1.0 + delta,
            # By which a silent neighbour's information shrinks.
            "share": 1.0 / ((1.0 + math.sqrt(alpha)) ** 2 * (1.0 + delta)),
        },
    )


@built_in("event-triggered", trigger="consensus")
@dataclass(frozen=True, eq=False)
class EventTriggeredCi(Filter):
    """Consensus on information with one step a slot, in which a node sends only if its neighbours
    could not predict its estimate well enough; else they use what they have predicted.

    inner       the filter that decides what is combined: ``hcmci`` with consensus on information
                and one step a slot
    thresholds  [alpha, delta]: a node is silent while ``(xhat - xbar)' P^-1 (xhat - xbar) < alpha``
                where xbar and Pbar are what it sent last, predicted to now, and while
                ``P < (1 + delta) Pbar`` and ``Pbar < (1 + delta) P``

    In place of a silent neighbour's (xhat, P) there is xbar with the enlarged covariance
    ``(1 + alpha^1/2)^2 (1 + delta) Pbar``, which bounds the second moment of its error (derived
    here, not in the paper): with d = xhat - xbar that of e + d is at most
    ``(1 + a) P + (1 + 1/a) d d'`` for any a > 0, ``d d' <= alpha P``, and a = alpha^1/2 is best.
    With thresholds 0 it is consensus on information. A sender does not notice that its message was
    lost: links should lose none.
    """

    inner: Filter = field(INNER, default=Hcmci(consensus=INFORMATION))
    thresholds: tuple[float, float] = field(THRESHOLDS, default=(1.0, 1.0))

    analysis = Analysis(paper="event_triggered", P_by_design=("larger", ""))
    timing = Timing(clocks=())
    needs = Needs(
        one_way=True,
        inverts=True,
        notes=unless_all_arrive(
            "event-triggered: messages may be lost, and a sender takes its neighbours to have what "
            "it sent; P may then be too small"
        ),
    )
    kernels = Kernels(
        predict=predict, emit=emit, absorb=absorb, shift=shift, decides=True,
        record=event_triggered_ci_record,
    )  # fmt: skip

    shift = Filter.shift  # affine, given who sends
