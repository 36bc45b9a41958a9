"""What is recorded of runs: whatever is wrong is a broken row, and healthy runs have none."""

import dataclasses

import numpy as np
import pytest

import netkf
from netkf.algorithms.diffusion import DiffusionFilter
from netkf.algorithms.traits import Weights
from netkf.checks import check as checking
from netkf.checks.check import check, with_check_times
from netkf.checks.evidence import BROKEN, NOT_PROMISED
from netkf.checks.parts.noises import reading_labels, reading_noises, sensor_laws
from netkf.checks.records import rows
from netkf.checks.records.events import event_fault
from netkf.checks.records.rows import files_fault
from netkf.checks.records.states import (
    sample_fault,
    start_fault,
    twin_fault,
    weight_fault,
    with_start,
)
from netkf.checks.storage import load_verdict, save_verdict
from netkf.core.errors import ScenarioError
from netkf.engines.base import Rank
from netkf.engines.compiled.engine import CompiledEngine
from netkf.engines.simpy import clocks, nodes, sensors, transmission
from netkf.engines.simpy import engine as processes
from netkf.laws.noise import compare_variances
from netkf.rng.streams import Streams
from netkf.runs import outcomes, stored, summary
from netkf.runs import run as run_files
from netkf.runs.parquet_files import ParquetSink
from netkf.scenario.derived import DerivedScenario
from netkf.scenario.reading import from_table
from netkf.trace.schema import CODES
from tests.checks.healthy import draw_scenario
from tests.checks.test_check import DIFFUSION, GOSSIP, RING
from tests.conftest import SCENARIOS
from tests.engines.drawn import FILTERS, LITERATURE, drawn_scenario

TICKING = {"kind": "periodic", "period": 0.4, "phase": 0.1}
SAMPLED = {"nodes": [0, 2], "H": [[1.0, 0.0]], "R": [[0.25]]}
WEIGHTS = [[0.5, 0.3, 0.2], [0.2, 0.5, 0.3], [0.3, 0.2, 0.5]]
TABLES = {
    "ring": RING,
    "gossip": GOSSIP,
    "diffusion": DIFFUSION,
    # Samples, ticks, arrivals and absorptions at one instant.
    "coincident": {
        **RING,
        "sensors": [{**SAMPLED, "sampling": {"kind": "periodic", "period": 0.2}}],
        "network": {
            **RING["network"],
            "activation": {"kind": "periodic", "period": 0.4},
            "channel": {"delay": {"kind": "constant", "seconds": 0.4}},
        },
    },
}


def scenario_of(name, folder):
    return with_check_times(from_table(TABLES[name], folder))


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Scenarios with one healthy run each, by name."""
    folder = tmp_path_factory.mktemp("records")
    made = {name: scenario_of(name, folder) for name in TABLES}
    return {name: (one, netkf.simulate(one, seed=3, replica=2)) for name, one in made.items()}


def with_log(run, log):
    return dataclasses.replace(run, log=log)


def rows_of(log, kind):
    return np.flatnonzero(log["kind"] == CODES[kind])


def without(log, kind):
    return np.delete(log, rows_of(log, kind)[-1])


def twice(log, kind):
    row = rows_of(log, kind)[1]
    return np.insert(log, row, log[row])


def exchanged(log, kind):
    """With the first event of another kind at the instant of one of this kind before it."""
    for row in rows_of(log, kind):
        if row and log["t"][row - 1] == log["t"][row] and log["kind"][row - 1] != CODES[kind]:
            changed = log.copy()
            changed[[row - 1, row]] = changed[[row, row - 1]]
            return changed
    raise AssertionError(f"no {kind} shares its instant")


def counted_from_one(log, kind):
    changed = log.copy()
    changed["message"][changed["message"] >= 0] += 1
    return changed


def settled(log, kind):
    """With a message that says another end than it had."""
    changed = log.copy()
    changed["kind"][rows_of(log, "deliver")[-1]] = CODES[kind]
    return changed


def before_it_was_sent(log, kind):
    """With all rows of a kind first among those of their instants."""
    return log[np.lexsort((log["kind"] != CODES[kind], log["t"]))]


def moved(log, kind):
    changed = log.copy()
    changed["t"][rows_of(log, kind)[-1] :] += 1e-4
    return changed


LOGS = [
    *(
        (name, without, kind)
        for name in ("ring", "coincident")
        for kind in ("sense", "tick", "send")
    ),
    *(("ring", change, kind) for change in (without, twice) for kind in ("deliver", "absorb")),
    *(
        ("gossip", change, kind)
        for change in (without, twice)
        for kind in ("sense", "tick", "swap")
    ),
    *(("diffusion", change, kind) for change in (without, twice) for kind in ("round", "absorb")),
    ("ring", twice, "sense"),
    ("ring", twice, "lost"),
    ("diffusion", without, "send"),
    ("coincident", exchanged, "tick"),
    ("coincident", exchanged, "deliver"),
    ("coincident", exchanged, "absorb"),
    *((name, counted_from_one, "") for name in TABLES),
    *((name, settled, "lost") for name in ("ring", "diffusion", "coincident")),
    ("ring", settled, "late"),
    *((name, before_it_was_sent, "deliver") for name in TABLES),
    ("ring", before_it_was_sent, "lost"),
    ("ring", moved, "tick"),
    ("ring", moved, "sense"),
]


@pytest.mark.parametrize(("name", "change", "kind"), LOGS)
def test_a_log_with_one_fault_is_not_taken_for_whole(name, change, kind, runs):
    scenario, run = runs[name]
    assert event_fault(scenario, run) == ""
    assert event_fault(scenario, with_log(run, change(run.log, kind)))


@pytest.mark.parametrize("cause", ["gate", "quantise"])
def test_refused_readings_and_clipped_messages_stand_anywhere_in_an_instant(runs, cause):
    scenario, _ = runs["ring"]
    sensor = {"nodes": [0, 3], "H": [[1.0, 0.0]], "R": [[0.25]]}
    sensor["sampling"] = {"kind": "periodic", "period": 0.5}
    table = {"probability": 0.05} if cause == "gate" else {"bits": 4, "range": 0.1}
    key = {"gate": "filter.gate", "quantise": "network.quantise"}[cause]
    scenario = scenario.replace({"sensors": [sensor], key: table})
    run = netkf.simulate(scenario, seed=3, engine="simpy")
    assert (run.events.kind == ("refuse" if cause == "gate" else "clip")).sum() > 5
    assert event_fault(scenario, run) == ""


def test_events_of_another_run_are_not_those_of_this_one(runs):
    scenario, _ = runs["ring"]
    other = netkf.simulate(scenario, seed=3, replica=4)
    assert event_fault(scenario, dataclasses.replace(other, replica=2))
    assert sample_fault(scenario, other, 3, 2)
    assert sample_fault(scenario, dataclasses.replace(other, replica=2), 3, 2)


SAMPLES = {
    "x and xhat shifted": lambda run: {"x": run.x + 1.0, "xhat": run.xhat + 1.0},
    "states permuted": lambda run: {"x": run.x[:, ::-1], "xhat": run.xhat[..., ::-1]},
    "nodes permuted": lambda run: {"xhat": np.roll(run.xhat, 1, axis=1)},
    "x late": lambda run: {"x": np.roll(run.x, 1, axis=0)},
    "times late": lambda run: {"times": run.times + 0.01},
    "a sample missing": lambda run: {
        name: getattr(run, name)[1:] for name in ("times", "x", "xhat", "P", "error")
    },
    "status": lambda run: {"status": "diverged"},
}


@pytest.mark.parametrize("name", ["ring", "gossip"])
@pytest.mark.parametrize("change", SAMPLES)
def test_samples_with_one_fault_are_not_taken_for_whole(name, change, runs):
    scenario, run = runs[name]
    assert sample_fault(scenario, run, 3, 2) == ""
    wrong = dataclasses.replace(run, **SAMPLES[change](run))
    assert sample_fault(scenario, wrong, 3, 2)


def test_starts_and_weights_are_those_of_the_file(tmp_path, monkeypatch):
    filtering = {"kind": "diffusion", "weights": WEIGHTS}
    network = {**DIFFUSION["network"], "graph": {"kind": "cycle", "nodes": 3}}
    scenario = from_table({**DIFFUSION, "network": network, "filter": filtering}, tmp_path)
    begun = with_start(scenario, 4.0)
    run = netkf.simulate(begun)
    assert start_fault(begun, run) == ""
    for name, factor in (("P", 1.01), ("xhat", 1.01)):
        wrong = getattr(run, name).copy()
        wrong[0, 1] = factor * wrong[0, 1] + 0.01
        assert "node 1 at time 0" in start_fault(begun, dataclasses.replace(run, **{name: wrong}))
    transposed = property(lambda self: Weights(matrix=self.weights.T))
    monkeypatch.setattr(DiffusionFilter, "link_weights", transposed)
    assert weight_fault(scenario) == "node 1 gives node 0 the weight 0.2, not 0.3"


RANKS = {
    "probes before absorptions": {"PROBE": 4, "ABSORB": 6},
    "ticks before samples": {"TICK": 1, "SENSE": 2, "UPDATE": 3},
    "arrivals before ticks": {"DELIVER": 3, "TICK": 4},
}


def test_networks_too_large_for_simpy_are_not_run_there(runs, monkeypatch):
    scenario, run = runs["gossip"]
    monkeypatch.setattr(rows, "MAX_TWIN_EVENTS", 10)
    monkeypatch.setattr(rows, "SimpyEngine", None)
    audit = rows.audit_run(scenario, dataclasses.replace(run, replica=0), 3, 0, CompiledEngine())
    assert audit.engines.startswith(f"{rows.UNKNOWN}3 slots have ")


@pytest.mark.parametrize("change", RANKS)
def test_another_order_in_one_engine_is_found_by_the_other(change, tmp_path, monkeypatch):
    scenario = scenario_of("coincident", tmp_path)
    scenario = with_start(scenario, 2.0, netkf.simulate(scenario).log)
    run = netkf.simulate(scenario, engine="compiled")
    assert twin_fault(scenario, run, netkf.simulate(scenario, engine="simpy")) == ""
    ranks = {rank.name: int(rank) for rank in Rank} | RANKS[change]
    for module in (nodes, clocks, transmission, sensors, processes):
        monkeypatch.setattr(module, "Rank", type("Ranks", (), ranks))
    assert twin_fault(scenario, run, netkf.simulate(scenario, engine="simpy"))


def changed_entry(part, name, change):
    """``summarise`` with one entry changed in one part: messages, overall, or each of nodes."""

    def altered(*arguments):
        made = summary.summarise(*arguments)
        for row in made[part] if part == "nodes" else [made[part]]:
            row[name] = change(row[name])
        return made

    return altered


SUMMARIES = [
    *(("messages", name) for name in ("sent", "delivered", "lost", "transmissions", "in_flight")),
    *(("nodes", name) for name in ("sent", "transmissions", "rms_error", "mean_trace")),
    *(("overall", name) for name in ("rms_error", "mean_trace", "mean_nees", "ratio")),
]


@pytest.mark.one_in(3)
@pytest.mark.parametrize(("part", "name"), SUMMARIES)
def test_a_wrong_number_in_the_summary_is_found(part, name, runs, monkeypatch):
    scenario, run = runs["ring"]
    monkeypatch.setattr(run_files, "summarise", changed_entry(part, name, lambda v: v + 1))
    assert f"summary.json: {'messages.' if part == 'messages' else ''}{name}" in files_fault(
        scenario, run, CompiledEngine()
    )


def patched(monkeypatch, owner, name, change):
    real = getattr(owner, name)
    monkeypatch.setattr(owner, name, lambda *arguments: change(real, *arguments))


FILES = {
    "rows missing": (ParquetSink, "events", lambda real, sink, rows: real(sink, rows[:-1])),
    "x": (ParquetSink, "states", lambda real, sink, t, x, *rest: real(sink, t, x + 1.0, *rest)),
    "nodes": (
        ParquetSink,
        "states",
        lambda real, sink, t, x, xhat, P, e: real(sink, t, x, xhat, P[:, ::-1], e),
    ),
    "squares": (
        ParquetSink,
        "states",
        lambda real, sink, t, x, xhat, P, e: real(sink, t, x, xhat, P, 1.1 * e),
    ),
    "reading": (stored, "_read_events", lambda real, *arguments: real(*arguments)[1:]),
    "transmissions": (
        outcomes.Transmissions,
        "transmissions",
        lambda real, self, nodes: [count + 1 for count in real(self, nodes)],
    ),
    "averages": (
        summary,
        "select_averaged_samples",
        lambda real, t, *_: summary.SampleIndices(np.arange(1, len(t)), np.arange(1, len(t))),
    ),
}


@pytest.mark.one_in(3)
@pytest.mark.parametrize("change", FILES)
def test_files_that_are_not_the_run_are_found(change, runs, monkeypatch):
    scenario, run = runs["ring"]
    patched(monkeypatch, *FILES[change])
    assert files_fault(scenario, run, CompiledEngine())


def test_healthy_files_hold_the_run(runs):
    for scenario, run in runs.values():
        assert files_fault(scenario, run, CompiledEngine()) == ""


@pytest.mark.one_in(2)
@pytest.mark.parametrize("seed", [0, 1, 7, 12])
def test_drawn_scenarios_are_recorded_without_a_fault(seed, tmp_path):
    """Every filter under every clock that it has, with all kinds of sensors, losses and delays."""
    for kinds in (FILTERS, LITERATURE):
        scenario = drawn_scenario(seed, tmp_path, (1, 2, 5), kinds)
        scenario = with_start(scenario, scenario.horizon)
        run = netkf.simulate(scenario, seed=seed)
        assert event_fault(scenario, run) == ""
        assert start_fault(scenario, run) == ""
        if scenario.is_random:
            assert sample_fault(scenario, run, seed, 0) == ""


@pytest.mark.parametrize("number", range(6))
def test_drawn_scenarios_in_slots_are_recorded_without_a_fault(number, tmp_path):
    scenario = with_check_times(draw_scenario(number, tmp_path))
    run = netkf.simulate(scenario, seed=number)
    assert event_fault(scenario, run) == ""
    assert sample_fault(scenario, run, number, 0) == ""


@pytest.mark.parametrize("name", ["recorded pairs", "nodes", "readings", "links", "directions"])
def test_networks_that_come_and_go_are_recorded_without_a_fault(name, tmp_path):
    """Pairs from a table, in slots; nodes that move out of range, by each kind of clock."""
    if name == "recorded pairs":
        (tmp_path / "pairs.csv").write_text("slot,node,peer\n1,0,1\n2,1,2\n5,0,2\n")
        network = {"activation": {"kind": "recorded", "path": "pairs.csv"}}
        table = {**GOSSIP, "network": GOSSIP["network"] | network}
    else:
        rows = ["t,node,x,y", *(f"0,{k},{k % 2},{k // 2}" for k in range(4)), "2,3,9,9", "3,3,1,1"]
        (tmp_path / "places.csv").write_text("\n".join(rows) + "\n")
        clock = {"kind": "poisson", "rate": 3.0, "at": name}
        network = {
            "graph": {"kind": "range", "nodes": 4, "radius": 1.2},
            "positions": "places.csv",
            "activation": {"kind": "readings"} if name == "readings" else clock,
        }
        sensors = [{**SAMPLED, "sampling": {"kind": "poisson", "rate": 3.0}}]
        weighted = {"kind": "covariance-intersection", "epsilon": 0.2}
        table = {**RING, "sensors": sensors, "network": network, "filter": weighted}
    scenario = with_check_times(from_table(table, tmp_path))
    run = netkf.simulate(scenario, seed=1)
    assert run.count("send")
    assert event_fault(scenario, run) == ""


def broken_rows(verdict):
    return [row.promise for row in verdict.rows if row.verdict == BROKEN]


def test_one_fault_of_the_record_is_one_broken_row(tmp_path, monkeypatch):
    """Through the whole check: it names the run, what was seen, and what was expected."""
    scenario = from_table(RING, tmp_path)

    def shifted(*arguments, **settings):
        run = real(*arguments, **settings)
        return dataclasses.replace(run, x=run.x + 1.0, xhat=run.xhat + 1.0)

    real = checking.simulate
    monkeypatch.setattr(checking, "simulate", shifted)
    verdict = check(scenario, 10, workers=1)
    assert broken_rows(verdict) == ["states are those that the plant draws, errors are x - xhat"]
    (row,) = [row for row in verdict.rows if row.verdict == BROKEN]
    assert (row.seen, row.expected, row.replica) == (10.0, 0.0, 0)
    assert "in run 0 x[0] at" in row.evidence


def test_events_that_contradict_each_other_are_a_verdict_and_no_traceback(tmp_path, monkeypatch):
    scenario = from_table(TABLES["coincident"], tmp_path)
    real = checking.simulate

    def doubled(*arguments, **settings):
        run = real(*arguments, **settings)
        return with_log(run, twice(run.log, "deliver"))

    monkeypatch.setattr(checking, "simulate", doubled)
    verdict = check(scenario, 12, workers=1)
    assert broken_rows(verdict) == ["events are recorded once, in order, with their numbers"]


def test_a_run_that_says_diverged_and_is_sound_is_no_evidence(tmp_path, monkeypatch):
    scenario = from_table(GOSSIP, tmp_path)
    real = checking.simulate
    monkeypatch.setattr(
        checking,
        "simulate",
        lambda *arguments: dataclasses.replace(real(*arguments), status="diverged"),
    )
    verdict = check(scenario, 10, workers=1)
    assert "states are those that the plant draws, errors are x - xhat" in broken_rows(verdict)


def test_only_the_first_runs_are_looked_at_and_only_one_is_done_again(runs):
    scenario, run = runs["ring"]
    engine = CompiledEngine()
    assert rows.audit_run(scenario, run, 3, rows.AUDITED_RUNS, engine).looked == (0, 0)
    assert rows.audit_run(scenario, run, 3, 2, engine).looked == (1, 0)
    first = netkf.simulate(scenario, seed=3)
    assert rows.audit_run(scenario, first, 3, 0, engine) == rows.Audit(looked=(1, 1))
    long = netkf.load(SCENARIOS / "gossip_ring.toml")
    short = rows._short_horizon(long, 8 * rows.TWIN_EVENTS)
    assert short == pytest.approx(long.horizon / 8.0, abs=long.slot_plant.period)
    assert rows._short_horizon(long, 10) == long.horizon


def test_audits_are_kept_beside_the_results(tmp_path):
    scenario = from_table(GOSSIP, tmp_path)
    verdict = check(scenario, 10, workers=1)
    folder = tmp_path / "out"
    folder.mkdir()
    save_verdict(folder, scenario, verdict)
    again = load_verdict(folder, scenario, verdict.seed)
    assert [result.audit for result in again.results] == [one.audit for one in verdict.results]
    more = check(scenario, 12, workers=1, earlier=again)
    promises = [row.promise for row in more.rows if row.source == "the record"]
    assert promises == [row.promise for row in verdict.rows if row.source == "the record"]


def test_results_that_are_read_back_wrongly_are_not_kept(tmp_path, monkeypatch):
    from netkf.checks import storage

    scenario = from_table(GOSSIP, tmp_path)
    verdict = check(scenario, 10, workers=1)
    folder = tmp_path / "out"
    folder.mkdir()
    patched(monkeypatch, storage, "_read_results", lambda real, *rest: real(*rest)[::-1])
    with pytest.raises(ScenarioError, match=r"results\.npz: reads back another"):
        save_verdict(folder, scenario, verdict)
    assert not (folder / "verdict.json").exists()


def test_readings_that_are_not_linear_leave_everything_else_to_judge(tmp_path):
    scenario = netkf.load(SCENARIOS / "nonlinear" / "range_tracking.toml")
    scenario = scenario.replace({"horizon": 5.0})
    verdict = check(scenario, 10, workers=1)
    assert verdict
    first = verdict.rows[0]
    assert first.verdict == NOT_PROMISED
    assert "readings are not linear" in first.assumptions
    promises = " ".join(row.promise for row in verdict.rows)
    for part in ("the plant's noise", "noises of the sensors", "messages are lost", "are recorded"):
        assert part in promises
    assert "both engines" in promises
    assert all(law.H is None for law in sensor_laws(with_check_times(scenario)))


def test_noise_of_readings_that_are_not_linear_is_held_to_their_covariance(tmp_path, monkeypatch):
    """Also of angles, which are not wrapped before they are compared."""
    from netkf.plants.nonlinear import NonlinearReadings

    scenario = netkf.load(SCENARIOS / "nonlinear" / "range_tracking.toml")
    scenario = with_check_times(scenario.replace({"horizon": 30.0}))

    def louder(real, self, slot, x):
        exact = np.asarray(self._sensor.h(x, self._node), dtype=np.float64)
        return exact + 2.0 * (real(self, slot, x) - exact)

    patched(monkeypatch, NonlinearReadings, "reading", louder)
    z = np.array([reading_noises(scenario, Streams(1, replica)).z for replica in range(40)])
    worst, _ = compare_variances(z, reading_labels(scenario), 0.01, "readings").worst
    assert worst.seen == pytest.approx(4.0, rel=0.2)


def test_initial_estimates_are_not_taken_from_the_method_that_engines_ask(tmp_path, monkeypatch):
    scenario = from_table(GOSSIP, tmp_path)
    patched(
        monkeypatch,
        DerivedScenario,
        "initial_estimate",
        lambda real, self, node: (real(self, node)[0] + 1.0, real(self, node)[1]),
    )
    begun = with_start(scenario, 4.0)
    assert "the estimate of node 0" in start_fault(begun, netkf.simulate(begun))
