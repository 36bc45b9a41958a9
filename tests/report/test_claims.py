"""Sentences at the top of a page, from summaries and comparisons made up for them."""

from types import SimpleNamespace

import numpy as np
import pytest
import scipy.stats

from netkf.report import claims
from netkf.report.data import describe_innovations
from netkf.trace.messages import DELIVERED, MESSAGE


def _sentence(rows, runs):
    nodes = [
        {"node": i, "mean_trace": mean, "mean_trace_se": error, "bound": bound}
        for i, (mean, error, bound) in enumerate(rows)
    ]
    (text,) = claims._describe_bound(
        SimpleNamespace(summary={"nodes": nodes, "bound": "H (12), exact"}, runs=runs)
    )
    return text


def test_a_node_that_exceeds_its_bound_is_found_behind_one_with_a_larger_ratio():
    text = _sentence([(1.3, 0.3, 1.0), (1.1, 0.01, 1.0), (0.5, 0.1, 1.0)], runs=100)
    assert "is exceeded by more than 2.2 standard errors at 1 of 3 nodes" in text
    assert "at node 1, ratio 1.1" in text


def test_chance_at_one_of_many_nodes_exceeds_no_bound():
    # 2.5 standard errors at one node: usual for the largest of 200, not for a single node.
    highest = (1.25, 0.1, 1.0)
    assert "holds; closest: " in _sentence([highest] + [(0.9, 0.1, 1.0)] * 199, runs=100)
    assert "is exceeded by more than 1.7 standard errors" in _sentence([highest], runs=100)


def test_a_covariance_that_equals_its_bound_holds():
    assert " holds; " in _sentence([(1.0 + 1e-12, 0.0, 1.0)], runs=10)
    assert "is exceeded" in _sentence([(1.0 + 1e-6, 0.0, 1.0)], runs=10)


@pytest.mark.parametrize(("mean", "side"), [(1.2, "above"), (0.8, "below")])
def test_a_single_run_exceeds_no_bound(mean, side):
    assert f"P was {side} it" in _sentence([(mean, None, 1.0)], runs=1)


@pytest.mark.parametrize(("reason", "named"), [("clocks have no rate", 0), ("below H(12)", 1)])
def test_a_paper_is_named_where_its_equations_are(reason, named):
    node = {"bound": None, "mean_trace": 1.0}
    source = SimpleNamespace(summary={"nodes": [node], "bound": reason}, runs=1)
    (text,) = claims._describe_bound(source)
    assert text.count("H is the paper") == named


def test_unknown_consistency_is_no_inconsistency():
    def row(name, consistency):
        rms = SimpleNamespace(value=1.0, real=False)
        return SimpleNamespace(
            filter=name, ran=True, status="complete", consistency=consistency, rms_error=rms
        )

    rows = [row("a", "consistent"), row("b", "-"), row("c", "overconfident")]
    sentences = claims._describe_filters(SimpleNamespace(rows=rows, runs=1, first="a"))
    assert "P does not describe the errors of c (overconfident)" in sentences


def test_an_error_is_judged_by_the_states_that_its_node_estimates(monkeypatch):
    """Of two blocks of 3 states, each node estimates its own: NEES has 3 degrees of freedom."""
    samples = SimpleNamespace(errors=np.zeros(50))
    monkeypatch.setattr(claims, "summary_samples", lambda run, summary: samples)
    source = SimpleNamespace(summary={}, scenario=SimpleNamespace(sizes=np.array([3, 3])))
    times, nees = np.array([0.0, 1.0]), np.array([[3.0, 3.0], [2.5, 30.0]])
    run = SimpleNamespace(nodes=(0, 1), times=times, nees=nees, x=np.zeros((2, 6)))
    (text,) = claims._judge_error(source, run, SimpleNamespace(node=1, time=1.0))
    limit = scipy.stats.chi2.isf(claims.FALSE_ALARM / 100, 3)
    assert f"far more than its P says: NEES 30, above {limit:.4g}" in text
    assert "(the mean is then 3)" in text


@pytest.mark.parametrize(
    ("nis", "words"),
    [
        ([1.0, 1.0, 1.0], "at all 3 nodes with readings as exact covariances allow"),
        ([1.0, 2.0, 0.3], "P is overconfident at 1 of 3 nodes with readings and conservative at 1"),
        ([0.9, 0.3, 0.3], "P is conservative at 2 of 3"),
        ([2.0], "2 at node 0, P is overconfident: 99% of such means would lie in {}"),
        ([0.3], "0.3 at node 0, P is more careful than needed: 99% of such means would lie in {}"),
        ([1.0], "1 at node 0, as exact covariances allow (99%: {})"),
    ],
)
def test_mean_innovations_are_judged_by_chi_square(nis, words):
    nodes = np.repeat(np.arange(len(nis)), 50)
    topology = SimpleNamespace(named=lambda node: node)
    nis, rows = np.repeat(2.0 * np.array(nis), 50), np.full(len(nodes), 2)
    readings = SimpleNamespace(nis=nis, nodes=nodes, rows=rows, increments=0)
    text = describe_innovations(readings, SimpleNamespace(topology=topology))
    low, high = scipy.stats.chi2(100).ppf([0.005, 0.995]) / 100
    assert words.format(f"{low:.4g} .. {high:.4g}") in text


@pytest.mark.parametrize(
    ("at", "words"),
    [
        (20, "unusually old: 10 s on average over its links, older than at 95% of its samples"),
        (6, "not unusual: 1 s on average over its links, mean over the run 3.25 s"),
    ],
)
def test_information_is_old_among_that_of_the_run(at, words):
    """Messages of 1, ..., 10 s arrive half a second later: ages are 1 s up to 11 s, then 2, ..."""
    heard = np.zeros(10, dtype=MESSAGE)
    heard["sent"], heard["outcome"] = np.arange(1, 11), DELIVERED
    heard["ended"], heard["receiver"] = heard["sent"] + 0.5, 1
    source, run = SimpleNamespace(cutoffs=lambda t: t), SimpleNamespace(times=np.arange(21.0))
    text = claims._judge_age(source, run, heard, SimpleNamespace(node=1, time=float(at)))
    assert words in text
