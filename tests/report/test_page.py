"""Pages without a browser: nothing from outside, every number the run's, every text escaped."""

import base64
import dataclasses
import hashlib
import json
import re
import shlex
import shutil
from functools import cache
from types import SimpleNamespace

import matplotlib
import networkx as nx
import numpy as np
import pandas as pd
import pytest
import scipy.stats

import netkf
from netkf.checks.innovations import compute_innovations
from netkf.cli.main import main
from netkf.core.errors import ScenarioError
from netkf.ensembles.directory import EnsembleOptions, runs_to_directory
from netkf.ensembles.pools import PoolOptions
from netkf.figures.style import SEQUENTIAL
from netkf.report import page as pages
from netkf.report.claims import describe_source
from netkf.report.data import Budget, information_age, sample_indices, thin_messages
from netkf.report.directories import read_source
from netkf.report.markup import script_json
from netkf.report.mending import describe_mending, explain_worst
from netkf.report.page import make_page
from netkf.report.tables import difference_curves
from netkf.runs.documents import file_digests, write_sealed
from netkf.runs.run import run_to_directory
from netkf.runs.tables import summary_table
from netkf.scenario.reading import from_table
from netkf.studies.compare_filters import compare_filters, write_comparison
from netkf.trace.messages import MESSAGE, join_messages
from tests.conftest import SCENARIOS, with_slow
from tests.report.conftest import EVIL, write_verdict
from tests.report.decoding import Page
from tests.report.oracle import plain_messages

LATER = ("delayed", "library")


@cache
def page_of(*directories):
    """The page of results that no test changes, made once."""
    return Page(make_page([*directories]))


def findings_of(directory):
    source = read_source(directory)
    return describe_source(source, join_messages(source.run.log))


@pytest.mark.parametrize("name", with_slow(["ring", "slots", *LATER], LATER))
def test_a_page_holds_every_number_of_its_run(name, request):
    directory = request.getfixturevalue(name)
    page, run = page_of(directory), netkf.open(directory)
    data = page.data["runs"][0]
    columns = {key: page.column(c) for key, c in data["samples"]["columns"].items()}
    i, j = np.triu_indices(run.x.shape[1])
    np.testing.assert_array_equal(columns["t"], run.times)
    np.testing.assert_array_equal(columns["xhat"], run.xhat)
    np.testing.assert_array_equal(columns["P"], run.P[..., i, j])
    if run.truth_known:
        np.testing.assert_array_equal(columns["x"], run.x)
        np.testing.assert_array_equal(columns["sq_error"], run.sq_error)
    assert data["totals"]["events"] == len(run.log)
    parts = {key: page.column(c) for key, c in data["messages"]["columns"].items()}
    numbers = np.cumsum(parts["number"].astype(np.uint64)) % 2**32
    nodes = np.array(run.nodes)
    ended = np.where(parts["travel"] == 0.0, parts["sent"], parts["travel"])
    outcomes = ("delivered", "lost", "late", "under way")
    found = {
        (int(nodes[a]), int(nodes[b]), int(k)): (sent, outcomes[o], end)
        for a, b, k, sent, o, end in zip(
            parts["sender"],
            parts["receiver"],
            numbers,
            parts["sent"],
            parts["outcome"],
            ended,
            strict=True,
        )
    }
    expected = plain_messages(run.events)
    assert found == {key: (sent, o, end) for key, (sent, o, end, _) in expected.items()}
    assert "Nothing was left out" in page.shown


def test_nothing_comes_from_outside(ring, ensembles):
    for directories in ([ring], ensembles):
        page = page_of(*directories)
        for tag, attrs in page.elements:
            assert not {"src", "action", "style", "onclick", "onload"} & set(attrs), tag
            assert attrs.get("href", "#").startswith(("#", "data:,"))
        script = next(text for tag, attrs, text in page.raw if tag == "script" and not attrs)
        (style,) = [text for tag, _, text in page.raw if tag == "style"]
        assert not re.search(r"url\(|@import|fetch\(|XMLHttp|innerHTML|eval\(", script + style)
        policy = next(a["content"] for t, a in page.elements if t == "meta" and "http-equiv" in a)
        for kind, text in (("script", script), ("style", style)):
            digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
            assert f"{kind}-src 'sha256-{digest}'" in policy
        assert policy.startswith("default-src 'none'")
        assert "unsafe" not in policy


def test_colours_are_those_of_the_figures():
    """The larger the darker: the stops of the page are those of the map that figures use."""
    found = re.search(r"const STOPS = (\[\[.*?\]\]);", pages._asset("theme.js"))
    stops = json.loads(found.group(1))
    shares = np.linspace(0.0, 1.0, len(stops))
    colours = matplotlib.colormaps[SEQUENTIAL](shares)[:, :3]
    np.testing.assert_allclose(np.array(stops) / 255, colours, rtol=0, atol=0.003)


def test_texts_of_files_are_escaped(tmp_path):
    changes = {"horizon": 1.0, "claim": EVIL, "name": f"name {EVIL}"}
    scenario = netkf.load(SCENARIOS / "poisson_ring.toml", changes)
    directory = run_to_directory(scenario, tmp_path / "a<b>&'quoted\"").directory
    write_verdict(directory, EVIL + "\u202e")
    text = make_page([directory])
    page = Page(text)
    assert [tag for tag, _ in page.elements].count("script") == 3
    assert not {"img", "b"} & {tag for tag, _ in page.elements}
    assert not any(name.startswith("on") for _, attrs in page.elements for name in attrs)
    assert text.count("<script") == 3
    assert "\u202e" not in text  # changes the direction of what follows
    assert page.data["runs"][0]["name"] == scenario.name


def test_nodes_have_their_names_and_say_when_they_were_down(tmp_path):
    names = ["a b", "c'd", "<e>"]
    lives = [{"nodes": ["<e>"], "kind": "duty", "period": 8.0, "up": 2.0}]
    changes = {
        "horizon": 6.0,
        "network.graph": nx.relabel_nodes(nx.path_graph(3), dict(enumerate(names))),
        "sensors.0.nodes": ["a b"],
        "network.lives": lives,
    }
    scenario = netkf.load(SCENARIOS / "poisson_ring.toml", changes)
    directory = run_to_directory(scenario, tmp_path / "my run", engine="simpy").directory
    page = page_of(directory)
    assert [row["name"] for row in page.data["summaries"][0]] == names
    assert page.data["runs"][0]["down"] == [[2, 2.0, 12.0]]
    assert "Node <e> was worst" in page.shown
    assert re.search(r"It was down at t = [2-6]\S* s, since t = 2 s", page.shown)
    assert f"netkf why '{directory}' --node '<e>' --at" in page.shown


@pytest.mark.parametrize("value", ["</script>", "<!--", "]]>", "\u2028", "a&lt;b"])
def test_data_cannot_end_their_element(value):
    text = script_json({value: value})
    assert not set("<>&\u2028\u2029") & set(text)
    assert json.loads(text) == {value: value}


def test_tables_show_the_numbers_of_the_command_line(ring, ensembles):
    for directory in (ring, ensembles[0]):
        source = read_source(directory)
        shown = page_of(directory).shown
        for line in summary_table(source.summary).splitlines()[2 : 2 + len(source.run.nodes)]:
            assert " ".join(line.split()) in shown


def test_the_claim_names_the_worst_node_of_the_tables(ring, slots, library):
    for directory in (ring, slots):
        source = read_source(directory)
        worst, rows = source.worst.overall, source.summary["nodes"]
        top = max(rows, key=lambda row: row["rms_error"])
        assert worst.node == top["node"]
        assert worst.value == pytest.approx(top["rms_error"], rel=1e-12)
        states = netkf.open(directory).states
        at = states[(states["node"] == worst.node) & (states["t"] > 0)].nlargest(1, "sq_error")
        assert (worst.time, worst.peak**2) == (at["t"].item(), pytest.approx(at["sq_error"].item()))
        assert (
            f"Node {worst.node} was worst: RMS error {top['rms_error']:.4g}"
            in findings_of(directory)[0]
        )
    assert "There is no ground truth" in findings_of(library)[0]


def test_why_counts_what_was_lost_since_the_worst_node_last_heard(ring):
    worst = read_source(ring).worst.overall
    messages = plain_messages(netkf.open(ring).events)
    lost = 0
    for sender in {key[0] for key in messages if key[1] == worst.node}:
        link = [m for key, m in messages.items() if key[:2] == (sender, worst.node)]
        heard = max(m[0] for m in link if m[1] == "delivered" and m[2] <= worst.time)
        lost += sum(m[1] == "lost" and heard < m[0] <= worst.time for m in link)
        assert f"node {sender} ({worst.time - heard:.4g} s before)" in findings_of(ring)[1]
    assert f"; {lost:,} message" in findings_of(ring)[1]


def test_a_node_that_hardly_hears_anybody_is_said_to_be_one(library, ring):
    messages = plain_messages(netkf.open(library).events)
    worst = read_source(library).worst.explained.node
    into = [found[1] == "delivered" for key, found in messages.items() if key[1] == worst]
    everywhere = [found[1] == "delivered" for found in messages.values()]
    assert np.mean(into) < 0.3 < 0.8 < np.mean(everywhere)
    (said,) = [line for line in findings_of(library) if line.startswith("Why: ")]
    own, all_nodes = (f"{np.mean(arrived):.1%}" for arrived in (into, everywhere))
    assert f"run {own} of {len(into):,} messages to it arrived" in said
    assert said.endswith(f", of those to all nodes {all_nodes}")
    # Where chance alone explains the difference nothing is said.
    assert not any("Over the whole run" in line for line in findings_of(ring))


@pytest.mark.slow
def test_lists_that_are_cut_say_how_many_are_left_out(library):
    told = page_of(library).shown
    run = netkf.open(library)
    others = len(run.nodes) - 1 - 4
    assert f"never heard node 1, 2, 3, 4 and {others} others" in told


def hybrid_ring(folder, name, changes):
    scenario = netkf.load(SCENARIOS / "poisson_ring.toml", {"horizon": 10.0, **changes})
    return run_to_directory(scenario, folder / name).directory


def test_the_worst_of_many_samples_is_judged_as_that(ring, tmp_path):
    wrong = hybrid_ring(tmp_path, "wrong", {"plant.cov": [[100.0, 0.0], [0.0, 100.0]]})
    for directory, words in (
        (ring, "within what its P allows"),
        (wrong, "far more than its P says"),
    ):
        source = read_source(directory)
        states = netkf.open(directory).states
        looked = states[states["t"] > 0]
        limit = scipy.stats.chi2(2).isf(0.01 / len(looked))
        worst = source.worst.explained
        at = looked[(looked["node"] == worst.node) & (looked["t"] == worst.time)]
        nees = at["nees"].item()
        assert (nees > limit) == words.startswith("far")
        (said,) = [line for line in findings_of(directory) if line.startswith("The error at")]
        assert f"t = {worst.time:g} s was {words}: NEES {nees:.4g}," in said
        assert f"above {limit:.4g}, which the worst of {len(looked)} samples" in said


def test_errors_of_the_start_up_are_called_so(tmp_path):
    far = {key: [[25.0, 0.0], [0.0, 25.0]] for key in ("plant.cov", "filter.cov")}
    directory = hybrid_ring(tmp_path, "far", {**far, "network.activation.rate": 4.0, "seed": 10})
    source, run = read_source(directory), netkf.open(directory)
    worst = source.worst.overall
    k = run.nodes.index(worst.node)
    traces = run.P[:, k, 0, 0] + run.P[:, k, 1, 1]
    halfway = (50.0 + traces[-5:].mean()) / 2  # of 21 samples the last quarter
    settled = next(i for i, trace in enumerate(traces) if trace <= halfway)
    later = settled + int(run.sq_error[settled:, k].argmax())
    peak = np.sqrt(run.sq_error[later, k])
    assert worst.time < run.times[settled]
    assert run.sq_error[0, k] > worst.peak**2 > peak**2  # time 0 is left out, in words
    lines = findings_of(directory)
    assert f"After time 0 its error was largest at t = {worst.time:g} s" in lines[0]
    assert lines[1].startswith(f"The filters had just started at t = {worst.time:g} s: trace P was")
    assert f"after this start-up was {peak:.4g} at t = {run.times[later]:g} s" in lines[1]
    assert lines[2].startswith("Why: ")
    assert explain_worst(source).at == run.times[later]
    page = Page(make_page([directory]))
    assert page.data["runs"][0]["worst"]["time"] == run.times[later]
    told = page.shown
    assert told.index("just started") < told.index("Why: ") < told.index("To mend it")


def test_messages_mend_nothing_with_which_a_replay_is_worse(ring):
    found = explain_worst(read_source(ring))
    assert describe_mending(found).startswith("To mend it: with no message missing")
    worse = dataclasses.replace(found.what_ifs[-1], trace=2.0 * found.what_ifs[0].trace)
    found = dataclasses.replace(found, what_ifs=(*found.what_ifs[:-1], worse))
    assert describe_mending(found).startswith("With no message missing it would be no better")
    assert "(+100.0 %)" in describe_mending(found)


def test_the_table_of_replays_has_the_changes_of_the_command_line(ring):
    page, found = page_of(ring), explain_worst(read_source(ring))
    was, best = found.what_ifs[0].trace, found.what_ifs[-1].trace
    assert f"{best:.4g} {100 * (best / was - 1):+.1f} %" in page.shown
    limit = f"{1.05 * best:.4g}, 1.05 times that with no message missing"
    assert limit in page.shown
    assert limit in str(found)


@pytest.mark.parametrize("name", ["ring", "slots"])
def test_the_price_of_the_network_is_the_centralised_filter_on_the_same_truth(name, request):
    """By a run of that filter from the command line's table, at the sample that is explained."""
    directory = request.getfixturevalue(name)
    source, page = read_source(directory), page_of(directory)
    run, at = netkf.open(directory), source.worst.explained.time
    other = netkf.simulate(
        netkf.load(directory / "scenario.toml").replace({"filter": {"kind": "central"}}),
        seed=run.seed,
    )
    k = other.times.tolist().index(at)
    trace, error = np.trace(other.P[k, 0]), np.linalg.norm(other.x[k] - other.xhat[k, 0])
    np.testing.assert_array_equal(other.x[k], run.x[run.times.tolist().index(at)])
    assert f"had trace P {trace:.4g} and error {error:.4g} then" in page.shown
    assert ("netkf size finds the rate" in page.shown) == (name == "ring")


def test_what_the_limit_of_the_bound_is_stands_below_the_averages(ring):
    shown = page_of(ring).shown
    assert "what the bound of every node tends to as links tick ever faster" in shown
    assert "with 1/N of the information of all N nodes' readings" in shown


def test_ages_of_information_are_means_over_links(delayed):
    run = netkf.open(delayed)
    messages, links = plain_messages(run.events), {}
    for (sender, receiver, _), (sent, outcome, ended, _) in messages.items():
        links.setdefault((sender, receiver), []).append((sent, outcome, ended))
    found = information_age(join_messages(run.log), run.nodes, run.times, run.times)
    for k in (1, len(run.times) // 2, len(run.times) - 1):
        t = run.times[k]
        for i, node in enumerate(run.nodes):
            ages = [
                t - max([0.0, *(s for s, o, e in link if o == "delivered" and e <= t)])
                for (_, receiver), link in links.items()
                if receiver == node
            ]
            assert found[k, i] == pytest.approx(np.mean(ages))


def test_thinned_pages_keep_what_they_say(ring, monkeypatch):
    monkeypatch.setattr(pages, "BUDGET", Budget(messages=120, values=700))
    page, run = Page(make_page([ring])), netkf.open(ring)
    data = page.data["runs"][0]
    kept, samples = data["messages"], data["samples"]
    assert 20 < kept["count"] <= 240 < data["totals"]["messages"] == run.count("send")
    parts = {name: page.column(c) for name, c in kept["columns"].items()}
    numbers = np.cumsum(parts["number"].astype(np.uint64)) % 2**32
    inside = (parts["sent"] >= kept["start"]) & (parts["sent"] <= kept["end"])
    sent = run.log["t"][run.log["kind"] == 2]
    assert inside.sum() == ((sent >= kept["start"]) & (sent <= kept["end"])).sum() > 0
    assert (numbers[~inside] % kept["step"] == 0).all()
    worst = read_source(ring).worst.overall
    times = page.column(samples["columns"]["t"])
    assert worst.time in times
    assert run.times[-1] in times
    assert f"of {run.count('send'):,} messages the page holds {kept['count']:,}" in page.shown
    assert sum(map(sum, data["traffic"].values())) == run.count("send")  # of all messages


def test_no_message_is_left_out_below_the_limit_and_few_beyond():
    messages = np.zeros(1000, dtype=MESSAGE)
    messages["sent"] = np.arange(1000.0)
    messages["number"] = np.arange(1000)
    assert thin_messages(messages, 1000, 500.0).step == 1
    for instant in (0.0, 500.0, 999.0):
        thinned = thin_messages(messages, 100, instant)
        assert thinned.start <= instant <= thinned.end
        assert len(thinned.messages) <= 110


@pytest.mark.slow
def test_a_page_of_fifty_nodes_and_100_000_events_is_small_and_complete(tmp_path):
    changes = {
        "network.graph": {"kind": "regular", "nodes": 50, "degree": 4, "seed": 1},
        "network.channel.delay": {"kind": "exponential", "mean": 0.05},
        "network.activation.rate": 2.8,
        "filter.epsilon": 0.2,
        "horizon": 57.0,
    }
    scenario = netkf.load(SCENARIOS / "poisson_ring.toml", changes)
    directory = run_to_directory(scenario, tmp_path / "large").directory
    assert 95_000 < len(netkf.open(directory).log) < 110_000
    text = make_page([directory])
    assert len(text.encode()) < 5_000_000
    assert Page(text).data["runs"][0]["messages"]["step"] == 1


@pytest.mark.slow
def test_larger_pages_are_thinned_until_they_fit(ring, monkeypatch):
    whole = len(make_page([ring]))
    monkeypatch.setattr(pages, "MAX_BYTES", whole - 5_000)
    monkeypatch.setattr(pages, "MIN_BUDGET", 10)
    text = make_page([ring])
    assert len(text.encode()) <= whole - 5_000
    assert "Left out: of" in text


def test_samples_of_large_networks_are_thinned_although_each_node_has_its_worst_one():
    random, (times, nodes, n) = np.random.default_rng(1), (200, 500, 2)
    run = SimpleNamespace(
        nodes=range(nodes),
        times=np.arange(float(times)),
        x=np.zeros((times, n)),
        truth_known=True,
        sq_error=random.exponential(size=(times, nodes)),
    )
    worst = np.unravel_index(run.sq_error.argmax(), run.sq_error.shape)[0]
    each = nodes * (n + n * (n + 1) // 2 + 4) + n + 1
    assert len(sample_indices(run, times * each, 77.0)) == times
    for most in (5, 20):
        kept = sample_indices(run, most * each, 77.0)
        assert most < len(kept) <= 2 * most + 3
        assert {0, int(worst), 77, times - 1} <= {*kept.tolist()}


@pytest.mark.parametrize("name", with_slow(["library", "slots"], {"library"}))
def test_innovations_are_those_of_the_run(name, request):
    """With and without truth; means and their intervals again with scipy."""
    directory = request.getfixturevalue(name)
    page, run = page_of(directory), netkf.open(directory)
    shown, found = page.data["runs"][0]["innovations"], compute_innovations(run)
    columns = {key: page.column(c) for key, c in shown["columns"].items()}
    assert shown["step"] == 1
    np.testing.assert_array_equal(columns["t"], found.times)
    np.testing.assert_array_equal(columns["nis"], found.nis / found.rows)
    nodes = np.unique(found.nodes)
    above = 0
    for node in nodes.tolist():
        mine = found.nis[found.nodes == node]
        rows = int(found.rows[found.nodes == node].sum())
        ends = scipy.stats.chi2(rows).ppf([0.005 / len(nodes), 1.0 - 0.005 / len(nodes)]) / rows
        place = str(run.nodes.index(node))
        np.testing.assert_allclose(shown["means"][place], [mine.sum() / rows, *ends], rtol=1e-9)
        above += mine.sum() / rows > ends[1]
    assert f"Over {len(found.nis):,} readings the squared innovation" in page.shown
    assert (f"P is overconfident at {above} of {len(nodes)} nodes" in page.shown) == (above > 0)


def test_what_stands_against_innovations_is_said(ring, slots, monkeypatch):
    shown = page_of(ring).shown
    assert "increments between two events of a node, the squared innovation" in shown
    monkeypatch.setattr("netkf.report.data.MAX_EVENTS", 10)
    shown = Page(make_page([slots])).shown
    assert "No innovations are shown: a run of more than 10 events is not replayed, and" in shown


def test_two_runs_show_their_differences(ensembles):
    page = page_of(*ensembles)
    comparison = netkf.compare(ensembles)
    certain = [row for row in comparison.rows if row.entries[1].real]
    assert certain
    assert f"{len(certain)} differences are certain" in page.shown
    assert page.shown.count("\u25c6 certain") == len(certain)
    value = comparison.rows[0].entries[1]
    assert f"{value.low:.4g} .. {value.high:.4g}" in page.shown
    assert len(page.data["runs"]) == 2
    # First the winner, then the key that differs and both errors, before anything of one run.
    head = page.shown[: page.shown.index("The network in motion")]
    better, worse = (e.value for e in comparison.rows[0].entries[::-1])
    assert better < worse
    winner = f"B has the smaller RMS error: {better:.4g} against {worse:.4g} of A"
    places = [winner, "network.activation.rate", "RMS error", "A: ", "Over 12 runs"]
    found = [head.index(place) for place in places[:2]] + [head.rindex(places[-1])]
    assert found == sorted(found)


def test_a_page_of_an_ensemble_says_which_run_moves_and_how_runs_spread(ensembles):
    states = pd.read_parquet(ensembles[0] / "states.parquet")
    errors = np.sqrt(states[states["t"] > 0.0].groupby("run")["sq_error"].mean()).sort_values()
    for replica, rank in ((None, None), ("worst", -1), ("median", (len(errors) - 1) // 2)):
        page = Page(make_page(ensembles[:1], replica))
        shown = 0 if rank is None else int(errors.index[rank])
        assert page.data["runs"][0]["replica"] == shown
        place = errors.index.get_loc(shown) + 1
        words = f"The run that moves below is replica {shown} of 12, RMS error {errors[shown]:.4g}"
        assert f"{words}, number {place} from the best" in page.shown
        # The reader can choose the worst and the median.
        others = {run["replica"]: run["words"] for run in page.data["replicas"][0]}
        named = {
            int(errors.index[-1]): "worst",
            int(errors.index[(len(errors) - 1) // 2]): "median",
        }
        assert others.keys() == named.keys() - {shown}
        for number, text in others.items():
            words = f"replica {number} ({named[number]}, RMS error {errors[number]:.4g})"
            assert text == words
    found = page.data["ensembles"][0]["spread"]["4"]
    at = states[(states["node"] == 4) & (states["t"] == 3.0)]["sq_error"]
    expected = np.sqrt(np.quantile(at, [0.5, 0.05, 0.95]))
    np.testing.assert_allclose([curve[6] for curve in found], expected, rtol=1e-12)
    with pytest.raises(ScenarioError, match="worst or median"):
        make_page(ensembles[:1], "best")


def test_states_have_their_names_and_units_on_pages_and_figures(ring, tmp_path):
    names = {"plant.states": ["height", "speed"], "plant.units": ["m", "m/s"]}
    scenario = netkf.load(SCENARIOS / "poisson_ring.toml", {"horizon": 2.0, **names})
    assert scenario.unit == "units of the state"
    run = netkf.simulate(scenario, engine="simpy")
    page = Page(make_page([netkf.save(run, scenario, tmp_path / "named")]))
    assert page.data["runs"][0]["states"] == ["height (m)", "speed (m/s)"]
    assert netkf.open(tmp_path / "named").scenario.plant.states == ("height", "speed")
    assert "xhat0" in run.states.columns  # columns of tables stay
    assert scenario.states_note == "states: height (m), speed (m/s)"
    metres = scenario.replace({"plant.units": ["m", "m"], "plant.states": ["x", "y"]})
    assert netkf.simulate(metres, engine="simpy").plot().axes[0].get_ylabel().endswith(", m")
    assert netkf.open(ring).scenario.state_labels == ("x0", "x1")
    assert netkf.open(ring).scenario.states_note == ""
    netkf.save(netkf.simulate(metres, engine="simpy"), metres, tmp_path / "metres")
    page = Page(make_page([tmp_path / "metres"]))
    assert page.data["unit"] == "m"
    assert "RMS error, m mean trace P, m^2" in " ".join(page.shown.split())
    assert "states: x (m), y (m)" in page.shown
    told = netkf.why(tmp_path / "metres", node=1, at=2.0, replays=1).sentences()[0]
    assert re.search(r"trace P is \S+ m\^2, which claims an RMS error of \S+ m; its error", told)
    compared = netkf.compare([tmp_path / "metres", tmp_path / "metres"])
    assert compared.remarks() == ["errors are in m, traces of P in m^2"]
    names = {"plant.units": ["km", "km"], "horizon": 1.5, "plant.A": [[0.0, 1.0], [-2.0, 0.1]]}
    other = netkf.load(SCENARIOS / "poisson_ring.toml", names)
    netkf.save(netkf.simulate(other, engine="simpy"), other, tmp_path / "kilometres")
    remarks = netkf.compare([tmp_path / "metres", tmp_path / "kilometres"]).remarks()
    assert remarks[0] == "errors are in m, km: they do not compare"
    assert remarks[1].startswith("the plants differ")
    assert remarks[2].startswith("the horizons differ")
    for key, value in (("states", ["x"]), ("states", ["x", "x"]), ("units", ["m"] * 3)):
        with pytest.raises(ScenarioError, match=f"plant.{key}"):
            scenario.replace({f"plant.{key}": value})
    file = SCENARIOS / "blocks" / "cooperative_localisation.toml"
    count = len(netkf.load(file).plants)
    blocks = netkf.load(file, {f"plants.{k}.states": ["x", "y", "heading"] for k in range(count)})
    assert blocks.state_labels == ("x", "y", "heading")


def test_readings_have_their_names_and_one_colour_is_one_run(tmp_path):
    table = {
        "format": 1,
        "name": "cart",
        "horizon": 12.0,
        "probe": 3.0,
        "plant": {
            "kind": "diffusion",
            "A": [[0.0, 1.0], [0.0, -0.3]],
            "B": [[0.0], [0.5]],
            "states": ["height", "speed"],
            "units": ["m", "m/s"],
        },
        "sensors": [
            {
                "nodes": [node],
                "H": [row],
                "R": [[0.4]],
                "sampling": {"kind": "poisson", "rate": 4.0},
            }
            for node, row in enumerate([[1.0, 0.0], [0.0, 1.0]])
        ],
        "network": {"graph": {"kind": "path", "nodes": 2}},
        "filter": {"kind": "local"},
    }
    scenario = from_table(table, tmp_path)
    runs = [netkf.simulate(scenario, seed=seed, engine="simpy") for seed in (0, 1)]
    stored = [
        netkf.save(run, scenario, tmp_path / name) for run, name in zip(runs, "AB", strict=True)
    ]
    html = make_page(stored)
    page = Page(html)
    data = page.data["runs"][0]
    assert data["read"] == ["height (m)", "speed (m/s)", "height (m), speed (m/s)"]
    correlations = data["innovations"]["correlations"]
    assert [correlations[k]["label"] for k in "01"] == ["height (m)", "speed (m/s)"]
    assert page.data["states"] == "states: height (m), speed (m/s)"
    nis, nees = (runs[0].plot(name).get_supxlabel() for name in ("nis", "nees"))
    assert "Readings: height (m), speed (m/s)." in " ".join(nis.split())
    assert "states: height (m), speed (m/s)." in " ".join(nees.split())
    legend = runs[0].plot("whiteness").axes[0].get_legend().get_texts()
    assert {"node 0, height (m), the largest", "node 1, speed (m/s), the largest"} & {
        one.get_text() for one in legend
    }

    # The page has the colours that matplotlib draws, light ones where it is dark.
    lines = netkf.plot({"A": runs[0], "B": runs[1]}).axes[0].get_lines()[:2]
    drawn = [matplotlib.colors.to_hex(line.get_color()) for line in lines]
    light, dark = (
        dict(re.findall(r"--(series-\d): (#\w+)", part))
        for part in re.findall(r":root \{ (--series-0[^}]*)\}", html)
    )
    names = page.data["series"]
    assert [light[name].lower() for name in names[:2]] == drawn
    for heading, name in zip("AB", names, strict=False):
        assert re.search(rf'<h2 class="{name}">{heading}: ', html)
    for paper, colours, least in (("#ffffff", light, 3.0), ("#14171b", dark, 4.5)):
        shown = [contrast(colours[name], paper) for name in names[: 5 if least == 3.0 else 8]]
        assert min(shown) >= least - 0.1, shown


def contrast(one, other):
    """Return the contrast ratio of two colours, WCAG 2.2."""
    levels = []
    for colour in (one, other):
        rgb = np.array(matplotlib.colors.to_rgb(colour))
        linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
        levels.append(float(linear @ [0.2126, 0.7152, 0.0722]) + 0.05)
    return max(levels) / min(levels)


def test_intervals_of_differences_over_time(ensembles):
    one, other = (read_source(directory) for directory in ensembles)
    found = difference_curves(one, other)
    tables = [netkf.open(d).table.set_index(["node", "t"]) for d in ensembles]
    count = len(tables[0])
    for node in (0, 3):
        a, b = (table.loc[node].iloc[5] for table in tables)
        gap = (b["E00"] + b["E11"]) - (a["E00"] + a["E11"])
        error = np.hypot(a["E00_se"] + a["E11_se"], b["E00_se"] + b["E11_se"])
        wide = scipy.stats.t(11).ppf(1 - 0.05 / (2 * count)) * error
        shown = [column[5] for column in found["nodes"][str(node)]]
        np.testing.assert_allclose(shown, [gap, gap - wide, gap + wide])


def test_every_kind_of_directory_has_a_page(ring, ensembles, sweep, tmp_path):
    verdict = tmp_path / "verdict"
    verdict.mkdir()
    (verdict / "scenario.toml").write_bytes((ring / "scenario.toml").read_bytes())
    write_verdict(verdict, "P fits the error")
    shown = Page(make_page([verdict])).shown
    assert "1 promise is broken in 50 runs (1 broken, 1 holds)" in shown
    assert "A verdict keeps no trace" in shown
    both = Page(make_page([ring, verdict]))
    assert "BROKEN P fits the error" in both.shown
    assert len(both.data["runs"]) == 1
    shown = Page(make_page([sweep])).shown
    table = pd.read_parquet(sweep / "sweep.parquet")
    assert f"RMS error {table['worst_rms'].min():.4g}" in shown
    assert "--trace full" in shown
    page = page_of(ensembles[0])
    np.testing.assert_array_equal(
        page.data["ensembles"][0]["times"], netkf.open(ensembles[0]).times
    )
    assert "Over 12 runs node" in page.shown


def test_a_comparison_of_filters_has_a_page(tmp_path):
    scenario = netkf.load(SCENARIOS / "push_sum_planar.toml", {"horizon": 2.0})
    filters = ["push-sum", {"kind": "hcmci", "steps": 2}, "local", "hybrid"]
    found = compare_filters(scenario, filters, 8, workers=1)
    folder = write_comparison(scenario, found, tmp_path / "filters")
    text = make_page([folder])
    page, ran = Page(text), [row for row in found.rows if row.ran]
    best = min(ran, key=lambda row: row.quantities["rms_error"].value)
    assert f"{best.filter} had the smallest RMS error" in page.shown
    assert "hybrid: cannot run here" in page.shown
    marks = [q.real for row in ran for q in row.quantities.values()]
    assert page.shown.count("\u25c6 certain") == sum(marks) > 0
    for row in ran:
        q = row.quantities["rms_error"]
        certain = f"Certain: the RMS error of {row.filter} is "
        assert (certain in page.shown) == q.real
        assert f"{q.value:.4g}" in page.shown
    assert """--filters 'push-sum,{ kind = "hcmci", steps = 2 },local,hybrid'""" in page.shown
    curves = page.data["filters"]["curves"]
    assert [curve["label"] for curve in curves] == [row.filter for row in ran]
    runs = netkf.monte_carlo(scenario.replace({"filter": {"kind": "local"}}), 8, workers=1)
    square = np.trace(runs.mean_error, axis1=2, axis2=3).mean(axis=1)
    local = curves[-1]
    np.testing.assert_allclose(local["x"], runs.times)
    np.testing.assert_allclose(local["y"][0], square, rtol=1e-9)
    central = netkf.theory.central_covariance(scenario).trace()
    assert page.data["filters"]["central"] == pytest.approx(central, rel=1e-9)
    # Dots of the figure stand as far from the axis as errors are large, relative to each other.
    places = [float(x) for x in re.findall(r'<circle cx="([0-9.]+)"', text)]
    errors = [row.quantities["rms_error"].value for row in ran]
    axis = float(re.search(r'<line x1="(\d+)" x2="\1"', text)[1])
    np.testing.assert_allclose(
        (np.array(places) - axis) / (places[0] - axis), np.array(errors) / errors[0], rtol=1e-3
    )
    assert page.data["runs"] == []


def test_an_interrupted_a_diverged_and_a_lonely_run_say_so(ring, build, tmp_path):
    def interrupt(*_):
        raise KeyboardInterrupt

    scenario = netkf.load(SCENARIOS / "poisson_ring.toml")
    with pytest.raises(KeyboardInterrupt):
        run_to_directory(scenario, tmp_path / "stopped", progress=interrupt)
    assert "poisson-ring (interrupted)" in Page(make_page([tmp_path / "stopped"])).shown
    plant = {"kind": "diffusion", "A": [[2.0]], "B": [[1.0]], "cov": [[1.0]]}
    wild = build(plant=plant, horizon=600.0, probe=10.0, filter={"kind": "local"})
    done = run_to_directory(wild, tmp_path / "wild")
    assert done.status == "diverged"
    shown = Page(make_page([done.directory])).shown
    assert re.search(r"Diverged: the .* of node 1 passed 1\.8e308", shown)
    graph = {"graph": {"kind": "complete", "nodes": 1}}
    alone = build(network=graph, filter={"kind": "local"})
    shown = Page(make_page([run_to_directory(alone, tmp_path / "one").directory])).shown
    assert "There is one node, so nothing is sent" in shown
    run_to_directory(scenario, tmp_path / "empty", trace="none")
    page = Page(make_page([tmp_path / "empty"]))
    assert "No samples were recorded" in page.shown
    assert page.data["runs"] == []


def test_an_interrupted_ensemble_shows_the_runs_that_were_kept(tmp_path):
    blocks = []

    def interrupt(*_):
        blocks.append(1)
        if len(blocks) > 3:
            raise KeyboardInterrupt

    scenario = netkf.load(SCENARIOS / "poisson_ring.toml", {"horizon": 1.0})
    with pytest.raises(KeyboardInterrupt):
        runs_to_directory(
            scenario,
            400,
            tmp_path / "many",
            EnsembleOptions(pool=PoolOptions(1)),
            progress=interrupt,
        )
    found = netkf.open(tmp_path / "many")
    errors = np.sqrt(found.average[:-1, 0])
    shown = Page(make_page([tmp_path / "many"])).shown
    done = found.manifest["runs"]["done"]
    assert 0 < done < 400
    assert f"Interrupted: {done} of 400 runs are done" in shown
    assert f"node {found.nodes[errors.argmax()]} was worst: RMS error {errors.max():.4g}" in shown


def test_the_command(ring, tmp_path, capsys):
    assert main(["report", str(ring), "--out", str(tmp_path / "html")]) == 0
    assert capsys.readouterr().out == f"written to {tmp_path / 'html'}\n"
    assert "poisson-ring" in (tmp_path / "html").read_text(encoding="utf-8")
    for arguments in (["report", str(tmp_path)], ["report", str(ring), "--replica", "7"]):
        assert main(arguments) == 2
        assert capsys.readouterr().err.count("\n") == 1
    assert main(["report", str(ring), str(ring), str(ring)]) == 2


def test_only_pages_are_overwritten(slots, tmp_path, capsys):
    page, notes = tmp_path / "html", tmp_path / "notes.html"
    for _ in range(2):  # a page may be made again
        assert main(["report", str(slots), "--out", str(page)]) == 0
    notes.write_text("<!DOCTYPE html>\n<title>netkf: my notes</title>\n")
    kept = notes.read_bytes()
    capsys.readouterr()
    assert main(["report", str(slots), "--out", str(notes)]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "not a page of netkf report" in said
    assert notes.read_bytes() == kept
    assert main(["report", str(slots), "--out", str(tmp_path / "notes.pdf")]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "name a file notes.html" in said


def test_a_summary_without_its_parts_is_refused_in_one_line(ring, tmp_path):
    directory = shutil.copytree(ring, tmp_path / "run")
    for name in ("limit", "notes", "bound"):
        summary = json.loads((ring / "summary.json").read_text())
        del summary[name]
        (directory / "summary.json").write_text(json.dumps(summary))
        manifest = json.loads((ring / "manifest.json").read_text())
        manifest["files"]["summary.json"] = file_digests(directory, ["summary.json"])[
            "summary.json"
        ]
        del manifest["sha256"]
        write_sealed(directory / "manifest.json", manifest)
        with pytest.raises(ScenarioError, match=f"summary.json lacks {name}"):
            make_page([directory])


def test_sweeps_are_not_compared(ring, sweep):
    with pytest.raises(ScenarioError, match="compares runs and ensembles"):
        make_page([ring, sweep])


@pytest.mark.one_in(2)
@pytest.mark.parametrize(
    ("command", "options"),
    [
        ("run", "--replica 2"),
        ("run", "--runs 4"),
        ("sweep", "--runs 3 --vary network.channel.symmetric=true,false"),
        ("check", "--runs 60 --confidence 0.9"),
        (
            "compare-filters",
            '--runs 2 --filters \'gossip,{ kind = "hcmci", steps = 2, consensus = "information" },'
            '{ kind = "event-triggered", trigger = "consensus", thresholds = [0.1, 0.2], '
            'inner = { kind = "hcmci", consensus = "information" } }\'',
        ),
    ],
)
def test_the_command_that_computes_results_again_is_the_one_that_did(tmp_path, command, options):
    out = tmp_path / "out"
    settings = [*shlex.split(options), "--set", "horizon=10.0", "--seed", "7"]
    main([command, str(SCENARIOS / "gossip_ring.toml"), *settings, "--out", str(out), "--no-plot"])
    shown = Page(make_page([out])).shown
    assert f"netkf {command} {out / 'scenario.toml'} {options}" in shown
    assert netkf.load(out / "scenario.toml").seed == 7
