"""Searches, sweeps and comparisons by what means over time hide."""

import json

import numpy as np
import pandas as pd
import pytest
import scipy.stats

import netkf
from netkf.cli.main import main
from netkf.runs.quantities import NETWORK
from netkf.studies.metrics import RunMetrics
from netkf.studies.targets import Target, quantity_by_simulation
from tests.conftest import SCENARIOS

RING = SCENARIOS / "poisson_ring.toml"


@pytest.fixture(scope="module")
def pair():
    """A sensor that one other node hears at exponential times: the mean age is 1 / rate."""
    scenario = netkf.load(RING).replace({"horizon": 100.0, "probe": 50.0})
    changes = {
        "sensors.0.nodes": [0],
        "network.graph": {"kind": "path", "nodes": 2},
        "network.activation": {"kind": "poisson", "rate": 1.0, "at": "directions"},
        "network.channel.loss": {"kind": "none"},
    }
    return scenario.replace(changes)


@pytest.mark.slow
def test_the_rate_that_keeps_the_age(pair):
    found = netkf.size(pair, "network.activation.rate", 0.5, 8.0, "mean_age<=0.5", runs=32)
    assert found.by == "simulation"
    # An undecided value counts as missed.
    assert 1.6 < found.misses < 2.2
    assert 1.95 < found.value < 2.6
    assert not found.grows


@pytest.mark.slow
def test_the_duty_cycle_that_stays_connected(pair):
    """Connected while node 1 is up too, and while 0 is the only one that is: always. With three
    nodes in a row and the middle asleep, not.
    """
    scenario = pair.replace(
        {
            "horizon": 40.0,
            "probe": 1.0,
            "network.graph": {"kind": "path", "nodes": 3},
            "sensors.0.sampling": {"kind": "periodic", "period": 1.0},
            "network.lives": [{"kind": "duty", "nodes": [1], "period": 10.0, "up": 5.5}],
        }
    )
    key = "network.lives.0.up"
    found = netkf.size(scenario, key, 2.5, 9.5, "time_connected>=0.65", runs=32)
    # Up in [0, u) of each 10 s: at ceil(u) of 10 samples, 28 of 41 for u in (6, 7].
    reached = found.value
    assert 6.0 < reached <= 7.0
    assert not found.grows
    assert {p.target for p in found.probes} == {"reached", "missed"}


@pytest.mark.parametrize(
    ("target", "words"),
    [
        ("time_above<=0.1", "needs a level"),
        ("joules<=1", "needs network.energy"),
        ("time_connected<=0.5", "time_connected>=LIMIT"),
        ("mean_age>=1", "mean_age<=LIMIT"),
        ("quantile_150<=1", "up to quantile_100; got 'quantile_150<=1'"),
        ("mean_years<=1", "QUANTITY<=LIMIT"),
    ],
)
def test_targets_that_cannot_be(target, words, capsys):
    options = ["--vary", "network.activation.rate=1:2", "--target", target]
    assert main(["size", str(RING), *options]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert words in printed.err
    assert printed.err.count("\n") == 1


def test_sweeps_and_comparisons_show_them(tmp_path, capsys):
    options = ["--runs", "4", "--set", "metrics.level=1.5", "--set", "metrics.network=true"]
    for name, seed in (("one", 1), ("two", 2)):
        out = ["--out", str(tmp_path / name), "--seed", str(seed), "--no-plot"]
        assert main(["run", str(RING), *options, *out]) == 0
    summaries = [
        json.loads((tmp_path / name / "summary.json").read_text()) for name in ("one", "two")
    ]
    found = netkf.compare([tmp_path / "one", tmp_path / "two"])
    rows = {row.quantity: row.entries for row in found.rows if row.node < 0}
    shown = ("worst_instant", "quantile_99", "time_above", *NETWORK[:-1])
    for name in shown:
        assert [entry.value for entry in rows[name]] == [s["overall"][name] for s in summaries]
        one, two = ((entry.value, entry.se * 2.0, 4) for entry in rows[name])
        p = scipy.stats.ttest_ind_from_stats(*two, *one, equal_var=False).pvalue
        assert rows[name][1].real == (p < 0.05 / (len(found.rows) - 3))
    assert "joules" not in rows
    scenario = netkf.load(RING).replace({"metrics.level": 1.5, "metrics.network": True})
    row = netkf.sweep(scenario, {"seed": [1]}, runs=4).iloc[0]
    for name in shown:
        assert row[name] == pytest.approx(summaries[0]["overall"][name])
        assert row[f"{name}_se"] == pytest.approx(summaries[0]["overall"][f"{name}_se"])


def test_filters_are_compared_by_them(tmp_path, capsys):
    """Quantiles run by run as single runs have them, ages of the first run."""
    scenario = netkf.load(RING).replace({"metrics.level": 1.5})
    table = netkf.compare_filters(scenario, ["hybrid", "gossip"], runs=3).table
    for _, row in table.iterrows():
        own = scenario.replace({"filter": {"kind": row["filter"]}} if row.name else {})
        lengths = []
        for k in range(3):
            run = netkf.simulate(own, replica=k)
            lengths.append(np.sqrt(run.sq_error[run.times > 0.0]).ravel())
        assert row["quantile_90"] == pytest.approx(np.mean([np.quantile(x, 0.9) for x in lengths]))
        assert row["time_above"] == pytest.approx(np.mean([(x > 1.5).mean() for x in lengths]))
        assert row["worst_instant"] == pytest.approx(np.mean([x.max() for x in lengths]))
    # A swap forgets what the node knew.
    assert table["mean_age"][1] > table["mean_age"][0]
    assert pd.isna(table["joules"]).all()


@pytest.mark.parametrize("runs", [32, 200, 1000])
def test_shares_of_runs_that_rarely_differ_are_right(runs):
    """Runs of share 0, and rare ones of share 1, against all that the binomial law can bring."""
    level, hits = 1e-3, np.arange(runs + 1)
    ends = []
    for count in hits[: min(runs, 100)]:
        shares = (np.arange(runs) < count).astype(float)[:, None]
        metrics = RunMetrics(*np.zeros((3, runs, 1)), np.zeros((runs, 1)), shares + np.inf, shares)
        target = Target("time_above", 0.5)
        found = quantity_by_simulation(metrics, target, level, None, ["time_above"], rare=True)
        assert 0.0 <= found.low <= count / runs <= found.high <= 1.0
        ends.append((found.low, found.high))
    low, high = np.array(ends).T
    for mean in (1.0, 3.0, 6.0, 10.0, 20.0):
        share = mean / runs
        missed = (low > share) | (high < share)
        assert scipy.stats.binom.pmf(hits[: len(low)][missed], runs, share).sum() < 3.0 * level


@pytest.mark.parametrize("kind", ["central", "local"])
def test_an_age_that_no_run_has_is_no_target(kind):
    changes = {"filter": {"kind": kind}}
    scenario = netkf.load(RING, changes)
    with pytest.raises(netkf.ScenarioError, match="mean_age"):
        netkf.size(scenario, "network.activation.rate", 1.0, 2.0, "mean_age<=1", runs=32)


@pytest.mark.parametrize("runs", [1, 3])
def test_quantiles_of_a_pooled_filter_are_between_samples_of_all_nodes(runs):
    scenario = netkf.load(RING, {"filter": {"kind": "central"}, "horizon": 4.0})
    row = netkf.sweep(scenario, {"seed": [1]}, runs=runs).iloc[0]
    expected = []
    for replica in range(runs):
        states = netkf.simulate(scenario, seed=1, replica=replica).states
        lengths = np.sqrt(states.loc[states["t"] > 0.0, "sq_error"])
        expected.append(np.quantile(lengths, [0.5, 0.9, 0.99]))
    np.testing.assert_allclose(
        row[["quantile_50", "quantile_90", "quantile_99"]].astype(float), np.mean(expected, axis=0)
    )
