"""What the diffusion filter, directed graphs and regressors ask of a scenario, and assumptions."""

import numpy as np
import pytest

import netkf
from netkf import theory
from netkf.scenario.reading import from_table, load
from netkf.scenario.writing import resolve_defaults, to_toml
from netkf.theory.diffusion.assumptions import sparse_weights
from tests.conftest import SCENARIOS

I3 = np.eye(3).tolist()
CONTINUOUS = {"kind": "diffusion", "A": [[-1.0]], "B": [[1.0]], "cov": [[1.0]]}


@pytest.fixture(scope="module")
def regression():
    return netkf.load(SCENARIOS / "diffusion_regression.toml").replace(
        {"horizon": 30.0, "probe": 1}
    )


def refused(change, key, fragment):
    return pytest.param(change, key, fragment, id=f"{next(iter(change))}-{fragment[:24]}")


REFUSALS = [
    refused({"filter.weights": [[1.0]]}, "filter.weights", "must be 3 x 3, not 1 x 1"),
    refused({"filter.weights": [[0.5, 0.5]]}, "filter.weights", "square matrix, not 1 x 2"),
    refused({"filter.weights": "best"}, "filter.weights", 'must be one of "metropolis"'),
    refused({"filter.weights": 0.5}, "filter.weights", "got 0.5"),
    refused({"filter.weights": [[0.5, 0, 0], [0, 1, 0], [0, 0, 1]]}, "filter.weights", "column 0"),
    refused(
        {"filter.weights": [[1.5, 0, 0], [-0.5, 1, 0], [0, 0, 1]]},
        "filter.weights[1][0]",
        "must not be negative; got -0.5",
    ),
    refused(
        {"filter.weights": [[0.5, 0, 0], [0.5, 1, 0], [0, 0, 1]]},
        "filter.weights[1][0]",
        "no link goes from node 1 to node 0; got 0.5",
    ),
    refused({"filter.on_loss": "ignore"}, "filter.on_loss", 'one of "renormalise", "keep-own"'),
    refused({"filter.gain": 1.0}, "filter.gain", "is not a key here"),
    refused({"filter.model.Q": [[0.1]]}, "filter.model.Q", "must be 3 x 3"),
    refused({"filter.model.R": [[0.1, 0], [0, 0.1]]}, "filter.model.R", "must be 1 x 1, not 2 x 2"),
    refused(
        {"filter.model.Q": np.zeros((3, 3)).tolist(), "filter.cov": np.zeros((3, 3)).tolist()},
        "filter.cov",
        "must be positive definite for the diffusion filter",
    ),
    refused({"sensors.0.A": [[0.5, 0.0]]}, "sensors[0].A", "square matrix, not 1 x 2"),
    refused({"sensors.0.A": [[0.5]]}, "sensors[0].B", "must be 1 x any, not 3 x 1"),
    refused({"sensors.0.B": [[1.0], [0.0]]}, "sensors[0].B", "must be 3 x any, not 2 x 1"),
    refused({"sensors.0.B": [1.0, 0.0, 0.0]}, "sensors[0].B", "must be a matrix"),
    refused({"sensors.1.C": [[1.0, 0.0, 0.0]]}, "sensors[1].C", "must be 3 x 3, not 1 x 3"),
    refused({"sensors.2.start": [1.0]}, "sensors[2].start", "must be 3, not 1"),
    refused({"sensors.0.xi_cov": I3}, "sensors[0].xi_cov", "must be 1 x 1, not 3 x 3"),
    refused({"sensors.0.xi_cov": [[-1.0]]}, "sensors[0].xi_cov", "positive semidefinite"),
    refused({"sensors.0.R": [[0.1, 0], [0, 0.1]]}, "sensors[0].R", "must be 1 x 1, not 2 x 2"),
    refused({"sensors.0.R": [[0.0]]}, "sensors[0].R", "positive definite"),
    refused({"sensors.0.H": [[1.0, 0.0, 0.0]]}, "sensors[0].H", "is not a key here"),
    refused(
        {
            "filter": {"kind": "gossip"},
            "network.activation": {"kind": "matching", "protocol": "maximal"},
        },
        "network.graph.directed",
        "must be false for the gossip filter",
    ),
    refused(
        {"filter": {"kind": "push-sum", "gamma": 1, "delta": 9.0}},
        "network.graph.directed",
        "must be false for the push-sum filter",
    ),
    refused(
        {"network.activation": {"kind": "matching", "protocol": "maximal"}},
        "network.activation.kind",
        "must be a broadcast for the diffusion filter",
    ),
    refused(
        {"network.activation": {"kind": "poisson", "rate": 1.0}},
        "network.activation.kind",
        "continuous",
    ),
    refused(
        {"network.activation.phase": 1.0}, "network.activation.phase", "room within the period"
    ),
]


@pytest.mark.parametrize(("change", "key", "fragment"), REFUSALS)
def test_refusals(regression, change, key, fragment):
    with pytest.raises(netkf.ScenarioError) as caught:
        regression.replace(change)
    assert caught.value.key == key
    assert fragment in str(caught.value)
    assert caught.value.remedy
    assert len(str(caught.value).splitlines()) == 1


def test_regressors_and_diffusion_belong_to_slots(build):
    sensor = {
        "kind": "regressor",
        "nodes": [0],
        "A": [[0.5]],
        "B": [[1.0]],
        "C": [[1.0]],
        "start": [1.0],
        "xi_cov": [[1.0]],
        "R": [[1.0]],
    }
    with pytest.raises(
        netkf.ScenarioError, match=r"sensors\[0\]\.kind: belongs to plants in slots"
    ):
        build(plant=CONTINUOUS, sensors=[sensor])
    with pytest.raises(netkf.ScenarioError, match=r"activation\.at: must be one that"):
        build(plant=CONTINUOUS, filter={"kind": "diffusion"})
    with pytest.raises(netkf.ScenarioError, match=r"filter\.kind: belongs to plants in continuous"):
        netkf.load(
            SCENARIOS / "diffusion_regression.toml",
            {"filter": {"kind": "covariance-intersection", "epsilon": 0.1}},
        )


@pytest.mark.parametrize(
    ("header", "rows", "words"),
    [
        ("t,node,y0", ["0.0,0,1.0"], "H: is missing"),
        (
            "t,node,y0,phi0,phi2",
            ["0.0,0,1.0,1.0,1.0"],
            "must have the columns t, node, y0, phi0, phi1",
        ),
        ("t,node,y0,phi0", ["0.0,0,1.0,1.0"], "H: must be any x 3, not 1 x 1"),
        (
            "t,node,y0,phi0,phi1,phi2",
            ["0.0,0,1.0,1.0,1.0,"],
            "line 2: phi2 must be a finite number",
        ),
    ],
)
def test_recorded_regressors_are_checked(regression, tmp_path, header, rows, words):
    (tmp_path / "seen.csv").write_text("\n".join([header, *rows]) + "\n")
    table = resolve_defaults(regression)
    table["sensors"] = [{"kind": "recorded", "path": "seen.csv", "R": [[0.1]]}]
    with pytest.raises(netkf.ScenarioError) as caught:
        from_table(table, tmp_path)
    assert words in str(caught.value)


def test_written_out_it_gives_the_same_run(regression, tmp_path):
    file = tmp_path / "again.toml"
    file.write_text(to_toml(resolve_defaults(regression)))
    again = load(file)
    assert netkf.simulate(again).fingerprint == netkf.simulate(regression).fingerprint
    np.testing.assert_array_equal(netkf.simulate(again).xhat, netkf.simulate(regression).xhat)


def test_metropolis_weights(regression):
    """1 / (1 + the larger number of incoming links), the rest for oneself; balanced both ways."""
    edges = [[0, 1], [1, 2], [2, 0], [0, 2]]
    changes = {"filter.weights": "metropolis", "network.graph.edges": edges}
    directed = sparse_weights(regression.replace(changes)).toarray()
    expected = [[2 / 3, 1 / 2, 1 / 3], [0.0, 1 / 2, 1 / 3], [1 / 3, 0.0, 1 / 3]]
    np.testing.assert_allclose(directed, expected, rtol=1e-15)
    both = sparse_weights(regression.replace(changes | {"network.graph.directed": False})).toarray()
    np.testing.assert_allclose(both.sum(axis=0), 1.0)
    np.testing.assert_allclose(both.sum(axis=1), 1.0)


def held(scenario):
    table = theory.assumptions(scenario)
    return {row.assumption.split(":")[0]: (row.holds, row.evidence) for row in table.itertuples()}


@pytest.mark.slow
def test_assumptions_of_section_vi_hold_and_their_breaking_is_seen(regression):
    whole = held(regression)
    assert [name for name, (holds, _) in whole.items() if not holds] == [
        "P_i(0) >= E[(x(0) - xhat_i(0))(x(0) - xhat_i(0))']"
    ]
    assert "diameter 2" in whole["the digraph is strongly connected"][1]
    alone = held(regression.replace({"filter.weights": I3}))
    assert not alone["the digraph is strongly connected"][0]
    lopsided = [[0.5, 0.5, 0.0], [0.0, 0.5, 0.9], [0.5, 0.0, 0.1]]
    table = held(regression.replace({"filter.weights": lopsided}))
    assert not table["the weights are balanced (rows and columns sum to 1)"][0]
    assert table["the digraph is strongly connected"][0]
    shift = [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]
    table = held(regression.replace({"filter.weights": shift}))
    assert "positive own weights" in table["the digraph is strongly connected"][1]
    lossy = {"network.channel": {"loss": {"kind": "bernoulli", "delivery": 0.5}}}
    assert not held(regression.replace(lossy))["every message arrives"][0]
    blind = regression.replace({"sensors.2.C": np.zeros((3, 3)).tolist()})
    assert not held(blind)["the sensors together excite every direction (sufficient)"][0]
    turning = regression.replace({"plant.F": (0.9 * np.eye(3)).tolist()})
    assert not held(turning)["the parameter is a random walk"][0]


def test_a_message_that_takes_its_whole_phase_arrives(regression):
    length = regression.phase_length
    late = regression.replace({"network.channel.delay": {"kind": "constant", "seconds": length}})
    log = netkf.simulate(late.replace({"horizon": 20.0})).events
    assert held(late)["every message arrives"][0]
    assert (log.kind == "deliver").sum() == (log.kind == "send").sum() > 0
    longer = {"network.channel.delay": {"kind": "constant", "seconds": 1.1 * length}}
    assert not held(regression.replace(longer))["every message arrives"][0]
