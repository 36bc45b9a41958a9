"""Rows of single results of the papers: they hold for healthy runs and break for broken ones."""

import dataclasses

import numpy as np
import pytest

import netkf
from netkf.checks import diffusion, exact, gossip, hybrid, intermittent, push_sum
from netkf.checks.samples import ReplicaSummary, check_times, stack_summaries
from tests.conftest import SCENARIOS

LEVEL = 0.01


def load(name, **changes):
    made = netkf.load(SCENARIOS / f"{name}.toml")
    return made.replace(changes) if changes else made


def collect(checks, scenario, runs, judged=None):
    """The samples of ``runs`` runs of a scenario, to be judged by another one."""
    probed = dataclasses.replace(scenario, probe=np.array(check_times(scenario)))
    found = [checks.summarise(scenario, netkf.simulate(probed, 5, k)) for k in range(runs)]
    return checks.collect(judged or scenario, stack_summaries(found), 5)


def changed(summary, **fields):
    """A summary with other values of some fields."""
    return ReplicaSummary(**vars(summary) | fields)


def is_broken(finding):
    return not finding.margin[2] >= 0.0


@pytest.fixture
def few_laws(monkeypatch):
    """Rows about P need no law of the errors of each run."""
    monkeypatch.setattr(exact, "MAX_REPLAYED", 0)
    monkeypatch.setattr(exact, "MIN_REPLAYED", 0)


@pytest.mark.slow
@pytest.mark.usefixtures("few_laws")
def test_averages_over_one_path():
    """R Proposition 25: also at delivery 0.3, where P has no mean; broken at another delivery."""
    loss = "network.channel.loss.delivery"
    rare = load("intermittent_scalar", **{loss: 0.3})
    samples = collect(intermittent.CHECKS, rare, 150)
    found = intermittent._averages_of_paths(samples, LEVEL)
    assert not is_broken(found)
    assert "over one path" in found.message
    other = dataclasses.replace(samples, scenario=load("intermittent_scalar", **{loss: 0.6}))
    assert is_broken(intermittent._averages_of_paths(other, LEVEL))
    # below the critical probability, and only there, the mean has a row of its own
    assert intermittent.DIVERGES in intermittent.CHECKS.promises(rare)
    assert intermittent.DIVERGES not in intermittent.CHECKS.promises(load("intermittent_scalar"))
    growing = intermittent._mean_diverges(samples, LEVEL)
    assert growing.margin[0] == pytest.approx(60 * np.log(2 * 0.7), rel=0.02)


@pytest.mark.usefixtures("few_laws")
def test_averages_over_one_path_have_no_units():
    """The row compares the same numbers whatever the unit of the state."""
    matrices = ("plant.Q", "plant.cov", "sensors.0.R")
    given, scaled = load("intermittent_scalar"), {key: [[2.0**-20]] for key in matrices}
    found = [
        collect(intermittent.CHECKS, scenario, 4).runs.averages
        for scenario in (given, given.replace(scaled))
    ]
    np.testing.assert_allclose(*found, rtol=1e-12)


def test_the_mean_diverges_at_a_node_without_a_neighbour_that_has_a_sensor():
    far = load("intermittent_scalar", **{"network.graph": {"kind": "path", "nodes": 3}})
    samples = collect(intermittent.CHECKS, far, 20)
    growing = intermittent._mean_diverges(samples, LEVEL)
    assert "at node 2 outages alone" in growing.message
    assert growing.margin[0] == pytest.approx(60 * np.log(2), rel=0.02)


@pytest.mark.slow
@pytest.mark.usefixtures("few_laws")
def test_all_sensors_together():
    """G (27)-(29): broken for the switched chain of another matching."""
    made = load("gossip_ring", horizon=40.0, probe=1.0)
    samples = collect(gossip.CHECKS, made, 200)
    assert not is_broken(gossip._sensors_together(samples, LEVEL))
    worse = made.replace({"sensors.0.R": [[9.0]]})
    other = dataclasses.replace(samples, scenario=worse)
    assert is_broken(gossip._sensors_together(other, LEVEL))


@pytest.mark.slow
def test_tracking_errors_stay_bounded():
    """D Theorem 4.2: broken where errors grow tenfold, and early where they must."""
    made = load("diffusion_regression", horizon=40.0, probe=1.0)
    samples = collect(diffusion.CHECKS, made, 60)
    found = diffusion._errors_bounded(samples, LEVEL)
    assert not is_broken(found)
    assert "sigma_p of D (29)" in found.message
    grown = samples.runs.e * np.array([1.0, 1.0, 1.0, 100.0])[:, None, None]
    broken = dataclasses.replace(samples, runs=changed(samples.runs, e=grown))
    assert is_broken(diffusion._errors_bounded(broken, LEVEL))
    Sigma = samples.runs.Sigma * np.array([1.0, 1.0, 1.0, 1e4])[:, None, None, None]
    early = dataclasses.replace(broken, runs=changed(broken.runs, Sigma=Sigma))
    assert diffusion._errors_bounded(early, LEVEL).early


class Stub:
    def __init__(self, scenario):
        self.scenario = scenario


def test_errors_come_to_those_of_the_central_filter(monkeypatch):
    """P Theorem 4, Lemma 4; no row where the links of a slot are held."""
    made = load("push_sum_planar")
    assert push_sum.LIMIT in push_sum.CHECKS.promises(made)
    held = made.replace({"filter.links": "held"})
    assert push_sum.LIMIT not in push_sum.CHECKS.promises(held)
    found = push_sum._many_steps(Stub(made), LEVEL)
    assert found.margin[0] > 0.0
    wrong = netkf.theory.large_gamma_limits(made)
    wrong = wrong._replace(covariance=1.1 * wrong.covariance)
    monkeypatch.setattr(push_sum, "large_gamma_limits", lambda scenario: wrong)
    monkeypatch.setattr(push_sum, "MAX_STEPS", 64)
    assert push_sum._many_steps(Stub(made), LEVEL).margin[0] < 0.0


def test_constant_gains_have_a_larger_bound(ring, monkeypatch):
    """H Remark 1."""
    assert hybrid._constant_gains_are_worse(Stub(ring), LEVEL).margin[0] >= 0.0
    monkeypatch.setattr(
        hybrid, "constant_gain_bound", lambda s, t: 0.99 * netkf.theory.covariance_bound(s, t)
    )
    assert is_broken(hybrid._constant_gains_are_worse(Stub(ring), LEVEL))


def test_the_row_of_a_false_proposition_says_so():
    """H Proposition 4 below the threshold of the links' rates."""
    verdict = netkf.check(load("threshold"), runs=10, workers=1)
    row = verdict.table.set_index("source").loc["H Proposition 4"]
    assert row["verdict"] == "not promised"
    assert "false here" in row["assumptions"]
    assert "below the threshold 2" in row["assumptions"]


def test_a_row_gives_each_reason_once():
    """Assumptions of the paper are also those of tests of the equations."""
    near = {"kind": "range", "nodes": [0], "positions": [[5.0, 5.0]], "R": [[1.0]]}
    curved = load("push_sum_planar").replace({"filter": {"kind": "kcf"}, "sensors": [near]})
    rows = netkf.check(curved, runs=10, workers=1).table.set_index("source")
    reason = rows.loc["all papers", "assumptions"]
    assert reason.count("readings are linear in the state") == 1
