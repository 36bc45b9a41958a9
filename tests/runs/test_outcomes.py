"""Matrices of delivery and shared fate, losses over time, and who was down."""

import numpy as np
import pandas as pd
import pytest

import netkf
from netkf.figures.catalogue import FigureSet
from netkf.runs.outcomes import (
    delivery_matrix,
    downtimes,
    fate_matrix,
    loss_windows,
    outcomes_of,
)
from netkf.trace.messages import join_messages

TOML = """
format = 1
name = "lossy"
horizon = {horizon}
probe = 5.0
[plant]
kind = "diffusion"
A = [[-1.0]]
B = [[1.0]]
[[sensors]]
nodes = [10, 11, 12]
H = [[1.0]]
R = [[1.0]]
sampling = {{ kind = "periodic", period = 1.0 }}
[network]
graph = {{ kind = "edges", edges = [[10, 11], [11, 12], [10, 12]] }}
activation = {{ kind = "periodic", period = 1.0, at = "nodes" }}
channel = {{ loss = {{ kind = "shared", delivery = 0.6, share = {share} }}, symmetric = false }}
[filter]
kind = "covariance-intersection"
epsilon = 0.2
cov = [[1.0]]
"""


def lossy(tmp_path, share=0.5, horizon=1500.0, more=""):
    file = tmp_path / "lossy.toml"
    file.write_text(TOML.format(share=share, horizon=horizon) + more)
    return netkf.load(file)


@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    return netkf.simulate(lossy(tmp_path_factory.mktemp("shared")), seed=3, engine="simpy")


def messages_by_pandas(run):
    events = run.events
    sent = events[events.kind == "send"].rename(columns={"node": "sender", "peer": "receiver"})
    heard = events[events.kind == "deliver"].rename(columns={"node": "receiver", "peer": "sender"})
    key = ["sender", "receiver", "message"]
    heard = heard[key].assign(heard=1.0)
    return sent[[*key, "t"]].merge(heard, on=key, how="left").fillna({"heard": 0.0})


@pytest.mark.slow
def test_delivery_and_windows_by_pandas(shared):
    messages, outcomes = (
        messages_by_pandas(shared),
        outcomes_of(join_messages(shared.log), shared.nodes),
    )
    expected = messages.pivot_table(index="sender", columns="receiver", values="heard")
    np.testing.assert_allclose(delivery_matrix(outcomes, 3), expected.to_numpy())
    edges = np.linspace(0.0, 1500.0, 7)
    links, shares = loss_windows(outcomes, 3, edges)
    messages["window"] = pd.cut(messages.t, edges, right=False, labels=False)
    lost = 1.0 - messages.pivot_table(
        index=["sender", "receiver"], columns="window", values="heard"
    )
    assert [(i + 10, j + 10) for i, j in links] == list(lost.index)
    np.testing.assert_allclose(shares, lost.to_numpy())


def test_shared_fate_is_the_share(shared):
    """The correlation of two hearers is the share of broadcasts that have one fate; by pandas it is
    that of columns of outcomes.
    """
    fates = fate_matrix(outcomes_of(join_messages(shared.log), shared.nodes), 3)
    messages = messages_by_pandas(shared)
    for i, j, sender in ((1, 2, 10), (0, 2, 11), (0, 1, 12)):
        own = messages[messages.sender == sender]
        table = own.pivot_table(index="t", columns="receiver", values="heard")
        assert fates[i, j] == fates[j, i] == pytest.approx(table.corr().iloc[0, 1])
        assert fates[i, j] == pytest.approx(0.5, abs=4.0 * np.sqrt(0.75 / 1500))


def test_downtimes_are_the_events_of_the_run(tmp_path):
    rows = "t,node,what\n0,12,down\n4,12,join\n6,10,down\n9,10,up\n20,10,leave\n"
    (tmp_path / "lives.csv").write_text(rows)
    more = '[[network.lives]]\nkind = "recorded"\nnodes = [10, 12]\npath = "lives.csv"\n'
    scenario = lossy(tmp_path, horizon=30.0, more=more)
    assert downtimes(scenario, 0, 0) == [
        (10, 6.0, 9.0, "crash"),
        (10, 20.0, np.inf, "leave"),
        (12, 0.0, 4.0, ""),
    ]
    run = netkf.simulate(scenario, seed=0)
    told = netkf.why(run, 11, 25.0)
    assert [one.node for one in told.down] == [10]
    assert told.sentences()[1] == "Node 10 was down since 20 s, 5 s before (leave)."
    assert netkf.why(run, 12, 2.0).sentences()[1] == "It was itself down since the beginning."
    assert not netkf.why(run, 11, 9.0).down
    # Three bands, in each panel.
    for name, panels in (("losses", 1), ("links", 1), ("error", 2)):
        axes = FigureSet(run).draw(name).axes[:panels]
        bands = [[p for p in one.patches if p.get_alpha() == 0.12] for one in axes]
        assert [len(found) for found in bands] == [3] * panels


def test_figures_show_the_matrices(shared):
    figures = FigureSet(shared)
    outcomes = outcomes_of(join_messages(shared.log), shared.nodes)
    for name, matrix in (("matrix", delivery_matrix), ("fate", fate_matrix)):
        axes = figures.draw(name).axes[0]
        shown = np.ma.filled(axes.images[0].get_array().astype(float), np.nan)
        expected = matrix(outcomes, 3)
        np.fill_diagonal(expected, np.nan)
        np.testing.assert_array_equal(shown, expected)
        assert [label.get_text() for label in axes.get_yticklabels()] == ["10", "11", "12"]


def test_one_hearer_shares_no_fate(tmp_path):
    scenario = lossy(tmp_path, horizon=30.0).replace({"network.activation.at": "links"})
    figure = FigureSet(netkf.simulate(scenario, engine="simpy")).draw("fate")
    assert any("No two nodes" in text.get_text() for text in figure.axes[0].texts)
