"""Check, theory and consistency of the filters that their papers have in slots, under clocks."""

import pytest

import netkf
from netkf.engines.compiled.engine import CompiledEngine
from netkf.runs.labels import covariance_bias, nees_note
from netkf.theory.promises import compute_promises, promises_text

SENSOR = {"H": [[1.0]], "R": [[0.5]], "sampling": {"kind": "periodic", "period": 0.4}}
LOSSY = {"loss": {"kind": "bernoulli", "delivery": 0.7}, "symmetric": False}
CLOCKS = {
    "gossip": {"kind": "poisson", "rate": 2.0},
    "push-sum": {"kind": "poisson", "rate": 2.0, "at": "nodes"},
    "intermittent": {"kind": "readings"},
}


@pytest.fixture
def clocked(build):
    def make(kind, **more):
        net = {"graph": {"kind": "path", "nodes": 3}, "activation": CLOCKS[kind], "channel": LOSSY}
        sensors = [{**SENSOR, "nodes": [0, 2]}]
        return build(sensors=sensors, filter={"kind": kind}, network=net, horizon=4.0, **more)

    return make


@pytest.mark.one_in(2)
@pytest.mark.parametrize("kind", CLOCKS)
def test_exact_rows_hold_under_clocks(kind, clocked):
    verdict = netkf.check(clocked(kind), runs=60, workers=1)
    assert verdict
    table = verdict.table.set_index("promise")
    assert table.verdict["P follows the equations along the events of each run"] == "holds"
    assert not set(table.verdict) - {"holds", "undecided"}
    mass = "mass is conserved"
    bound = "P is at least the covariance of the error, given the events"
    assert (mass in table.index, bound in table.index) == (
        (True, False) if kind == "push-sum" else (False, True)
    )
    assert table.verdict[mass if kind == "push-sum" else bound] == "holds"


def test_wrong_covariances_break_the_exact_rows(clocked, monkeypatch):
    scenario = clocked("gossip")
    estimate = type(scenario.node_filter).estimate

    def sure(self, state):
        xhat, P = estimate(self, state)
        return xhat, 0.9 * P

    monkeypatch.setattr(type(scenario.node_filter), "estimate", sure)
    monkeypatch.setattr(CompiledEngine, "refusal", lambda *_: "this filter is not the built-in one")
    verdict = netkf.check(scenario, runs=20, workers=1)
    # P is wrong from time 0 on, from which the rest follows.
    broken = verdict.table[verdict.table.verdict == "broken"]
    assert list(broken.promise) == ["estimates, covariances and weights begin as [filter] says"]
    reason = (
        'follows from the broken row "estimates, covariances and weights begin as [filter] says"'
    )
    assert list(verdict.table.assumptions[:2]) == [reason] * 2


@pytest.mark.parametrize("kind", CLOCKS)
def test_theory_sees_what_sensors_that_sample_see(kind, clocked):
    scenario = clocked(kind)
    rows = netkf.theory.assumptions(scenario).set_index("assumption")
    row = rows.loc["(A, H) is observable, all sensors together"]
    assert row.holds
    assert row.evidence == "every mode is seen; 2 of 3 nodes see all alone"
    shown = promises_text(scenario, compute_promises(scenario))
    assert "H(" not in shown
    assert not rows.source.str.contains("H ").any()
    assert "slot" not in shown


def test_push_sum_says_where_its_covariance_is_too_small(clocked):
    scenario = clocked("push-sum")
    assert covariance_bias(scenario) == "smaller"
    assert "NEES above n = 1 is right" in nees_note(scenario)
    found = netkf.consistency(scenario, runs=20, workers=1)
    assert found
    said = [row.verdict for row in found.rows]
    assert "as expected: P is overconfident by design" in said
    assert nees_note(clocked("gossip")) == ""
