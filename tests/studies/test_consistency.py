"""NEES and NIS: correct filters are as they should be, the cautious too; wrong ones not."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy.stats

import netkf
from netkf.checks.innovations import compute_innovations
from netkf.cli.main import main
from netkf.core.errors import ScenarioError
from netkf.rng.streams import Streams
from netkf.runs.labels import covariance_bias, mismatch_note
from netkf.scenario.reading import from_table
from netkf.studies import innovations
from netkf.studies.consistency import (
    RunConsistency,
    consistency,
    judge_consistency,
    judged_blocks,
    replica_consistency,
)
from netkf.studies.innovations import ClockedInnovations
from netkf.studies.metrics import expected_metrics
from netkf.studies.tables import format_consistency
from tests.algorithms.test_block_intersection import CLOCKED, ROBOTS, load
from tests.checks.broken import Overconfident
from tests.conftest import SCENARIOS

NO_REASON = np.array([""])
GOSSIP = str(SCENARIOS / "gossip_ring.toml")


@pytest.mark.parametrize(
    "model",
    [{}, {"F": [[0.7, 0.1], [0.1, 0.9]]}, {"input": False}, {"schedule": False}],
    ids=lambda model: "-".join(model) or "right",
)
@pytest.mark.parametrize("kind", ["local", "intermittent"])
def test_nis_is_that_of_the_innovations_of_the_filter(kind, model):
    """From samples, also where filters believe in another plant: as the filter itself has them."""
    sine = {"kind": "sine", "G": [[1.0], [0.5]], "amplitude": 2.0, "frequency": 0.1}
    plant = {
        "kind": "linear", "period": 1.0, "F": [[0.9, 0.3], [0.0, 0.8]],
        "Q": [[0.2, 0.0], [0.0, 0.3]], "mean": [2.0, -1.0], "cov": [[1.0, 0.0], [0.0, 1.0]],
        "input": sine, "schedule": [{"from": 5.0, "F": [[0.5, 0.3], [0.2, 0.8]]}],
    }  # fmt: skip
    table = {
        "format": 1, "name": "innovations", "horizon": 12.0, "probe": 1.0, "plant": plant,
        "sensors": [{"nodes": [0], "H": [[1.0, 0.5]], "R": [[0.4]]}],
        "network": {"graph": {"kind": "path", "nodes": 2}, "activation": {"kind": "broadcast"}},
        "filter": {"kind": kind, "model": model},
    }  # fmt: skip
    if kind == "local":
        table["network"].pop("activation")
    scenario = from_table(table, Path())
    found = replica_consistency(scenario, 3, 0, "simpy").nis[0]
    # A sample at 12 s has the innovation of a slot that the shorter run does not begin.
    run = netkf.simulate(scenario.replace({"horizon": 13.0}), 3, engine="simpy")
    given = compute_innovations(run)
    own = given.nis[(given.nodes == 0) & (given.times > 0.0) & (given.times <= 12.0)]
    assert len(own) == 12
    assert found == pytest.approx(own.mean(), rel=1e-9)


@pytest.fixture
def gossip():
    return netkf.load(GOSSIP, {"horizon": 16.0, "probe": 1.0})


def test_exact_filters_should_have_n_and_do(gossip):
    found = consistency(gossip, runs=20, confidence=0.999, workers=1)
    assert found
    assert all(row.verdict == "consistent" for row in found.rows)
    np.testing.assert_allclose([row.expected for row in found.rows], 4.0, rtol=1e-9)
    np.testing.assert_allclose([row.expected_nis for row in found.rows if row.node != 1], 1.0)
    assert np.isnan(found.rows[1].nis)
    low, high = scipy.stats.chi2.ppf([0.0005, 0.9995], 20 * 4) / 20
    assert (found.low, found.high) == pytest.approx((low, high))
    assert min(row.inside for row in found.rows) > 0.8


def test_cautious_filters_are_not_called_wrong(ring):
    found = consistency(ring.replace({"horizon": 3.0}), runs=12, confidence=0.999, workers=1)
    assert found
    for row in found.rows:
        assert row.expected < 1.9
        assert row.verdict == "as expected: P is conservative by design"


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("filter.cov", [[0.01, 0.0], [0.0, 0.01]], "begin with a P below"),
        ("filter.mean", [3.0, 0.0], "begin with a P below"),
        ("network.lives", [{"kind": "duty", "period": 2.0, "up": 1.0}], "node 1 begins again"),
    ],
)
def test_no_filter_is_cautious_by_design_that_starts_too_sure(key, value, words, ring):
    """P of the hybrid filter bounds its errors only if it does so when a node begins."""
    sampled = {"nodes": [0, 3], "H": [[1.0, 0.0]], "R": [[0.25]]}
    sampled["sampling"] = {"kind": "poisson", "rate": 3.0}
    ring = ring.replace({"sensors": [sampled]})
    assert covariance_bias(ring) == "larger"
    if key == "network.lives":
        value = [{**value[0], "nodes": [1], "memory": "lost"}]
    changed = ring.replace({key: value})
    assert covariance_bias(changed) == ""
    assert words in mismatch_note(changed)
    # One cause does not hide another.
    gated = changed.replace({"filter.gate": {"probability": 0.99, "then": "ignore"}})
    assert words in mismatch_note(gated)
    assert "a gate refuses" in mismatch_note(gated)


def test_a_mismatched_model_is_as_bad_as_theory_says(gossip):
    wrong = gossip.replace({"filter.model": {"R": [[0.2]]}})
    found = consistency(wrong, runs=12, confidence=0.999, workers=1)
    assert found
    assert all("the filters' model makes P overconfident" in row.verdict for row in found.rows)


@pytest.mark.one_in(2)
@pytest.mark.parametrize("time", ["slots", "clocks"])
def test_filters_that_start_elsewhere_have_the_errors_of_that(time, gossip, ring):
    if time == "slots":
        scenario = gossip.replace({"filter.mean": [3.0, 0.0, -2.0, 1.0]})
    else:
        scenario = ring.replace({"horizon": 2.0, "filter.mean": [[4.0, -4.0]] * 6})
    found = consistency(scenario, runs=20, confidence=0.999, workers=1)
    assert found
    for row in found.rows:
        assert row.nees == pytest.approx(row.expected, rel=0.25)
    assert max(row.expected for row in found.rows) > 1.2 * scenario.plant.n
    assert any("start elsewhere than the state" in row.verdict for row in found.rows)


def test_the_square_of_the_first_offset_is_in_what_nees_and_mean_squares_should_be():
    """Of one Kalman filter: P + m m', m the offset as the filter forgets it, written plainly."""
    F, Q, R, H, offset = 0.9, 0.5, 2.0, 1.0, 5.0
    table = {
        "format": 1,
        "name": "one",
        "horizon": 5.0,
        "probe": 1.0,
        "plant": {"kind": "linear", "F": [[F]], "Q": [[Q]], "period": 1.0, "cov": [[1.0]]},
        "sensors": [{"nodes": [0], "H": [[H]], "R": [[R]]}],
        "network": {
            "graph": {"kind": "path", "nodes": 2},
            "activation": {"kind": "broadcast"},
        },
        "filter": {"kind": "local", "mean": [-offset]},
    }
    scenario = from_table(table, Path())
    P, m, squares, expected = 1.0, offset, [1.0 + offset**2], []
    for _ in range(5):
        P, m = F * P * F + Q, F * m
        gain = P * H / (H * P * H + R)
        P, m = (1.0 - gain * H) * P, (1.0 - gain * H) * m
        squares.append(P + m**2)
        expected.append(1.0 + m**2 / P)
    found = replica_consistency(scenario, 1, 0)
    assert found.expected[0] == pytest.approx(np.mean(expected), rel=1e-9)
    exact = expected_metrics(scenario, 1, 0, "simpy")
    assert exact.mean_square[0, 0] == pytest.approx(np.mean(squares[1:]), rel=1e-9)


def test_what_is_not_known_is_not_judged(gossip):
    """A filter of one's own with a P that is four times too small."""
    kind = f"{Overconfident.__module__}:{Overconfident.__name__}"
    network = {"graph": {"kind": "path", "nodes": 2}, "activation": {"kind": "broadcast"}}
    changes = {
        "network": network,
        "sensors": [{"nodes": [0, 1], "H": np.eye(4).tolist(), "R": np.eye(4).tolist()}],
    }
    other = gossip.replace({**changes, "filter": {"kind": kind}})
    found = consistency(other, runs=12, workers=1)
    assert found
    for row in found.rows:
        assert row.verdict == "above n; the expected NEES is unknown"
        assert row.nees == pytest.approx(16.0, rel=0.3)
    assert "the expected NEES is unknown: the exact error covariance is not known" in found.notes[0]


def test_exact_covariances_of_large_networks_are_left_out_and_a_line_says_so(ring):
    changes = {"network.graph": {"kind": "cycle", "nodes": 129}, "horizon": 1.0}
    changes["filter"] = {"kind": "local"}  # exact, so that NEES is near n
    found = consistency(ring.replace(changes), runs=10, workers=1, confidence=0.999)
    assert "the expected NEES is left out: the exact covariance of 258 errors" in found.notes[0]
    assert all(np.isnan(row.expected) for row in found.rows)
    assert {row.verdict for row in found.rows} == {"near n; the expected NEES is unknown"}


def test_nis_is_the_textbook_one(gossip):
    """Local filters: the prediction from the last sample against the reading, in plain numpy."""
    local = gossip.replace({"filter": {"kind": "local"}})
    seen, run = replica_consistency(local, 3, 2), netkf.simulate(local, seed=3, replica=2)
    from netkf.rng.streams import Streams

    path = local.slot_path(Streams(3, 2), 0, local.placed_sensors[0][0])
    F, Q, (H, R) = local.plant.F, local.plant.Q, local.observation_matrices(0)
    values = []
    for k in range(1, 17):
        v = path.reading(k, run.x[k]) - H @ F @ run.xhat[k - 1, 0]
        S = H @ (F @ run.P[k - 1, 0] @ F.T + Q) @ H.T + R
        values.append(v @ np.linalg.inv(S) @ v)
    assert seen.nis[0] == pytest.approx(np.mean(values))
    assert np.isnan(seen.nis[1])


@pytest.mark.parametrize(
    ("factor", "words"), [(1.6, "larger"), (0.5, "smaller"), (1.0, "consistent")]
)
def test_errors_that_are_not_what_they_should_be_are_found(gossip, factor, words):
    random, n, nodes = np.random.default_rng(8), 4, len(gossip.nodes)
    runs = []
    for _ in range(40):
        samples = factor * random.chisquare(n, size=(10, nodes))
        nothing = np.full(nodes, np.nan)
        told = samples.mean(axis=0), np.full(nodes, 4.0), nothing, nothing
        runs.append(RunConsistency(samples, *told, np.array([np.inf]), np.array([True]), NO_REASON))
    found = judge_consistency(gossip, runs, 0.999)
    assert bool(found) == (factor == 1.0)
    assert all(words in row.verdict for row in found.rows)
    if factor == 1.0:
        assert np.mean([row.inside for row in found.rows]) > 0.97


def test_a_broken_node_is_named_with_its_time(gossip):
    random, n, nodes = np.random.default_rng(9), 4, len(gossip.nodes)
    runs = []
    for _ in range(40):
        samples = random.chisquare(n, size=(16, nodes))
        samples[9:, 2] *= 2.0  # from 10 s on
        nothing = np.full(nodes, np.nan)
        told = samples.mean(axis=0), np.full(nodes, 4.0), nothing, nothing
        runs.append(RunConsistency(samples, *told, np.array([np.inf]), np.array([True]), NO_REASON))
    verdicts = [row.verdict for row in judge_consistency(gossip, runs, 0.999).rows]
    assert verdicts.pop(2) == "BROKEN: errors are larger than expected, since 10 s"
    assert set(verdicts) == {"consistent"}


def test_the_command_and_the_table_of_a_run_say_so(capsys, tmp_path):
    short = ["--set", "horizon=6.0", "--set", "probe=1.0"]
    arguments = ["consistency", GOSSIP, *short, "--runs", "10", "--workers", "1"]
    assert main([*arguments, "--confidence", "0.999"]) == 0
    printed = capsys.readouterr().out
    assert "chi-square bounds" in printed
    assert "consistent" in printed
    assert main([*arguments, "--json", "--confidence", "0.999"]) == 0
    found = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
    assert found["n"] == 4
    assert len(found["rows"]) == 5
    ring = str(SCENARIOS / "poisson_ring.toml")
    assert (
        main(["run", ring, "--set", "horizon=1.0", "--no-plot", "--out", str(tmp_path / "o")]) == 0
    )
    assert "NEES below n = 2 is right" in capsys.readouterr().out


def test_bad_requests_are_refused(gossip, capsys):
    with pytest.raises(ScenarioError, match="runs: must be an integer of at least 10"):
        consistency(gossip, runs=3)
    assert main(["consistency", GOSSIP, "--confidence", "7"]) == 2
    assert capsys.readouterr().err.startswith("netkf: confidence: must be")


def test_the_summary_of_many_runs_has_chi_square_bounds(tmp_path, capsys):
    out = tmp_path / "o"
    arguments = ["run", GOSSIP, "--set", "horizon=40.0", "--runs", "12", "--workers", "1"]
    assert main([*arguments, "--no-plot", "--trace", "full", "--out", str(out)]) == 0
    found = json.loads((out / "summary.json").read_text())["nees"]
    low, high = scipy.stats.chi2.ppf([0.025, 0.975], 12 * 4) / 12
    assert (found["low"], found["high"]) == pytest.approx((low, high))
    states = pd.read_parquet(out / "states.parquet")
    means = states[states.t > 0.0].groupby(["t", "node"])["nees"].mean()
    assert found["inside"] == pytest.approx(((means >= low) & (means <= high)).mean())
    words = f"95% in {low:.4g} .. {high:.4g} where P is exact, here {found['inside']:.0%}"
    assert words in capsys.readouterr().out


@pytest.mark.filterwarnings("error")
@pytest.mark.slow
def test_errors_beyond_all_numbers_are_reported_without_a_warning():
    # Too few exchanges for a long path: the estimates grow by a factor a slot.
    nodes = 40
    changes = {
        "network.graph": {"kind": "path", "nodes": nodes},
        "filter.gamma": 1,
        "filter.delta": 2.0,
        "sensors.0.nodes": [0],
        "sensors.1.nodes": [nodes - 1],
        "horizon": 600.0,
        "probe": 10.0,
    }
    found = netkf.consistency(netkf.load(SCENARIOS / "push_sum_planar.toml", changes), 10)
    assert any("errors are not finite" in row.verdict for row in found.rows)
    assert "nan" not in format_consistency(found)


@pytest.mark.slow
def test_each_block_of_a_node_is_judged(tmp_path):
    naive = load(
        ROBOTS, tmp_path, filter__rule="naive", filter__estimates="own+neighbours", horizon=8.0
    )
    found = netkf.consistency(naive, runs=12, seed=3)
    pairs = [(row.node, row.block) for row in found.rows]
    assert len(set(pairs)) == 7
    assert (2, "pose@3") in pairs
    assert any(row.verdict.endswith("overconfident") for row in found.rows)
    row = found.rows[pairs.index((2, "pose@3"))]
    ratios = []
    for replica in range(12):
        block = netkf.simulate(naive, seed=3, replica=replica).block("pose", 3, by=2)
        kept = (block.times > 0.0) & (block.times < 8.0)
        ratios.append((block.error[kept, 0] ** 2 / block.P[kept, 0, 0]).mean())
    np.testing.assert_allclose(row.nees, np.mean(ratios), rtol=1e-9)
    # Where P is exact NEES has the mean n, and NIS that of the readings of a block.
    filtering = {"kind": "central", "estimates": "own+neighbours"}
    central = netkf.consistency(naive.replace({"filter": filtering}), runs=10)
    expected = {(row.node, row.block): row for row in central.rows}
    for pair, readings in {(1, "pose@1"): 2, (2, "pose@1"): 1, (2, "pose@2"): 2}.items():
        np.testing.assert_allclose(expected[pair].expected, 1.0, rtol=1e-9)
        np.testing.assert_allclose(expected[pair].expected_nis, readings, rtol=1e-9)
        assert 0.5 * readings < expected[pair].nis < 2.0 * readings
    text = format_consistency(found)
    assert "pose@3" in text
    assert "all blocks together" in text


def test_nis_under_clocks_is_that_of_samples(tmp_path):
    """Of a node alone by a plain Kalman filter; where P is exact its mean is that of chi-square."""
    lost = {"loss": {"kind": "bernoulli", "delivery": 0.0}}
    alone = load(CLOCKED, tmp_path, network__channel=lost)
    seen, run = replica_consistency(alone, 3, 2), netkf.simulate(alone, seed=3, replica=2)
    path = alone.sample_path(Streams(3, 2), 1, alone.placed_sensors[1][0])
    F, values, x, P = np.exp(-0.1), [], 0.0, 1.0
    for k in range(1, 12):
        x, P = F * x, F * P * F + 0.25 * (1.0 - np.exp(-0.2)) / 0.2
        y = path.reading(k - 1, run.x[k])[0][0]
        values.append((y - x) ** 2 / (P + 0.1))
        x, P = x + P / (P + 0.1) * (y - x), P * 0.1 / (P + 0.1)
    assert seen.nis[0] == pytest.approx(np.mean(values))
    assert seen.expected_nis[0] == pytest.approx(1.0)
    assert seen.nees.shape == (3,)
    filtering = {"kind": "central", "estimates": "own+neighbours"}
    late = {"network__channel": {"delay": {"kind": "constant", "seconds": 0.3}}}
    drawn = load(CLOCKED, tmp_path, filter=filtering, horizon=4.0, **late)
    # Two instants of an absolute reading and a relative one for each with a relative one alone.
    blocks = {(b.node, b.block): k for k, b in enumerate(judged_blocks(drawn))}
    found = replica_consistency(drawn, 3, 2)
    assert found.expected_nis[blocks[0, "pose@1"]] == pytest.approx((3 * 2 + 4) / 7)
    assert found.expected_nis[blocks[1, "pose@1"]] == pytest.approx(1.0)
    own = load(CLOCKED, tmp_path, filter__estimates="own+neighbours", horizon=4.0, **late)
    found = replica_consistency(own, 3, 2)
    assert np.isfinite(found.nis[blocks[2, "pose@3"]])
    assert found.expected_nis[blocks[2, "pose@3"]] <= 1.0 + 1e-9


def test_nodes_with_wrong_clocks_have_nis_of_what_they_predict(tmp_path):
    """Readings are a second apart by the clock of node 1, and so are its predictions."""
    lost = {"loss": {"kind": "bernoulli", "delivery": 0.0}}
    clocks = [{"nodes": [1], "drift": 0.25}]
    alone = load(CLOCKED, tmp_path, network__channel=lost, network__clocks=clocks)
    times = np.arange(1, 15) / 1.25
    seen = replica_consistency(alone, 3, 2)
    run = netkf.simulate(alone.replace({"probe": times.tolist()}), seed=3, replica=2)
    path = alone.sample_path(Streams(3, 2), 1, alone.placed_sensors[1][0])
    F, values, x, P = np.exp(-0.1), [], 0.0, 1.0
    for k in range(14):
        x, P = F * x, F * P * F + 0.25 * (1.0 - np.exp(-0.2)) / 0.2
        y = path.reading(k, run.x[k])[0][0]
        values.append((y - x) ** 2 / (P + 0.1))
        x, P = x + P / (P + 0.1) * (y - x), P * 0.1 / (P + 0.1)
    assert seen.nis[0] == pytest.approx(np.mean(values))
    # Errors hold the state, of which no covariance is known.
    assert np.isnan(seen.expected_nis[0])
    assert np.isfinite(seen.nis[1:]).all() == np.isfinite(seen.expected_nis[1:]).all()


def test_nodes_that_sample_at_times_of_their_own_have_innovations_each(ring, monkeypatch):
    """As many as nodes that sample together, and fewer where the network is large: that of 1000
    nodes was refused, as if its user had asked for too many probe times.
    """
    sampling = {"kind": "poisson", "rate": 1.0}
    sensors = [{"nodes": list(range(6)), "H": [[1.0, 0.0]], "R": [[0.2]], "sampling": sampling}]
    scenario = ring.replace({"sensors": sensors, "horizon": 8.0})
    run = netkf.simulate(scenario, seed=3)
    for most, count in ((innovations.MAX_ENTRIES, 8.0), (6 * 6 * 4 * 2 * 3, 3.0), (1, 0.0)):
        monkeypatch.setattr(innovations, "MAX_ENTRIES", most)
        found = ClockedInnovations(scenario, run.log, Streams(3, 0))
        found.run, found.sigma = netkf.simulate(scenario.replace({"probe": found.times}), 3), None
        numbers = [
            len(list(found.of_block(block, np.zeros(len(found.times), dtype=bool))))
            for block in judged_blocks(scenario)
        ]
        assert np.mean(numbers) == pytest.approx(count, rel=0.35)
        assert np.isfinite(replica_consistency(scenario, 3, 0).nis).all() == (count > 0.0)


def test_runs_in_which_a_node_reads_nothing_do_not_hide_its_innovations(ring):
    sampling = {"kind": "poisson", "rate": 0.4}
    sensors = [{"nodes": [0, 1, 2], "H": [[1.0, 0.0]], "R": [[0.2]], "sampling": sampling}]
    scenario = ring.replace({"sensors": sensors, "filter": {"kind": "local"}, "horizon": 5.0})
    runs = [replica_consistency(scenario, 1, replica) for replica in range(20)]
    assert np.isnan([run.nis[:3] for run in runs]).any()
    found = judge_consistency(scenario, runs, 0.99)
    assert np.isfinite(found.table["nis"][:3]).all()
    assert np.isnan(found.table["nis"][3:]).all()


def test_runs_of_one_sample_at_time_0_say_so(ring):
    found = netkf.consistency(ring.replace({"probe": [0.0]}), runs=10, workers=1)
    assert set(found.table["verdict"]) == {"no NEES: no sample after time 0"}


def test_messages_of_few_bits_leave_nis_to_be_judged():
    """Predictions are those of the trace: their NIS follows from errors, P and readings."""
    few = netkf.load(
        GOSSIP, {"horizon": 40.0, "probe": 1.0, "network.quantise": {"bits": 5, "range": 8.0}}
    )
    found, run = replica_consistency(few, 3, 0), netkf.simulate(few, 3)
    path = few.slot_path(Streams(3, 0), 0, few.placed_sensors[0][0])
    R, values = few.noise_covariance(few.placed_sensors[0][0].entry, believed=True), []
    for k in range(1, len(run.times)):
        H, P = path.matrix(k), run.P[k, 0]
        e = path.reading(k, run.x[k]) - H @ run.xhat[k, 0]
        values.append(e @ np.linalg.solve(H @ P @ H.T + R, e))
    assert found.nis[0] == pytest.approx(np.mean(values))
    assert np.isnan(found.expected_nis[0])
