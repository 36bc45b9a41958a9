"""Small results of every kind, simulated once: what figures have to cope with."""

import networkx as nx
import pytest

import netkf
from netkf.ensembles.pools import PoolOptions
from netkf.runs.run import run_to_directory
from netkf.studies.sweep import plan_sweep, sweep_to_directory
from tests.conftest import SCENARIOS

RING = SCENARIOS / "poisson_ring.toml"


def interrupt_after(seconds):
    """Return a progress function that stops a run."""

    def progress(time):
        if time > seconds:
            raise KeyboardInterrupt

    return progress


def one_node():
    """A node that samples a scalar plant and talks to nobody."""
    parts = netkf.parts
    return netkf.Scenario(
        name="one node, with $markup$ in its name",
        horizon=20.0,
        probe=0.5,
        plant=parts.Diffusion(A=[[-0.5]], B=[[1.0]], cov=[[1.0]]),
        sensors=[
            parts.LinearSensor([0], H=[[1.0]], R=[[0.5]], sampling=parts.Poisson(rate=5.0)),
        ],
        network=netkf.Network(graph=parts.Edges(edges=[], nodes=1)),
        filter=netkf.Filtering(parts.Local()),
    )


NAMES = (
    "$\\frac$",
    "<b>x</b>",
    "a, b",
    "a node whose name goes " + "on and on " * 9,
    "Zo\u00eb",
    "=1",
)


def named_nodes():
    """A path of nodes whose names are no formulas, no markup, and too long for any axis."""
    changes = {
        "horizon": 4.0,
        "network.graph": nx.path_graph(len(NAMES)),
        "network.activation.at": "nodes",
        "network.channel.symmetric": False,
        "sensors.0.nodes": [NAMES[0], NAMES[3]],
        "plant.states": ["$\\frac$", "x_{"],
        "plant.units": ["$m$", "$m$"],
    }
    changes["network.graph"] = nx.relabel_nodes(changes["network.graph"], dict(enumerate(NAMES)))
    return netkf.load(RING, changes)


def make(kind, folder):
    """Return the result of a kind; some are read back from ``folder``."""
    if kind == "ring":
        return netkf.simulate(netkf.load(RING, {"horizon": 10.0}))
    if kind == "ensemble":
        return netkf.monte_carlo(netkf.load(RING, {"horizon": 5.0}), 12, workers=1)
    if kind == "one node":
        return netkf.simulate(one_node(), engine="simpy")  # no loop compiled for this alone
    if kind == "no truth":
        return netkf.simulate(netkf.load(SCENARIOS / "ulb_library.toml", {"horizon": 1200.0}))
    if kind == "no samples":
        run_to_directory(netkf.load(RING, {"horizon": 1.0}), folder / "none", trace="none")
        return netkf.open(folder / "none")
    if kind == "interrupted":
        scenario = netkf.load(RING, {"horizon": 10.0})
        with pytest.raises(KeyboardInterrupt):
            run_to_directory(
                scenario, folder / "stopped", engine="simpy", progress=interrupt_after(5.0)
            )
        return netkf.open(folder / "stopped")
    if kind == "diverged":
        changes = {"horizon": 1100.0, "probe": 10.0, "plant.F": [[0.0, -2.0], [2.0, 0.0]]}
        scenario = netkf.load(SCENARIOS / "gossip_periodic.toml", changes)
        return netkf.simulate(scenario)
    if kind == "names":
        return netkf.simulate(named_nodes(), engine="simpy")
    assert kind == "slots"
    return netkf.simulate(netkf.load(SCENARIOS / "intermittent_scalar.toml"))


KINDS = (
    "ring", "ensemble", "one node", "no truth", "no samples", "interrupted", "diverged", "slots",
    "names",
)  # fmt: skip


@pytest.fixture(scope="session")
def results(tmp_path_factory):
    """Return a function from a kind to its result, which is made once."""
    folder, made = tmp_path_factory.mktemp("results"), {}

    def result(kind):
        if kind not in made:
            made[kind] = make(kind, folder)
        return made[kind]

    return result


@pytest.fixture(scope="session")
def sweeps(tmp_path_factory):
    """Return sweeps over one key, over two, and over a key of parts."""
    folder = tmp_path_factory.mktemp("sweeps")
    scenario = netkf.load(RING, {"horizon": 2.0})
    rates = {"network.activation.rate": [0.5, 2.0, 20.0]}
    grids = {
        "one": rates,
        "two": {**rates, "filter.epsilon": [0.1, 0.5]},
        "parts": {"filter": [{"kind": "local"}, {"kind": "central"}]},
    }
    for name, grid in grids.items():
        sweep_to_directory(plan_sweep(scenario, grid, 2), folder / name, PoolOptions(1))
    return {name: netkf.open(folder / name) for name in grids}
