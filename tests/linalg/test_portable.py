"""Products and factors without BLAS and LAPACK: against those, and their bits under others."""

import os
import subprocess
import sys
from itertools import pairwise

import numpy as np
import pytest
import scipy.linalg

from netkf.linalg import portable
from netkf.linalg.arrays import square_root

DIGEST = """
import hashlib, sys
import numpy as np
import netkf
from netkf.plants.sensors import step_noise
from netkf.rng.streams import Streams

found = hashlib.sha256()
def add(*arrays):
    for array in arrays:
        found.update(np.ascontiguousarray(np.asarray(array, dtype=float) + 0.0).tobytes())

ring = netkf.load("scenarios/poisson_ring.toml")
plant = {"kind": "diffusion", "A": [[0.3, 1.1, 0.0], [-0.7, -0.2, 0.4], [0.1, 0.0, -0.9]],
         "B": [[0.2], [1.3], [0.7]], "cov": [[2.0, 0.3, 0.1], [0.3, 1.0, 0.2], [0.1, 0.2, 0.5]]}
R = [[0.5, 0.1, 0.05], [0.1, 0.4, 0.1], [0.05, 0.1, 0.3]]
H = [[1.0, 0.3, 0.1], [0.2, 1.0, 0.7], [0.3, 0.1, 0.9]]
sensor = {"nodes": [0, 3], "H": H, "R": R}
clocked = {**sensor, "sampling": {"kind": "poisson", "rate": 3.0}}
cases = ([sensor], True), ([sensor], False), ([clocked], True), ([sensor, clocked], False)
for sensors, frames in cases:
    changes = {"plant": plant, "sensors": sensors, "probe": 0.37, "filter": {"kind": "local"}}
    scenario = ring.replace(changes)
    streams = Streams(5)
    truth = scenario.continuous_truth(streams, frames)
    times = scenario.times
    steps = iter(truth.frame_times.tolist())
    ahead, k = next(steps, np.inf), 0
    for t in times.tolist():
        while ahead <= t:
            add(truth.rebase(k))
            ahead, k = next(steps, np.inf), k + 1
        add(truth.absolute(t))
    add(scenario.diffusion.moves.laws(np.array([0.01, 0.7, 30.0]))[1])
    path = scenario.sensors[0].path if not sensors[0].get("sampling") else None
    if path is not None:
        own = path(streams.generator("noise", 0, 0), streams.generator("cutting", 0, 0))
        add(step_noise(own._normals.draw().reshape(2, -1), 0.1), own._root)
    for place in scenario.sampled_sensors.get(0, ()):
        samples = scenario.sample_path(streams, 0, place)
        add(*(samples.reading(k, np.array([0.3, 0.7, -0.2]))[0] for k in range(20)))
gossip = netkf.load("scenarios/gossip_ring.toml")
F = [[1.02, 0.1, 0.03], [-0.2, 0.9, 0.4], [0.1, 0.0, 0.8]]
for name in ("gossip", "local"):
    slots = {"kind": "linear", "F": F, "Q": plant["cov"], "cov": R, "period": 1.0}
    scenario = gossip.replace({"plant": slots, "sensors": [sensor], "filter": {"kind": name}})
    streams = Streams(5)
    truth = scenario.slot_plant.truth(streams.generator("plant"), True)
    readings = scenario.slot_path(streams, 0, scenario.placed_sensors[0][0])
    for slot in range(30):
        if slot and slot % (truth.frame_slots or 31) == 0:
            add(truth.rebase(slot))
        add(truth.absolute(slot), readings.reading(slot, truth.local(slot)))
regression = netkf.load("scenarios/diffusion_regression.toml")
streams = Streams(2)
for node, placed in regression.placed_sensors.items():
    path = regression.slot_path(streams, node, placed[0])
    for slot in range(20):
        add(path.matrix(slot), path.reading(slot, np.ones(regression.plant.n)))
print(found.hexdigest())
"""


def matrices():
    random = np.random.default_rng(3)
    for n in (1, 2, 3, 5, 8):
        B = random.normal(size=(n, n))
        yield B @ B.T


@pytest.mark.slow
def test_the_truth_and_the_readings_have_the_same_bits_under_other_kernels_of_openblas():
    """OPENBLAS_CORETYPE chooses the loops that OpenBLAS would take on another CPU."""
    cores = (None, "Prescott", "Nehalem", "Haswell")
    started = []
    for core in cores:
        env = {**os.environ, "OMP_NUM_THREADS": "1"} | ({"OPENBLAS_CORETYPE": core} if core else {})
        command = [sys.executable, "-c", DIGEST]
        started.append(subprocess.Popen(command, env=env, stdout=subprocess.PIPE, text=True))
    found = [process.communicate()[0] for process in started]
    assert [process.returncode for process in started] == [0] * len(cores)
    assert len(found[0]) == 65
    assert dict.fromkeys(cores, found[0]) == dict(zip(cores, found, strict=True))


def test_terms_that_are_left_out_change_no_bit(monkeypatch):
    """Of plants of many blocks most terms of a sum are 0; some blocks have a -0."""
    random, count, n = np.random.default_rng(4), 3, 60
    blocks = np.kron(np.eye(n // 4), np.ones((4, 4)))
    a, b = (blocks * random.standard_normal((count, n, n)) for _ in range(2))
    a[:, :2] *= -0.0
    long = np.tile(b, (1, 1, 10)) * (random.random((count, n, 10 * n)) < 0.2)
    b[:, :, :20] += 1.0

    def results():
        return (
            portable.product(a, b), portable.product(a, long), portable.product(a[0], b[1]),
            portable.apply(np.swapaxes(long, 1, 2), b[:, 3]), portable.apply(long, long[:, 5]),
            portable.norm(long), portable.norm(long[:, 7]),
        )  # fmt: skip

    found = results()
    monkeypatch.setattr(portable, "MANY", 10**9)
    for mine, plain in zip(found, results(), strict=True):
        assert mine.tobytes() == plain.tobytes()


def test_products_are_those_of_numpy():
    random = np.random.default_rng(1)
    for shape, other in (((3, 4), (4, 2)), ((5, 1, 3), (5, 3, 2)), ((2, 5, 3, 4), (4, 4))):
        a, b = random.normal(size=shape), random.normal(size=other)
        np.testing.assert_allclose(portable.product(a, b), a @ b, rtol=1e-14, atol=1e-14)
    a, x = random.normal(size=(6, 3, 4)), random.normal(size=(6, 4))
    np.testing.assert_allclose(portable.apply(a, x), np.einsum("kij,kj->ki", a, x), atol=1e-14)
    np.testing.assert_allclose(portable.norm(x), np.linalg.norm(x, axis=1), rtol=1e-14)
    assert portable.product(np.empty((2, 0)), np.empty((0, 3))).tolist() == [[0.0] * 3] * 2


@pytest.mark.parametrize("matrix", list(matrices()), ids=len)
def test_factors_are_those_of_lapack(matrix):
    n = len(matrix)
    L = portable.cholesky(matrix)
    np.testing.assert_allclose(L, scipy.linalg.cholesky(matrix, lower=True), rtol=1e-11, atol=1e-13)
    right = np.arange(2.0 * n).reshape(n, 2)
    solved = scipy.linalg.solve_triangular(L, right, lower=True)
    np.testing.assert_allclose(portable.solve_lower(L, right), solved, rtol=1e-9)
    values, vectors = portable.eigenvectors(matrix)
    np.testing.assert_allclose(values, np.linalg.eigvalsh(matrix), rtol=1e-9)
    np.testing.assert_allclose(vectors.T @ vectors, np.eye(n), atol=1e-13)
    np.testing.assert_allclose(matrix @ vectors, vectors * values, atol=1e-12 * values[-1])
    values, vectors = np.linalg.eigh(matrix)
    np.testing.assert_allclose(portable.noise_root(matrix), vectors * np.sqrt(values), atol=1e-11)
    root = portable.symmetric_root(matrix)
    np.testing.assert_allclose(root, scipy.linalg.sqrtm(matrix).real, atol=1e-10)
    inverse = portable.pseudo_inverse(matrix, 1e-13)
    np.testing.assert_allclose(inverse @ matrix, np.eye(n), atol=1e-9)


@pytest.mark.parametrize("copies", [1, 2, 8])
def test_roots_have_the_digits_of_all_rows_whatever_their_units(copies):
    """Metres beside radians a second: the units are no reason to lose the digits of a variance."""
    random, units = np.random.default_rng(0), [1e-9, 1e2, 1e-5, 1e3, 1e-3, 1e-2]
    own = np.corrcoef(random.normal(size=(6, 20))) * np.outer(units, units)
    # Several alike have multiple eigenvalues, and many are too many to be refined.
    matrix = np.kron(np.eye(copies), own)
    sizes = np.tile(units, copies)
    for root in (square_root(matrix), portable.noise_root(matrix)):
        error = np.abs(root @ root.T - matrix) / np.outer(sizes, sizes)
        assert error.max() < 1e-13
    # What is rounding of zero has no units, and is far from semidefinite by itself.
    matrix = np.array([[1e-33, 1e-16], [1e-16, 1.0]])
    np.testing.assert_allclose(square_root(matrix) @ square_root(matrix).T, matrix, atol=1e-15)


@pytest.mark.parametrize(
    "matrix",
    [
        np.zeros((3, 3)),
        np.eye(4),
        np.diag([3.0, 0.0, 1.0, 3.0]),
        np.diag([1e-20, 1.0, 1e12]),
        np.ones((3, 3)),
        np.kron([[1e-5, 8e-5], [8e-5, 6.5e-4]], np.eye(2)),
        np.diag([1.0, 1.0, 1.0]) + 1e-14 * np.ones((3, 3)),
        np.array([[1e-300, 1e-305], [1e-305, 1e-300]]),
    ],
    ids=str,
)
def test_singular_and_multiple_eigenvalues(matrix):
    """The columns are those of LAPACK, which paths of all earlier runs were drawn with, except that
    of a multiple eigenvalue any basis will do: LAPACK's own depends on the kernels of its BLAS.
    """
    S, scale = portable.noise_root(matrix), np.sqrt(np.abs(matrix).max())
    np.testing.assert_allclose(S @ S.T, matrix, rtol=1e-12, atol=1e-13 * scale**2)
    values, vectors = np.linalg.eigh(matrix)
    expected = vectors * np.sqrt(np.maximum(values, 0.0))
    # Columns of one eigenvalue are neighbours, since LAPACK sorts eigenvalues.
    starts = np.flatnonzero(np.diff(values, prepend=-np.inf) > 1e-13 * np.abs(values).max())
    for first, last in pairwise([*starts, len(values)]):
        ours, theirs = S[:, first:last], expected[:, first:last]
        if last - first == 1:
            np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=2e-7 * scale)
        else:
            np.testing.assert_allclose(ours @ ours.T, theirs @ theirs.T, atol=4e-13 * scale**2)
    inverse = portable.pseudo_inverse(matrix, 1e-13)
    reference = np.linalg.pinv(matrix, rcond=1e-13, hermitian=True)
    np.testing.assert_allclose(inverse, reference, rtol=1e-9, atol=1e-9 * np.abs(reference).max())


@pytest.mark.parametrize("count", [1, 2, 10, 20])
def test_quadrature(count):
    x, w = np.polynomial.legendre.leggauss(count)
    nodes, weights = portable.gauss_legendre(count)
    np.testing.assert_allclose(nodes, 0.5 * (x + 1.0), rtol=0, atol=3e-16)
    np.testing.assert_allclose(weights, 0.5 * w, rtol=1e-13)
    for power in range(2 * count):
        assert weights @ nodes**power == pytest.approx(1.0 / (power + 1), rel=1e-14)
