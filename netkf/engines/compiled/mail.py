"""Messages in the compiled replay: the heap of those on their way, and inboxes."""

from __future__ import annotations

import numpy as np

from netkf.core.arrays import FloatArray
from netkf.core.compiling import in_place
from netkf.engines.compiled.tables import FREE, WAITING, Mail


@in_place
def sooner(arrival: FloatArray, way: np.ndarray, order: np.ndarray, a: int, b: int) -> bool:
    """Whether message ``a`` arrives before message ``b``."""
    if arrival[a] != arrival[b]:
        return bool(arrival[a] < arrival[b])
    if way[a] != way[b]:
        return bool(way[a] < way[b])
    return bool(order[a] < order[b])


@in_place
def push(mail: Mail, size: int, message: int) -> None:
    """Put a message on the heap of ``size``."""
    heap, arrival, way, order, k = mail.heap, mail.arrival, mail.way, mail.order, size
    while k > 0 and sooner(arrival, way, order, message, heap[(k - 1) // 2]):
        heap[k] = heap[(k - 1) // 2]
        k = (k - 1) // 2
    heap[k] = message


@in_place
def pop(mail: Mail, size: int) -> int:
    """Take the next message off the heap of ``size``."""
    heap, arrival, way, order = mail.heap, mail.arrival, mail.way, mail.order
    top, moved, k = heap[0], heap[size - 1], 0
    while 2 * k + 1 < size - 1:
        child = 2 * k + 1
        if child + 1 < size - 1 and sooner(arrival, way, order, heap[child + 1], heap[child]):
            child += 1
        if not sooner(arrival, way, order, heap[child], moved):
            break
        heap[k] = heap[child]
        k = child
    heap[k] = moved
    return int(top)


@in_place
def put(
    inbox: np.ndarray,
    waiting: np.ndarray,
    ends: np.ndarray,
    sent: FloatArray,
    ways: np.ndarray,
    following: np.ndarray,
    place: np.ndarray,
    h: int,
    message: int,
    now: float,
) -> None:
    """Put a message into an inbox, by peer; the newest of several from one peer counts."""
    if inbox[h] == -1:
        waiting[place[WAITING]] = h
        place[WAITING] += 1
    way = ways[message]
    peer, other = ends[way // 2, way % 2], -1
    before, here = -1, inbox[h]
    while here != -1:
        other = ends[ways[here] // 2, ways[here] % 2]
        if other >= peer:
            break
        before, here = here, following[here]
    gone = -1
    if here != -1 and other == peer:
        if now - sent[message] > now - sent[here]:
            gone = message
        else:
            gone, here = here, following[here]
    if gone != message:
        following[message] = here
        if before == -1:
            inbox[h] = message
        else:
            following[before] = message
    if gone != -1:
        following[gone] = place[FREE]
        place[FREE] = gone


@in_place
def put_in_order(hosts: np.ndarray, count: int) -> None:
    """Sort the first ``count`` places (Shell's sort: a few lines to compile)."""
    gap = count // 2
    while gap > 0:
        for k in range(gap, count):
            host, place = hosts[k], k
            while place >= gap and hosts[place - gap] > host:
                hosts[place] = hosts[place - gap]
                place -= gap
            hosts[place] = host
        gap //= 2
