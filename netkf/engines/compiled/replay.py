"""The replay: what happens in one run, event after event, as one compiled function.

It stops and says why where Python has something to do: draw more, pass rows on, take a sample.
Every state of it is in arrays, so that it goes on where it stopped.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from netkf.algorithms.flow import usable
from netkf.algorithms.gains import GainTable, gain_update
from netkf.algorithms.hybrid import reset
from netkf.algorithms.riccati import RiccatiTable, riccati_step
from netkf.core.arrays import FloatArray
from netkf.core.compiling import compilable
from netkf.engines.base import SHORTEST_SHARE
from netkf.engines.compiled.schedule import Window
from netkf.engines.compiled.tables import Hosts, Links, Mail, Models, Sensing
from netkf.plants.diffusion import Step, seen
from netkf.plants.sensors import cut, reading
from netkf.trace.schema import CODES

SENSE, TICK, SEND, DELIVER, LOST, ABSORB = (
    CODES[kind] for kind in ("sense", "tick", "send", "deliver", "lost", "absorb")
)
WANT_TICKS, WANT_STEPS, WANT_CUTS, WANT_MAIL, WANT_ROWS, SAMPLE, DONE = range(7)
"""Why the replay stopped: it needs the next window, the next steps of the path, normals for cuts,
a larger pool of messages or room for rows; it is time for a sample; all is done.
"""

# Places in Cursor.place.
TICK_AT, STEP_AT, GRID_AT, AWAKE, PROBE_AT, ROW, FREE, HEAP, WAITING, READY, SENT, HOST = range(12)
PLACES = 12
MOST_ROWS = 5  # of one activation
NEVER = math.inf


class Cursor(NamedTuple):
    """Where a run stands: ``place`` (PLACES,) in all that is gone through in order."""

    place: np.ndarray
    mailed: FloatArray


class Stretch(NamedTuple):
    """Some steps of the sensing grid, the last of which ends at ``end``.

    K pieces (a step is cut where a state is shown): start, stop (K,), x at both (K, n), moments
    (K, 2, n), cubic (K, 4, n), whose step (K,) it is and where that ends (K,); ``grid`` holds the
    times at which sensors wake; ``series`` as of the path.
    """

    end: float
    start: FloatArray
    stop: FloatArray
    x_start: FloatArray
    x_stop: FloatArray
    moments: FloatArray
    cubic: FloatArray
    step: np.ndarray
    last: FloatArray
    grid: FloatArray
    series: FloatArray


@compilable
def read(
    sensing: Sensing, first: int, after: int, x: FloatArray, step: int, u: float, length: float
) -> FloatArray:
    """(2 p,) moments of the readings of sensors ``first`` to ``after``, where x has the moments
    ``x``, over the first share ``u`` of the ``length`` seconds left of a step (-1: all of it).
    """
    total = 0
    for s in range(first, after):
        total += sensing.rows[s]
    out, row = np.empty(2 * total), 0
    for s in range(first, after):
        if sensing.step[s] != step:
            sensing.step[s] = step
            sensing.rest[s] = sensing.noise[s, step]
        noise = sensing.rest[s].copy()
        if u >= 0.0:
            normals = sensing.normals[s, sensing.used[s]]
            sensing.used[s] += 1
            noise, rest = cut(noise, normals, u, length)
            sensing.rest[s] = rest
        y = reading(x, sensing.H[s], noise, sensing.root[s])
        for i in range(sensing.rows[s]):
            out[row] = y[0, i]
            out[total + row] = y[1, i]
            row += 1
    return out


@compilable
def flow_table(models: Models, k: int) -> RiccatiTable:
    """The table of one model."""
    n = models.F.shape[2]
    return RiccatiTable(
        n, models.unit[k], models.series[k], models.jump[k], models.F[k], models.G[k], models.Q[k]
    )


@compilable
def gains_of(models: Models, k: int) -> GainTable:
    """The gains of one model."""
    terms, width, first = models.shape[k, 1], models.shape[k, 2], models.first[k]
    series = models.gains[first : first + terms * width].reshape(terms, width)
    return GainTable(models.F.shape[2], models.shape[k, 0], series)


@compilable
def advance(
    hosts: Hosts, models: Models, sensing: Sensing, path: Stretch, piece: int, h: int, time: float
) -> bool:
    """Bring host ``h`` to ``time`` as a Host of the processes does; False where it needs more
    normals for cuts first, and then goes on where it stopped.
    """
    now = hosts.now[h]
    if not now < time:
        return True
    first, after, k = hosts.sensors[h], hosts.sensors[h + 1], hosts.model[h]
    table = flow_table(models, k)
    xhat, P = hosts.xhat[h].copy(), hosts.P[h].copy()
    senses, enough = after > first, True
    while now < time:
        end = time
        if senses:
            stretch = usable(P, models.information[k])
            if stretch < time - now:
                end = now + max(stretch, SHORTEST_SHARE * (time - now))
            last = path.last[piece]
            if end < last:
                for s in range(first, after):
                    if sensing.used[s] == sensing.normals.shape[1]:
                        enough = False
                if not enough:
                    break
        P, xhat = riccati_step(table, P, xhat, end - now)
        if senses:
            step = Step(
                path.start[piece],
                path.stop[piece],
                path.x_start[piece],
                path.x_stop[piece],
                path.moments[piece],
                path.cubic[piece],
            )
            x = seen(path.series, step, now, end)
            share = (end - now) / (last - now) if end < last else -1.0
            moments = read(sensing, first, after, x, path.step[piece], share, last - now)
            xhat = gain_update(gains_of(models, k), P, xhat, moments, end - now)
        now = end
    hosts.xhat[h] = xhat
    hosts.P[h] = P
    hosts.now[h] = now
    return enough


@compilable
def sooner(mail: Mail, a: int, b: int) -> bool:
    """Whether message ``a`` arrives before message ``b``."""
    if mail.arrival[a] != mail.arrival[b]:
        return bool(mail.arrival[a] < mail.arrival[b])
    if mail.way[a] != mail.way[b]:
        return bool(mail.way[a] < mail.way[b])
    return bool(mail.order[a] < mail.order[b])


@compilable
def push(mail: Mail, size: int, message: int) -> None:
    """Put a message on the heap of ``size``."""
    k = size
    while k > 0 and sooner(mail, message, mail.heap[(k - 1) // 2]):
        mail.heap[k] = mail.heap[(k - 1) // 2]
        k = (k - 1) // 2
    mail.heap[k] = message


@compilable
def pop(mail: Mail, size: int) -> int:
    """Take the next message off the heap of ``size``."""
    top, moved, k = mail.heap[0], mail.heap[size - 1], 0
    while 2 * k + 1 < size - 1:
        child = 2 * k + 1
        if child + 1 < size - 1 and sooner(mail, mail.heap[child + 1], mail.heap[child]):
            child += 1
        if not sooner(mail, mail.heap[child], moved):
            break
        mail.heap[k] = mail.heap[child]
        k = child
    mail.heap[k] = moved
    return int(top)


@compilable
def put(
    hosts: Hosts, links: Links, mail: Mail, place: np.ndarray, h: int, message: int, now: float
) -> None:
    """Put a message into an inbox, by peer; the newest of several from one peer counts."""
    if hosts.inbox[h] == -1:
        mail.waiting[place[WAITING]] = h
        place[WAITING] += 1
    way = mail.way[message]
    peer = links.ends[way // 2, way % 2]
    before, here = -1, hosts.inbox[h]
    while here != -1:
        other = links.ends[mail.way[here] // 2, mail.way[here] % 2]
        if other >= peer:
            break
        before, here = here, mail.next[here]
    gone = -1
    if here != -1 and other == peer:
        if now - mail.sent[message] > now - mail.sent[here]:
            gone = message
        else:
            gone, here = here, mail.next[here]
    if gone != message:
        mail.next[message] = here
        if before == -1:
            hosts.inbox[h] = message
        else:
            mail.next[before] = message
    if gone != -1:
        mail.next[gone] = place[FREE]
        place[FREE] = gone


@compilable
def absorb(
    hosts: Hosts, models: Models, links: Links, mail: Mail, place: np.ndarray, h: int, now: float
) -> float:
    """Use all mail of a host in one reset; returns the age of the oldest message."""
    own, message = 0.0, hosts.inbox[h]
    while message != -1:
        way = mail.way[message]
        own += links.weight[way // 2, way % 2]
        message = mail.next[message]
    own = 1.0 - own
    xhat, P = own * hosts.xhat[h], own * hosts.P[h]
    oldest, message = 0.0, hosts.inbox[h]
    prediction = len(models.unit) - 1
    while message != -1:
        way, age = mail.way[message], now - mail.sent[message]
        other, other_P = mail.xhat[message], mail.P[message]
        if age > 0.0:
            other_P, other = riccati_step(flow_table(models, prediction), other_P, other, age)
            oldest = max(oldest, age)
        xhat, P = reset(xhat, P, links.weight[way // 2, way % 2], other, other_P)
        following = mail.next[message]
        mail.next[message] = place[FREE]
        place[FREE] = message
        message = following
    hosts.xhat[h] = xhat
    hosts.P[h] = P
    hosts.inbox[h] = -1
    return oldest


@compilable
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
    horizon: float,
    rows: np.ndarray,
) -> int:
    """Go on until something is wanted; see the words above. Order is (time, rank, entity)."""
    place, mailed = cursor.place, cursor.mailed
    while True:
        if place[ROW] + MOST_ROWS > len(rows):
            return WANT_ROWS
        sense = tick = deliver = ready = probe = NEVER
        if place[GRID_AT] < len(path.grid):
            sense = path.grid[place[GRID_AT]]
        if place[TICK_AT] < len(window.t):
            tick = window.t[place[TICK_AT]]
        if place[HEAP] > 0:
            deliver = mail.arrival[mail.heap[0]]
        if place[WAITING] > 0:
            ready = mailed[0]
        if place[PROBE_AT] < len(probes):
            probe = probes[place[PROBE_AT]]
        now = min(sense, tick, deliver, ready, probe)
        if now >= window.end and window.end < NEVER:
            return WANT_TICKS
        if now > path.end and path.end < horizon:
            return WANT_STEPS
        if now == NEVER:
            return DONE
        while path.stop[place[STEP_AT]] < now:
            place[STEP_AT] += 1
        piece = place[STEP_AT]
        if sense == now:
            k = place[AWAKE]
            if not advance(hosts, models, sensing, path, piece, sensing.host[k], now):
                return WANT_CUTS
            note(rows, place, now, SENSE, sensing.node[k], -1, -1, np.nan)
            place[AWAKE] += 1
            if place[AWAKE] == len(sensing.host):
                place[AWAKE] = 0
                place[GRID_AT] += 1
        elif tick == now:
            capacity = len(mail.sent)
            if place[FREE] >= capacity or mail.next[place[FREE]] >= capacity:
                return WANT_MAIL
            link = window.link[place[TICK_AT]]
            i, j = links.ends[link, 0], links.ends[link, 1]
            if not advance(hosts, models, sensing, path, piece, i, now):
                return WANT_CUTS
            if not advance(hosts, models, sensing, path, piece, j, now):
                return WANT_CUTS
            note(rows, place, now, TICK, hosts.node[i], hosts.node[j], -1, np.nan)
            number = links.messages[link]
            links.messages[link] += 1
            for way in range(links.ways):
                sender, receiver = (i, j) if way == 0 else (j, i)
                one, other = hosts.node[sender], hosts.node[receiver]
                note(rows, place, now, SEND, one, other, number, np.nan)
                delay = window.delay[place[TICK_AT], way]
                arrival = now + delay
                if delay < 0.0:
                    note(rows, place, now, LOST, one, other, number, np.nan)
                elif delay == 0.0 or arrival < horizon:
                    message = place[FREE]
                    place[FREE] = mail.next[message]
                    mail.xhat[message] = hosts.xhat[sender]
                    mail.P[message] = hosts.P[sender]
                    mail.sent[message] = now
                    mail.way[message] = 2 * link + way
                    mail.number[message] = number
                    if delay == 0.0:
                        note(rows, place, now, DELIVER, other, one, number, 0.0)
                        put(hosts, links, mail, place, receiver, message, now)
                        mailed[0] = now
                    else:
                        mail.arrival[message] = arrival
                        mail.order[message] = place[SENT]
                        place[SENT] += 1
                        push(mail, place[HEAP], message)
                        place[HEAP] += 1
            place[TICK_AT] += 1
        elif deliver == now:
            message = pop(mail, place[HEAP])
            place[HEAP] -= 1
            link, way = mail.way[message] // 2, mail.way[message] % 2
            sender, receiver = links.ends[link, way], links.ends[link, 1 - way]
            one, other, number = hosts.node[sender], hosts.node[receiver], mail.number[message]
            note(rows, place, now, DELIVER, other, one, number, now - mail.sent[message])
            put(hosts, links, mail, place, receiver, message, now)
            mailed[0] = now
        elif ready == now:
            if place[READY] == 0:
                mail.waiting[: place[WAITING]].sort()
            h = mail.waiting[place[READY]]
            if not advance(hosts, models, sensing, path, piece, h, now):
                return WANT_CUTS
            oldest = absorb(hosts, models, links, mail, place, h, now)
            note(rows, place, now, ABSORB, hosts.node[h], -1, -1, oldest)
            place[READY] += 1
            if place[READY] == place[WAITING]:
                place[READY] = place[WAITING] = 0
        else:
            while place[HOST] < len(hosts.now):
                if not advance(hosts, models, sensing, path, piece, place[HOST], now):
                    return WANT_CUTS
                place[HOST] += 1
            place[HOST] = 0
            place[PROBE_AT] += 1
            return SAMPLE
