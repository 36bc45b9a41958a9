"""netkf compare-filters: values run by run, paired intervals, traffic, and what cannot run."""

import json
import math
import re

import numpy as np
import pandas as pd
import pytest
import scipy.stats

import netkf
from netkf import parts
from netkf.cli.main import main
from netkf.scenario.reading import from_table
from netkf.scenario.tables import as_table
from netkf.studies.compare_filters import write_comparison
from netkf.studies.metrics import FilterValues, credibility
from netkf.studies.tables import format_filters
from tests.conftest import SCENARIOS

RUNS = 6
SLOTS = """
format = 1
name = "compared"
horizon = 8.0
probe = 1.0
seed = 3

[plant]
kind = "linear"
F = [[0.98, 0.2], [-0.2, 0.98]]
Q = [[0.05, 0.0], [0.0, 0.05]]
cov = [[2.0, 0.0], [0.0, 2.0]]
period = 1.0

[[sensors]]
nodes = [0, 2]
H = [[1.0, 0.0]]
R = [[0.5]]

[[sensors]]
nodes = [1]
H = [[0.0, 1.0], [0.3, 0.0]]
R = [[0.5, 0.0], [0.0, 0.8]]

[network]
graph = { kind = "path", nodes = 4 }
activation = { kind = "broadcast" }
channel = { loss = { kind = "bernoulli", delivery = 0.8 } }

[filter]
kind = "hcmci"
steps = 2
cov = [[3.0, 0.0], [0.0, 3.0]]
"""
FILTERS = [
    "hcmci",
    {"kind": "icf", "steps": 2},
    "local",
    "diffusion-kalman",
    "kcf",
    "gossip",
    "central",
]


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("compared") / "compared.toml"
    path.write_text(SLOTS)
    return path


@pytest.fixture(scope="module")
def scenario(file):
    return netkf.load(file)


@pytest.fixture(scope="module")
def found(scenario):
    return netkf.compare_filters(scenario, FILTERS, runs=RUNS, workers=1)


def row_of(found, name):
    return next(row for row in found.rows if row.filter == name)


def runs_of(scenario, table):
    cov = [[3.0, 0.0], [0.0, 3.0]]
    chosen = scenario.replace({"filter": {**table, "cov": cov}})
    return [netkf.simulate(chosen, replica=k) for k in range(RUNS)]


def test_values_are_those_of_the_runs_and_intervals_students(scenario, found):
    one = runs_of(scenario, {"kind": "hcmci", "steps": 2})
    two = runs_of(scenario, {"kind": "local"})
    square = [
        np.mean([(run.error[1:] ** 2).sum(axis=2).mean() for run in runs]) for runs in (one, two)
    ]
    local = row_of(found, "local").quantities
    assert local["rms_error"].value == pytest.approx(math.sqrt(square[1]), rel=1e-12)
    gap = math.sqrt(square[1]) - math.sqrt(square[0])
    assert local["rms_error"].difference == pytest.approx(gap, rel=1e-10)
    worst = [
        np.array([np.linalg.norm(run.error[1:], axis=2).max() for run in runs])
        for runs in (one, two)
    ]
    # Three quantities of five filters beside the first share the level.
    level = 1.0 - 0.05 / (3 * 5)
    ends = scipy.stats.ttest_1samp(worst[1] - worst[0], 0.0).confidence_interval(level)
    quantity = local["worst_instant"]
    assert (quantity.low, quantity.high) == pytest.approx(tuple(ends), rel=1e-10)
    assert quantity.real == (not ends.low <= 0.0 <= ends.high)
    nees = [
        np.einsum("tia,tiab,tib->ti", run.error[1:], np.linalg.inv(run.P[1:]), run.error[1:]).mean()
        for run in two
    ]
    assert local["nees_ratio"].value == pytest.approx(np.mean(nees) / 2.0, rel=1e-10)
    assert local["nees_ratio"].se == pytest.approx(scipy.stats.sem(nees) / 2.0, rel=1e-8)


def test_curves_are_mean_square_errors_over_the_runs(scenario, found, tmp_path):
    squares = [
        (run.error**2).sum(axis=2).mean(axis=1) for run in runs_of(scenario, {"kind": "local"})
    ]
    curve = next(curve for curve in found.curves if curve.label == "local")
    np.testing.assert_array_equal(curve.times, scenario.times)
    np.testing.assert_allclose(curve.square, np.mean(squares, axis=0), rtol=1e-12)
    np.testing.assert_allclose(curve.se, scipy.stats.sem(squares), rtol=1e-9, atol=1e-15)
    # The figure has them, also when it is read back.
    directory = write_comparison(scenario, found, tmp_path / "out")
    for comparison in (found, netkf.open(directory)):
        axes = comparison.plot("error").axes[0]
        lines = {line.get_label(): line.get_ydata() for line in axes.lines}
        np.testing.assert_array_equal(lines["local"], curve.square)
        limit = lines.pop("centralised filter, trace of P by theory")[0]
        assert limit == pytest.approx(netkf.theory.central_covariance(scenario).trace())
        assert set(lines) == {row.filter for row in found.rows if row.ran}


def test_one_algorithm_under_two_names_does_not_differ(found):
    icf = row_of(found, "icf steps=2")
    for quantity in icf.quantities.values():
        assert abs(quantity.difference) < 1e-12
        assert not quantity.real
    assert row_of(found, "hcmci").bytes == 2 * icf.bytes
    assert math.isnan(row_of(found, "hcmci").quantities["rms_error"].difference)


def test_traffic_is_counted_by_hand(found):
    """Seven slots with exchanges, four nodes, three with readings."""
    pair = 2 + 3
    expected = {
        "hcmci": (7 * 4 * 2, 7 * 4 * 2 * 2 * pair),
        "icf steps=2": (7 * 4 * 2, 7 * 4 * 2 * pair),
        "kcf": (7 * 4, 7 * (3 * (pair + 2) + 2)),
        "diffusion-kalman": (7 * (3 + 4), 7 * (2 * (1 + 2 + 1) + (2 + 4 + 3) + 4 * 2)),
        "local": (0, 0),
        "central": (0, 0),
    }
    for name, (transmissions, numbers) in expected.items():
        row = row_of(found, name)
        assert (row.transmissions, row.bytes) == (transmissions, 8 * numbers), name


def test_what_cannot_run_says_why(found, scenario):
    row = row_of(found, "gossip")
    assert not row.ran
    assert "must be a matching for the gossip filter" in row.status
    assert found.first == "hcmci"
    with pytest.raises(netkf.ScenarioError, match="none of them can run there; gossip: cannot run"):
        netkf.compare_filters(scenario, ["gossip"], runs=2)
    with pytest.raises(netkf.ScenarioError, match="must be at most 200 filters; got 201"):
        netkf.compare_filters(scenario, ["hybrid"] * 201)
    for odd in (5, {"kind": "icf"}, parts.Icf(), "icf", []):
        with pytest.raises(netkf.ScenarioError, match="filters: must be a list of filters"):
            netkf.compare_filters(scenario, odd, runs=2)
    for odd in (1, None, ["icf"], 2.0, True):
        with pytest.raises(netkf.ScenarioError, match="filters: must hold filters"):
            netkf.compare_filters(scenario, ["icf", odd], runs=2)
    with pytest.raises(netkf.ScenarioError, match="must differ from each other"):
        netkf.compare_filters(scenario, ["icf", "icf"], runs=2)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"stepss": 2}, 'filter.stepss: is not a key here; got 2; did you mean "steps"?'),
        ({"steps": "x"}, "filter.steps: must be"),
        ({"consensus": "inf"}, "filter.consensus: must be one of"),
        ({"gate": {"nis": 9.0}}, "filter.gate.nis: is not a key here"),
    ],
)
def test_a_misspelt_filter_is_refused_rather_than_noted(scenario, settings, message):
    with pytest.raises(netkf.ScenarioError, match=re.escape(message)):
        netkf.compare_filters(scenario, ["icf", {"kind": "hcmci", **settings}], runs=2)


def test_objects_of_one_kind_are_told_apart_by_the_settings_that_differ(scenario):
    filters = [parts.Icf(), parts.Icf(steps=2), parts.Kcf(epsilon=0.2)]
    found = netkf.compare_filters(scenario, filters, runs=2, workers=1)
    assert [row.filter for row in found.rows] == ["icf steps=1", "icf steps=2", "kcf"]
    same = netkf.compare_filters(scenario, ["icf", {"kind": "icf", "steps": 2}], 2, workers=1)
    for ours, other in zip(found.rows[:2], same.rows, strict=True):
        assert ours.quantities["rms_error"].value == other.quantities["rms_error"].value
    with pytest.raises(netkf.ScenarioError, match="must differ from each other"):
        netkf.compare_filters(scenario, [parts.Icf(), parts.Icf()], runs=2)


def test_the_command_line_prints_a_table_a_document_and_a_directory(file, tmp_path, capsys):
    filters = 'hcmci,{kind="icf",steps=2},gossip,intermittent'
    command = ["compare-filters", str(file), "--filters", filters, "--runs", "3", "--workers", "1"]
    out = tmp_path / "out"
    assert main([*command, "--out", str(out)]) == 0
    text, notes = capsys.readouterr()
    assert "note: gossip: cannot run here: " in notes
    for words in (
        "icf steps=2",
        "gossip: cannot run here",
        "consistency",
        "of intermittent are predictions",
        "by run, +- half of their intervals",
    ):
        assert words in text
    assert {f.name for f in out.iterdir()} == {
        *("scenario.toml", "manifest.json", "filters.csv", "filters.parquet", "filters.png"),
        *("errors.parquet", "errors.png"),
    }
    assert list(pd.read_parquet(out / "filters.parquet")["filter"]) == [
        *("hcmci", "icf steps=2", "gossip", "intermittent")
    ]
    assert main([*command, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["runs"] == 3
    assert document["rows"][2]["rms_error"] is None
    assert main(["compare-filters", str(file), "--filters", "hcmi"]) == 2
    assert "is no filter; got 'hcmi'; did you mean" in capsys.readouterr().err


def test_under_clocks_a_broadcast_is_one_transmission(ring):
    nodes = {"kind": "poisson", "rate": 2.0, "at": "nodes"}
    chosen = ring.replace({"network.activation": nodes, "horizon": 4.0})
    table = [{"kind": "hcmci", "consensus": "information"}, "hybrid", "icf"]
    found = netkf.compare_filters(chosen, table, runs=2, workers=1)
    ci, hybrid, icf = found.rows
    assert not icf.ran
    transmitted = netkf.simulate(chosen).count("transmit")
    assert ci.transmissions == hybrid.transmissions == transmitted > 10
    assert ci.bytes == hybrid.bytes == 8 * 5 * transmitted


@pytest.mark.parametrize(
    "file", sorted((SCENARIOS / "benchmark").glob("*.toml")), ids=lambda f: f.stem
)
def test_the_networks_of_the_benchmark_run(file):
    """Each says what it is: the share of messages that is lost, and how long they take."""
    scenario = netkf.load(file, {"horizon": 6.0})
    run = netkf.simulate(scenario)
    lost = run.count("lost") / run.count("send")
    if "lossless" in file.stem:
        assert lost == 0.0
    elif file.stem != "intel_lab":
        assert 0.25 < lost < 0.55
    ages = run.events.loc[run.events["kind"] == "deliver", "age"]
    assert (ages.max() > 0.1) == (file.stem == "one_way")
    assert np.isfinite(run.P).all()


def test_one_record_is_no_test_of_P(scenario, tmp_path):
    """Runs that differ by losses alone have one error of the plant: no spread tells of P."""
    rows = "".join(f"{k},{3 * k},0\n" for k in range(10))
    (tmp_path / "truth.csv").write_text(f"t,x0,x1\n{rows}")
    table = as_table(scenario)
    table["plant"] |= {"kind": "recorded", "path": "truth.csv"}
    recorded = from_table(table, tmp_path).replace({"sensors.0.R": [[1e-9]]})
    drawn = recorded.replace({"plant": as_table(scenario)["plant"]})
    verdicts = [
        [row.consistency for row in netkf.compare_filters(one, ["local"], runs=5, workers=1).rows]
        for one in (recorded, drawn)
    ]
    assert verdicts[0] == ["-"]
    assert verdicts[1] != ["-"]
    text = format_filters(netkf.compare_filters(recorded, ["central"], runs=2, workers=1))
    assert "worst instant: largest error of any node" in text
    unknown = {key: value for key, value in table["plant"].items() if key != "path"}
    table["plant"] = unknown | {"kind": "unknown"}
    table["sensors"] = []
    blind = netkf.compare_filters(from_table(table, tmp_path), ["central"], runs=2, workers=1)
    assert "worst instant: truth unknown, largest root of trace P of any n" in format_filters(blind)
    assert "consistency: -, where all runs have the one state or readings of a record" in text


@pytest.mark.parametrize(
    ("size", "word"), [(0.5, "conservative"), (1.0, "consistent"), (2.0, "overconfident")]
)
def test_credibility_is_told_of_squares_of_normal_numbers(size, word):
    """Of NEES of three states in 100 runs; the truth is called something else in at most 5 %."""
    nees = size * np.random.default_rng(6).chisquare(3, size=(200, 100))
    said = [credibility(FilterValues(one, one, one[:, None], one > 0.0), 3.0, 0.05) for one in nees]
    assert said.count(word) > 178
