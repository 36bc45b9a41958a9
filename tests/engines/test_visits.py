"""Filters side by side in lanes against the same filters one by one in the event loop, and against
themselves in other company.
"""

import dataclasses

import numpy as np
import pytest
import scipy.linalg

import netkf
from netkf.algorithms.gossip import swap
from netkf.algorithms.kernels import run as standard
from netkf.algorithms.kernels.root_flow import cell_of
from netkf.algorithms.records import Record, estimate_shapes
from netkf.algorithms.traits import Weights
from netkf.engines.compiled import agenda, batches, flow, visits
from netkf.engines.compiled.flow import Workspace
from netkf.engines.compiled.lane_series import NEAR
from netkf.engines.compiled.visits import fill_row
from netkf.kernels import Kernels
from netkf.linalg.compiling import kernel
from netkf.linalg.series import polynomial
from netkf.parts import Filter, Hybrid
from tests.benchmarks.cases import planar
from tests.engines.agreement import assert_agree

TWO_ROWS = {"nodes": [3, 5], "H": np.eye(2).tolist(), "R": [[0.5, 0.1], [0.1, 0.3]]}
ONE_ROW = {"nodes": [0], "H": [[1.0, 0.0]], "R": [[0.25]]}
PRECISE = {"nodes": [0, 3], "H": [[1.0, 0.0]], "R": [[1e-6]]}
UNSTABLE = {"kind": "diffusion", "A": [[0.6, 1.0], [0.0, 0.4]], "B": [[0.0], [1.0]]}
CASES = {
    "links": {},
    "each way": {"network.channel.symmetric": False},
    "directions": {"network.activation": {"kind": "poisson", "rate": 1.0, "at": "directions"}},
    "nodes": {"network.activation": {"kind": "poisson", "rate": 1.0, "at": "nodes"}},
    "bursts": {
        "network.channel.loss": {"kind": "gilbert-elliott", "mean_loss": 0.3, "mean_burst": 3.0}
    },
    "unobserved": {"sensors": []},
    "two kinds of sensors": {"sensors": [ONE_ROW, TWO_ROWS]},
    "several stretches of a step": {"sensors": [PRECISE]},
    "wide": {"filter.cov": [[1e9, 0.0], [0.0, 1e9]]},
    "long gaps": {"network.activation": {"kind": "poisson", "rate": 0.05}, "horizon": 40.0},
    "unstable": {"plant": {**UNSTABLE, "cov": np.eye(2).tolist()}},
}


def one_by_one(monkeypatch):
    for module in (flow, batches):
        monkeypatch.setattr(module, "is_immediate", lambda _: False)


def dimensions(build, n):
    """n states, of which all nodes but one read the first."""
    random = np.random.default_rng(n)
    A = random.normal(size=(n, n)) / np.sqrt(n)
    plant = {"kind": "diffusion", "A": A.tolist(), "B": np.eye(n).tolist()}
    eye, H = np.eye(n).tolist(), np.eye(1, n).tolist()
    return build(
        horizon=3.0,
        plant={**plant, "cov": eye},
        sensors=[{"nodes": [0, 1], "H": H, "R": [[0.3]]}],
        filter={"kind": "hybrid", "epsilon": 0.3, "cov": eye},
    )


def assert_close(case, monkeypatch):
    assert agenda.is_immediate(case)
    found = netkf.simulate(case, 3, engine="compiled")
    with monkeypatch.context() as patch:
        one_by_one(patch)
        expected = netkf.simulate(case, 3, engine="compiled")
    assert found.fingerprint == expected.fingerprint
    np.testing.assert_array_equal(found.x, expected.x)
    size = np.abs(expected.P).max(axis=(2, 3))
    scale = np.sqrt(np.maximum(size, 1.0))[..., None]
    np.testing.assert_allclose(found.xhat / scale, expected.xhat / scale, rtol=0.0, atol=1e-9)
    assert (np.abs(found.P - expected.P).max(axis=(2, 3)) <= 1e-10 * size).all()


@pytest.mark.parametrize("name", CASES)
def test_lanes_leave_what_the_event_loop_leaves(ring, monkeypatch, name):
    assert_close(ring.replace({"horizon": 8.0, **CASES[name]}), monkeypatch)


@pytest.mark.parametrize("n", [1, 4])
def test_states_of_any_size(build, monkeypatch, n):
    assert_close(dimensions(build, n), monkeypatch)


@pytest.mark.parametrize("name", ["links", "two kinds of sensors", "several stretches of a step"])
def test_company_does_not_matter(ring, monkeypatch, name):
    case = ring.replace({"horizon": 8.0, **CASES[name]})
    (whole,) = batches.flow_batches(case, 5, range(20))
    for places, most, largest in ((1, 1 << 14, 256), (400, 1, 256), (20, 50, 7)):
        monkeypatch.setattr(agenda, "MAX_FILTERS", places)
        for module in (agenda, visits):
            monkeypatch.setattr(module, "MAX_VISITS", most)
        monkeypatch.setattr(batches, "MAX_BATCH_RUNS", largest)
        again = case.replace({})  # nothing is kept of the runs before
        parts = list(batches.flow_batches(again, 5, range(20)))
        for field in ("xhat", "P", "counts"):
            found = np.concatenate([getattr(part, field) for part in parts])
            np.testing.assert_array_equal(found, getattr(whole, field))


def test_only_runs_whose_messages_take_no_time(ring):
    diffusion = {"kind": "diffusion", "weights": "metropolis"}  # own weights differ by node
    at = {"network.activation": {"kind": "poisson", "rate": 1.0, "at": "nodes"}}
    assert agenda.is_immediate(ring.replace(at))
    assert not agenda.is_immediate(ring.replace({**at, "filter": diffusion}))
    assert agenda.is_immediate(ring)
    apart = (
        {"kind": "periodic", "period": 0.5, "phase": "random"},
        {"kind": "renewal", "distribution": "gamma", "shape": 3.0, "mean": 0.5},
        {"kind": "renewal", "distribution": "uniform", "low": 0.1, "high": 0.5},
    )
    for clock in apart:
        assert agenda.is_immediate(ring.replace({"network.activation": clock}))
    for change in (
        {"network.activation": {"kind": "renewal", "distribution": "constant", "mean": 0.5}},
        {"network.channel.delay": {"kind": "constant", "seconds": 0.1}},
        {"network.activation": {"kind": "periodic", "period": 0.5}},
        {"filter": {"kind": "local"}},
        {"sensors.0.sampling": {"kind": "periodic", "period": 0.5}},
    ):
        assert not agenda.is_immediate(ring.replace(change))


@kernel
def summed(series, unit, far_terms, gap, out):
    """All columns of a table of one model at a gap."""
    cell, since = cell_of(unit, gap)
    fill_row(out, 0, series, series.shape[2] if cell < NEAR else far_terms, 0, cell, since)


def noise_over(A, B, gap):
    """The covariance that noise adds over a gap, by a quadrature of positive terms."""
    nodes, weights = np.polynomial.legendre.leggauss(24)
    responses = [scipy.linalg.expm(A * (0.5 * gap * (1.0 + node))) @ B for node in nodes]
    return 0.5 * gap * sum(w * M @ M.T for w, M in zip(weights, responses, strict=True))


@pytest.mark.parametrize("case", ["ring", "two axes"])
def test_tables_of_lanes_hold_transitions_and_gains(ring, case):
    case = ring if case == "ring" else planar(6)
    workspace = Workspace(case)
    waiting = workspace.visits()
    A, n = np.array(case.plant.A), case.plant.n
    lower = n * (n + 1) // 2
    model = next(model for model in case.models if len(model.H))
    places = {"unobserved": waiting.unobserved.column, "sensing": waiting.sensing.column}
    # Two axes that are alike have few columns of their own.
    assert (len(set(places["sensing"])) < 30) == (len(set(places["unobserved"])) < 10)
    for kind, longest in (("unobserved", 0.9), ("sensing", 0.19)):
        table = getattr(waiting, kind)
        out = np.empty((1, table.series.shape[3]))
        # Short gaps are near 0, where entries of Q vanish as cubes: they keep their digits.
        for gap in longest * np.append(
            np.random.default_rng(1).random(30), 0.5 ** np.arange(1, 12)
        ):
            summed(table.series, table.unit[0], table.far_terms, gap, out)
            values = out[0][table.column]
            if kind == "unobserved":
                Q = noise_over(A, np.array(case.plant.B), gap)[np.tril_indices(n)]
                np.testing.assert_allclose(values[:lower], Q, rtol=1e-12)
            E = values[lower : lower + n * n].reshape(n, n)
            np.testing.assert_allclose(E, scipy.linalg.expm(A * gap), rtol=0.0, atol=1e-14)
            if kind == "sensing":
                gains, expected = (
                    values[2 * lower + 2 * n * n :],
                    polynomial(model.gains.series, gap),
                )
                np.testing.assert_allclose(gains, expected, rtol=0.0, atol=1e-13 * expected.max())


@dataclasses.dataclass(frozen=True, eq=False)
class Swaps(Hybrid):
    """A hybrid filter by name that swaps estimates."""

    kernels = Kernels(absorb=swap, unrolled=True)
    shift = Filter.shift


@kernel
def trust_late_ones(record, h, run):
    """Halve the estimate, where time has passed."""
    for i in range(len(run.size)):
        record.xhat[h, i, 0] *= 1.0 if run.gap == 0.0 else 0.5


@kernel
def swap_and_wait(record, h, run):
    """Swap, and then do what depends on more than estimates."""
    swap(record, h, run)
    trust_late_ones(record, h, run)


@kernel
def count(record, h, run):
    """Swap, and count the swaps."""
    swap(record, h, run)
    record.swaps[h, 0] += 1.0


def counting_record(_filtering, _infos, models):
    return Record(payload=estimate_shapes(len(models[0].information)), node={"swaps": ()})


def with_filter(scenario, algorithm):
    return dataclasses.replace(
        scenario, filter=dataclasses.replace(scenario.filter, algorithm=algorithm)
    )


def test_verbs_and_not_the_class_say_what_runs_in_lanes(ring, monkeypatch):
    own = with_filter(ring, Swaps(epsilon=0.3))
    assert agenda.is_immediate(own)
    assert_agree(own.replace({"horizon": 3.0}))
    for kernels in (
        Kernels(absorb=swap_and_wait),
        Kernels(absorb=count, record=counting_record),
        Kernels(absorb=swap, update=standard.absorb),
        Kernels(absorb=swap, begin=lambda *_: None),
    ):
        monkeypatch.setattr(Swaps, "kernels", kernels)
        assert not agenda.is_immediate(with_filter(ring, Swaps(epsilon=0.3)))


OTHERS = {
    "gossip": {"kind": "gossip"},
    "intersection": {"kind": "covariance-intersection", "epsilon": 0.2},
    "best weight": {"kind": "track-fusion", "rule": "ci"},
}


@pytest.mark.one_in(3)
@pytest.mark.parametrize("each_way", [False, True])
@pytest.mark.parametrize("name", OTHERS)
def test_other_filters_that_exchange_estimates(ring, monkeypatch, name, each_way):
    case = ring.replace(
        {"horizon": 8.0, "filter": OTHERS[name], "network.channel.symmetric": not each_way}
    )
    assert_close(case, monkeypatch)
    (batch,) = batches.flow_batches(case, 5, range(5))
    alone = netkf.simulate(case, 5, replica=3, engine="compiled")
    np.testing.assert_array_equal(batch.P[3], alone.P)
    np.testing.assert_array_equal(batch.xhat[3], alone.xhat)


UNEQUAL = np.array([[0.5, 0.3, 0.1], [0.2, 0.6, 0.25], [0.3, 0.1, 0.65]])


@dataclasses.dataclass(frozen=True, eq=False)
class Unequal(Hybrid):
    """A hybrid filter whose links have weights of their own."""

    shift = Filter.shift

    @property
    def link_weights(self):
        return Weights(matrix=UNEQUAL)


def test_messages_in_one_register_have_different_weights(build):
    graph = {"kind": "complete", "nodes": 3}
    network = {"graph": graph, "activation": {"kind": "poisson", "rate": 2.0}}
    case = build(horizon=6.0, network=network)
    case = with_filter(case, Unequal(epsilon=0.3))
    assert agenda.is_immediate(case)
    assert_agree(case)
