"""Correct filters on unstable plants are never judged by rounding."""

import dataclasses
import json

import numpy as np
import pytest

import netkf
from netkf.algorithms.filter import Filter
from netkf.algorithms.traits import Timing
from netkf.ensembles.directory import EnsembleOptions, runs_to_directory
from netkf.ensembles.pools import PoolOptions
from netkf.runs.run import run_to_directory
from netkf.studies.compare import compare
from netkf.trace.run import blurred_samples
from tests.conftest import SCENARIOS

ROTATIONS = [
    [1.15, -0.35, 0.0, 0.0],
    [0.35, 1.15, 0.0, 0.0],
    [0.0, 0.0, 1.2, 0.1],
    [0.0, 0.0, -0.1, 1.2],
]
"""They grow faster than those of the file: by 1e21 in 260 slots instead of 1600."""
UNSTABLE = {
    "intermittent_scalar": {"horizon": 150.0, "probe": 10.0},
    "gossip_ring": {"plant.F": ROTATIONS, "horizon": 260.0, "probe": 20.0},
    "threshold": {"network.activation.rate": 6.0, "horizon": 120.0, "probe": 10.0},
}


@pytest.fixture(params=UNSTABLE, ids=str)
def unstable(request):
    return netkf.load(SCENARIOS / f"{request.param}.toml", UNSTABLE[request.param])


def subtracted(run):
    """The run of an engine that knows no frames."""
    error = run.x[:, None] - run.xhat
    return dataclasses.replace(run, error=error, exact_errors=False)


@pytest.mark.slow
def test_no_promise_is_broken_by_rounding(unstable):
    found = netkf.check(unstable, 10, workers=1)
    assert found, [row for row in found.rows if row.verdict == "broken"]


@pytest.mark.slow
def test_no_filter_is_inconsistent_by_rounding(unstable):
    found = netkf.consistency(unstable, 10, confidence=0.999, workers=1)
    assert found, found.rows


@pytest.fixture
def growing(build):
    """Errors stay of order 1 while the state grows beyond 1e16."""
    plant = {"kind": "diffusion", "A": [[1.0]], "B": [[1.0]], "cov": [[1.0]]}
    sensors = [{"nodes": [0, 1], "H": [[1.0]], "R": [[0.5]]}]
    return build(plant=plant, sensors=sensors, horizon=60.0, probe=2.0, filter={"kind": "local"})


def test_samples_after_digits_are_lost_are_found(growing):
    run = subtracted(netkf.simulate(growing))
    assert 20.0 < run.rounding_from < 40.0
    lost = blurred_samples(run, run.P)
    assert not lost[run.times < run.rounding_from].any()
    assert lost[-1].all()
    exact = dataclasses.replace(run, exact_errors=True)
    assert exact.rounding_from == np.inf
    assert not blurred_samples(exact, exact.P).any()


class NoFrames(Filter):
    """A local filter that does not say how it commutes with a shift."""

    timing = Timing(talks=False)

    def absorb(self, state, messages, exchange):
        return state


class NoCovariance(NoFrames):
    def estimate(self, state):
        return state.xhat, None


@pytest.fixture
def plugged(growing):
    return growing.replace({"filter": {"kind": f"{__name__}:NoFrames"}})


@pytest.fixture
def silent(growing):
    return growing.replace({"filter": {"kind": f"{__name__}:NoCovariance"}, "horizon": 10.0})


def test_averages_leave_out_what_rounding_blurs(plugged, tmp_path):
    done = run_to_directory(plugged, tmp_path / "one")
    run = netkf.simulate(plugged)
    used = (run.times > 0.0) & (run.times < run.rounding_from)
    overall = done.summary["overall"]
    assert done.summary["rounding_from"] == run.rounding_from < 40.0
    assert overall["rms_error"] == pytest.approx(np.sqrt((run.error[used] ** 2).mean()))
    assert overall["rms_error"] < 3.0
    assert overall["mean_trace"] == pytest.approx(run.P[1:].mean())
    assert "rounding blurs the errors" in done.summary["notes"][0]
    ensemble = netkf.monte_carlo(plugged, 5, workers=1)
    late = ensemble.times >= ensemble.rounding_from
    assert late.any()
    assert np.isnan(ensemble.mean_error[late]).all()
    assert np.isfinite(ensemble.mean_error[~late]).all()
    assert np.isfinite(ensemble.mean_P).all()
    assert ensemble.average[-1, 0] < 9.0
    table = netkf.sweep(plugged, {"horizon": [10.0, 60.0]}, runs=2, workers=1)
    assert table["status"].iloc[0] == "complete"
    assert "left out" in table["status"].iloc[1]
    assert (table["mean_rms"] < 3.0).all()


def test_comparisons_leave_out_what_rounding_blurs(plugged, tmp_path):
    for name in ("one", "two"):
        runs_to_directory(
            plugged, 3, tmp_path / name, EnsembleOptions(trace="full", pool=PoolOptions(1))
        )
    found = compare([tmp_path / "one", tmp_path / "two"])
    rms = next(row for row in found.rows if row.quantity == "rms_error")
    assert rms.entries[0].value < 3.0
    assert all("rounding blurs" in notes[0] for notes in found.notes)


def test_a_filter_without_a_covariance_is_shown_without_one(silent, tmp_path):
    pytest.importorskip("matplotlib")
    from netkf.figures.pictures import run_picture
    from netkf.runs.tables import summary_table

    done = run_to_directory(silent, tmp_path / "out", finish=lambda f: run_picture(silent, f))
    assert done.status == "complete"
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["overall"]["mean_trace"] is None
    assert summary["overall"]["mean_nees"] is None
    assert summary["overall"]["rms_error"] > 0.0
    assert summary["notes"] == ["the filter gives no covariance"]
    shown = summary_table(done.summary)
    assert "note: the filter gives no covariance" in shown
    assert (tmp_path / "out" / "run.png").exists()


def test_nobody_judges_a_covariance_that_is_not_given(silent):
    ensemble = netkf.monte_carlo(silent, 3, workers=1)
    assert np.isnan(ensemble.mean_P).all()
    assert np.isfinite(ensemble.mean_error).all()
    found = netkf.consistency(silent, 10, workers=1)
    assert {row.verdict for row in found.rows} == {"the filter gives no covariance"}
    assert found.notes == ("the filter gives no covariance",)


@pytest.mark.slow
def test_check_says_that_there_is_no_covariance(ring):
    mute = ring.replace({"filter": {"kind": f"{__name__}:Mute", "epsilon": 0.3}})
    with pytest.raises(netkf.TheoryError, match="gives no covariance"):
        netkf.check(mute, 10, workers=1)


class Mute(netkf.parts.Hybrid):
    def estimate(self, state):
        return state.xhat, None


class Indefinite(netkf.parts.Hybrid):
    def estimate(self, state):
        xhat, P = super().estimate(state)
        return xhat, -P if P[0, 0] > 0.4 else P


@pytest.mark.slow
def test_negative_covariances_end_a_run(ring):
    odd = ring.replace({"filter": {"kind": f"{__name__}:Indefinite", "epsilon": 0.3}})
    run = netkf.simulate(odd)
    assert run.status == "diverged"
    assert run.count("diverged") > 0
    least = np.linalg.eigvalsh(run.P)[..., 0]
    assert (least[:-1] >= 0.0).all()
    assert least[-1].min() < 0.0
    found = netkf.check(odd, 10, workers=1)
    assert not found
    assert "ended early" in found.rows[0].evidence


def test_no_frames_of_users_are_told_by_the_engine(plugged):
    assert not netkf.simulate(plugged).exact_errors
    assert netkf.simulate(plugged).rounding_from < 40.0


def test_size_does_not_decide_by_rounding(plugged):
    late = plugged.replace({"probe": [0.0, 50.0, 60.0]})
    from netkf.runs.simulate import choose_engine
    from netkf.studies.metrics import block_metrics
    from netkf.studies.targets import parse_target, quantity_by_simulation

    figures = block_metrics(late, 1, range(3), choose_engine("auto", late))
    interval = quantity_by_simulation(figures, parse_target("mean_rms<=3"), 0.05, None)
    assert interval.low == -np.inf
    assert interval.high == np.inf
