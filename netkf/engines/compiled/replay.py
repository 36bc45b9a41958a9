"""The replay: what happens in one run, event after event, as one compiled function.

It stops and says why where Python has something to do: draw more, pass rows on, take a sample.
Every state of it is in arrays, so that it goes on where it stopped.
"""

from __future__ import annotations

import math
from types import FunctionType
from typing import NamedTuple

import numpy as np

from netkf.algorithms.covariance_intersection import intersected_pairs
from netkf.algorithms.hybrid import add_neighbour
from netkf.algorithms.riccati import move_blind
from netkf.core.arrays import FloatArray
from netkf.core.compiling import compilable, in_place
from netkf.core.small import fill, fill_square
from netkf.engines.compiled.mail import pop, push, put, put_in_order
from netkf.engines.compiled.readings import Stretch, advance, move_far
from netkf.engines.compiled.schedule import Window
from netkf.engines.compiled.tables import (
    AWAKE,
    FREE,
    GRID_AT,
    HEAP,
    PROBE_AT,
    READY,
    ROW,
    SENT,
    SHOWN,
    STEP_AT,
    TICK_AT,
    WAITING,
    Hosts,
    Links,
    Mail,
    Models,
    Parts,
    Room,
    Sensing,
)
from netkf.trace.schema import CODES

SENSE, TICK, SEND, DELIVER, LOST, ABSORB = (
    CODES[kind] for kind in ("sense", "tick", "send", "deliver", "lost", "absorb")
)
WANT_TICKS, WANT_STEPS, WANT_CUTS, WANT_MAIL, WANT_ROWS, WANT_SAMPLES, DONE = range(7)
"""Why the replay stopped: it needs the next window, the next steps of the path, normals for cuts,
a larger pool of messages, room for rows or for samples; all is done.
"""

MOST_ROWS = 5  # of one activation
NEVER = math.inf


class Cursor(NamedTuple):
    """Where a run stands: ``place`` (PLACES,) in all that is gone through in order."""

    place: np.ndarray
    mailed: FloatArray


class Samples(NamedTuple):
    """Room for B samples of all hosts: xhat (B, H, n), P (B, H, n, n), how many ``rows`` (B,) came
    before and in which ``piece`` (B,) of the path it is. Samples are taken from it in lots, because
    a call of the replay costs more than a sample.
    """

    xhat: FloatArray
    P: FloatArray
    rows: np.ndarray
    piece: np.ndarray


@in_place
def note(
    rows: np.ndarray,
    place: np.ndarray,
    t: float,
    kind: int,
    node: int,
    peer: int,
    message: int,
    age: float,
) -> None:
    """Write one row of the events."""
    row = rows[place[ROW]]
    row.t, row.kind, row.node, row.peer = t, kind, node, peer
    row.message, row.phase, row.age = message, -1, age
    place[ROW] += 1


@in_place
def add_part(parts: Parts, count: int, weight: float, xhat: FloatArray, P: FloatArray) -> int:
    """Put one more pair behind ``count`` others; returns how many there are now."""
    parts.weight[count] = weight
    fill(parts.xhat[count], xhat)
    fill_square(parts.P[count], P)
    return count + 1


@compilable
def intersect(parts: Parts, count: int, xhat: FloatArray, P: FloatArray, h: int) -> None:
    """Write what the first ``count`` parts come to into place ``h`` of xhat (H, n), P (H, n, n)."""
    mean, cov = intersected_pairs(parts.weight[:count], parts.xhat[:count], parts.P[:count])
    fill(xhat[h], mean)
    fill_square(P[h], cov)


@in_place
def replay(  # noqa: PLR0911, PLR0912, PLR0915 - the compiler sees one function, and it stops often
    hosts: Hosts,
    models: Models,
    sensing: Sensing,
    links: Links,
    mail: Mail,
    cursor: Cursor,
    window: Window,
    path: Stretch,
    probes: FloatArray,
    samples: Samples,
    horizon: float,
    rows: np.ndarray,
    room: Room,
    parts: Parts | None,
) -> int:
    """Go on until something is wanted; see the words above. Order is (time, rank, entity).

    Resets are convex where ``parts`` is None; what is for the other kind is compiled with it alone.
    """
    place, mailed = cursor.place, cursor.mailed
    model, nodes, xhats, Ps, reached = hosts.model, hosts.node, hosts.xhat, hosts.P, hosts.now
    sensors, inbox, ends, weights = hosts.sensors, hosts.inbox, links.ends, links.weight
    messages, ways, free = links.messages, links.ways, mail.next
    mail_x, mail_P, sent, way_of = mail.xhat, mail.P, mail.sent, mail.way
    numbers, arrivals, order, heap = mail.number, mail.arrival, mail.order, mail.heap
    waiting, ticks, ticking, delays = mail.waiting, window.t, window.link, window.delay
    grid, stop, awake, awake_node = path.grid, path.stop, sensing.host, sensing.node
    capacity, window_end, path_end = len(mail.sent), window.end, path.end
    unit, blind, E, X, n = models.unit, models.blind, room.E, room.X, xhats.shape[1]
    while True:
        if place[ROW] + MOST_ROWS > len(rows):
            return WANT_ROWS
        sense = tick = deliver = ready = probe = NEVER
        if place[GRID_AT] < len(grid):
            sense = grid[place[GRID_AT]]
        if place[TICK_AT] < len(ticks):
            tick = ticks[place[TICK_AT]]
        if place[HEAP] > 0:
            deliver = arrivals[heap[0]]
        if place[WAITING] > 0:
            ready = mailed[0]
        if place[PROBE_AT] < len(probes):
            probe = probes[place[PROBE_AT]]
        now = min(sense, tick, deliver, ready, probe)
        if now >= window_end and window_end < NEVER:
            return WANT_TICKS
        if now > path_end and path_end < horizon:
            return WANT_STEPS
        if now == NEVER:
            return DONE
        while stop[place[STEP_AT]] < now:
            place[STEP_AT] += 1
        # Who must be brought to this time before anything happens.
        first, after = 0, len(reached)
        link = i = j = -1
        if sense == now:
            first = awake[place[AWAKE]]
            after = first + 1
        elif tick == now:
            if place[FREE] >= capacity or free[place[FREE]] >= capacity:
                return WANT_MAIL
            link = ticking[place[TICK_AT]]
            i, j = ends[link, 0], ends[link, 1]
            first, after = 0, 2
        elif deliver == now:
            after = 0
        elif ready == now:
            if place[READY] == 0:
                put_in_order(waiting, place[WAITING])
            first = waiting[place[READY]]
            after = first + 1
        for k in range(first, after):
            h = k
            if link >= 0:
                h = i if k == 0 else j
            if not reached[h] < now:
                continue
            if sensors[h] < sensors[h + 1]:
                if not advance(hosts, models, sensing, path, place[STEP_AT], h, now, room):
                    return WANT_CUTS
            else:
                m, gap = model[h], now - reached[h]
                if gap >= unit[m]:
                    gap = move_far(models, m, Ps, xhats, h, gap, room)
                if gap > 0.0:
                    move_blind(blind[m], Ps, xhats, h, gap, E, X)
                reached[h] = now
        if sense == now:
            note(rows, place, now, SENSE, awake_node[place[AWAKE]], -1, -1, np.nan)
            place[AWAKE] += 1
            if place[AWAKE] == len(awake):
                place[AWAKE] = 0
                place[GRID_AT] += 1
        elif tick == now:
            note(rows, place, now, TICK, nodes[i], nodes[j], -1, np.nan)
            number = messages[link]
            messages[link] += 1
            for way in range(ways):
                sender, receiver = (i, j) if way == 0 else (j, i)
                one, other = nodes[sender], nodes[receiver]
                note(rows, place, now, SEND, one, other, number, np.nan)
                delay = delays[place[TICK_AT], way]
                arrival = now + delay
                if delay < 0.0:
                    note(rows, place, now, LOST, one, other, number, np.nan)
                elif delay == 0.0 or arrival < horizon:
                    message = place[FREE]
                    place[FREE] = free[message]
                    for r in range(n):
                        mail_x[message, r] = xhats[sender, r]
                        for c in range(n):
                            mail_P[message, r, c] = Ps[sender, r, c]
                    sent[message] = now
                    way_of[message] = 2 * link + way
                    numbers[message] = number
                    if delay == 0.0:
                        note(rows, place, now, DELIVER, other, one, number, 0.0)
                        put(inbox, waiting, ends, sent, way_of, free, place, receiver, message, now)
                        mailed[0] = now
                    else:
                        arrivals[message] = arrival
                        order[message] = place[SENT]
                        place[SENT] += 1
                        push(mail, place[HEAP], message)
                        place[HEAP] += 1
            place[TICK_AT] += 1
        elif deliver == now:
            message = pop(mail, place[HEAP])
            place[HEAP] -= 1
            came, way = way_of[message] // 2, way_of[message] % 2
            sender, receiver = ends[came, way], ends[came, 1 - way]
            one, other, number = nodes[sender], nodes[receiver], numbers[message]
            note(rows, place, now, DELIVER, other, one, number, now - sent[message])
            put(inbox, waiting, ends, sent, way_of, free, place, receiver, message, now)
            mailed[0] = now
        elif ready == now:
            h = waiting[place[READY]]
            own, message = 0.0, inbox[h]
            while message != -1:
                own += weights[way_of[message] // 2, way_of[message] % 2]
                message = free[message]
            own = 1.0 - own
            count = 0
            if parts is None:  # what others sent is a copy, so that sums may grow in their place
                for r in range(n):
                    xhats[h, r] *= own
                    for c in range(n):
                        Ps[h, r, c] *= own
            else:
                count = add_part(parts, count, max(own, 0.0), xhats[h], Ps[h])
            oldest, message = 0.0, inbox[h]
            while message != -1:
                age = now - sent[message]
                weight = weights[way_of[message] // 2, way_of[message] % 2]
                if age > 0.0:
                    oldest = max(oldest, age)
                    m, gap = len(unit) - 1, age
                    if gap >= unit[m]:
                        gap = move_far(models, m, mail_P, mail_x, message, gap, room)
                    if gap > 0.0:
                        move_blind(blind[m], mail_P, mail_x, message, gap, E, X)
                if parts is None:
                    add_neighbour(xhats, Ps, h, weight, mail_x, mail_P, message)
                else:
                    count = add_part(parts, count, weight, mail_x[message], mail_P[message])
                gone, message = message, free[message]
                free[gone] = place[FREE]
                place[FREE] = gone
            if parts is not None:
                intersect(parts, count, xhats, Ps, h)
            inbox[h] = -1
            note(rows, place, now, ABSORB, nodes[h], -1, -1, oldest)
            place[READY] += 1
            if place[READY] == place[WAITING]:
                place[READY] = place[WAITING] = 0
        else:
            taken = place[SHOWN]
            for h in range(len(reached)):
                fill(samples.xhat[taken, h], xhats[h])
                fill_square(samples.P[taken, h], Ps[h])
            samples.rows[taken] = place[ROW]
            samples.piece[taken] = place[STEP_AT]
            place[PROBE_AT] += 1
            place[SHOWN] += 1
            if place[SHOWN] == len(samples.rows):
                return WANT_SAMPLES


intersecting = in_place(FunctionType(replay.__code__, replay.__globals__, "intersecting"))
"""The same, compiled on its own for covariance intersection, so that the first run of each kind
says that it compiles.
"""
intersecting.__qualname__ = "intersecting"
