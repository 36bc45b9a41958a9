"""Rows look at their assumptions before they judge, and a test without a number judges nothing."""

import math
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest

import netkf
from netkf.checks import evidence
from netkf.checks.check import Verdict, judge_replicas, run_replica, with_check_times
from netkf.checks.evidence import (
    BROKEN,
    HOLDS,
    NOT_PROMISED,
    UNDECIDED,
    Finding,
    Promise,
    fold_followers,
    judge,
)
from netkf.checks.laws import find_largest
from netkf.checks.mode_sequences import sensing_neighbours
from netkf.checks.report import verdict_text
from netkf.checks.samples import ReplicaSummary
from netkf.checks.stochastic_trigger import check_rate
from netkf.laws.intervals import Interval
from netkf.laws.losses import mean_correlation
from netkf.laws.ticks import largest_correlation
from netkf.parts import Bernoulli, Hybrid, Weights
from netkf.scenario.reading import from_table
from netkf.theory.common.random_links import all_messages_arrive, delivery_of
from tests.checks.test_check import DIFFUSION, INTERMITTENT, RING, scenario_of

HERE = __name__


def judged(scenario, runs=12, level=0.01):
    chosen = with_check_times(scenario)
    results = [run_replica(chosen, 3, k) for k in range(runs)]
    return judge_replicas(chosen, results, 3, 1.0 - level).rows


def broken(rows):
    return [row.promise for row in rows if row.verdict == BROKEN]


def reason_of(rows, promise):
    (row,) = [row for row in rows if row.promise.startswith(promise)]
    assert row.verdict == NOT_PROMISED
    return row.assumptions


def promise(name, finding, **options):
    return Promise(name, "source", (), lambda samples, level: finding, **options)


@pytest.mark.parametrize(
    "finding",
    [
        Finding((math.nan, math.nan, math.nan), 0.1, "divided 0 by 0"),
        Finding((0.1, -0.2, math.nan), 0.1, "divided 0 by 0"),
        Finding((-1.0, math.nan, -0.5), 0.1, "divided 0 by 0"),
    ],
)
def test_a_test_that_gives_nan_is_not_judged_and_says_so(finding):
    (row,) = judge([promise("p", finding)], None, [], 20, 0.01)
    assert row.verdict == UNDECIDED
    assert "not judged" in row.evidence
    assert "divided 0 by 0" in row.evidence


def test_comparisons_that_are_nan_are_left_out():
    nan, off = Interval(math.nan, math.nan, math.nan), Interval(0.5, 0.4, 0.6)
    found = find_largest([(nan, "a"), (off, "b"), (nan, "c")], 0.1, "distance")
    assert found.margin == (-0.5, -0.6, -0.4)
    assert "b" in found.message
    assert "left out" in found.message
    (row,) = judge([promise("p", find_largest([(nan, "a")], 0.1, "distance"))], None, [], 9, 0.1)
    assert row.verdict == UNDECIDED


def test_broken_rows_have_seen_and_expected():
    (row,) = judge([promise("p", Finding((-2.0, -3.0, -1.0), 0.1, ""))], None, [], 20, 0.01)
    assert row.verdict == BROKEN
    assert (row.seen, row.expected) == (2.0, 0.0)


def test_one_mistake_is_one_broken_row():
    off, fine = Finding((-2.0, -3.0, -1.0), 0.1, ""), Finding((0.0, -0.01, 0.0), 0.1, "")
    promises = [
        promise("equations", off, exact=True),
        promise("bound", off, exact=True),
        promise("law", off),
        promise("held law", fine),
        promise("losses", off, group=evidence.LOSSES),
        promise("losses apart", off, group=evidence.LOSSES),
        promise("delays", fine, group=evidence.DELAYS),
    ]
    rows = fold_followers(judge(promises, None, [], 20, 0.01))
    assert broken(rows) == ["equations", "losses"]
    assert [row.verdict for row in rows[3:7:3]] == [HOLDS, HOLDS]
    for k, root in ((1, "equations"), (2, "equations"), (5, "losses")):
        assert rows[k].verdict == NOT_PROMISED
        assert f'follows from the broken row "{root}"' in rows[k].assumptions
        assert rows[k].seen == 2.0


@pytest.mark.parametrize("parts", [(), ("plant",)])
def test_a_class_departs_by_itself_where_rows_of_its_filter_follow_from_parts(parts):
    off = Finding((-2.0, -3.0, -1.0), 0.1, "")
    rows = [promise("same", off, group=evidence.BASE), promise("e", off, group=evidence.ERRORS)]
    rows += [promise(name, off, group=name) for name in parts]
    assert broken(fold_followers(judge(rows, None, [], 20, 0.01))) == (
        ["same", "plant"] if parts else ["e"]
    )


def test_rates_of_nodes_that_decide_nothing_are_unknown():
    found = check_rate(SimpleNamespace(runs=SimpleNamespace(sends=np.zeros((20, 2)))), 0.01)
    assert "no node has a slot" in found.message


def test_a_verdict_fits_on_two_screens_unless_all_is_asked_for():
    """Broken rows say all; others have one line each, and rows that look at no run one together."""
    wide = Finding((0.0, -0.5, 0.0), 0.1, "evidence " * 40, detectable=0.25)
    off = Finding((-2.0, -3.0, -1.0), 0.1, "evidence " * 40)
    promises = [promise(f"row {k}", wide) for k in range(36)]
    promises += [promise(f"computed {k}", wide, group=evidence.COMPUTED) for k in range(4)]
    promises += [promise("wrong", off, exact=True), promise("too", off)]
    rows = tuple(fold_followers(judge(promises, None, [], 20, 0.01)))
    verdict = Verdict("it", 20, 0, 0.99, rows)
    short, full = verdict_text(verdict, full=False), verdict_text(verdict)
    assert len(short.splitlines()) <= 100
    assert len(full.splitlines()) > 150
    assert short.count("no run can break these") == 1
    assert "computed 3 [source]: undecided" in " ".join(short.split())
    assert short.count("detectable 0.25") == 36
    assert 'follows from the broken row "wrong"' in short
    assert short.splitlines()[2].startswith("BROKEN       wrong")
    assert "BROKEN: wrong  [source]: seen 2, expected 0" in short


def rare_losses(random, q, windows, links, sent):
    counts = random.poisson(sent, (windows, links))
    lost = random.binomial(counts, q)
    return lost - counts * q, counts * (q * (1.0 - q))


@pytest.mark.one_in(3)
@pytest.mark.parametrize(("q", "windows", "sent"), [(2e-3, 160, 5), (5e-4, 4000, 1), (0.3, 160, 5)])
def test_rare_losses_of_links_are_not_taken_for_correlated(q, windows, sent):
    random, level, accused, values = np.random.default_rng(5), 0.05, 0, []
    for _ in range(300):
        excess, variance = rare_losses(random, q, windows, 6, sent)
        found = largest_correlation(excess, variance, level)
        mean = mean_correlation(excess, variance, level)
        accused += (found is not None and found[0].low > 0.0) or (
            mean is not None and not mean.low <= 0.0 <= mean.high
        )
        values += [found[0].value] if found is not None else []
    # Both have the level 0.05: 30 are expected at most, 45 and more have probability 0.003.
    assert accused < 45
    assert all(value < 1.0 for value in values)


@pytest.mark.slow
def test_senders_of_directed_graphs_are_those_of_its_links(tmp_path):
    edges = [[0, 1], [1, 2], [2, 0], [1, 0]]
    network = {
        "graph": {"kind": "edges", "edges": edges, "directed": True},
        "activation": {"kind": "broadcast"},
        "channel": {"loss": {"kind": "bernoulli", "delivery": 0.3}, "symmetric": False},
    }
    plant = {"kind": "linear", "F": [[-0.7]], "Q": [[0.1]], "period": 1.0, "cov": [[3.0]]}
    sensors = [{"nodes": [1], "H": [[1.4]], "R": [[5.0]]}, {"nodes": [2], "H": [[1.7]],
                                                            "R": [[0.1]]}]  # fmt: skip
    table = {**INTERMITTENT, "plant": plant, "sensors": sensors, "network": network}
    scenario = from_table({**table, "horizon": 12.0, "probe": 1.0}, tmp_path)
    assert sensing_neighbours(scenario) == {0: (1, 2), 1: (), 2: (1,)}
    assert not broken(judged(scenario, runs=60, level=0.2))


def test_links_of_a_recorded_broadcast_are_no_losses(tmp_path):
    lines = [f"{slot},0,0,0,1" for slot in range(0, 12, 2)]
    (tmp_path / "up.csv").write_text("\n".join(["slot,phase,step,node,peer", *lines]) + "\n")
    recorded = {"kind": "recorded", "path": "up.csv"}
    scenario = scenario_of(DIFFUSION, tmp_path, horizon=12.0, **{"network.activation": recorded})
    rows = judged(scenario)
    assert not broken(rows)
    assert "a table lists the links" in reason_of(rows, "messages are lost as often")
    assert not all_messages_arrive(scenario)


EVENTS = {
    **INTERMITTENT,
    "horizon": 10.0,
    "network": {"graph": {"kind": "complete", "nodes": 3}, "activation": {"kind": "broadcast"}},
}


@pytest.mark.parametrize(
    "start",
    [{"cov": [np.diag([s, s]).tolist() for s in (1.0, 10.0, 100.0)]},
     {"mean": [[0.0, 0.0], [5.0, 0.0], [9.0, 9.0]]}],
    ids=["cov", "mean"],
)  # fmt: skip
def test_silence_is_about_the_senders_prediction(start, tmp_path):
    kind = {"kind": "event-triggered", "trigger": "stochastic", "Y": 1.0,
            "inner": {"kind": "intermittent"}}  # fmt: skip
    scenario = scenario_of(EVENTS, tmp_path, filter={**kind, **start})
    rows = judged(scenario, runs=20)
    assert not broken(rows)
    assert "not the hearer's" in reason_of(rows, "errors have the covariance")


@dataclass(frozen=True, eq=False)
class Weaker(Hybrid):
    """Gives smaller weights, and so may have more neighbours."""

    @property
    def link_weights(self):
        given = super().link_weights
        return Weights(lambda *degrees: 0.5 * given.of(*degrees), None, 2.0 * given.largest_degree)


@pytest.mark.slow
def test_a_class_with_weights_of_its_own_may_say_how_many_links_they_allow(tmp_path):
    scenario = scenario_of(RING, tmp_path, filter={"kind": f"{HERE}:Weaker", "epsilon": 0.4})
    rows = judged(scenario)
    assert not broken(rows)
    assert "by design" in reason_of(rows, "its estimates are those")


@dataclass(frozen=True, eq=False)
class Unknown(Bernoulli):
    """Does not say before a run how many messages arrive."""

    def mean_delivery(self, sent):
        return math.nan


@dataclass(frozen=True, eq=False)
class Alternating(Bernoulli):
    """Loses every other message, and says how many on average."""

    def delivery_probability(self, sent):
        return float(sent.number % 2)

    def mean_delivery(self, sent):
        return 0.5


@pytest.mark.one_in(2)
@pytest.mark.parametrize(
    ("kind", "reason"),
    [("Unknown", "state no probability"), ("Alternating", "different probabilities")],
)
def test_losses_without_one_known_probability_are_not_compared_with_it(kind, reason, tmp_path):
    loss = {"kind": f"{HERE}:{kind}", "delivery": 0.5}
    scenario = scenario_of(INTERMITTENT, tmp_path, **{"network.channel.loss": loss})
    with pytest.raises(netkf.TheoryError, match=reason):
        delivery_of(scenario, (0, 1))
    rows = judged(scenario, runs=25, level=0.2)
    assert not broken(rows)
    for row in ("readings arrive with the stated", "the law of P is that", "averages over one"):
        assert reason in reason_of(rows, row)


@pytest.mark.slow
def test_a_replay_that_equations_cannot_give_accuses_nobody(ring):
    scenario = with_check_times(ring)
    results = [run_replica(scenario, 5, k) for k in range(10)]
    changed = []
    for one in results:
        replayed = one.summary.replayed.copy()
        replayed[0, 0] = np.nan
        summary = ReplicaSummary(**vars(one.summary) | {"replayed": replayed})
        changed.append(one._replace(summary=summary))
    rows = judge_replicas(scenario, changed, 5, 0.99).rows
    assert not broken(rows)
    assert rows[0].verdict == HOLDS
