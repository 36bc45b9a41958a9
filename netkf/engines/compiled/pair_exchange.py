"""What two nodes make of each other's messages, in lanes, by the verbs of their filter.

For ``visits``: L pairs of nodes that hear each other stand in the lanes of one record of two nodes,
whose verbs are those of runs side by side in slots.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from netkf.algorithms.kernels.at_rest import run_at_rest
from netkf.algorithms.kernels.run import SlotModelArrays, SlotRun, size_of
from netkf.algorithms.records import Kernels, make_records
from netkf.linalg.addresses import AnyStruct, address_of, any_struct, call_at, call_at_two
from netkf.linalg.arrays import FloatArray, IntArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import LANES, MANY, with_spare
from netkf.linalg.structs import Struct
from netkf.scenario.scenario import Scenario


class PairExchange(Struct):
    """The record of two nodes in L lanes, and what calls its verbs.

    emit, absorb : addresses of the verbs
    record, run : what they are called with
    xhat, root : (2, n, L) and (2, n, n, L), the estimates of the record, with spare memory behind
    message, link, message_weight, arrived : the inbox of the run, one message
    weights, weight_row : (K,) and (2, L), the distinct weights of links in ascending order, and
                          which of them the message to each node of a lane has
    """

    emit: int
    absorb: int
    record: AnyStruct
    run: AnyStruct
    xhat: FloatArray
    root: FloatArray
    message: IntArray
    link: IntArray
    message_weight: FloatArray
    arrived: np.ndarray
    weights: FloatArray
    weight_row: IntArray


def pair_exchange(scenario: Scenario, kernels: Kernels, weights: FloatArray) -> PairExchange:
    """Return the exchange of two nodes by these ``kernels``, over links of ``weights`` (W,)."""
    n, infos, (model, *_) = scenario.plant.n, scenario.node_infos, scenario.model_pieces[0]
    record = make_records(
        scenario.node_filter,
        [(np.zeros(n), np.zeros((n, n)))] * 2,
        [infos[0]] * 2,
        [model] * 2,
        links=2,
        messages=2,
        lanes=LANES,
    ).struct
    # Entries are gathered L at a time.
    record.xhat, record.root = with_spare((2, n, LANES)), with_spare((2, n, n, LANES))
    run = _run_of_pairs(n, kernels.unrolled)
    return PairExchange(
        emit=address_of(kernels.emit, record, run, 2),
        absorb=address_of(kernels.absorb, record, run),
        record=any_struct(record),
        run=any_struct(run),
        xhat=record.xhat,
        root=record.root,
        message=run.message,
        link=run.link,
        message_weight=run.message_weight,
        arrived=run.arrived,
        weights=np.unique(weights),
        weight_row=np.zeros((2, LANES), dtype=np.int64),
    )


def _run_of_pairs(n: int, unrolled: bool) -> Any:
    size = size_of(n, unrolled)
    cls = SlotRun.of_size(n) if isinstance(size, tuple) else SlotRun
    return cls(
        **run_at_rest(n, LANES, 1) | {"count": 1},
        size=size,
        lanes=MANY,
        # Messages take no time: nothing is predicted.
        model=SlotModelArrays(F=np.eye(n), root_Q=np.zeros((n, n))),
        first=np.arange(3),
        sender=np.array([1, 0]),
        opposite=np.array([1, 0]),
        weight=np.zeros(2),
        y=np.zeros((1, 1, LANES)),
        H=np.zeros((1, 1, 1, LANES)),
        rows=np.zeros(1, dtype=np.int64),
        matrix=np.zeros(2, dtype=np.int64),
    )


@kernel
def send_both(exchange: PairExchange) -> None:
    """Let both nodes send what they know, in all lanes."""
    for h in range(2):
        call_at_two(exchange.emit, exchange.record, h, h, exchange.run)


@kernel
def receive(exchange: PairExchange, side: int, receivers: IntArray) -> bool:
    """Let node ``side`` use what the other sent in lanes with ``receivers`` >= 0; False if none."""
    exchange.message[0], exchange.link[0] = 1 - side, side
    done, rows = 0, exchange.weight_row[side]
    for first in range(len(receivers)):
        if receivers[first] < 0 or (done >> first) & 1:
            continue
        # A message has one weight for all lanes: those of each weight together.
        for q in range(len(receivers)):
            alike = receivers[q] >= 0 and rows[q] == rows[first]
            exchange.arrived[0, q] = alike
            done |= int(alike) << q
        exchange.message_weight[0] = exchange.weights[rows[first]]
        call_at(exchange.absorb, exchange.record, side, exchange.run)
    return done != 0
