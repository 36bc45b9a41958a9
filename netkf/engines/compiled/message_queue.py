"""Messages in the event loop: the heap of those on their way, inboxes, the list of free ones."""

from __future__ import annotations

import numpy as np

from netkf.engines.compiled.state import READINGS, Simulation
from netkf.linalg.compiling import kernel


@kernel
def arrives_first(pool: np.ndarray, a: int, b: int) -> bool:
    """Return True if message ``a`` arrives before ``b``: by time, directed link, order sent."""
    # Never by insertion: the order must be that of the SimPy engine.
    one, other = pool[a], pool[b]
    if one.arrival != other.arrival:
        return bool(one.arrival < other.arrival)
    if one.direction != other.direction:
        return bool(one.direction < other.direction)
    return bool(one.order < other.order)


@kernel
def push(pool: np.ndarray, heap: np.ndarray, size: int, message: int) -> None:
    """Put a message on the heap of ``size``."""
    # A binary heap of indices in the pool: sift up. heapq would need Python objects.
    k = size
    while k > 0 and arrives_first(pool, message, heap[(k - 1) // 2]):
        heap[k] = heap[(k - 1) // 2]
        k = (k - 1) // 2
    heap[k] = message


@kernel
def pop(pool: np.ndarray, heap: np.ndarray, size: int) -> int:
    """Take the next message off the heap of ``size``."""
    # Sift the last entry down from the top.
    top, moved, k = heap[0], heap[size - 1], 0
    while 2 * k + 1 < size - 1:
        child = 2 * k + 1
        if child + 1 < size - 1 and arrives_first(pool, heap[child + 1], heap[child]):
            child += 1
        if not arrives_first(pool, heap[child], moved):
            break
        heap[k] = heap[child]
        k = child
    heap[k] = moved
    return int(top)


@kernel
def take(state: Simulation) -> int:
    """Take a free message from the pool."""
    # The free messages are a linked list: a stack, so that recently used memory comes first.
    message = state.free
    state.free = state.pool[message].next
    state.free_count -= 1
    return message


@kernel
def release(state: Simulation, message: int) -> None:
    """Give a message back to the pool."""
    state.pool[message].next = state.free
    state.free = message
    state.free_count += 1


@kernel
def put(state: Simulation, h: int, message: int) -> None:
    """Put a message into the inbox of node ``h``, in the order of senders; of several of one sender
    the newest counts, or all readings in the order of arrival.
    """
    nodes, directions, pool = state.nodes, state.directions, state.pool
    newest_only = state.kind != READINGS
    node, peer = nodes[h], directions[pool[message].direction].sender
    before, here = -1, node.inbox
    # Inboxes are linked lists, with the last one known: a message from a later sender goes to the
    # end.
    # Mostly they come in order.
    if here != -1 and directions[pool[node.last].direction].sender < peer:
        before, here = node.last, -1
    while here != -1:
        other = directions[pool[here].direction].sender
        # Before the first message of a later sender, and in place of one of this sender if the
        # newest counts.
        if other > peer or (other == peer and newest_only):
            break
        before, here = here, pool[here].next
    if here != -1 and directions[pool[here].direction].sender == peer:
        # An older message than the one that is there brings nothing.
        if pool[message].sent < pool[here].sent:
            release(state, message)
            return
        # The newer message takes the place of the older one.
        gone, here = here, pool[here].next
        release(state, gone)
    pool[message].next = here
    if before == -1:
        node.inbox = message
    else:
        pool[before].next = message
    # The end of the list moved.
    if here == -1:
        node.last = message


@kernel
def sort_indices(indices: np.ndarray, count: int) -> None:
    """Sort the first ``count`` indices (Shell's sort: a few lines to compile)."""
    gap = count // 2
    while gap > 0:
        for k in range(gap, count):
            moved, to = indices[k], k
            while to >= gap and indices[to - gap] > moved:
                indices[to] = indices[to - gap]
                to -= gap
            indices[to] = moved
        gap //= 2
