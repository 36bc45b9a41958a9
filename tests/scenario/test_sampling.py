"""Sampled sensors, recorded and unknown states over a diffusion: files and the truth of runs."""

import numpy as np
import pytest

import netkf
from netkf.plants.paths import DiffusionPath
from netkf.plants.truth import RecordedTruth, SampledTruth
from netkf.rng.streams import Streams
from netkf.scenario import sampling
from netkf.scenario.reading import from_table
from netkf.scenario.writing import as_table, resolve_defaults

POISSON = {"kind": "poisson", "rate": 3.0}
SAMPLED = {"nodes": [0, 1], "H": [[1.0, 0.0]], "R": [[0.5]], "sampling": POISSON}
INCREMENTS = {"nodes": [1], "H": [[0.0, 1.0]], "R": [[0.4]]}
RECORDED = {"kind": "recorded", "path": "r.csv", "H": [[1.0, 0.0]], "R": [[0.5]]}
A, B = [[0.4, 1.0], [-1.0, 0.4]], [[0.0], [1.0]]
COV = [[1.0, 0.0], [0.0, 1.0]]


@pytest.fixture
def make(tmp_path):
    (tmp_path / "r.csv").write_text("t,node,y0\n0.35,0,1.0\n0.7,2,2.0\n0.5,0,3.0\n40.0,0,1.0\n")
    rows = [f"{t / 2},{t},{-t}" for t in range(41)]
    (tmp_path / "x.csv").write_text("t,x0,x1\n" + "\n".join(rows) + "\n")

    def build(sensors=(SAMPLED,), plant=None, **more):
        table = {
            "format": 1,
            "name": "sampled",
            "horizon": 20.0,
            "probe": 0.5,
            "seed": 4,
            "plant": {"kind": "diffusion", "A": A, "B": B, "cov": COV, **(plant or {})},
            "sensors": list(sensors),
            "network": {
                "graph": {"kind": "path", "nodes": 3},
                "activation": {"kind": "poisson", "rate": 1.0},
            },
            "filter": {"kind": "hybrid", "epsilon": 0.2},
            **more,
        }
        return from_table(table, tmp_path)

    return build


@pytest.mark.parametrize(
    "clock",
    [
        POISSON,
        {"kind": "periodic", "period": 0.5},
        {"kind": "periodic", "period": 0.5, "phase": "random", "jitter": 0.1},
        {"kind": "renewal", "distribution": "gamma", "shape": 2.0, "mean": 0.4},
        {"kind": "recorded", "path": "s.csv"},
    ],
)
def test_what_is_written_reads_as_the_same_scenario(clock, make, tmp_path):
    (tmp_path / "s.csv").write_text("t,node\n0.5,0\n0.7,1\n")
    scenario = make([{**SAMPLED, "sampling": clock}])
    for table in (as_table(scenario), resolve_defaults(scenario)):
        again = from_table(table, tmp_path)
        assert again.sensors == scenario.sensors
        times = [s.sample_times(Streams(1)) for s in (scenario, again)]
        assert times[0].keys() == {(0, 0), (1, 0)}
        for key, t in times[0].items():
            np.testing.assert_array_equal(times[1][key], t)
    written = as_table(scenario)["sensors"][0]["sampling"]
    assert {k: getattr(value, "name", value) for k, value in written.items()} == clock
    changed = scenario.replace({"sensors.0.sampling": {"kind": "poisson", "rate": 9.0}})
    assert changed.sensors[0].sampling.rate == 9.0


def test_models_hold_the_sensors_of_increments_only(make):
    mixed = make([SAMPLED, INCREMENTS])
    assert [len(model.H) for model in mixed.models] == [0, 1, 0]
    pooled = mixed.replace({"filter": {"kind": "central"}})
    assert len(pooled.model_pieces[0][0].H) == 1
    assert {n: [p.entry for p in places] for n, places in mixed.increment_sensors.items()} == {
        1: [1]
    }
    assert {n: [p.entry for p in places] for n, places in mixed.sampled_sensors.items()} == {
        0: [0],
        1: [0],
    }
    assert mixed.sensing_nodes == (0, 1)
    assert mixed.diffusion.sensing_period == make([INCREMENTS]).diffusion.sensing_period
    assert make().diffusion.sensing_period is None
    assert make([]).diffusion.sensing_period is not None
    assert make([INCREMENTS], {"sensing_period": 0.015625}).diffusion.sensing_period == 0.015625


def test_the_default_sensing_period_suits_each_node_and_not_only_all_together(make):
    """Of these two nodes the first needs shorter intervals than both together."""
    plant = {
        "A": [[0.8272, -0.2011, 0.0006462], [-0.2869, -0.6773, 0.004165], [-465.4, -63.02, -0.557]],
        "B": [[0.1524, 0.007792, 0.07837], [-0.6522, -0.4336, 0.3393], [-28.14, -2.822, 32.74]],
        "cov": np.eye(3).tolist(),
    }
    sensors = [
        {"nodes": [0], "H": [[6.978, -3.57, 0.0159]], "R": [[1.866]]},
        {"nodes": [1], "H": [[-0.5824, -1.487, -0.02464]], "R": [[0.5413]]},
    ]
    together = make(sensors, plant)
    alone = min(make([one], plant).diffusion.sensing_period for one in sensors)
    assert together.diffusion.sensing_period <= alone


def test_streams_of_samples_have_their_names(make):
    scenario, streams = make([SAMPLED, {**SAMPLED, "nodes": [1]}]), Streams(4)
    times = scenario.sample_times(streams)
    gaps = streams.generator("sampling", 1, 1).standard_exponential(20) / 3.0
    expected = scenario.time_grid.snap(np.add.accumulate(gaps))
    np.testing.assert_array_equal(times[1, 1][:20], expected)
    path = scenario.sample_path(streams, 1, scenario.sampled_sensors[1][1])
    noise = streams.generator("noise", 1, 1).standard_normal(2)
    y, H = path.reading(1, np.array([2.0, 3.0]))
    np.testing.assert_allclose(y, 2.0 + np.sqrt(0.5) * noise[1])
    np.testing.assert_array_equal(H, [[1.0, 0.0]])


@pytest.mark.parametrize(
    ("sensors", "kind"),
    [
        ([SAMPLED], SampledTruth),
        ([SAMPLED, INCREMENTS], DiffusionPath),
        ([INCREMENTS], DiffusionPath),
        ([RECORDED], SampledTruth),
        ([], DiffusionPath),
    ],
)
@pytest.mark.parametrize("frames", [False, True])
def test_the_truth_is_known_at_samples_and_probes(sensors, kind, frames, make):
    scenario = make(sensors)
    truth = scenario.continuous_truth(Streams(4), frames)
    assert isinstance(truth, kind)
    assert len(truth.frame_times) == (frames and 1)
    assert scenario.exact_errors == (sensors != [RECORDED])
    sampled = sampling.all_sample_times(scenario.sample_times(Streams(4)))
    plain = scenario.continuous_truth(Streams(4), frames=False)
    k = 0
    for t in np.union1d(sampled, scenario.times).tolist():
        if k < len(truth.frame_times) and t >= truth.frame_times[k]:
            truth.rebase(k)
            k += 1
        x = plain.absolute(t)
        # Cuts of the grid amplify what absolute states have lost to growth.
        np.testing.assert_allclose(truth.absolute(t), x, rtol=0, atol=1e-7 * (1 + np.abs(x).max()))


def test_network_and_probes_do_not_move_the_truth_at_samples(make):
    base = make([SAMPLED, INCREMENTS])
    for other in (
        make([SAMPLED, INCREMENTS], probe=0.3),
        make(
            [SAMPLED, INCREMENTS],
            network={
                "graph": {"kind": "path", "nodes": 3},
                "activation": {"kind": "poisson", "rate": 9.0},
            },
        ),
    ):
        paths = [s.continuous_truth(Streams(4), frames=False) for s in (base, other)]
        for t in sampling.all_sample_times(base.sample_times(Streams(4)))[:20]:
            np.testing.assert_array_equal(*(path.local(t) for path in paths))


def test_recorded_states_and_readings_over_a_diffusion(make):
    plant = {"kind": "recorded", "path": "x.csv"}
    scenario = make([RECORDED, {**SAMPLED, "sampling": {"kind": "periodic", "period": 0.5}}], plant)
    assert not scenario.is_random
    assert scenario.sensing_nodes == (0, 1, 2)
    truth = scenario.continuous_truth(Streams(4), frames=False)
    assert isinstance(truth, RecordedTruth)
    np.testing.assert_array_equal(truth.absolute(3.5), [7.0, -7.0])
    assert np.isnan(truth.local(0.35)).all()  # nobody needs it: that reading is recorded
    times = scenario.sample_times(Streams(4))
    np.testing.assert_array_equal(times[0, 0], [0.35, 0.5])
    np.testing.assert_array_equal(times[2, 0], [0.7])
    assert as_table(scenario)["plant"]["kind"] == "recorded"
    assert scenario.replace({"seed": 9}).plant == scenario.plant


def test_unknown_states_are_nan(make):
    scenario = make([RECORDED], {"kind": "unknown"})
    truth = scenario.continuous_truth(Streams(4), frames=False)
    local, absolute = truth.states(scenario.times)
    assert local.shape == (41, 2)
    assert np.isnan(local).all()
    assert np.isnan(absolute).all()
    assert not scenario.plant.truth_known
    assert as_table(scenario)["plant"]["kind"] == "unknown"


def test_nodes_without_readings_are_noted(make):
    scenario = make([{**RECORDED, "nodes": [0, 1]}])
    assert scenario.notes[-1] == "r.csv has no readings of node 1"


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"sensors": [{**SAMPLED, "sampling": "often"}]},
            'sensors[0].sampling: must be "continuous" or',
        ),
        (
            {"sensors": [{**SAMPLED, "sampling": {"kind": "matching"}}]},
            "sensors[0].sampling.kind: must be one of",
        ),
        (
            {"sensors": [{**SAMPLED, "sampling": {"kind": "poisson"}}]},
            "sensors[0].sampling.rate: is missing",
        ),
        (
            {"sensors": [{**SAMPLED, "sampling": {**POISSON, "rates": [[0, 1, 2.0]]}}]},
            "sampling.rates: belongs to",
        ),
        (
            {"sensors": [{**SAMPLED, "sampling": {**POISSON, "at": "nodes"}}]},
            "sampling.at: belongs to",
        ),
        (
            {"sensors": [{**SAMPLED, "sampling": {"kind": "poisson", "rate": 1e9}}]},
            "sensors[0].sampling: must take at most",
        ),
        ({"sensors": [{**SAMPLED, "sampling": {"kind": "recorded", "path": "r.csv"}}]}, None),
        (
            {"plant": {"kind": "recorded", "path": "x.csv"}},
            "plant.path: x.csv has no state for a sample of node 0, t = ",
        ),
        (
            {"plant": {"kind": "recorded", "path": "x.csv"}, "sensors": [RECORDED], "probe": 0.3},
            "x.csv has no state for the probe, t = 0.3",
        ),
        (
            {"plant": {"kind": "recorded", "path": "x.csv"}, "sensors": [INCREMENTS]},
            "sensors[0].sampling: must be a clock",
        ),
        ({"plant": {"kind": "unknown"}}, "sensors[0].kind: must be recorded"),
        (
            {"plant": {"kind": "unknown", "path": "x.csv"}, "sensors": [RECORDED]},
            "plant.path: is not a key here",
        ),
        (
            {"sensors": [{**RECORDED, "nodes": [9]}]},
            "sensors[0].nodes[0]: must be a node of the graph",
        ),
    ],
)
def test_mistakes_are_refused_in_one_line(changes, words, make):
    if words is None:
        make(**changes)
        return
    with pytest.raises(netkf.ScenarioError) as caught:
        make(**changes)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_recorded_samples_of_other_nodes_and_times_are_refused(make, tmp_path):
    (tmp_path / "s.csv").write_text("t,node\n0.5,7\n")
    sensor = {**SAMPLED, "sampling": {"kind": "recorded", "path": "s.csv"}}
    with pytest.raises(
        netkf.ScenarioError, match=r"s.csv names a node that the graph does not have"
    ):
        make([sensor])
    with (tmp_path / "r.csv").open("a") as file:
        file.write("-1.0,0,9.0\n")
    with pytest.raises(netkf.ScenarioError, match="at least 0") as caught:
        make([RECORDED])
    assert str(caught.value).startswith("sensors[0].path: ")
    with (tmp_path / "x.csv").open("a") as file:
        file.write("0.5,1.0,1.0\n")
    with pytest.raises(
        netkf.ScenarioError, match=r"x.csv lines \d+ and \d+: there may be one row a time"
    ):
        make([SAMPLED], {"kind": "recorded", "path": "x.csv"})


def test_sampling_is_for_continuous_time(make):
    plant = {"kind": "linear", "F": A, "Q": COV, "period": 1.0}
    table = {
        "plant": plant,
        "sensors": [SAMPLED],
        "filter": {"kind": "local"},
        "network": {"graph": {"kind": "path", "nodes": 3}},
    }
    base = make()
    with pytest.raises(
        netkf.ScenarioError, match=r"sensors\[0\].sampling: belongs to plants in cont"
    ):
        base.replace({"probe": 1.0, **table})
