"""Special cases that must coincide: clocks and samples at k T over a diffusion are slots on its
exact discretisation; broadcasts are pushes; no delay is a delay of 0; increments are the limit of
ever more samples; one node with irregular samples is the textbook filter.
"""

import csv

import numpy as np
import pytest
import scipy.linalg

import netkf
from netkf.scenario.reading import from_table

A = np.array([[0.0, 1.0], [-0.8, -0.2]])
B = np.array([[0.2, 0.0], [0.0, 0.7]])
PERIOD, SLOTS = 0.25, 24
H = {0: [[1.0, 0.0]], 2: [[0.3, 1.0]]}
R = {0: [[0.2]], 2: [[0.5]]}
LINKS = [[0, 1], [1, 2], [2, 3], [3, 0]]


def discretised(A, B, gap):
    """e^{A g} and int_0^g e^{A s} B B' e^{A' s} ds by Van Loan's block exponential."""
    n = len(A)
    blocks = np.block([[-A, B @ B.T], [np.zeros((n, n)), A.T]])
    E = scipy.linalg.expm(blocks * gap)
    F = E[n:, n:].T
    return F, F @ E[:n, n:]


def table(folder, name, header, rows):
    with (folder / name).open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows(rows)
    return name


def readings(folder):
    random = np.random.default_rng(7)
    rows = [
        [repr(k * PERIOD), node, repr(float(random.normal()))]
        for k in range(1, SLOTS + 1)
        for node in H
    ]
    return table(folder, "readings.csv", ["t", "node", "y0"], rows)


def scenario(folder, plant, network, filter_, sensors=None, **more):
    if sensors is None:
        path = readings(folder)
        sensors = [
            {"kind": "recorded", "path": path, "nodes": [k], "H": H[k], "R": R[k]} for k in H
        ]
    tables = {
        "format": 1,
        "name": "coincidence",
        "horizon": SLOTS * PERIOD,
        "probe": PERIOD,
        "seed": 3,
        "plant": {"cov": [[1.0, 0.2], [0.2, 0.8]], **plant},
        "sensors": sensors,
        "network": {"graph": {"kind": "edges", "edges": LINKS}, **network},
        "filter": filter_,
        **more,
    }
    return from_table(tables, folder)


def flow(kind="unknown"):
    return {"kind": kind, "A": A.tolist(), "B": B.tolist()}


def slots():
    F, Q = discretised(A, B, PERIOD)
    return {"kind": "unknown", "F": F.tolist(), "Q": Q.tolist(), "period": PERIOD}


@pytest.mark.parametrize("kind", ["local", "central"])
def test_samples_at_slots_are_slots(kind, tmp_path):
    network = {"activation": {"kind": "broadcast"}}
    one = netkf.simulate(scenario(tmp_path, slots(), network, {"kind": kind}), engine="simpy")
    other = netkf.simulate(scenario(tmp_path, flow(), {}, {"kind": kind}), engine="simpy")
    # At the horizon nothing happens under clocks, while a slot there makes its sample.
    np.testing.assert_allclose(other.P[:-1], one.P[:-1], rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(other.xhat[:-1], one.xhat[:-1], rtol=1e-12, atol=1e-13)


def test_gossip_by_clocks_is_gossip_in_slots(tmp_path):
    """Under clocks samples come before ticks, in slots a swap comes before the reading. So a tick
    at k T is the matching of slot k + 1; readings and ticks at even k are compared at odd k, where
    the slot's sample shows the state before the swap and the probe the state after it.
    """
    pairs = [(0, 1), (2, 3), (1, 2), (0, 3)]
    even = range(2, SLOTS, 2)
    random = np.random.default_rng(7)
    rows = [[repr(k * PERIOD), node, repr(float(random.normal()))] for k in even for node in H]
    path = table(tmp_path, "even.csv", ["t", "node", "y0"], rows)
    sensors = [{"kind": "recorded", "path": path, "nodes": [k], "H": H[k], "R": R[k]} for k in H]
    ticks = [[repr(k * PERIOD), *pairs[k // 2 % 4]] for k in even]
    clock = {"kind": "recorded", "path": table(tmp_path, "t.csv", ["t", "node", "peer"], ticks)}
    matching = [[k + 1, *pairs[k // 2 % 4]] for k in even]
    path = table(tmp_path, "m.csv", ["slot", "node", "peer"], matching)
    matched, gossip = {"kind": "recorded", "path": path}, {"kind": "gossip"}
    slotted = scenario(tmp_path, slots(), {"activation": matched}, gossip, sensors)
    one = netkf.simulate(slotted, engine="simpy")
    odd = [k + 1 for k in even]
    probes = [k * PERIOD for k in odd]
    clocked = scenario(tmp_path, flow(), {"activation": clock}, gossip, sensors, probe=probes)
    other = netkf.simulate(clocked, engine="simpy")
    for row, k in enumerate(odd):
        i, j = pairs[k // 2 % 4]
        swapped = np.arange(4)
        swapped[[i, j]] = j, i
        np.testing.assert_allclose(other.P[row], one.P[k][swapped], rtol=1e-12, atol=1e-14)
        np.testing.assert_allclose(other.xhat[row], one.xhat[k][swapped], rtol=1e-12, atol=1e-13)


def test_diffusion_in_synchronous_rounds_is_diffusion_in_slots(tmp_path):
    """Combination right after the samples of an instant, so F = 1 lets slots be compared: D's own
    case, where prediction and combination commute but for the noise.
    """
    still = {"kind": "unknown", "A": [[0.0, 0.0], [0.0, 0.0]], "B": [[0.0], [0.0]]}
    frozen = {"kind": "unknown", "F": np.eye(2).tolist(), "Q": [[0.0] * 2] * 2, "period": PERIOD}
    broadcast = {"activation": {"kind": "broadcast"}}
    rounds = {"activation": {"kind": "periodic", "period": PERIOD, "at": "nodes"}}
    one = netkf.simulate(
        scenario(tmp_path, frozen, broadcast, {"kind": "diffusion"}), engine="simpy"
    )
    other = netkf.simulate(scenario(tmp_path, still, rounds, {"kind": "diffusion"}), engine="simpy")
    # A slot's sample shows what was known before its reading: one period later in slots.
    np.testing.assert_allclose(other.P[1:-1], one.P[2:], rtol=1e-12)
    np.testing.assert_allclose(other.xhat[1:-1], one.xhat[2:], rtol=1e-11, atol=1e-13)


SAMPLED = [
    {
        "nodes": [0, 2],
        "H": [[1.0, 0.0]],
        "R": [[0.3]],
        "sampling": {"kind": "poisson", "rate": 3.0},
    },
    {
        "nodes": [3],
        "H": [[0.0, 1.0]],
        "R": [[0.4]],
        "sampling": {"kind": "periodic", "period": 0.4, "jitter": 0.1},
    },
]


@pytest.mark.parametrize("kind", ["hybrid", "covariance-intersection", "diffusion"])
def test_a_broadcast_is_a_push_in_each_direction(kind, tmp_path):
    settings = {} if kind == "diffusion" else {"epsilon": 0.3}
    random = np.random.default_rng(5)
    ticks = sorted((float(t), int(random.integers(4))) for t in random.uniform(0.01, 5.9, 40))
    nodes = [[repr(t), node] for t, node in ticks]
    peers = {k: sorted({i + j - k for i, j in LINKS if k in (i, j)}) for k in range(4)}
    pushes = [[repr(t), node, peer] for t, node in ticks for peer in peers[node]]
    channel = {"loss": {"kind": "bernoulli", "delivery": 0.6}, "symmetric": False}
    runs = []
    for at, header, rows in (
        ("nodes", ["t", "node"], nodes),
        ("directions", ["t", "node", "peer"], pushes),
    ):
        path = table(tmp_path, f"{at}.csv", header, rows)
        network = {"activation": {"kind": "recorded", "at": at, "path": path}, "channel": channel}
        made = scenario(
            tmp_path, flow("diffusion"), network, {"kind": kind, **settings}, sensors=SAMPLED
        )
        runs.append(netkf.simulate(made, engine="simpy"))
    np.testing.assert_array_equal(runs[0].P, runs[1].P)
    np.testing.assert_array_equal(runs[0].xhat, runs[1].xhat)
    assert runs[0].count("transmit") == len(ticks)
    assert runs[1].count("transmit") == 0


@pytest.mark.parametrize("at", ["links", "directions", "nodes"])
def test_no_delay_is_a_delay_of_zero(at, tmp_path):
    runs = []
    for delay in ({"kind": "none"}, {"kind": "constant", "seconds": 0.0}):
        network = {
            "activation": {"kind": "poisson", "rate": 1.5, "at": at},
            "channel": {"delay": delay, "loss": {"kind": "bernoulli", "delivery": 0.7}},
        }
        filter_ = {"kind": "hybrid", "epsilon": 0.3}
        made = scenario(tmp_path, flow("diffusion"), network, filter_, sensors=SAMPLED)
        runs.append(netkf.simulate(made, engine="simpy"))
    assert runs[0].fingerprint == runs[1].fingerprint
    np.testing.assert_array_equal(runs[0].P, runs[1].P)


def test_ever_more_samples_tend_to_increments_with_first_order(tmp_path):
    """Samples every h of R = V / h against increments of V: P within O(h)."""
    V, gaps = 0.3, [0.1, 0.05, 0.025, 0.0125]
    continuous = [{"nodes": [0], "H": [[1.0, 0.0]], "R": [[V]]}]
    wanted = netkf.simulate(
        scenario(tmp_path, flow("diffusion"), {}, {"kind": "local"}, sensors=continuous)
    ).P[-1, 0]
    off = []
    for h in gaps:
        sampling = {"kind": "periodic", "period": h}
        sampled = [{"nodes": [0], "H": [[1.0, 0.0]], "R": [[V / h]], "sampling": sampling}]
        made = scenario(tmp_path, flow("diffusion"), {}, {"kind": "local"}, sensors=sampled)
        # A probe halfway between two samples is right to second order.
        probe = SLOTS * PERIOD - 0.5 * h
        run = netkf.simulate(made.replace({"probe": [probe]}), engine="simpy")
        off.append(np.abs(run.P[0, 0] - wanted).max())
    orders = np.log2(np.array(off[:-1]) / np.array(off[1:]))
    assert (orders > 0.9).all(), (off, orders)
    assert off[-1] < 0.01 * np.abs(wanted).max()


def test_one_node_with_irregular_samples_is_filterpy(tmp_path):
    from filterpy.kalman import KalmanFilter

    sampling = {"kind": "renewal", "distribution": "gamma", "shape": 0.5, "mean": 0.3}
    sensors = [{"nodes": [0], "H": [[1.0, 0.4]], "R": [[0.3]], "sampling": sampling}]
    made = scenario(tmp_path, flow("diffusion"), {}, {"kind": "local"}, sensors=sensors)
    run = netkf.simulate(made, engine="simpy")
    from netkf.rng.streams import Streams

    streams = Streams(made.seed)
    times = made.sample_times(streams)[0, 0]
    truth, path = (
        made.continuous_truth(streams),
        made.sample_path(streams, 0, made.placed_sensors[0][0]),
    )
    peer = KalmanFilter(dim_x=2, dim_z=1)
    peer.x, peer.P = np.zeros((2, 1)), np.array(made.plant.cov)
    peer.H, peer.R = np.array([[1.0, 0.4]]), np.array([[0.3]])
    now, k = 0.0, 0
    for t, P, xhat in zip(run.times, run.P[:, 0], run.xhat[:, 0], strict=True):
        while k < len(times) and times[k] <= t:
            peer.F, peer.Q = discretised(A, B, times[k] - now)
            peer.predict()
            now, y = times[k], path.reading(k, truth.local(times[k]))[0]
            peer.update(y)
            k += 1
        F, Q = discretised(A, B, t - now)
        np.testing.assert_allclose(P, F @ peer.P @ F.T + Q, rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(xhat, (F @ peer.x)[:, 0], rtol=1e-9, atol=1e-10)
    assert k == len(times) > 10
