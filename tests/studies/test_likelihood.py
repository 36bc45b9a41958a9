"""Likelihoods of readings against statsmodels and the innovations of filters; noises fitted."""

import json

import numpy as np
import pandas as pd
import pytest
import scipy.stats

import netkf
from netkf.checks.innovations import compute_innovations
from netkf.cli.main import main
from netkf.cli.options import parse_changes
from netkf.core.errors import ScenarioError
from netkf.scenario.reading import from_table
from netkf.scenario.writing import as_table, to_toml
from netkf.studies.likelihood import fit_noise, log_likelihood
from tests.studies.statsmodels_likelihood import (
    LEVEL,
    TREND,
    level_readings,
    reference,
    trend_readings,
)

# As `python tests/studies/statsmodels_likelihood.py` prints it, with statsmodels 0.15.
REFERENCE = {
    "level": {
        "start": -146.36946107177238,
        "maximum": -141.94508064531573,
        "values": [0.45734869994500504, 1.050470316185966],
        "se": [0.17186776207431026, 0.23232777326296225],
    },
    "trend": {
        "start": -154.71514985271543,
        "maximum": -153.61281762616034,
        "values": [0.03605388044624729, 0.4909653608931991, 1.8415022479173468],
        "se": [0.02323360050183067, 0.10762410608888723, 0.38885837580254323],
    },
}


def scenario(folder, plant, sensor, horizon, **changes):
    table = {
        "format": 1,
        "name": "fitted",
        "horizon": horizon,
        "probe": horizon,
        "plant": plant,
        "sensors": [{"nodes": [0], **sensor}],
        "network": {"graph": {"kind": "path", "nodes": 2}},
        "filter": {"kind": "local"},
        **changes,
    }
    return from_table({k: v for k, v in table.items() if v is not None}, folder)


@pytest.fixture(scope="module")
def level(tmp_path_factory):
    folder = tmp_path_factory.mktemp("level")
    y = level_readings()
    rows = {"t": np.arange(1, len(y) + 1), "node": 0, "y0": y}
    pd.DataFrame(rows).to_csv(folder / "level.csv", index=False)
    plant = {"kind": "unknown", "F": [[1.0]], "Q": [[LEVEL["q"]]], "period": 1.0}
    plant |= {"mean": [LEVEL["mean"]], "cov": [[LEVEL["cov"]]]}
    sensor = {"kind": "recorded", "path": "level.csv", "H": [[1.0]], "R": [[LEVEL["r"]]]}
    return scenario(folder, plant, sensor, len(y) + 1.0)


@pytest.fixture(scope="module")
def trend(tmp_path_factory):
    folder = tmp_path_factory.mktemp("trend")
    t, y = trend_readings()
    rows = {"t": t, "node": 0, "y0": y[:, 0], "y1": y[:, 1]}
    pd.DataFrame(rows).to_csv(folder / "trend.csv", index=False)
    plant = {"kind": "unknown", "A": [[0.0, 1.0], [0.0, 0.0]], "B": [[0.0], [TREND["q"] ** 0.5]]}
    plant |= {"mean": TREND["mean"], "cov": TREND["cov"]}
    H, R = [[1.0, 0.0], [1.0, 0.0]], np.diag(TREND["r"]).tolist()
    sensor = {"kind": "recorded", "path": "trend.csv", "H": H, "R": R}
    return scenario(folder, plant, sensor, float(t[-1]) + 1.0)


@pytest.mark.parametrize("name", ["level", "trend"])
def test_likelihood_and_its_maximum_are_those_of_statsmodels(name, request):
    given, right = request.getfixturevalue(name), REFERENCE[name]
    assert log_likelihood(given) == pytest.approx(right["start"], abs=1e-8)
    found = fit_noise(given)
    assert found.start_log_likelihood == log_likelihood(given)
    assert found.log_likelihood == pytest.approx(right["maximum"], abs=1e-8)
    np.testing.assert_allclose(found.table["value"], right["values"], rtol=1e-6)
    np.testing.assert_allclose(found.table["se"], right["se"], rtol=1e-4)
    # At 95 %, of logarithms.
    reach = 1.959964 * found.table["se"] / found.table["value"]
    np.testing.assert_allclose(found.table["high"], found.table["value"] * np.exp(reach), rtol=1e-5)
    np.testing.assert_allclose(found.table["low"], found.table["value"] * np.exp(-reach), rtol=1e-5)
    # The scenario it returns has the matrices that it says.
    assert log_likelihood(found.scenario) == pytest.approx(found.log_likelihood, abs=1e-8)


def test_slots_without_readings_are_predictions(tmp_path):
    """The density of all readings together, two of one instant among them, by their covariance."""
    k, y = np.array([1, 2, 2, 5, 9]), np.array([0.3, -1.0, 0.4, 2.0, 0.7])
    pd.DataFrame({"t": k, "node": 0, "y0": y}).to_csv(tmp_path / "y.csv", index=False)
    plant = {"kind": "unknown", "F": [[0.8]], "Q": [[0.3]], "period": 1.0, "cov": [[2.0]]}
    sensor = {"kind": "recorded", "path": "y.csv", "H": [[1.5]], "R": [[0.4]]}
    steady = 0.3 / (1.0 - 0.8**2)
    variance = steady + 0.64**k * (2.0 - steady)
    first = np.minimum.outer(np.arange(5), np.arange(5))
    x = 0.8 ** np.abs(np.subtract.outer(k, k)) * variance[first]
    law = scipy.stats.multivariate_normal(np.zeros(5), 1.5**2 * x + 0.4 * np.eye(5))
    given = scenario(tmp_path, plant, sensor, 10.0)
    assert log_likelihood(given) == pytest.approx(law.logpdf(y), abs=1e-9)


def test_statsmodels_still_says_so():
    pytest.importorskip("statsmodels")
    for name, found in reference().items():
        assert found["start"] == pytest.approx(REFERENCE[name]["start"], abs=1e-9)
        assert found["maximum"] == pytest.approx(REFERENCE[name]["maximum"], abs=1e-8)


@pytest.mark.parametrize("name", ["level", "trend"])
def test_likelihood_is_the_density_of_the_innovations_of_the_central_filter(name, request):
    given = request.getfixturevalue(name)
    central = given.replace({"filter": {"kind": "central"}})
    assert compute_innovations(
        netkf.simulate(central, engine="simpy")
    ).log_density.sum() == pytest.approx(log_likelihood(given), abs=1e-8)


def correlated(folder, **changes):
    """Drawn readings of two nodes: noise that is not diagonal, an input, two plants' noises."""
    plant = {"kind": "diffusion", "A": [[0.0, 1.0], [-1.0, -0.3]], "B": [[0.3, 0.0], [0.1, 0.4]]}
    plant["input"] = {"kind": "sine", "G": [[0.0], [1.0]], "amplitude": [1.0], "frequency": [0.2]}
    sensor = {"H": [[1.0, 0.0], [0.0, 1.0]], "R": [[0.3, 0.1], [0.1, 0.2]], "nodes": [0, 1]}
    sensor["sampling"] = {"kind": "poisson", "rate": 3.0}
    return scenario(folder, plant, sensor, 60.0, **changes)


def test_drawn_readings_with_correlated_noise_and_an_input(tmp_path):
    given = correlated(tmp_path)
    central = given.replace({"filter": {"kind": "central"}})
    density = compute_innovations(netkf.simulate(central, engine="simpy")).log_density.sum()
    assert log_likelihood(given) == pytest.approx(density, abs=1e-7)
    found = fit_noise(given)
    assert found.table["name"].tolist() == ["|B[:, 0]|^2", "|B[:, 1]|^2", "trace sensors[0].R"]
    assert found.log_likelihood > found.start_log_likelihood


def test_intervals_hold_and_a_wrong_start_does_not_matter(tmp_path):
    plant = {"kind": "diffusion", "A": [[0.0]], "B": [[0.8]], "cov": [[1.0]]}
    sensor = {"H": [[1.0]], "R": [[0.5]], "sampling": {"kind": "periodic", "period": 0.5}}
    given = scenario(tmp_path, plant, sensor, 100.0)
    wrong = given.replace({"filter.model": {"B": [[8.0]], "R": [[5e-3]]}})
    missed = 0
    for seed in range(20):
        found = fit_noise(given, seed=seed, confidence=0.9).table
        missed += (found["low"] > [0.64, 0.5]).sum() + (found["high"] < [0.64, 0.5]).sum()
    # 40 intervals at 90 %: 4 miss, more than 11 in one of 3000 such tests.
    assert missed <= 11
    again = fit_noise(wrong, seed=19).table
    np.testing.assert_allclose(again["value"], found["value"], rtol=1e-5)


def test_the_fit_is_likelier_than_the_truth_wherever_it_starts(tmp_path):
    """From a wrong start a first step can go so far that rounding leaves no likelihood, and a
    variance that is far too small does not slope.
    """
    plant = {"kind": "linear", "F": [[0.7, 0.3], [-0.2, 0.6]], "Q": [[0.5, 0.0], [0.0, 0.8]]}
    plant |= {"period": 1.0, "cov": [[1.0, 0.0], [0.0, 1.0]]}
    sensor = {"nodes": [0, 1], "H": [[1.0, 0.0], [0.5, 1.0]], "R": [[0.4, 0.0], [0.0, 0.3]]}
    given = scenario(tmp_path, plant, sensor, 150.0)
    for q0, q1, r0, r1 in ((5.0, 0.08, 1.2, 0.3), (5e3, 4e-5, 20.0, 0.15), (5e-6, 4e3, 1e-3, 10.0)):
        model = {"Q": [[q0, 0.0], [0.0, q1]], "R": [[r0, 0.0], [0.0, r1]]}
        for seed in range(3):
            found = fit_noise(given.replace({"filter.model": model}), seed)
            assert found.log_likelihood >= log_likelihood(given, seed)


def test_a_variance_that_readings_deny_is_zero(tmp_path):
    plant = {"kind": "linear", "F": [[1.0]], "Q": [[0.0]], "period": 1.0, "cov": [[1.0]]}
    given = scenario(tmp_path, plant, {"H": [[1.0]], "R": [[1.0]]}, 50.0)
    model = {"Q": [[0.1]]}
    fits = [fit_noise(given.replace({"filter.model": model}), seed=seed) for seed in range(6)]
    zero = [found for found in fits if found.table["value"][0] == 0.0]
    # The maximum is at 0 in about two of three.
    assert 1 <= len(zero) <= 6
    assert np.isnan(zero[0].table["se"][0])
    assert "Q[0][0]" in zero[0].notes[0]
    assert zero[0].scenario.filter.model.Q[0, 0] == 0.0


def test_what_no_reading_depends_on_stays_as_it_is_and_noise_that_a_table_has_too(tmp_path):
    """Readings of the first state, each with the variance that its row says, and none after 3 s."""
    rows = [f"{k},0,{y:g},{0.5 + 0.1 * k:g}" for k, y in enumerate((0.3, -1.0, 0.8, 1.7), 1)]
    (tmp_path / "y.csv").write_text("\n".join(["t,node,y0,R0", *rows]))
    plant = {
        "kind": "unknown", "F": [[1.0, 0.0], [0.0, 0.9]], "Q": [[500.0, 0.0], [0.0, 0.7]],
        "period": 1.0, "cov": [[1.0, 0.0], [0.0, 1.0]],
    }  # fmt: skip
    sensor = {"kind": "recorded", "path": "y.csv", "H": [[1.0, 0.0]]}
    table = fit_noise(scenario(tmp_path, plant, sensor, 6.0)).table.set_index("name")
    assert list(table.index) == ["Q[0][0]", "Q[1][1]"]
    assert table.loc["Q[1][1]", "value"] == 0.7
    assert np.isnan(table.loc["Q[1][1]", "se"])


def test_blocks_of_one_name_share_a_variance(tmp_path):
    plants = [
        {"name": "walk", "nodes": [0, 1], "kind": "diffusion", "A": [[0.0]], "B": [[0.5]]},
        {"name": "team", "kind": "diffusion", "A": [[-0.1]], "B": [[1.0]]},
    ]
    clock = {"kind": "periodic", "period": 0.5}
    sensors = [
        {"nodes": [0, 1], "of": "walk", "H": [[1.0]], "R": [[0.2]], "sampling": clock},
        {"nodes": [0], "of": "team", "H": [[1.0]], "R": [[0.1]], "sampling": clock},
    ]
    given = scenario(tmp_path, None, {}, 80.0, plants=plants, sensors=sensors)
    found = fit_noise(given, seed=3, confidence=0.999)
    names = ["walk: |B[:, 0]|^2", "team: |B[:, 0]|^2", "sensors[0].R[0][0]", "sensors[1].R[0][0]"]
    assert found.table["name"].tolist() == names
    assert (found.table["low"] < [0.25, 1.0, 0.2, 0.1]).all()
    assert (found.table["high"] > [0.25, 1.0, 0.2, 0.1]).all()
    assert log_likelihood(found.scenario, seed=3) == pytest.approx(found.log_likelihood, abs=1e-8)


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"sensors.0.sampling": None}, "sensors"),
        ({"plant.schedule": [{"from": 5.0, "A": [[0.0, 1.0], [-2.0, 0.0]]}]}, "plant.schedule"),
        ({"filter.model": {"input": False}}, "filter.model.input"),
        (
            {"plant.input": None, "network.clocks": [{"nodes": [0], "offset": 0.1}]},
            "network.clocks: cannot be here",
        ),
    ],
)
def test_what_has_no_one_linear_model_is_refused(tmp_path, changes, key):
    given = correlated(tmp_path)
    if "sensors.0.sampling" in changes:
        sensor = {"H": [[1.0, 0.0]], "R": [[0.3]]}
        changes = {"sensors": [{"nodes": [0], **sensor}]}
    with pytest.raises(ScenarioError, match=f"^{key}"):
        log_likelihood(given.replace(changes))


def test_rounding_of_large_readings_is_not_taken_for_noise(tmp_path):
    """Those of an unstable plant: no likelihood has their noise, innovations from errors do."""
    plant = {"kind": "linear", "F": [[1.5]], "Q": [[1.0]], "period": 1.0, "cov": [[1.0]]}
    given = scenario(tmp_path, plant, {"H": [[1.0]], "R": [[0.5]]}, 150.0)
    with pytest.raises(ScenarioError, match=r"^sensors: give readings too large for rounding"):
        fit_noise(given)
    assert netkf.innovations(given.replace({"filter": {"kind": "central"}}))


def test_the_command_prints_the_model_that_the_scenario_may_take(level, tmp_path, capsys):
    path = tmp_path / "level.toml"
    path.write_text(to_toml(as_table(level)))
    (tmp_path / "level.csv").write_bytes((level._folder / "level.csv").read_bytes())
    assert main(["fit", str(path), "--noise"]) == 0
    lines = capsys.readouterr().out.strip().split("\n")[-2:]
    again = netkf.load(path, parse_changes(lines))
    assert log_likelihood(again) == pytest.approx(fit_noise(level).log_likelihood, abs=1e-8)
    # Where filters believe another R than the sensor has, that is what changes.
    told = fit_noise(level.replace({"filter.model": {"R": [[5.0]]}})).scenario
    assert log_likelihood(told) == pytest.approx(log_likelihood(again), abs=1e-6)
    assert main(["fit", str(path), "--noise", "--json", "--set", "plant.Q=[[1.0]]"]) == 0
    got = json.loads(capsys.readouterr().out)
    assert [row["start"] for row in got["variances"]] == [1.0, 2.0]
    assert main(["fit", str(path), "--noise", "--set", "filter.gain=1"]) == 2


def test_a_sensor_without_noise_keeps_a_little(tmp_path):
    """Readings of the state itself: R is 0 as far as half of the runs tell, and filters run."""
    plant = {"kind": "linear", "F": [[0.9]], "Q": [[1.0]], "period": 1.0, "cov": [[1.0]]}
    given = scenario(tmp_path, plant, {"H": [[1.0]], "R": [[1e-6]]}, 100.0)
    wrong = given.replace({"filter.model": {"R": [[1.0]]}})
    found = next(fit for fit in (fit_noise(wrong, seed=seed) for seed in range(9)) if fit.notes)
    assert 0.0 < found.table["value"][1] < 1e-3
    assert found.table["value"][0] == pytest.approx(1.0, rel=0.5)
    assert np.isfinite(netkf.simulate(found.scenario, engine="simpy").xhat).all()


def test_values_that_the_filter_does_not_take_are_found_and_said(tmp_path):
    """A noise of 0 leaves the inverse of P(0) = 0 to push-sum, as do readings of a still plant."""
    plant = {"kind": "diffusion", "A": [[-0.3]], "B": [[1e-6]]}
    sampling = {"kind": "periodic", "period": 0.5}
    given = scenario(tmp_path, plant, {"H": [[1.0]], "R": [[1.0]], "sampling": sampling}, 30.0)
    network = {"graph": {"kind": "edges", "edges": [[0, 1]]}}
    network["activation"] = {"kind": "poisson", "rate": 1.0, "at": "nodes"}
    summing = given.replace(
        {"network": network, "filter": {"kind": "push-sum", "model": {"B": [[0.5]]}}}
    )
    fits = (fit_noise(summing, seed=seed) for seed in range(9))
    found = next(fit for fit in fits if fit.table["value"][0] == 0.0)
    assert found.changes["filter.model.B"] == [[0.0]]
    assert "cannot run with the values: filter.cov: must be positive definite" in found.notes[-1]
    with pytest.raises(netkf.ScenarioError, match="must be positive definite"):
        _ = found.scenario


@pytest.mark.parametrize(
    ("plant", "H", "unknown", "told"),
    [
        # Two noises that act alike; all that is read is Q + R; two modes of one sum; one unseen.
        ({"kind": "diffusion", "A": [[-0.3]], "B": [[1.0, 1.0]]}, [[1.0]], [0, 1], [2]),
        ({"F": [[0.0]], "Q": [[1.0]]}, [[1.0]], [0, 1], []),
        ({"F": [[0.5, 0], [0, 0.5]], "Q": [[1.0, 0], [0, 1.0]]}, [[1.0, 1.0]], [0, 1], [2]),
        ({"F": [[0.5, 0], [0, 0.5]], "Q": [[1.0, 0], [0, 1.0]]}, [[1.0, 0.0]], [1], [0]),
    ],
)
def test_what_readings_do_not_tell_has_no_interval_and_is_not_called_zero(
    tmp_path, plant, H, unknown, told
):
    sensor = {"H": H, "R": [[0.2]]}
    if "A" in plant:
        sensor["sampling"] = {"kind": "periodic", "period": 0.5}
    else:
        plant = {"kind": "linear", "period": 1.0, **plant}
    found = fit_noise(scenario(tmp_path, plant, sensor, 200.0))
    rows = found.table.iloc[unknown]
    assert rows[["se", "low", "high"]].isna().all(axis=None)
    assert (rows["value"] > 0.01).all()
    assert found.notes[-1].endswith(": " + ", ".join(rows["name"]))
    assert np.isfinite(found.table.iloc[told]["se"]).all()
    if unknown == [1]:  # the scenario's
        assert rows["value"].item() == 1.0
