"""Looks that add up, verdicts that grow, and what a check leaves in a directory."""

import dataclasses
import json
import math
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import scipy.stats

import netkf
from netkf.checks.check import Verdict, check, keep_decisions, level_of_look, next_runs
from netkf.checks.evidence import BROKEN, HOLDS, UNDECIDED, Evidence, Promise, judge
from netkf.checks.laws import find_largest
from netkf.checks.report import verdict_text
from netkf.checks.statistics import band_around, band_width
from netkf.checks.storage import load_verdict, save_verdict
from netkf.cli.main import main
from netkf.core.errors import ScenarioError
from netkf.laws.intervals import (
    correlation_interval,
    deviation_interval,
    poisson_interval,
    probability_interval,
    scale_interval,
    student_interval,
)
from netkf.scenario.reading import from_table
from tests.checks.test_check import GOSSIP, INTERMITTENT

SCENARIOS = Path(__file__).parents[2] / "scenarios"


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
    assert not Verdict("", 0, 0, 0.9, tuple(rows)).is_decided
    # Without a forecast more runs decide nothing.
    assert Verdict("", 0, 0, 0.9, (row(HOLDS), row(UNDECIDED))).is_decided


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


def _sums(draw, most):
    """Return a function from a number of runs to the sum of what they drew."""
    sums = np.cumsum(draw(most))
    return lambda runs: float(sums[runs - 1])


LEVEL = 1e-3
KINDS = {
    # What a run draws, the interval after so many runs from their sum, and what is tolerated.
    "a variance": (
        lambda random: lambda most: random.chisquare(1.0, most),
        lambda total, runs: deviation_interval(1.0, scale_interval(total, runs, LEVEL)),
        0.05,
        4000,
    ),
    "a variance of few values": (
        lambda random: lambda most: random.chisquare(1.0, most),
        lambda total, runs: deviation_interval(1.0, scale_interval(total, runs, LEVEL)),
        0.3,
        20,
    ),
    "rare losses": (
        lambda random: lambda most: random.random(most) < 0.002,
        lambda total, runs: deviation_interval(
            0.002, probability_interval(int(total), runs, LEVEL)
        ),
        0.01,
        150,
    ),
    "no losses": (
        lambda random: np.zeros,
        lambda total, runs: deviation_interval(0.0, probability_interval(0, runs, LEVEL)),
        0.005,
        60,
    ),
    "few ticks": (
        lambda random: lambda most: random.poisson(0.7, most),
        lambda total, runs: deviation_interval(1.0, poisson_interval(total, 0.7 * runs, LEVEL)),
        0.2,
        50,
    ),
    "the mean of few runs": (
        lambda random: random.standard_normal,
        lambda total, runs: deviation_interval(
            0.0, student_interval(total / runs, 1.0 / math.sqrt(runs), runs, LEVEL)
        ),
        0.25,
        20,
    ),
    "a correlation": (
        lambda random: lambda most: random.standard_normal(most) * random.standard_normal(most),
        lambda total, runs: deviation_interval(
            0.0, correlation_interval(total / runs, runs, LEVEL)
        ),
        0.2,
        40,
    ),
    "a distribution function": (
        lambda random: lambda most: random.random(most) < 0.5,
        lambda total, runs: band_around(abs(total / runs - 0.5), band_width(runs, LEVEL)),
        0.25,
        12,
    ),
}


@pytest.mark.one_in(4)
@pytest.mark.parametrize("kind", KINDS)
def test_forecasts_of_all_kinds_of_intervals_hold_within_a_factor(kind):
    # Runs that decide a healthy row: the forecast against what it takes.
    source, interval, tolerance, first = KINDS[kind]
    random, ratios = np.random.default_rng(5), []
    grid = np.unique(np.geomspace(first, 40 * first, 120).astype(int)).tolist()
    for _ in range(60):
        total = _sums(source(random), 40 * first)

        def judged(runs, total=total):
            found = find_largest([(interval(total(runs), runs), "it")], tolerance, "c")
            promise = Promise("c is as stated", "here", (), lambda _, __: found)
            return judge([promise], None, [], runs, LEVEL)[0]

        row = judged(first)
        if row.verdict == UNDECIDED:
            decided = next((runs for runs in grid if judged(runs).verdict == HOLDS), math.nan)
            ratios.append(row.needed / decided)
    assert len(ratios) > 30
    assert 1.0 / 1.5 < np.median(ratios) < 1.5


@pytest.mark.slow
def test_runs_added_to_a_verdict_are_those_of_one_check(tmp_path):
    scenario = scenario_of(INTERMITTENT, tmp_path)
    first = check(scenario, 12, workers=1)
    more = check(scenario, 16, workers=1, earlier=first)
    whole = check(scenario, 16, workers=1)
    assert more.runs == 16
    assert more.looks == 2
    assert more.confidence == pytest.approx(1.0 - 0.01 - 0.01 / 4.0)
    # The same results, judged at another level: margins are equal where no decision was kept.
    old = {one.promise: one for one in whole.rows}
    for one in more.rows:
        if one.verdict == UNDECIDED:
            assert one.margin == pytest.approx(old[one.promise].margin, nan_ok=True)
            assert one.low <= old[one.promise].low
    with pytest.raises(ScenarioError, match="16 runs already"):
        check(scenario, 16, earlier=more)
    with pytest.raises(ScenarioError, match="seed"):
        check(scenario, 30, seed=77, earlier=more)


@pytest.mark.slow
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


@pytest.mark.one_in(6)
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


OWN_CLASS = """
from dataclasses import dataclass

from netkf.parts import Hybrid


@dataclass(frozen=True, eq=False)
class Mine(Hybrid):
    def absorb(self, state, messages, exchange):
        return super().absorb(state, messages, exchange)._replace(root=state.root)
"""


def test_the_printed_command_replays_a_broken_run(tmp_path, monkeypatch, capsys):
    """In an empty folder beside the files, for a user's class: the first departure is there."""
    (tmp_path / "mine_too.py").write_text(OWN_CLASS)
    monkeypatch.chdir(tmp_path)
    path = str(SCENARIOS / "threshold.toml")
    sets = ["--set", "horizon=2.0", "--set", 'filter.kind="mine_too:Mine"']
    assert main(["check", path, "--trust", "--runs", "10", "--no-plot", *sets]) == 1
    text = capsys.readouterr().out
    # Each broken row has the command of a run that shows it.
    command = re.search(r"BROKEN: P follows.+\n\s+replay it: netkf (.+)", text)[1]
    assert text.count("BROKEN: ") == 1  # what follows from it is not a further mistake
    found = re.search(r"first seen to depart in run (\d+)\s+at ([0-9.]+) s, node (\d+)", text)
    assert command.endswith(f"--replica {found[1]}")
    more = ["--out", "replayed", "--no-plot", "--set", "probe=0.25"]
    assert main([*shlex.split(command), *more]) == 0
    run = netkf.open("replayed", trust=True)
    changes = {"horizon": 2.0, "probe": 0.25}
    exact = netkf.simulate(netkf.load(path, changes), run.seed, int(found[1]))
    apart = np.abs(run.P - exact.P).max(axis=(2, 3))
    time, node = (
        int(np.argmin(np.abs(run.times - float(found[2])))),
        exact.nodes.index(int(found[3])),
    )
    assert run.times[time] == pytest.approx(float(found[2]))
    assert apart[time, node] > 1e-6
    assert apart[0].max() < 1e-12


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
