"""Contacts: the ticks of a clock that lie in the intervals of a table, and no others."""

import numpy as np
import pytest

import netkf
from netkf.core.clock import ClockPosition, generate_ticks, next_ticks
from netkf.network.clocks import Periodic, Poisson, Renewal
from netkf.network.contacts import Contacts
from netkf.scenario.reading import from_table
from netkf.scenario.usage import record_usage

ROWS = """from,until,node,peer
2,4.5,0,1
4,6,1,0
9,11,0,1
9,11,0,1
1,3,1,2
12,30,1,2
40,50,1,2
"""
INTERVALS = {(0, 1): [(2, 6), (9, 11)], (1, 2): [(1, 3), (12, 30)], (2, 3): []}
HORIZON = 20.0
CLOCKS = {
    "poisson": {"kind": "poisson", "rate": 3.0, "rates": [[1, 2, 9.0]]},
    "gamma": {"kind": "renewal", "distribution": "gamma", "mean": 0.4, "shape": 3.0},
    "constant": {"kind": "renewal", "distribution": "constant", "mean": 0.3},
    "periodic": {"kind": "periodic", "period": 0.5},
    "phase": {"kind": "periodic", "period": 0.7, "phase": 0.2},
    "random phase": {"kind": "periodic", "period": 0.7, "phase": "random", "jitter": 0.6},
}
SCENARIO = {
    "format": 1,
    "name": "contacts",
    "horizon": HORIZON,
    "probe": 5.0,
    "plant": {"kind": "diffusion", "A": [[-0.1]], "B": [[1.0]], "cov": [[1.0]]},
    "sensors": [
        {"nodes": [0], "H": [[1.0]], "R": [[0.5]], "sampling": {"kind": "periodic", "period": 0.5}}
    ],
    "network": {
        "graph": {"kind": "path", "nodes": 4},
        "activation": CLOCKS["poisson"],
        "channel": {"loss": {"kind": "bernoulli", "delivery": 0.7}},
    },
    "filter": {"kind": "hybrid", "epsilon": 0.3},
}


@pytest.fixture
def make(tmp_path):
    (tmp_path / "contacts.csv").write_text(ROWS)

    def make(clock, **more):
        contacts = {"kind": "contacts", "path": "contacts.csv", "clock": clock, **more}
        plain = from_table(SCENARIO, tmp_path).replace({"network.activation": clock})
        return plain, plain.replace({"network.activation": contacts})

    return make


def inside(link, times):
    return [t for t in times if any(a <= t <= b for a, b in INTERVALS[link])]


def ticks_of(run, link):
    rows = run.events[run.events["kind"] == "tick"]
    chosen = (rows["node"] == link[0]) & (rows["peer"] == link[1])
    return rows["t"][chosen].tolist()


@pytest.mark.one_in(3)
@pytest.mark.parametrize("name", CLOCKS)
def test_links_tick_as_their_clock_inside_and_never_outside(name, make):
    plain, contacts = make(CLOCKS[name])
    everything = netkf.simulate(plain, seed=5, engine="simpy")
    runs = [netkf.simulate(contacts, seed=5, engine=engine) for engine in ("simpy", "compiled")]
    assert runs[0].fingerprint == runs[1].fingerprint
    np.testing.assert_allclose(runs[0].xhat, runs[1].xhat, rtol=0, atol=1e-10)
    for link, intervals in INTERVALS.items():
        expected = inside(link, ticks_of(everything, link))
        assert ticks_of(runs[0], link) == expected
        assert bool(expected) == bool(intervals)
    ensemble = netkf.monte_carlo(contacts, runs=2, seed=5, engine="compiled", workers=1)
    assert set(ensemble.runs) == {2}


@pytest.mark.parametrize(
    "clock",
    [
        Poisson(rate=3.0),
        Renewal(distribution="constant", mean=0.3),
        Periodic(period=0.1),
        Periodic(period=0.25, phase=0.1, jitter=0.2),
    ],
    ids=lambda clock: repr(type(clock).__name__),
)
def test_ticks_do_not_depend_on_how_many_are_drawn_at_once(clock, tmp_path):
    (tmp_path / "c.csv").write_text(ROWS)
    contacts = Contacts(path=tmp_path / "c.csv", clock=clock)
    random = np.random.default_rng
    together = generate_ticks(contacts, (0, 1), None, random(1), HORIZON)
    origin = contacts.origin((0, 1), None)
    single, now, generator = [], 0.0, random(1)
    while np.isfinite(now):
        position = ClockPosition(origin, len(single), now)
        block = next_ticks(contacts, (0, 1), position, generator, 1)
        now = block[-1] if len(block) else np.inf
        single += [t for t in block if np.isfinite(t)]
    assert single == together.tolist()
    assert len(single) > 5


def test_rows_are_counted_and_overlaps_and_links_without_contact_are_noted(make):
    _, contacts = make(CLOCKS["poisson"])
    assert record_usage(contacts, None)["network.activation"] == {
        "path": "contacts.csv",
        "rows": 7,
        "used": 5,
        "merged": 1,
        "unused": 1,
    }
    notes = [note for note in contacts.notes if "contacts.csv" in note]
    assert any("1 of 7 rows repeat the link and interval" in note for note in notes)
    assert any("1 of 7 rows overlap another interval of the same link" in note for note in notes)
    assert any("1 of 3 links without any contact" in note for note in notes)


def test_directions_have_contacts_of_their_own(make):
    clock = {"kind": "poisson", "rate": 4.0}
    _, contacts = make(clock, at="directions")
    run = netkf.simulate(contacts, seed=2, engine="simpy")
    assert run.fingerprint == netkf.simulate(contacts, seed=2, engine="compiled").fingerprint
    assert all(2 <= t <= 4.5 or 9 <= t <= 11 for t in ticks_of(run, (0, 1)))
    assert all(4 <= t <= 6 for t in ticks_of(run, (1, 0)))
    assert ticks_of(run, (0, 1))
    assert ticks_of(run, (1, 0))
    assert not ticks_of(run, (2, 1))


def test_a_scenario_with_contacts_is_written_and_read_back(make, tmp_path):
    _, contacts = make(CLOCKS["poisson"])
    out = tmp_path / "out"
    netkf.save(netkf.simulate(contacts, engine="simpy"), contacts, out)
    again = netkf.load(out / "scenario.toml")
    assert again.network.activation.clock == contacts.network.activation.clock
    assert again.network.activation.row_keys == contacts.network.activation.row_keys


def test_theory_takes_contacts_for_no_poisson_process(make):
    _, contacts = make(CLOCKS["poisson"])
    with pytest.raises(netkf.TheoryError, match="not Poisson"):
        netkf.theory.covariance_bound(contacts, [1.0])
    table = netkf.theory.assumptions(contacts)
    row = table[table["assumption"].str.contains("independent Poisson")].iloc[0]
    assert row["holds"] is False or row["holds"] == False  # noqa: E712


class Leaky(Contacts):
    """Ticks outside of its contacts too."""

    def ticks(self, entity, origin, index, now, random, count):
        return self.clock.ticks(entity, origin, index, now, random, count)


class Fast(Contacts):
    """Ticks half as often again in its contacts."""

    def ticks(self, entity, origin, index, now, random, count):
        faster = Contacts(path=self.path, clock=Poisson(rate=4.5))
        return faster.ticks(entity, origin, index, now, random, count)


@pytest.mark.parametrize(
    ("cls", "broken"),
    [
        (Contacts, []),
        (Leaky, ["links tick in their contacts only"]),
        (Fast, ["clocks tick at the rates of the scenario"]),
    ],
)
@pytest.mark.slow
def test_check_knows_the_intervals(cls, broken, make):
    _, contacts = make({"kind": "poisson", "rate": 3.0})
    clock = cls(path=contacts.network.activation.path, clock=Poisson(rate=3.0))
    verdict = netkf.check(contacts.replace({"network.activation": clock}), runs=40)
    table = verdict.table.set_index("promise")["verdict"].str.lower()
    rows = ["links tick in their contacts only", "clocks tick at the rates of the scenario"]
    assert set(rows) <= set(table.index)
    assert [row for row in rows if table[row] == "broken"][: len(broken)] == broken
    if not broken:
        assert not (table == "broken").any()


def test_a_contact_of_an_instant_has_the_tick_of_that_instant(make, tmp_path):
    """Both ends count, and logs of scans have contacts that were seen once."""
    (tmp_path / "contacts.csv").write_text("from,until,node,peer\n8,8,0,1\n9.1,9.1,0,1\n")
    _, contacts = make(CLOCKS["periodic"])
    assert ticks_of(netkf.simulate(contacts), (0, 1)) == [8.0]


def test_contacts_that_overlap_are_one_and_those_that_touch_do_not_overlap(make, tmp_path):
    rows = "from,until,node,peer\n0,10,0,1\n1,2,0,1\n5,6,0,1\n10,12,0,1\n"
    (tmp_path / "contacts.csv").write_text(rows)
    _, contacts = make(CLOCKS["periodic"])
    assert ticks_of(netkf.simulate(contacts), (0, 1)) == [0.5 * k for k in range(1, 25)]
    assert any("2 of 4 rows overlap" in note for note in contacts.notes)


def test_times_in_contact_and_distances_from_contacts_are_counted_by_hand(make, tmp_path):
    (tmp_path / "contacts.csv").write_text("from,until,node,peer\n-3,2,0,1\n6,8,0,1\n")
    clock = make(CLOCKS["periodic"])[1].network.activation
    assert clock.time_in_contact((0, 1), np.array([1.0, 4.0, 7.0])).tolist() == [1.0, 2.0, 3.0]
    assert clock.distance((0, 1), np.array([1.0, 4.5, 9.0])) == 1.5


WRONG = {
    "ends first": ("from,until,node,peer\n3,2,0,1\n", {}, "line 2: until must not be before from"),
    "no link": ("from,until,node,peer\n1,2,0,3\n", {}, "line 2: every pair must be a link"),
    "no end": ("from,node,peer\n1,0,1\n", {}, "columns from, until, node, peer"),
    "nodes": (ROWS, {"at": "nodes"}, "at: must be links or directions"),
    "clock": (ROWS, {"clock": {"kind": "readings"}}, "clock: must be a poisson or"),
    "inner rates": (ROWS, {"clock": {"kind": "poisson", "rates": []}}, "clock.rate: is missing"),
}


@pytest.mark.parametrize("name", WRONG)
def test_mistakes_are_named(name, make, tmp_path):
    text, more, words = WRONG[name]
    _, contacts = make(CLOCKS["poisson"])
    (tmp_path / "contacts.csv").write_text(text)
    changes = {"kind": "contacts", "path": "contacts.csv", "clock": CLOCKS["periodic"], **more}
    with pytest.raises(netkf.ScenarioError, match=words):
        contacts.replace({"network.activation": changes})


def test_a_filter_of_nodes_is_sent_to_another_kind(make):
    _, contacts = make(CLOCKS["poisson"])
    words = 'at = "directions" or at = "nodes" of another kind than contacts or'
    with pytest.raises(netkf.ScenarioError, match=words):
        contacts.replace({"filter": {"kind": "diffusion"}})
