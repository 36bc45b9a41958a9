"""Batches of runs: every run of a batch is what it is alone."""

import numpy as np
import pytest

import netkf
from netkf.engines.compiled import batches
from netkf.engines.compiled.engine import CompiledEngine
from netkf.engines.simpy.engine import SimpyEngine
from netkf.trace.schema import KINDS
from tests.conftest import scenario_files, with_slow

SHORT = {"delayed_links": 6.0, "intel_lab": 240.0, "intel_lab_radio": 240.0, "push_sum_planar": 3.0}
LONG = {"diffusion_regression", "intel_lab_radio", "ulb_library"}
FILES = {file.stem: file for file in scenario_files()}
UNSTABLE = {"kind": "diffusion", "A": [[2.0]], "B": [[1.0]], "cov": [[1.0]]}
BURSTS = {"mean_loss": 0.3, "mean_burst": 3.0}
SAMPLED = {"nodes": [0, 3], "H": [[1.0, 0.0]], "R": [[0.25]]}
CASES = {
    "plain": {},
    "each way": {"network.channel.symmetric": False},
    "bursts": {"network.channel.loss": {"kind": "gilbert-elliott", **BURSTS}},
    "late": {"network.channel.delay": {"kind": "exponential", "mean": 0.4}},
    "other clocks": {"network.activation": {"kind": "periodic", "period": 0.3}},
    "nodes": {"network.activation": {"kind": "poisson", "rate": 1.0, "at": "nodes"}},
    "directions": {"network.activation": {"kind": "poisson", "rate": 1.0, "at": "directions"}},
    "silent": {"filter": {"kind": "local"}},
    "pooled": {"filter": {"kind": "central"}},
    "intersecting": {"filter": {"kind": "covariance-intersection", "epsilon": 0.3}},
    "blind": {"sensors": []},
    "off the grid": {"probe": 0.17},
    "sampled": {"sensors": [{**SAMPLED, "sampling": {"kind": "poisson", "rate": 3.0}}]},
    "two rows": {"sensors": [{**SAMPLED, "H": np.eye(2).tolist(), "R": np.eye(2).tolist()}]},
}


def assert_alone(scenario, engine, seed, replicas, fingerprint=False):
    """The batches of ``run_many`` hold the runs of ``run``, to the last bit."""
    done = []
    for batch in engine.run_many(scenario, seed, replicas, fingerprint):
        if not fingerprint or done:
            assert batch.fingerprint == ""
        else:
            first = netkf.simulate(scenario, seed, replicas[0], SimpyEngine())
            assert batch.fingerprint == first.fingerprint
        done += batch.replicas
        for r, replica in enumerate(batch.replicas):
            run = netkf.simulate(scenario, seed, replica, engine)
            length, pooled = len(run.times), batch.xhat.shape[2] == 1
            assert batch.lengths[r] == length
            assert batch.status[r] == run.status
            assert batch.exact_errors == run.exact_errors
            assert {name: tuple(pair[r]) for name, pair in batch.sums.items()} == run.sums
            np.testing.assert_array_equal(batch.counts[r], [run.count(kind) for kind in KINDS])
            np.testing.assert_allclose(batch.times[:length], run.times, rtol=1e-12)
            np.testing.assert_array_equal(batch.x[r, :length], run.x)
            for name in ("xhat", "P", "error"):
                found, expected = getattr(batch, name)[r, :length], getattr(run, name)
                expected = expected[:, :1] if pooled else expected
                np.testing.assert_array_equal(found, expected, err_msg=name)
    assert done == list(replicas)


@pytest.mark.one_in(3)
@pytest.mark.parametrize("largest", [256, 3])
@pytest.mark.parametrize("name", CASES)
def test_runs_drawn_together_are_what_they_are_alone(ring, monkeypatch, name, largest):
    monkeypatch.setattr(batches, "MAX_BATCH_RUNS", largest)
    assert_alone(ring.replace({"horizon": 15.0, **CASES[name]}), CompiledEngine(), 7, range(1, 6))


def test_a_batch_of_one_where_memory_is_short(ring, monkeypatch):
    monkeypatch.setattr(batches, "MAX_BATCH_BYTES", 1 << 12)
    assert batches.batch_size(ring) == 1
    assert_alone(ring.replace({"horizon": 2.0}), CompiledEngine(), 7, range(2))


@pytest.mark.one_in(4)
@pytest.mark.parametrize("name", with_slow(FILES, LONG))
def test_compiled_batches_hold_the_runs_of_the_scenarios(name):
    scenario = netkf.load(FILES[name])
    horizon = min(scenario.horizon, SHORT.get(name, scenario.horizon))
    case = scenario.replace({"horizon": horizon})
    # In slots the events of a run of a batch are recorded, else those of a run alone.
    assert_alone(case, CompiledEngine(), 7, range(1, 4), fingerprint=scenario.slotted)


@pytest.mark.parametrize("changes", [{}, {"filter": {"kind": "central"}}])
def test_simpy_batches_hold_its_runs(ring, changes):
    case = ring.replace({"horizon": 3.0, **changes})
    assert_alone(case, SimpyEngine(), 3, range(2, 5), fingerprint=True)


def test_batches_hold_runs_that_diverge(build):
    grown = build(horizon=600.0, probe=10.0, plant=UNSTABLE, filter={"kind": "local"})
    assert_alone(grown, CompiledEngine(), 0, range(3), fingerprint=True)
    assert_alone(grown.replace({"horizon": 450.0}), SimpyEngine(), 0, range(2))


def test_batches_in_slots_hold_runs_that_diverge(build):
    plant = {"kind": "linear", "F": [[2.0]], "Q": [[1.0]], "cov": [[1.0]], "period": 1.0}
    grown = build(
        horizon=1100.0,
        probe=100.0,
        plant=plant,
        network={"graph": {"kind": "path", "nodes": 2}, "activation": {"kind": "broadcast"}},
        filter={"kind": "local"},
    )
    (batch,) = CompiledEngine().run_many(grown, 0, range(3))
    assert batch.diverged.all()
    assert_alone(grown, CompiledEngine(), 0, range(3), fingerprint=True)
