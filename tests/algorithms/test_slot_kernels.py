"""Kernels of filters in slots against the plain formulas, for several seeds and dimensions."""

import numpy as np
import pytest

from netkf.algorithms.filter import NodeInfo, Reading
from netkf.algorithms.kernels import slots
from netkf.algorithms.models import SlotModel
from netkf.algorithms.push_sum import PushSum
from netkf.linalg.lanes import LANES, aligned

CASES = [(seed, n) for seed in range(3) for n in (1, 2, 4, 7)]


def triangular(random, n, count=1):
    return np.stack([np.linalg.cholesky(_covariance(random, n)) for _ in range(count)])


def _covariance(random, n):
    B = random.standard_normal((n, n + 2))
    return B @ B.T


def lanes_last(values):
    """The runs of one block (L, ...) as (1, ..., L)."""
    made = aligned((1, *values.shape[1:], LANES))
    made[0] = np.moveaxis(values, 0, -1)
    return made


def filters(random, n, p):
    """Two filters in each run of a block, and their whitened readings in one slot."""
    Q, F = triangular(random, n)[0], random.standard_normal((n, n))
    x = random.standard_normal((LANES, 2, n))
    roots = triangular(random, n, 2 * LANES).reshape(LANES, 2, n, n)
    nodes = slots.SlotNodes(lanes_last(x), lanes_last(roots), F, Q, np.array([p, 0]))
    y = lanes_last(random.standard_normal((LANES, 1, 2, p)))
    H = lanes_last(random.standard_normal((LANES, 1, 2, p, n)))
    local = lanes_last(random.standard_normal((LANES, 1, n)))
    return nodes, slots.ReadingBlock(y, H, local, np.array([True]))


def estimates(nodes, h, q):
    """xhat (n,) and P (n, n) of filter ``h`` in lane ``q``."""
    root = np.tril(nodes.root[0, h, :, :, q])
    return nodes.xhat[0, h, :, q].copy(), root @ root.T


@pytest.mark.parametrize(("seed", "n"), CASES)
def test_prediction(seed, n):
    random = np.random.default_rng(seed)
    nodes, _ = filters(random, n, 1)
    before = [estimates(nodes, 1, q) for q in range(LANES)]
    slots.predict_all(nodes, slots.slot_scratch(2, n, unrolled=True), 0)
    for q, (x, P) in enumerate(before):
        found, cov = estimates(nodes, 1, q)
        expected = nodes.F @ P @ nodes.F.T + nodes.root_Q @ nodes.root_Q.T
        np.testing.assert_allclose(cov, expected, rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(found, nodes.F @ x, rtol=1e-10, atol=1e-12)
        assert (np.diag(nodes.root[0, 1, :, :, q]) > 0.0).all()


@pytest.mark.parametrize("n", [1, 2, 4, 7])
def test_a_lane_is_the_same_in_any_company(n):
    """One lane alone has the bits of the eight."""
    random = np.random.default_rng(n)
    nodes, _ = filters(random, n, 1)
    roots = nodes.root[0, 0].copy()
    slots.predict_all(nodes, slots.slot_scratch(2, n, unrolled=True), 0)
    for q in range(LANES):
        alone = slots.predict_root_alone(roots[:, :, q], nodes.F, nodes.root_Q)
        np.testing.assert_array_equal(np.tril(alone), np.tril(nodes.root[0, 0, :, :, q]))


def test_prediction_of_what_is_known_and_moves_by_itself():
    """Rows of zeros and signs that change."""
    F, zero = np.diag([-2.0, 1.0, 0.0]), np.zeros((3, 3))
    root = slots.predict_root_alone(np.diag([1.0, 0.0, 3.0]), F, zero)
    np.testing.assert_allclose(root, np.diag([2.0, 0.0, 0.0]), atol=0.0)


@pytest.mark.parametrize(("seed", "n"), CASES)
@pytest.mark.parametrize("p", [1, 3])
def test_update_with_a_whitened_reading(seed, n, p):
    random = np.random.default_rng(seed)
    nodes, readings = filters(random, n, p)
    before = [estimates(nodes, 0, q) for q in range(LANES)]
    slots.read_all(nodes, readings, slots.slot_scratch(2, n, unrolled=True), 0, 0)
    for q, (x, P) in enumerate(before):
        y, H = readings.y[0, 0, 0, :, q], readings.H[0, 0, 0, :, :, q]
        gain = P @ H.T @ np.linalg.inv(H @ P @ H.T + np.eye(p))
        found, cov = estimates(nodes, 0, q)
        np.testing.assert_allclose(cov, P - gain @ H @ P, rtol=1e-10, atol=1e-11)
        np.testing.assert_allclose(found, x + gain @ (y - H @ x), rtol=1e-10, atol=1e-11)


@pytest.mark.parametrize(("seed", "n"), CASES)
def test_whitening(seed, n):
    random = np.random.default_rng(seed)
    y, H, R = random.standard_normal(2), random.standard_normal((2, n)), _covariance(random, 2)
    white, seen = slots.whiten_reading(y, H, R)
    np.testing.assert_allclose(seen.T @ seen, H.T @ np.linalg.inv(R) @ H, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(seen.T @ white, H.T @ np.linalg.inv(R) @ y, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize(("seed", "n"), CASES)
def test_the_gain_of_push_sum(seed, n):
    """P (8)."""
    random = np.random.default_rng(seed)
    x, root = random.standard_normal(n), triangular(random, n)[0]
    y, H, R = random.standard_normal(2), random.standard_normal((2, n)), _covariance(random, 2)
    filter_ = PushSum(gamma=1, delta=2.0)
    model, info = SlotModel(np.eye(n), np.eye(n), H, R), NodeInfo(0, 1, 1, 2, 1.0, np.eye(n))
    state = filter_.init(model, x, root @ root.T, info)
    state = state._replace(information=np.zeros((n, n)), number=3.5)
    found = filter_.update(state, Reading(y, H, R))
    expected = x + 3.5 * root @ root.T @ H.T @ np.linalg.inv(R) @ (y - H @ x)
    np.testing.assert_allclose(found.xhat, expected, rtol=1e-10, atol=1e-12)
    nothing = filter_.update(state, Reading(y[:0], H[:0], R[:0, :0]))
    assert (nothing.xhat == x).all()


@pytest.mark.parametrize("framed", [False, True])
@pytest.mark.parametrize(("seed", "n"), CASES)
def test_samples_show_the_covariance_and_frames_move_estimates(seed, n, framed):
    random = np.random.default_rng(seed)
    nodes, readings = filters(random, n, 1)
    runs = LANES - 1  # the last lane is idle
    absolute = 100.0 + random.standard_normal((1, 1, n, LANES))
    samples = slots.SlotSamples(
        np.empty((runs, 1, n)),
        np.empty((runs, 1, 2 * n)),
        np.empty((runs, 1, 2 * n * n)),
        np.empty((runs, 1, 2 * n)),
        np.zeros((1, 2, LANES), int),
        np.zeros((1, 2, 2, LANES)),
        absolute,
        readings.local,
        framed,
        np.zeros((1, LANES)),
    )
    flags, up = np.array([True]), np.zeros((1, 1, 1, 0, LANES), dtype=np.uint8)
    # Who sends is nobody's choice.
    nothing = np.zeros((0,) * 5, dtype=np.uint8), np.zeros((0,) * 5), slots.WHOLE
    plan = slots.SlotPlan(0, flags, flags, np.array([0]), up, *nothing)
    room = slots.slot_scratch(2, n, unrolled=True)
    slots.store_sample_of_slot(nodes, plan, samples, room, 0, 0)
    xhat, error = (v.reshape(runs, 2, n) for v in (samples.xhat, samples.error))
    P, before = samples.P.reshape(runs, 2, n, n), nodes.xhat.copy()
    slots.rebase(nodes, readings, room, 0, 0)
    for q in range(runs):
        for h in range(2):
            cov = estimates(nodes, h, q)[1]
            np.testing.assert_allclose(P[q, h], cov, rtol=1e-10, atol=1e-12)
            local = readings.local[0, 0, :, q]
            mine = before[0, h, :, q] + framed * (absolute[0, 0, :, q] - local)
            np.testing.assert_allclose(xhat[q, h], mine, rtol=1e-13)
            np.testing.assert_array_equal(error[q, h], local - before[0, h, :, q])
        np.testing.assert_array_equal(samples.x[q, 0], absolute[0, 0, :, q])
        shown = xhat[q].sum() + sum(np.tril(cov).sum() for cov in P[q])
        np.testing.assert_allclose(samples.total[0, q], shown, rtol=1e-10)
    moved = before - readings.local[0, 0]
    np.testing.assert_array_equal(nodes.xhat, moved)
