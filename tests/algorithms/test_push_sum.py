"""The push-sum filter's steps against formulas written plainly, and the mass over many rounds."""

import math

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st

from netkf.algorithms.filter import Exchange, Message, NodeInfo
from netkf.algorithms.models import SlotModel
from netkf.algorithms.push_sum import (
    AVERAGE,
    MASS,
    PushSum,
    asymptotic_root,
    corrected_root,
    has_converged,
    moved_within,
)

EXCHANGE = Exchange(phase=MASS, step=0, slot=1)
EDGES = ((0, 1), (1, 2), (0, 2), (2, 3), (3, 4))
T1 = (
    *((0, 3), (1, 5), (2, 5), (0, 6), (4, 6), (5, 6), (1, 7), (4, 7), (3, 7)),
    *((0, 8), (1, 8), (2, 8), (4, 8), (0, 9), (2, 9), (4, 9), (7, 9)),
)


def degrees_of(edges):
    return np.bincount(np.array(edges).ravel()).tolist()


def states_with(masses, edges, filter_):
    """A state of each node with that mass, which is padded to the size of one."""
    n = math.ceil(math.sqrt(max(1, len(masses[0]) - 2)))
    model = SlotModel(np.eye(n), np.eye(n), np.zeros((0, n)), np.zeros((0, 0)))
    states = []
    for node, (mass, degree) in enumerate(zip(masses, degrees_of(edges), strict=True)):
        info = NodeInfo(node, degree, degree, len(masses), 1.0, np.eye(n))
        state = filter_.init(model, np.zeros(n), np.eye(n), info)
        states.append(state._replace(mass=np.pad(mass, (0, 2 + n * n - len(mass)))))
    return states


def exchanged(filter_, states, edges, up, exchange=EXCHANGE):
    """The states after one exchange over the links that are up."""
    states, sent = zip(*(filter_.emit(state, exchange) for state in states), strict=True)
    boxes = [[] for _ in states]
    for (i, j), here in zip(edges, up, strict=True):
        if here:
            # By the paper's rule a stopped node sends nothing.
            boxes[i] += [] if sent[j] is None else [Message(j, 0.0, sent[j], 0.0)]
            boxes[j] += [] if sent[i] is None else [Message(i, 0.0, sent[i], 0.0)]
    return [filter_.absorb(s, box, exchange) for s, box in zip(states, boxes, strict=True)]


def one_round(masses, edges, up):
    """All nodes, with the links that are up."""
    filter_ = PushSum(gamma=1, delta=100.0)
    states = exchanged(filter_, states_with(masses, edges, filter_), edges, up)
    return [state.mass[: len(mass)] for state, mass in zip(states, masses, strict=True)]


def drift(rounds, replicas, delivery, seed):
    """The largest relative drift of a total over stacks of masses of very different sizes."""
    random = np.random.default_rng(seed)
    masses = list(10.0 ** random.uniform(-6, 6, size=(5, replicas)))
    masses[0][0], masses[1:] = 1.0, [np.append(0.0, m[1:]) for m in masses[1:]]
    start = [math.fsum(column) for column in np.transpose(masses)]
    luck = random.random((rounds, len(EDGES))) < delivery
    filter_ = PushSum(gamma=1, delta=100.0)
    states = states_with(masses, EDGES, filter_)
    for up in luck:
        states = exchanged(filter_, states, EDGES, up)
    masses = [state.mass[:replicas] for state in states]
    end = [math.fsum(column) for column in np.transpose(masses)]
    return max(abs(b - a) / a for a, b in zip(start, end, strict=True))


@pytest.mark.one_in(3)
@pytest.mark.parametrize("delivery", [0.3, 0.7, 1.0])
def test_mass_is_conserved_to_rounding(delivery):
    assert drift(1000, 66, delivery, 1) <= 1e-14


links = st.tuples(st.integers(0, 6), st.integers(0, 6)).filter(lambda link: link[0] < link[1])


@settings(max_examples=15, deadline=None)
@given(
    edges=st.lists(links, min_size=1, unique=True),
    masses=st.lists(st.floats(0.0, 1e9, allow_subnormal=False), min_size=7, max_size=7),
    data=st.data(),
)
def test_no_graph_and_no_failure_changes_the_total(edges, masses, data):
    ends = sorted({node for link in edges for node in link})
    edges = [(ends.index(i), ends.index(j)) for i, j in edges]
    now = [np.array([mass]) for mass in masses[: len(ends)]]
    total = math.fsum(mass[0] for mass in now)
    for _ in range(5):
        up = data.draw(st.lists(st.booleans(), min_size=len(edges), max_size=len(edges)))
        now = one_round(now, edges, up)
        assert min(mass[0] for mass in now) >= 0.0
        assert abs(math.fsum(mass[0] for mass in now) - total) <= 1e-14 * total


@pytest.mark.slow
@pytest.mark.parametrize("delivery", [0.3, 0.7])
def test_mass_is_conserved_over_many_rounds(delivery):
    assert drift(100_000, 6, delivery, 2) <= 1e-12


def test_one_round_is_the_matrix_of_the_proof():
    """Theta = I - L (I + D)^-1 with the failed links out of L and the nominal degrees in D."""
    random, degrees = np.random.default_rng(3), degrees_of(EDGES)
    for _ in range(50):
        up = random.random(len(EDGES)) < 0.6
        L = np.zeros((5, 5))
        for (i, j), here in zip(EDGES, up, strict=True):
            L += here * np.outer(np.eye(5)[i] - np.eye(5)[j], np.eye(5)[i] - np.eye(5)[j])
        theta = np.eye(5) - L @ np.linalg.inv(np.eye(5) + np.diag(degrees))
        z = random.standard_normal((5, 3))
        np.testing.assert_allclose(one_round(list(z), EDGES, up), theta @ z, rtol=0, atol=1e-14)


@pytest.mark.parametrize("n", [1, 2, 4])
def test_the_correction_is_the_formula_of_the_paper(n):
    random = np.random.default_rng(n)
    for rank in range(n + 1):
        A, B = random.standard_normal((n, n)), random.standard_normal((n, rank))
        M, G = A @ A.T, B @ B.T
        root = corrected_root(np.linalg.cholesky(M), G)
        expected = M @ np.linalg.inv(np.eye(n) + G @ M)
        np.testing.assert_allclose(root @ root.T, expected, rtol=1e-10, atol=1e-12)


def test_the_correction_survives_a_covariance_that_grew_for_long():
    """A node without mass lets P grow; when information comes, what is seen is known again."""
    P, G = np.diag([1e20, 1e18]), np.diag([4.0, 0.0])
    root = corrected_root(np.sqrt(P), G)
    np.testing.assert_allclose(root @ root.T, np.diag([0.25, 1e18]), rtol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_the_asymptotic_covariance_is_the_centralised_one(seed):
    random = np.random.default_rng(seed)
    F, B = 1.2 * random.standard_normal((3, 3)), random.standard_normal((3, 3))
    H, R = random.standard_normal((2, 3)), np.diag([0.5, 2.0])
    Q, G = B @ B.T, H.T @ np.linalg.inv(R) @ H
    root = asymptotic_root(F, Q, G)
    X = scipy.linalg.solve_discrete_are(F.T, H.T, Q, R)
    np.testing.assert_allclose(root @ root.T, np.linalg.inv(np.linalg.inv(X) + G), rtol=1e-8)


def test_no_asymptotic_covariance_where_a_growing_mode_is_not_seen():
    assert asymptotic_root(np.diag([1.1, 0.5]), np.eye(2), np.diag([0.0, 1.0])) is None
    # The difference of the two states is never seen and walks away; rounding ends its doubling.
    for scale in (1.0, 2.0, 3.0):
        assert asymptotic_root(np.eye(2), np.eye(2), np.full((2, 2), scale)) is None
    h = np.array([[0.0, 0.0, 1.0], [1.0, 1.0, 1.0]])
    assert asymptotic_root(np.eye(3), np.eye(3), h.T @ np.diag([1.0, 2.0]) @ h) is None
    # So do states of which no sensor sees one direction, growing, resting or at constant speed.
    for seed in range(10):
        random = np.random.default_rng(seed)
        T = np.linalg.qr(random.standard_normal((4, 4)))[0]
        speeds = np.kron(np.eye(2), [[1.0, 0.25], [0.0, 1.0]])
        for modes, hidden in ((np.diag([1.0, 1.0, 0.5, 1.02]), 3), (speeds, 0), (np.eye(4), 0)):
            H = random.standard_normal((2, 4))
            H[:, hidden] = 0.0
            H = H @ T.T
            assert asymptotic_root(T @ modes @ T.T, np.eye(4), H.T @ H) is None
        # One that is seen poorly is known poorly.
        H = np.array([[1e-3, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]) @ T.T
        assert asymptotic_root(T @ speeds @ T.T, np.eye(4), H.T @ H) is not None
    # Wide, yet there: an unstable mode behind a reading with a noise of 1e13.
    P = asymptotic_root(np.array([[1.5]]), np.eye(1), np.array([[1e-13]]))
    assert P is not None


def test_averaging_keeps_the_mean_and_follows_the_laplacian():
    random = np.random.default_rng(4)
    z = random.standard_normal((5, 2))
    L = np.zeros((5, 5))
    for i, j in EDGES:
        L += np.outer(np.eye(5)[i] - np.eye(5)[j], np.eye(5)[i] - np.eye(5)[j])
    filter_ = PushSum(gamma=1, delta=4.5)
    states = states_with([np.ones(6)] * 5, EDGES, filter_)
    states = [state._replace(xhat=x) for state, x in zip(states, z, strict=True)]
    step = EXCHANGE._replace(phase=AVERAGE)
    after = [s.xhat for s in exchanged(filter_, states, EDGES, [True] * len(EDGES), step)]
    np.testing.assert_allclose(after, z - L @ z / 4.5, atol=1e-14)


def numbers(stop, delivery, rounds, seed, leader=0):
    """N^(i) of all nodes of T1 after some rounds with that stop rule."""
    filter_ = PushSum(gamma=1, delta=4.01, stop=stop, leader=leader)
    random, degrees = np.random.default_rng(seed), degrees_of(T1)
    H = {4: [[1.0, 0.0]], 9: [[0.0, 1.0]]}
    states = []
    for node, degree in enumerate(degrees):
        rows = np.array(H.get(node, np.zeros((0, 2))))
        model = SlotModel(np.eye(2), np.eye(2), rows, 0.01 * np.eye(len(rows)))
        info = NodeInfo(node, degree, degree, 10, 1.0, 100.0 * np.eye(2))
        states.append(filter_.init(model, np.zeros(2), np.eye(2), info))
    for k in range(rounds):
        up = random.random(len(T1)) < delivery
        states = exchanged(filter_, states, T1, up, EXCHANGE._replace(slot=k))
    total = math.fsum(state.mass[0] for state in states)
    assert total == pytest.approx(1.0, abs=1e-14)
    return np.array([state.number for state in states]), states


def test_every_node_learns_how_many_there_are_and_what_they_see():
    for leader in (0, 7):
        found, states = numbers("never", 0.7, 150, 1, leader)
        np.testing.assert_allclose(found, 10.0, rtol=1e-9)
        for state in states:
            np.testing.assert_allclose(state.information, 100.0 * np.eye(2), atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("delivery", "wrong"), [pytest.param(0.7, 0.5, marks=pytest.mark.slow), (0.5, 0.9)]
)
def test_the_stop_rule_of_the_paper_breaks_and_the_safe_one_does_not(delivery, wrong):
    """Section 4: nodes with N^(i) wrong by more than 1 %: 76 % and 98 %; safe 0 %."""
    paper = np.array([numbers("paper", delivery, 200, seed)[0] for seed in range(4)])
    assert np.mean(np.abs(paper - 10.0) > 0.1) > wrong
    for seed in range(2):
        found, states = numbers("safe", delivery, 300, seed)
        assert all(PushSum(gamma=1, delta=4.01).analysis.stopped(state) for state in states)
        np.testing.assert_allclose(found, 10.0, rtol=1e-4)


def within(D, bound):
    mass = np.concatenate([[1.0, 1.0], D.reshape(-1)])
    return moved_within(
        np.zeros((len(mass), 1)), mass[None, :, None], 0, 0, bound, np.empty(D.shape)
    )


def settled(information, number, former, former_number, tolerance):
    former, information = former[None, ..., None], information[..., None]
    return has_converged(former, 0, information, 0, former_number, number, tolerance)


@pytest.mark.parametrize("n", [1, 2, 4, 7])
def test_the_spectral_norm_is_held_against_the_tolerance(n):
    random = np.random.default_rng(n)
    for scale in (1e-150, 1e-9, 1.0, 1e9):
        for _ in range(50):
            D = scale * random.standard_normal((n, n))
            D += D.T
            norm = np.linalg.norm(D, 2)
            assert within(D, norm * (1.0 + 1e-12))
            assert not within(D, norm * (1.0 - 1e-12))
    flat = np.outer(np.ones(n), np.ones(n))  # as far beyond its entries as can be
    for sign in (1.0, -1.0):
        assert within(sign * flat, n + 1e-12)
        assert not within(sign * flat, n - 1e-12)
    for tolerance in (0.0, 1e-300, 1.0):
        assert within(np.zeros((n, n)), tolerance) == (tolerance > 0.0)
        assert not within(np.full((n, n), np.nan), tolerance)


@pytest.mark.parametrize("n", [1, 4])
def test_settled_means_less_than_the_tolerance_relative(n):
    random = np.random.default_rng(n)
    new, step = random.standard_normal((2, n, n))
    step *= np.linalg.norm(new) / np.linalg.norm(step)
    for tolerance in (1e-9, 1e-3):
        near, far = (new - tolerance * share * step for share in (0.999, 1.001))
        assert settled(new, 10.0, near, 10.0 * (1.0 - 0.999 * tolerance), tolerance)
        assert not settled(new, 10.0, far, 10.0, tolerance)
        assert not settled(new, 10.0, near, 10.0 * (1.0 + 1.001 * tolerance), tolerance)
    assert not settled(new, 10.0, new, 10.0, 0.0)


def test_the_safe_rule_waits_for_mass():
    """Far from the leader all links are up and nothing changes while the weight is 0."""
    filter_ = PushSum(gamma=1, delta=4.01, stop="safe")
    model = SlotModel(np.eye(1), np.eye(1), np.zeros((0, 1)), np.zeros((0, 0)))
    state = filter_.init(model, np.zeros(1), np.eye(1), NodeInfo(3, 1, 1, 10, 1.0, np.eye(1)))
    same = filter_.emit(state, EXCHANGE)[1]
    after = filter_.absorb(state, [Message(2, 0.0, same, 0.0)], EXCHANGE)
    assert not filter_.analysis.stopped(after)
    assert after.number == 1.0
