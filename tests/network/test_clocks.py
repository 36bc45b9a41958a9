"""Link clocks against the laws they are named after (Kolmogorov-Smirnov at level 1e-4 each)."""

import numpy as np
import pytest
import scipy.stats

from netkf.core.errors import ScenarioError
from netkf.core.fields import SourceFile
from netkf.core.instants import TimeGrid
from netkf.network.clocks import LinkClock, OnReadings, Periodic, Poisson, RecordedClock, Renewal
from netkf.network.graphs import Edges, PathGraph
from netkf.rng.streams import Streams

LINK = (0, 1)


def ticks(clock, count, seed=0, block=None):
    random = Streams(seed).generator("clock", *LINK)
    origin = clock.origin(LINK, lambda: Streams(seed).generator("phase", *LINK))
    times, now = [], 0.0
    while len(times) < count:
        new = clock.ticks(LINK, origin, len(times), now, random, block or count)
        times.extend(new.tolist())
        now = times[-1]
    return np.array(times[:count])


LAWS = {
    "poisson": (Poisson(rate=3.0), scipy.stats.expon(scale=1 / 3)),
    "gamma": (
        Renewal(distribution="gamma", shape=4.0, mean=0.5),
        scipy.stats.gamma(4.0, scale=0.125),
    ),
    "weibull": (
        Renewal(distribution="weibull", shape=2.0, rate=2.0),
        scipy.stats.weibull_min(2.0, scale=0.5 / scipy.special.gamma(1.5)),
    ),
    "uniform": (Renewal(distribution="uniform", low=0.2, high=1.0), scipy.stats.uniform(0.2, 0.8)),
}


@pytest.mark.parametrize("name", LAWS)
def test_gaps_have_their_law(name):
    clock, law = LAWS[name]
    gaps = np.diff(ticks(clock, 4000), prepend=0.0)
    assert scipy.stats.kstest(gaps, law.cdf).pvalue > 1e-4
    # and the test can tell: the same gaps stretched by a fifth fail
    assert scipy.stats.kstest(1.2 * gaps, law.cdf).pvalue < 1e-4
    assert clock.mean_rate(LINK) == pytest.approx(1.0 / law.mean())
    assert clock.memoryless == (name == "poisson")


@pytest.mark.parametrize(
    "clock",
    [
        LAWS["poisson"][0],
        LAWS["weibull"][0],
        Periodic(period=0.1, phase="random", jitter=0.05),
        Renewal(distribution="constant", mean=0.1),
    ],
)
def test_blocks_do_not_show(clock):
    np.testing.assert_array_equal(ticks(clock, 500), ticks(clock, 500, block=7))


def test_lattices_meet():
    tenth, third = Periodic(period=0.1), Periodic(period=0.3)
    snap = TimeGrid(1e-12).snap
    assert set(snap(ticks(third, 50))) < set(snap(ticks(tenth, 150)))
    constant = Renewal(distribution="constant", rate=10.0)
    np.testing.assert_array_equal(snap(ticks(constant, 100)), snap(ticks(tenth, 100)))


def test_phase_and_jitter():
    assert ticks(Periodic(period=1.0), 2).tolist() == [1.0, 2.0]
    assert ticks(Periodic(period=1.0, phase=0.25), 2).tolist() == [0.25, 1.25]
    starts = [ticks(Periodic(period=2.0, phase="random"), 1, seed)[0] for seed in range(300)]
    assert scipy.stats.kstest(starts, scipy.stats.uniform(0, 2).cdf).pvalue > 1e-4
    late = ticks(Periodic(period=1.0, jitter=0.5), 1000) - np.arange(1, 1001)
    assert scipy.stats.kstest(late, scipy.stats.uniform(0, 0.5).cdf).pvalue > 1e-4


def test_every_entity_has_a_clock():
    path, directed = PathGraph(3).build(0), Edges(edges=[[0, 1], [2, 1]], directed=True).build(0)
    expected = {
        "links": ((0, 1), (1, 2)),
        "directions": ((0, 1), (1, 0), (1, 2), (2, 1)),
        "nodes": ((0,), (1,), (2,)),
    }
    for at, entities in expected.items():
        assert Poisson(rate=1.0, at=at).entities(path) == entities
    assert Periodic(period=1.0, at="directions").entities(directed) == ((0, 1), (2, 1))
    assert OnReadings().entities(path) == ()
    assert OnReadings().at == "readings"
    with pytest.raises(ScenarioError, match=r"at: is no setting; .*write OnReadings\(\)"):
        OnReadings(at="nodes")
    assert directed.receivers(0) == directed.receivers(2) == (1,)
    assert directed.senders(1) == (0, 2)
    assert directed.receivers(1) == ()
    assert path.receivers(1) == path.senders(1) == (0, 2)


def test_rates_of_directions_and_nodes():
    ways = Poisson(rate=1.0, rates=[[1, 0, 5.0]], at="directions")
    assert (ways.mean_rate((0, 1)), ways.mean_rate((1, 0))) == (1.0, 5.0)
    nodes = Poisson(rates=[[2, 3.0]], rate=1.0, at="nodes")
    assert (nodes.mean_rate((0,)), nodes.mean_rate((2,))) == (1.0, 3.0)
    nodes.check(PathGraph(3).build(0))
    with pytest.raises(ScenarioError, match="must name a node of the graph; got \\[2\\]"):
        nodes.check(PathGraph(2).build(0))
    again = Poisson(rate=1.0, rates=[[1, 0, 5.0], [1, 0, 6.0]], at="directions")
    with pytest.raises(ScenarioError, match="names a direction again"):
        again.check(PathGraph(2).build(0))
    with pytest.raises(ScenarioError, match=r'pair \[i, rate\]; got .*, because at = "nodes"'):
        Poisson(rates=[[0, 1, 3.0]], at="nodes")
    with pytest.raises(ScenarioError, match=r'triple .*; got \[0, 3\]; .*, because at = "links"'):
        Poisson(rates=[[0, 3.0]])


def recorded(folder, text, **settings):
    (folder / "ticks.csv").write_text(text)
    return RecordedClock(SourceFile("ticks.csv", folder), **settings)


def test_recorded_ticks_of_links_directions_and_nodes(tmp_path):
    text = "t,node,peer\n0.5,1,0\n0.25,0,1\n0.5,0,1\n"
    random = np.random.default_rng()
    links = recorded(tmp_path, text)
    assert links.ticks((0, 1), 0.0, 0, 0.0, random, 9).tolist() == [0.25, 0.5]
    assert links.row_keys == [((0, 1), 0.5), ((0, 1), 0.25), ((0, 1), 0.5)]
    ways = recorded(tmp_path, text, at="directions")
    assert ways.ticks((0, 1), 0.0, 0, 0.0, random, 9).tolist() == [0.25, 0.5]
    assert ways.ticks((1, 0), 0.0, 0, 0.0, random, 9).tolist() == [0.5]
    nodes = recorded(tmp_path, "t,node\n0.5,1\n0.25,1\n0.5,0\n", at="nodes")
    assert nodes.ticks((1,), 0.0, 0, 0.0, random, 9).tolist() == [0.25, 0.5]
    assert nodes.ticks((2,), 0.0, 0, 0.0, random, 9).tolist() == []


def test_a_clock_of_ones_own_needs_no_at():
    class Own(LinkClock):
        def ticks(self, link, origin, index, now, random, count):
            return np.arange(index + 1.0, index + 1.0 + count)

    assert Own().at == "links"
    assert Own().entities(PathGraph(2).build(0)) == ((0, 1),)
