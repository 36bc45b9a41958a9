"""The rows of the table: netkf against hand-written kernels, and against other packages."""

from functools import partial

import numpy as np

import netkf
from netkf.algorithms.kernels.chains import move_roots, reading_modes
from tests.benchmarks import bare_simpy, cases, jobs, peers
from tests.benchmarks.table import Row, Side

MANY = 1000
"""Runs in one call of ``netkf.monte_carlo`` if time allows."""

TOGETHER = 50
"""Runs of a hand-written kernel in one call."""


def ensembles(case, least=8):
    """Runs of netkf."""
    return Side(lambda runs: netkf.monte_carlo(case, runs, workers=1), least, MANY)


def kernel(name, make, limit):
    """A row against a hand-written kernel: time of a run."""

    def sides():
        case = make()
        call, _ = jobs.prepared(case, TOGETHER)
        return ensembles(case), Side(call, TOGETHER, 20 * MANY)

    return Row(f"by hand: {name}", "run", sides, limit, True)


def tables(**channel):
    """Runs with another channel in slots, against runs with Bernoulli losses."""
    return ensembles(cases.push_sum_with(**channel), 16), ensembles(cases.push_sum_with(), 16)


def batched_numpy():
    """Runs of the gossip ring, 1000 side by side."""
    case = cases.load("gossip_ring")
    job = (*jobs.in_slots(case), len(case.times))
    theirs = Side(lambda runs: peers.batched_gossip(job, runs), MANY, MANY)
    return ensembles(case, MANY), theirs


def hybrid_job(job):
    """Runs of 50 nodes, n = 4, by the tick: objects of another package against netkf."""
    case = cases.planar(50)
    ticks = list(peers.clocks(case))
    events = peers.events_of(case, ticks)
    ensemble = netkf.monte_carlo(case, 16, workers=1)
    each = ensemble.messages["sent"] / 2.0 / 16  # both ends of a link send when it ticks

    def mine(count):
        netkf.monte_carlo(case, max(1, round(count / each)), workers=1)

    least = round(16 * each)
    return Side(mine, least, 100 * least), Side(lambda _: job(case, events), len(ticks), len(ticks))


def central(job, count):
    """Slots of a central Kalman filter on ``count`` series with all results; netkf draws them."""
    case = cases.central()
    readings, slots = peers.series(case, count), len(case.times) - 1
    total = count * slots

    def mine(_):
        netkf.monte_carlo(case, MANY, workers=1)

    theirs = Side(lambda _: job(case, readings), total, total)
    return Side(mine, MANY * slots, MANY * slots), theirs


def covariance_bound():
    """The bound (12) at 41 times of 10 s, 1000 nodes, against scipy's solve_ivp."""
    case = cases.planar(1000)
    times = np.linspace(0.0, 10.0, 41)

    def mine(_):
        netkf.theory.covariance_bound(case, times)

    return Side(mine), Side(lambda _: peers.StackedBound(case).solved(times))


def random_riccati():
    """Chains of the random Riccati equation against a plain numpy loop."""
    F, Q, H, R = peers.random_system()
    words = np.random.default_rng(1).random((200, 64)) < 0.7
    roots = np.broadcast_to(np.eye(4), (200, 4, 4))
    maps = reading_modes([(H[:0], R[:0, :0]), (H, R)], 4)

    def mine(_):
        move_roots(roots, words, F, np.linalg.cholesky(Q), maps)

    def theirs(_):
        peers.plain_chains(roots, words, F, Q, H, R)

    return Side(mine, words.size, words.size), Side(theirs, words.size, words.size)


def simpy_alone():
    """The SimPy engine on 200 nodes against bare SimPy with its timeouts and numerical calls."""
    case = cases.hybrid(200, 5.0, 8)
    calls, timeouts = bare_simpy.recorded_calls(case)
    theirs = Side(lambda _: bare_simpy.bare_run(case, calls, timeouts))
    return Side(lambda _: bare_simpy.engine_run(case)), theirs


INTERSECTION = {"kind": "covariance-intersection", "epsilon": 0.3}

ROWS = [
    kernel("hybrid, ring of 6, n = 2", partial(cases.load, "poisson_ring"), 3.0),
    kernel("hybrid, 50 nodes, n = 4, 17 sensors", partial(cases.planar, 50), 2.0),
    kernel("hybrid, 1000 nodes, n = 4, 334 sensors", partial(cases.planar, 1000), 2.0),
    kernel("hybrid, 1000 nodes, n = 2, 2 sensors", partial(cases.hybrid, 1000), 2.0),
    kernel("hybrid, unstable plant, 2 nodes, n = 1", partial(cases.load, "threshold"), 3.0),
    kernel("hybrid, ring of 6, bursts of loss", partial(cases.ring, cases.BURSTS), 3.0),
    kernel("hybrid, ring of 6, periodic", partial(cases.ring, clock=cases.LATTICE), 3.0),
    kernel("hybrid, ring of 6, Erlang", partial(cases.ring, clock=cases.ERLANG), 3.0),
    kernel("gossip, ring of 6, clocks", partial(cases.ring, filter={"kind": "gossip"}), 3.0),
    kernel("intersection, ring of 6, clocks", partial(cases.ring, filter=INTERSECTION), 3.0),
    kernel("push-sum, 10 nodes, clocks", partial(cases.load, "push_sum_continuous"), 3.0),
    kernel("gossip, ring of 5, 400 slots", partial(cases.load, "gossip_ring"), 3.0),
    kernel("gossip, 100 nodes, degree 4, 400 slots", partial(cases.gossip, 100), 3.0),
    kernel("push-sum, 10 nodes, gamma 3", partial(cases.load, "push_sum_planar"), 3.0),
    kernel("push-sum, 10 nodes, gamma 881, 40 slots", cases.push_sum_long, 3.0),
    kernel("push-sum, 50 nodes, gamma 3", partial(cases.push_sum, 50), 3.0),
    kernel("diffusion, 3 nodes, 2000 slots", partial(cases.load, "diffusion_regression"), 3.0),
    kernel("diffusion, 20 nodes, n = 5, 500 slots", cases.diffusion, 3.0),
    kernel("intermittent, n = 1, 60 slots", partial(cases.load, "intermittent_scalar"), 3.0),
    kernel("intersection, radio, 53 motes, n = 4", partial(cases.load, "intel_lab_radio"), 3.0),
    kernel("intersection, radio, 300 nodes, n = 4", partial(cases.radio, 300), 3.0),
    Row("Bernoulli losses: law as kernel", "run", partial(tables, loss=cases.BY_KERNEL), 3.0, True),
    Row("Bernoulli losses: fate shared", "run", partial(tables, loss=cases.SHARED), 12.0, True),
    Row("Bernoulli losses: and delays", "run", partial(tables, delay=cases.LATE), 12.0, True),
    Row("batched numpy: gossip, ring of 5", "run", batched_numpy, 5.0, False),
    Row(
        "filterpy: hybrid, 50 nodes, n = 4",
        "tick",
        partial(hybrid_job, peers.filterpy_job),
        100.0,
        False,
    ),
    Row(
        "Stone Soup: hybrid, 50 nodes, n = 4",
        "tick",
        partial(hybrid_job, peers.stone_soup_job),
        500.0,
        False,
    ),
    Row(
        "filterpy: central, n = 4", "slot", partial(central, peers.filterpy_filter, 20), 20.0, False
    ),
    Row(
        "simdkalman: central, n = 4, 1000 series",
        "slot",
        partial(central, peers.simdkalman_filter, MANY),
        1.0,
        False,
    ),
    Row("solve_ivp: bound (12), 1000 nodes, n = 4", "call", covariance_bound, None, False),
    Row("numpy: random Riccati equation, n = 4", "step", random_riccati, None, False),
    Row("bare SimPy: the SimPy engine, 200 nodes", "run", simpy_alone, 2.0, True),
]
