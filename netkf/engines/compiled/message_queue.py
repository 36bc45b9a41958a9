"""Messages in the event loop: the heap of those on their way, inboxes, the list of free ones."""

from __future__ import annotations

import numpy as np

from netkf.engines.compiled.state import Simulation
from netkf.linalg.compiling import kernel


@kernel
def arrives_first(pool: np.ndarray, a: int, b: int) -> bool:
    """Return True if message ``a`` of the ``pool`` arrives before message ``b``."""
    # Ties must not depend on the order of insertion: the order is that of the SimPy engine.
    first, second = pool[a], pool[b]
    if first.arrival != second.arrival:
        return bool(first.arrival < second.arrival)
    if first.direction != second.direction:
        return bool(first.direction < second.direction)
    return bool(first.order < second.order)


@kernel
def push(pool: np.ndarray, heap: np.ndarray, size: int, message: int) -> None:
    """Insert ``message`` into the ``heap`` of ``size`` messages ordered by arrival."""
    # A binary heap of indices in the pool: sift up. heapq would need Python objects.
    k = size
    while k > 0 and arrives_first(pool, message, heap[(k - 1) // 2]):
        heap[k] = heap[(k - 1) // 2]
        k = (k - 1) // 2
    heap[k] = message


@kernel
def pop(pool: np.ndarray, heap: np.ndarray, size: int) -> int:
    """Remove and return the message that arrives next from the ``heap`` of ``size`` messages."""
    # Sift the last entry down from the top.
    top, last, k = heap[0], heap[size - 1], 0
    while 2 * k + 1 < size - 1:
        child = 2 * k + 1
        if child + 1 < size - 1 and arrives_first(pool, heap[child + 1], heap[child]):
            child += 1
        if not arrives_first(pool, heap[child], last):
            break
        heap[k] = heap[child]
        k = child
    heap[k] = last
    return int(top)


@kernel
def take_free(state: Simulation) -> int:
    """Remove a free message from the pool and return its index."""
    # The free messages are a linked list: a stack, so that recently used memory comes first.
    message = state.first_free
    state.first_free = state.pool[message].next
    state.free_count -= 1
    return message


@kernel
def release(state: Simulation, message: int) -> None:
    """Return ``message`` (index in ``state.pool``) to the free ones."""
    state.pool[message].next = state.first_free
    state.first_free = message
    state.free_count += 1


@kernel
def put(state: Simulation, h: int, message: int) -> None:
    """Insert ``message`` into the inbox of node ``h``, a linked list sorted by sender. Of several
    messages of one sender the newest replaces the others, or all stay in the order of arrival.
    """
    nodes, directions, pool = state.nodes, state.directions, state.pool
    newest_only = state.newest_only == 1
    node, peer = nodes[h], directions[pool[message].direction].sender
    previous, position = -1, node.inbox
    # Inboxes are linked lists with a pointer to the last message. Mostly messages come in the order
    # of senders and go to the end at once.
    if position != -1 and directions[pool[node.last].direction].sender < peer:
        previous, position = node.last, -1
    while position != -1:
        sender = directions[pool[position].direction].sender
        # Stop at the first message of a later sender, or at one of this sender if the newest
        # counts.
        if sender > peer or (sender == peer and newest_only):
            break
        previous, position = position, pool[position].next
    if position != -1 and directions[pool[position].direction].sender == peer:
        # A message older than the present one is dropped.
        if pool[message].sent < pool[position].sent:
            release(state, message)
            return
        # The newer message takes the place of the older one.
        replaced, position = position, pool[position].next
        release(state, replaced)
    pool[message].next = position
    if previous == -1:
        node.inbox = message
    else:
        pool[previous].next = message
    # The end of the list moved.
    if position == -1:
        node.last = message


@kernel
def sort_indices(indices: np.ndarray, count: int) -> None:
    """Sort the first ``count`` entries of ``indices`` (Shell's sort: quick to compile)."""
    gap = count // 2
    while gap > 0:
        for k in range(gap, count):
            value, position = indices[k], k
            while position >= gap and indices[position - gap] > value:
                indices[position] = indices[position - gap]
                position -= gap
            indices[position] = value
        gap //= 2
