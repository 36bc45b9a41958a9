"""Looks that add up, verdicts that grow, and what a check leaves in a directory."""

import dataclasses
import json
import math

import numpy as np
import pytest
import scipy.stats

from netkf.checks.check import check
from netkf.checks.evidence import BROKEN, HOLDS, UNDECIDED, Evidence, Promise, judge
from netkf.checks.laws import find_largest
from netkf.checks.looks import is_decided, keep_decisions, level_of_look, next_runs
from netkf.checks.report import verdict_text
from netkf.checks.statistics import deviation_interval, scale_interval
from netkf.checks.storage import load_verdict, save_verdict
from netkf.core.errors import ScenarioError
from netkf.scenario.reading import from_table
from tests.checks.test_check import GOSSIP, INTERMITTENT


def scenario_of(table, folder, **changes):
    return from_table({**table, **changes}, folder)


def row(verdict, needed=None, promise="one"):
    number = 0.1
    return Evidence(
        promise, "here", "hold", -number, -number, 0.0, 0.1, verdict, needed, "", runs_needed=needed
    )


def test_levels_of_all_looks_add_up_to_the_level():
    assert sum(level_of_look(0.01, look) for look in range(1, 60)) == pytest.approx(0.01)


def test_the_next_look_is_where_the_slowest_row_is_decided():
    rows = [row(HOLDS), row(UNDECIDED, 700), row(UNDECIDED, 900), row(UNDECIDED)]
    assert next_runs(rows, 500, 10_000) == math.ceil(1.1 * 900)
    assert next_runs(rows, 500, 800) == 800
    assert next_runs([row(UNDECIDED, 10**7)], 500, 10**6) == 3000
    assert next_runs([row(UNDECIDED, 510)], 500, 10**6) == 750
    assert not is_decided(rows)
    # Without a forecast more runs decide nothing.
    assert is_decided([row(HOLDS), row(UNDECIDED)])


def test_decisions_are_kept_and_broken_promises_stay_broken():
    before = [row(HOLDS), row(BROKEN, promise="two"), row(HOLDS, promise="three")]
    now = [row(UNDECIDED, 9), row(HOLDS, promise="two"), row(BROKEN, promise="three")]
    kept = keep_decisions(before, now)
    assert [one.verdict for one in kept] == [HOLDS, BROKEN, BROKEN]


def test_looking_often_breaks_no_more_than_the_level():
    # A healthy row that is looked at again and again, as until = "decided" does.
    random, level, wrong, trials = np.random.default_rng(2), 0.2, 0, 600
    for _ in range(trials):
        total, count, rows, look = 0.0, 0, (), 0
        for runs in (20, 40, 80, 160, 320):
            total += float(random.chisquare(runs - count))
            count, look = runs, look + 1
            interval = scale_interval(total, runs, level_of_look(level, look))
            finding = find_largest([(deviation_interval(1.0, interval), "it")], 0.05, "c")
            promise = Promise("c is 1", "here", (), lambda _, __, found=finding: found)
            rows = keep_decisions(rows, judge([promise], None, [], runs, level))
        wrong += rows[0].verdict == BROKEN
    assert scipy.stats.binom.sf(wrong - 1, trials, level) > 1e-3


def test_forecasts_of_an_interval_hold_within_a_factor():
    # Runs that decide a healthy row: the forecast against what it takes.
    random, level, tolerance = np.random.default_rng(5), 1e-3, 0.05
    ratios = []
    for _ in range(60):
        values = random.chisquare(1.0, 60_000)
        sums = np.cumsum(values)

        def judged(runs, sums=sums):
            interval = scale_interval(float(sums[runs - 1]), runs, level)
            finding = find_largest([(deviation_interval(1.0, interval), "it")], tolerance, "c")
            promise = Promise("c is 1", "here", (), lambda _, __: finding)
            return judge([promise], None, [], runs, level)[0]

        first = judged(4000)
        if first.verdict != UNDECIDED:
            continue
        grid = np.unique(np.geomspace(4000, 60_000, 80).astype(int)).tolist()
        decided = next((runs for runs in grid if judged(runs).verdict == HOLDS), None)
        if decided is not None:
            ratios.append(first.needed / decided)
    assert len(ratios) > 30
    assert 1.0 / 1.5 < np.median(ratios) < 1.5


def test_runs_added_to_a_verdict_are_those_of_one_check(tmp_path):
    scenario = scenario_of(INTERMITTENT, tmp_path)
    first = check(scenario, 12, workers=1)
    more = check(scenario, 20, workers=1, earlier=first)
    whole = check(scenario, 20, workers=1)
    assert more.runs == 20
    assert more.looks == 2
    assert more.confidence == pytest.approx(1.0 - 0.01 - 0.01 / 4.0)
    # The same results, judged at another level: margins are equal where no decision was kept.
    old = {one.promise: one for one in whole.rows}
    for one in more.rows:
        if one.verdict == UNDECIDED:
            assert one.margin == pytest.approx(old[one.promise].margin, nan_ok=True)
            assert one.low <= old[one.promise].low
    with pytest.raises(ScenarioError, match="20 runs already"):
        check(scenario, 20, earlier=more)
    with pytest.raises(ScenarioError, match="seed"):
        check(scenario, 30, seed=77, earlier=more)


def test_until_decided_ends_where_it_should(tmp_path):
    scenario = scenario_of(INTERMITTENT, tmp_path)
    seen = []
    verdict = check(
        scenario, 10, workers=1, until="decided", most=25, progress=lambda *done: seen.append(done)
    )
    assert verdict.runs == 25
    assert verdict.looks >= 2
    assert verdict.confidence == pytest.approx(0.99)
    with pytest.raises(ScenarioError, match="decided"):
        check(scenario, 10, until="tomorrow")


def test_a_kept_verdict_is_the_same_and_grows(tmp_path):
    scenario = scenario_of(GOSSIP, tmp_path)
    verdict = check(scenario, 10, workers=1)
    (tmp_path / "kept").mkdir()
    save_verdict(tmp_path / "kept", scenario, verdict)
    again = load_verdict(tmp_path / "kept", scenario, scenario.seed)
    assert [one.verdict for one in again.rows] == [one.verdict for one in verdict.rows]
    assert (
        again.table.drop(columns="needed")
        .astype(str)
        .equals(verdict.table.drop(columns="needed").astype(str))
    )
    grown, direct = (check(scenario, 14, workers=1, earlier=one) for one in (again, verdict))
    assert [dataclasses.astuple(one) for one in grown.rows].__repr__() == [
        dataclasses.astuple(one) for one in direct.rows
    ].__repr__()
    names = {file.name for file in (tmp_path / "kept").iterdir()}
    assert names == {"scenario.toml", "verdict.json", "verdict.csv", "verdict.txt", "results.npz"}


@pytest.mark.parametrize("damage", ["missing", "text", "null", "npz", "rows"])
def test_a_damaged_verdict_is_one_line(damage, tmp_path):
    scenario = scenario_of(GOSSIP, tmp_path)
    kept = tmp_path / "kept"
    kept.mkdir()
    save_verdict(kept, scenario, check(scenario, 10, workers=1))
    document = kept / "verdict.json"
    if damage == "missing":
        document.unlink()
    elif damage == "text":
        document.write_text("{")
    elif damage == "null":
        document.write_text("null")
    elif damage == "npz":
        (kept / "results.npz").write_bytes(b"PK nothing")
    else:
        found = json.loads(document.read_text())
        document.write_text(json.dumps({**found, "rows": [{"promise": 1}]}))
    with pytest.raises(ScenarioError) as error:
        load_verdict(kept, scenario, scenario.seed)
    assert "\n" not in str(error.value)


def test_a_verdict_of_another_scenario_is_refused(tmp_path):
    scenario = scenario_of(GOSSIP, tmp_path)
    kept = tmp_path / "kept"
    kept.mkdir()
    save_verdict(kept, scenario, check(scenario, 10, workers=1))
    other = scenario.replace({"horizon": 14.0})
    with pytest.raises(ScenarioError, match="another scenario"):
        load_verdict(kept, other, scenario.seed)
    with pytest.raises(ScenarioError, match="another seed"):
        load_verdict(kept, scenario, scenario.seed + 1)


def test_broken_rows_come_first_and_again_with_their_command(tmp_path):
    table = {**GOSSIP, "filter": {"kind": "tests.checks.broken:SwapsOnlyP"}}
    verdict = check(scenario_of(table, tmp_path), 12, workers=1)
    text = verdict_text(verdict, "a claim", "netkf run it.toml --replica")
    lines = text.splitlines()
    assert lines[0].endswith("a claim")
    assert lines[2].startswith("BROKEN")
    again = [line for line in lines if line.startswith("BROKEN: ")]
    assert len(again) == sum(one.verdict == BROKEN for one in verdict.rows)
    shown = [one.replica for one in verdict.rows if one.replica is not None]
    replays = [line for line in lines if line.strip().startswith("replay it:")]
    assert len(replays) == len(shown)
    assert "[G ...]" in text
    assert "[H ...]" not in text


def test_rows_that_use_some_of_the_runs_do_not_ask_for_more_than_help():
    def judged(most):
        interval = scale_interval(20.0, 20, 0.01)  # as expected, too wide to be decided
        found = find_largest([(deviation_interval(1.0, interval), "it")], 0.05, "c")
        promise = Promise("c is 1", "here", (), lambda _, __: found._replace(most_runs=most))
        return judge([promise], None, [], 20, 0.01)[0]

    limited, free = judged(20), judged(math.inf)
    assert (limited.verdict, free.verdict) == (UNDECIDED, UNDECIDED)
    assert limited.needed is None
    assert "exact covariances are those of 20 runs at most" in limited.evidence
    assert free.needed > 1000
    assert judged(10 * free.needed).needed == free.needed
