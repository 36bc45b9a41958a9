"""Who hears whom at each tick of a run in which nodes move, found before the run."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from netkf.engines.compiled.senders import Senders
from netkf.engines.reach import Reach
from netkf.linalg.arrays import FloatArray, IntArray
from netkf.scenario.scenario import Scenario


class MovingLinks(NamedTuple):
    """The links of one run at its ticks.

    heard : (K,) bool of each direction: whether its ends can hear each other at its ticks
    distance : (K,) of each direction, of its ends then, where losses follow it
    owner : (C,), when links come up or go down as far as anyone looks: the number of the tick of
            the run, or -1 - k at sample k
    link : (C, 3), the ids of both ends, and 1 if it has come up
    """

    heard: list[np.ndarray]
    distance: list[FloatArray]
    owner: IntArray
    link: IntArray


def moving_links(
    scenario: Scenario,
    senders: Senders,
    listed: list[FloatArray],
    truth: Any,
    is_down: Callable[[int, FloatArray], np.ndarray],
) -> MovingLinks:
    """Return the links of a run at the ticks of its entities, ``listed`` (K,) in seconds, where
    nodes are where its ``truth`` says; ``is_down(index, times)`` says when a node is down.
    """
    rows: list[Any] = []
    reach, owner = Reach(scenario, truth, rows.append), list[int]()
    count, samples = sum(map(len, listed)), scenario.times[scenario.times < scenario.horizon]
    t = np.concatenate([np.empty(0), *listed, samples])
    entity = np.repeat(np.arange(len(listed) + 1), [*map(len, listed), len(samples)])
    heard: list[list[bool]] = [[] for _ in senders.directions]
    # Nobody looks at a link neither of whose ends can send.
    index, ends = scenario.topology.index, 1 + (senders.at == "links")
    awake = [
        {node: iter((~is_down(index[node], times)).tolist()) for node in entity[:ends]}
        for entity, times in zip(senders.entities, listed, strict=True)
    ]
    distance: list[list[float]] = [[] for _ in senders.directions]
    follows, number = scenario.network.channel.loss.follows_distance, [0, 0]
    # Samples come behind all ticks of their instant, and these in the order of entities.
    for k in np.lexsort((entity, t)).tolist():
        e, now, is_sample = int(entity[k]), float(t[k]), k >= count
        if is_sample:
            reach.look_at_all(None, now)
        else:
            up = {node for node, flags in awake[e].items() if next(flags)}
            for w in senders.outgoing[senders.first[e] : senders.first[e + 1]].tolist():
                i, j = senders.directions[w]
                heard[w].append(bool(up) and reach.connects(i, j, now) and i in up)
                if follows:
                    distance[w].append(reach.distance(i, j, now))
        owner += [-1 - number[1] if is_sample else number[0]] * (len(rows) - len(owner))
        number[is_sample] += 1
    link = [row[2:5] for row in rows]
    return MovingLinks(
        [np.array(flags, dtype=bool) for flags in heard],
        [np.array(d) for d in distance],
        np.array(owner, dtype=np.int64),
        np.array(link, dtype=np.int64).reshape(-1, 3),
    )
