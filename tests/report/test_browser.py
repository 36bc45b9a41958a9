"""Pages in a headless Chromium, opened from disk with the network off.

Skipped without Python's playwright (the extra ``browser``) or without a Chromium on the path. With
NETKF_AXE naming axe.min.js (``npm pack axe-core``), axe looks at the pages too.
"""

import math
import os
import random
import shutil
from pathlib import Path

import networkx as nx
import numpy as np
import pytest

import netkf
from netkf.report.directories import read_source
from netkf.report.page import write_report
from netkf.runs.run import run_to_directory
from netkf.runs.tables import format_number
from netkf.studies.why import why
from tests.conftest import SCENARIOS
from tests.report.conftest import EVIL, write_verdict
from tests.report.oracle import last_heard, on_show, plain_messages, reachable

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no chromium is installed")
AXE = os.environ.get("NETKF_AXE", "")
TIMES = 20
PLACES = 67  # of each of three runs: 201 nodes and times to explain
BOUND = 3000  # milliseconds until a page is ready


@pytest.fixture(scope="module")
def chromium():
    with playwright.sync_playwright() as found:
        browser = found.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def files(ring, delayed, slots, library, gossip, readings, ensembles, sweep, folder):
    """A page of each kind by its name."""
    kinds = {"ring": [ring], "delayed": [delayed], "slots": [slots], "library": [library]}
    kinds |= {"gossip": [gossip], "readings": [readings]}
    kinds |= {"two": ensembles, "ensemble": ensembles[:1], "sweep": [sweep]}
    return {k: write_report(found, folder / f"{k}.html") for k, found in kinds.items()}


@pytest.fixture
def look(chromium):
    """Open a page; at the end there was no error, and nobody asked for anything else."""
    asked, problems, contexts = [], [], []

    def note(message):
        if message.type == "error":
            problems.append(message.text)

    def opened(path, width=1440, **options):
        size = {"width": width, "height": 900}
        context = chromium.new_context(viewport=size, offline=True, **options)
        contexts.append(context)
        page = context.new_page()
        page.on("request", lambda request: asked.append(request.url))
        page.on("console", note)
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.goto(Path(path).as_uri())
        page.wait_for_selector("html[data-ready=true]", timeout=BOUND)
        return page

    yield opened
    for context in contexts:
        context.close()
    assert problems == []
    assert [url for url in asked if not url.startswith("file:")] == []
    assert len(asked) == len(contexts)


KINDS = ["ring", "delayed", "slots", "library", "gossip", "two", "ensemble", "sweep"]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("width", [360, 1440])
def test_pages_open_and_nothing_overflows(files, look, kind, width):
    page = look(files[kind], width)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    boxes = (
        "[...document.querySelectorAll('main *')].filter((e) => !e.closest('.scroll, pre, svg'))"
    )
    wide = f"{boxes}.filter((e) => e.getBoundingClientRect().right > {width} + 1).length"
    assert page.evaluate(wide) == 0


@pytest.mark.parametrize("kind", ["ring", "delayed", "slots", "library"])
def test_the_state_shown_is_that_of_the_trace(files, look, request, kind):
    page, run = look(files[kind]), netkf.open(request.getfixturevalue(kind))
    messages = plain_messages(run.events)
    chance = random.Random(kind)
    end = float(run.scenario.horizon)
    times = [chance.uniform(0.0, end) for _ in range(TIMES - 4)]
    times += [m[0] for m in chance.sample(list(messages.values()), 4)]  # at a sending
    for t in times:
        persist = chance.choice([0.001, 0.05]) * end
        state = page.evaluate("([t, p]) => window.netkf.state(t, p)", [t, persist])
        shown = {
            (m["sender"], m["receiver"], m["number"], m["sent"], m["state"])
            for m in state["messages"]
        }
        assert shown == on_show(messages, t, persist)
        k = int(np.flatnonzero(run.times <= t)[-1])
        assert state["sample"] == run.times[k]
        i, j = np.triu_indices(run.x.shape[1])
        for column, node in enumerate(state["nodes"]):
            np.testing.assert_array_equal(node["xhat"], run.xhat[k, column])
            np.testing.assert_array_equal(node["P"], run.P[k, column][i, j])
            if run.truth_known:
                assert node["error"] == pytest.approx(math.sqrt(run.sq_error[k, column]))
                assert node["nees"] == run.nees[k, column] or node["nees"] is None
        if run.truth_known:
            np.testing.assert_array_equal(state["x"], run.x[k])


@pytest.mark.parametrize("kind", ["ring", "slots", "gossip", "readings", "library"])
def test_why_agrees_with_the_command(files, look, request, kind):
    """Filters that combine, swap, or send readings; samples before and after a slot, or of now."""
    page, run = look(files[kind]), netkf.open(request.getfixturevalue(kind))
    chance = random.Random(2)
    nodes = {node: i for i, node in enumerate(run.nodes)}
    for _ in range(4):
        node, at = chance.choice(run.nodes), float(chance.choice(run.times[len(run.times) // 2 :]))
        shown = page.evaluate("([i, t]) => window.netkf.why(i, t)", [node, at])
        found = why(run, node, at, replays=1)
        heard = {s.node: s.heard for s in found.sources if s.neighbour and s.heard == s.heard}
        assert heard == {
            run.nodes[x["sender"]]: x["sent"] for x in shown["links"] if x["newest"] >= 0
        }
        read = {s.node: s.reading for s in found.sources if s.sensor and s.reading == s.reading}
        mine = {r["node"]: r["at"] for r in shown["readings"] if r["way"]}
        assert mine == {nodes[node]: pytest.approx(t, abs=1e-9) for node, t in read.items()}


@pytest.mark.parametrize("kind", ["ring", "delayed", "library"])
def test_why_is_an_independent_backward_search(files, look, request, kind):
    page, run = look(files[kind]), netkf.open(request.getfixturevalue(kind))
    messages = plain_messages(run.events)
    chance = random.Random(1)
    senses = run.events[run.events["kind"] == "sense"]
    places = [
        [chance.choice(run.nodes), chance.uniform(0.0, run.scenario.horizon)] for _ in range(PLACES)
    ]
    told = page.evaluate(
        """(places) => places.map(([node, t]) => {
          const found = window.netkf.why(node, t), { outcome } = window.netkf.app.run.messages;
          const bad = (link) => link.missing.filter((row) => [1, 2].includes(outcome[row])).length;
          return { ...found, bad: found.links.map(bad) };
        })""",
        places,
    )
    for (node, t), found in zip(places, told, strict=True):
        expected = last_heard(messages, node, t)
        links = {
            run.nodes[link["sender"]]: (link["sent"] if link["newest"] >= 0 else None, count)
            for link, count in zip(found["links"], found["bad"], strict=True)
        }
        assert links == expected
        moments = reachable(messages, node, t)
        for reading in found["readings"]:
            sensor = run.nodes[reading["node"]]
            until = moments.get(sensor, -math.inf)
            taken = senses["t"][(senses["node"] == sensor) & (senses["t"] <= until)]
            expected = taken.max() if len(taken) else None
            if sensor in run.scenario.increment_sensors:  # used up to the very moment
                expected = until if sensor in moments else None
            shown = reading["at"] if reading["way"] else None
            assert shown == expected


def test_innovations_are_drawn_with_their_mean_and_interval(files, look):
    page = look(files["library"])
    told = page.evaluate("window.netkf.app.run.innovations.means")
    node = page.evaluate("window.netkf.app.run.index.get(window.netkf.app.nodeId)")
    mean, low, high = map(format_number, told[str(node)])
    shown = page.inner_text("#curves")
    assert f"mean of all (where P is exact {low} .. {high}): {mean}" in " ".join(shown.split())
    assert "Are innovations white?" not in shown  # too few readings


def test_numbers_are_written_as_on_the_command_line(files, look):
    page = look(files["sweep"])
    chance = np.random.default_rng(3)
    values = (chance.standard_normal(2000) * 10.0 ** chance.integers(-12, 13, 2000)).tolist()
    values += [0.0, 1.0, 12345.0, 12355.0, 0.5, 99995.0, 9999.5, 1e-5, 123.45, 1e300, -2.5e-308]
    values += [float(k) + 0.5 for k in range(1000, 1100)]  # exact ties are rounded to even
    shown = page.evaluate("(values) => values.map(window.netkf.format)", values)
    assert shown == [format_number(value) for value in values]


def test_it_plays_scrubs_and_filters_by_keyboard_alone(files, look):
    page = look(files["ring"])
    time = "() => window.netkf.time()"
    reached = set()
    for _ in range(60):
        page.keyboard.press("Tab")
        reached.add(page.evaluate("document.activeElement.id || document.activeElement.className"))
    wanted = {"play", "back", "forward", "next", "worst", "scrub", "speed", "node", "filter"}
    wanted |= {"axis-x", "axis-y", "range", "view", "window", "lifelines", "sequence"}
    assert {w for w in wanted if not any(w in str(r).split() for r in reached)} <= {"sequence"}
    page.focus(".view")
    page.keyboard.press("Home")
    assert page.evaluate(time) == 0.0
    page.keyboard.press("ArrowRight")
    assert page.evaluate(time) == 0.5
    page.keyboard.press("End")
    assert page.evaluate(time) == 20.0
    page.keyboard.press("w")
    page.keyboard.press(" ")
    for _ in range(50):  # wait_for_function evaluates texts, which the page forbids
        page.wait_for_timeout(50)
        if page.evaluate(time) > 8.2:
            break
    assert page.evaluate(time) > 8.2
    page.keyboard.press(" ")
    stopped = page.evaluate(time)
    page.wait_for_timeout(150)
    assert page.evaluate(time) == stopped
    page.focus("#scrub")
    page.keyboard.press("Home")
    page.keyboard.press("ArrowRight")
    assert 0.0 < page.evaluate(time) < 1.0
    page.focus("#filter")
    page.keyboard.press("l")  # lost and late only
    page.keyboard.press("Enter")
    assert page.evaluate("window.netkf.app.filter") == "trouble"
    page.focus("#node")
    before = page.evaluate("window.netkf.app.nodeId")
    page.keyboard.press("ArrowDown")
    assert page.evaluate("window.netkf.app.nodeId") == before + 1
    assert f"Why: node {before + 1}" in page.inner_text("#why-title")
    assert f"node {before + 1} has error" in page.inner_text("#state")


def test_the_first_sight_is_the_worst_instant(files, look, ring):
    worst = read_source(ring).worst.overall
    page = look(files["ring"])
    assert page.evaluate("window.netkf.time()") == worst.time
    assert page.inner_text("#why-title") == f"Why: node {worst.node} at {worst.time:g} s"
    assert f"error {worst.peak:.4g}" in page.inner_text("#why")
    page.click("text=All nodes at this time as a table")
    row = page.locator("#table tbody tr").nth(worst.node).inner_text().split()
    assert row[0] == str(worst.node)
    assert f"{worst.peak:.4g}" in row


def test_the_address_is_a_moment_and_the_figures_share_a_stretch_of_time(files, look):
    page = look(files["two"])
    page.evaluate("location.hash = '#t=3.5&node=2&run=B'")
    page.wait_for_timeout(300)
    told = "[window.netkf.time(), window.netkf.app.nodeId, window.netkf.app.focus]"
    assert page.evaluate(told) == [3.5, 2, 1]
    page.keyboard.press("Escape")
    page.focus(".view")
    page.keyboard.press("ArrowRight")
    page.wait_for_timeout(300)
    assert page.evaluate("location.hash") == "#t=4&node=2&run=B"
    over = page.locator(".curve .u-over")
    over.first.scroll_into_view_if_needed()
    box = over.first.bounding_box()
    page.mouse.move(box["x"] + 0.25 * box["width"], box["y"] + 40)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.75 * box["width"], box["y"] + 45, steps=4)
    page.mouse.up()
    page.wait_for_timeout(300)
    assert page.evaluate("window.netkf.app.span") == pytest.approx([1.5, 4.5], abs=0.05)
    assert page.evaluate("window.netkf.time()") == 4.0  # a drag is no click
    page.locator("#tracks").scroll_into_view_if_needed()
    box = page.locator("#tracks").bounding_box()
    left, width = box["x"] + 92, box["width"] - 104
    page.mouse.click(left + 0.5 * width, box["y"] + 6 + 13 * 4.5)  # the fifth row: node 4
    page.wait_for_timeout(300)
    assert page.evaluate(told) == [pytest.approx(3.0, abs=0.05), 4, 0]
    page.click("#whole")
    assert page.evaluate("window.netkf.app.span") is None


def test_the_sequence_chart_shows_the_stretch_and_chooses_one(files, look):
    page = look(files["ring"])
    page.evaluate("location.hash = '#t=9&node=1&from=8&to=10'")
    page.wait_for_timeout(300)
    assert " messages from 8 to 10 s" in page.inner_text("#sequence-note")
    scrub = "[document.getElementById('scrub').min, document.getElementById('scrub').max]"
    assert page.evaluate(scrub) == ["8", "10"]
    page.evaluate("window.netkf.app.setTime(2)")  # a time outside moves no chart
    page.wait_for_timeout(300)
    assert " messages from 8 to 10 s" in page.inner_text("#sequence-note")
    assert page.locator("#sequence .now").count() == 0
    chart = page.locator("#sequence svg")
    chart.scroll_into_view_if_needed()
    box = chart.bounding_box()
    top, high = box["y"] + 34, 480 - 34 - 14
    page.mouse.move(box["x"] + 200, top + 0.25 * high)
    page.mouse.down()
    page.mouse.move(box["x"] + 210, top + 0.5 * high, steps=3)
    assert page.locator(".brush").count() == 1
    page.mouse.up()
    page.wait_for_timeout(300)
    assert page.evaluate("window.netkf.app.span") == pytest.approx([8.5, 9.0], abs=0.02)
    assert page.locator(".brush").count() == 0
    page.locator("#sequence svg").click(position={"x": 200, "y": 34 + 0.5 * high})
    page.wait_for_timeout(300)
    assert page.evaluate("window.netkf.time()") == pytest.approx(8.75, abs=0.01)


def test_a_run_of_an_ensemble_is_chosen_on_the_page(files, look, ensembles):
    page, stored = look(files["ensemble"]), netkf.open(ensembles[0])
    number = read_source(ensembles[0]).replicas.numbers[-1]
    page.select_option("#replica", str(number))
    page.wait_for_timeout(300)
    assert page.evaluate("window.netkf.app.run.replica") == number
    run = stored.replica(int(number))
    shown = page.evaluate("window.netkf.state(3.0, 0.1).nodes.map((node) => node.xhat)")
    np.testing.assert_array_equal(shown, run.xhat[np.flatnonzero(run.times <= 3.0)[-1]])
    assert f"&replica={number}" in page.evaluate("location.hash")
    assert f"--replica {number}" in page.inner_text("#why")


def test_tables_are_offered_as_csv(files, look):
    page = look(files["two"])
    with page.expect_download() as download:
        page.locator("button.csv").first.click()
    lines = Path(download.value.path()).read_text(encoding="utf-8").splitlines()
    assert "network.activation.rate,1.0,4.0" in lines
    assert lines[2].startswith("RMS error,")


def test_a_broadcast_says_who_lost_it(files, look, slots):
    page = look(files["slots"])
    messages = plain_messages(netkf.open(slots).events)
    text = page.locator("#sequence .hearers title").first.text_content()
    words = text.split()
    sender, sent = int(words[4]), float(words[6])
    lost = {
        receiver
        for (who, receiver, _), (at, outcome, *_) in messages.items()
        if who == sender and abs(at - sent) < 1e-6 and outcome == "lost"
    }
    assert {int(name.strip(",")) for name in words[words.index("by") + 1 :]} == lost


def test_a_click_on_a_node_explains_it(files, look):
    page = look(files["ring"])
    box = page.locator(".view canvas").first.bounding_box()
    before = page.inner_text("#why-title")
    for x in range(30, int(box["width"]), 14):  # wherever the nodes are, a row of clicks meets one
        page.locator(".view canvas").first.click(position={"x": x, "y": box["height"] / 2})
        if page.inner_text("#why-title") != before:
            break
    assert page.inner_text("#why-title") != before
    arrow = page.locator("#sequence .message title").first.text_content()
    assert arrow.startswith("message ")


def test_counts_are_of_the_messages_that_are_drawn(files, look):
    page = look(files["ring"])
    page.evaluate("""() => {
      const { app } = window.netkf, m = app.run.messages, node = app.nodeOf(app.run);
      const others = (_, k) => m.sender[k] !== node && m.receiver[k] !== node;
      app.setTime(m.sent[m.sent.findIndex(others)]);
    }""")
    every = page.evaluate("window.netkf.state(window.netkf.time()).messages.length")
    numbers = {}
    for kind in ("all", "node", "trouble", "none"):
        page.select_option("#filter", kind)
        page.wait_for_timeout(100)
        drawn = page.locator("#sequence .message").count()
        assert page.inner_text("#sequence-note").startswith(f"{drawn} messages")
        assert f", {drawn} messages;" in page.get_attribute("#sequence svg", "aria-label")
        page.evaluate("document.getElementById('messages-box').open = true")
        page.wait_for_timeout(100)
        numbers[kind] = page.locator("#message-table tbody tr").count()
        assert f"; {numbers[kind]} messages on show" in page.inner_text("#state")
    assert numbers["all"] == every > numbers["node"] >= numbers["none"] == 0


def test_the_canvas_shows_what_is_lost(files, look):
    """A lost message is drawn in the colour of losses, and nothing is where messages are off."""
    page = look(files["ring"])
    lost = "window.netkf.app.run.messages"
    t = page.evaluate(f"{lost}.sent[{lost}.outcome.findIndex((o) => o === 1)]")
    page.evaluate("(t) => window.netkf.app.setTime(t)", t)
    count = """() => {
      const canvas = document.querySelector('.view canvas'), wanted = [0xb8, 0x4a, 0x00];
      const pixels = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data;
      let found = 0;
      for (let k = 0; k < pixels.length; k += 4)
        found += wanted.every((c, i) => Math.abs(pixels[k + i] - c) < 12);
      return found;
    }"""
    page.wait_for_timeout(100)
    assert page.evaluate(count) > 20
    page.select_option("#filter", "none")
    page.wait_for_timeout(100)
    assert page.evaluate(count) == 0


def test_curves_over_many_orders_of_magnitude_are_drawn(look, build, tmp_path):
    plant = {"kind": "diffusion", "A": [[2.0]], "B": [[1.0]], "cov": [[1.0]]}
    scenario = build(plant=plant, horizon=600.0, probe=10.0, filter={"kind": "local"})
    directory = run_to_directory(scenario, tmp_path / "wild").directory
    assert netkf.open(directory).sq_error.max() > 1e200
    page = look(write_report([directory], tmp_path / "page.html"))
    blue = """() => {
      const canvas = document.querySelector('.curve canvas'), wanted = [0x00, 0x72, 0xb2];
      const pixels = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data;
      const columns = new Set();
      for (let k = 0; k < pixels.length; k += 4)
        if (wanted.every((c, i) => Math.abs(pixels[k + i] - c) < 30))
          columns.add((k / 4) % canvas.width);
      return columns.size / canvas.width;
    }"""
    # All charts show the whole horizon, of which the run lived until its numbers ended.
    lived = netkf.open(directory).times[-1] / 600.0
    assert page.evaluate(blue) > 0.6 * lived > 0.1


def test_ticks_of_a_map_and_of_a_short_run_differ(look, tmp_path):
    """Eastings and northings, and microseconds."""
    changes = {"plants.0.mean": [4.6e5, 5.5e6]}
    changes |= {f"plants.{k}.mean": [4.6e5 + k, 5.5e6] for k in range(1, 5)}
    places = SCENARIOS / "blocks" / "formation.toml", changes | {"horizon": 3.0}
    brief = SCENARIOS / "poisson_ring.toml", {"horizon": 5e-5, "probe": 1e-6}
    for (file, given), wanted in ((places, "5500000"), (brief, "1e-5")):
        out = tmp_path / file.stem
        directory = run_to_directory(netkf.load(file, given), out).directory
        page = look(write_report([directory], out / "page.html"))
        page.evaluate("""() => {
          const type = CanvasRenderingContext2D.prototype, fill = type.fillText;
          window.drawn = [];
          type.fillText = function (text, ...rest) {
            window.drawn.push(String(text));
            fill.call(this, text, ...rest);
          };
        }""")
        page.select_option("#node", "1")
        page.wait_for_function(f"window.drawn.includes('{wanted}')")
        assert "5.5e+6" not in page.evaluate("window.drawn")


def test_nodes_are_shown_by_their_names(look, tmp_path):
    names = ["zero", "<b>one</b>", 'two, "2"']
    graph = nx.relabel_nodes(nx.path_graph(3), dict(enumerate(names)))
    changes = {"horizon": 1.0, "network.graph": graph, "sensors.0.nodes": ["zero"]}
    scenario = netkf.load(SCENARIOS / "poisson_ring.toml", changes)
    directory = run_to_directory(scenario, tmp_path / "run").directory
    page = look(write_report([directory], tmp_path / "page.html"))
    page.click("text=All nodes at this time as a table")
    page.wait_for_selector("#table tbody th")
    assert page.locator("#table tbody th").all_text_contents() == names
    page.select_option("#node", "2")
    page.wait_for_function(
        "document.getElementById('state').textContent.includes('node two, \"2\" has')"
    )
    assert "node 2" not in page.inner_text("body")


def test_markup_in_texts_runs_nothing(look, tmp_path):
    changes = {"horizon": 1.0, "claim": EVIL, "name": f"name {EVIL}"}
    scenario = netkf.load(SCENARIOS / "poisson_ring.toml", changes)
    directory = run_to_directory(
        scenario, tmp_path / "a<img src=x onerror=window.pwned=1>"
    ).directory
    write_verdict(directory, EVIL)
    page = look(write_report([directory, directory], tmp_path / "page.html"))
    page.click("text=Messages at this time as a table")
    assert page.evaluate("window.pwned") is None
    assert page.locator("img").count() == 0
    assert EVIL in page.inner_text(".claim")


def test_motion_is_reduced_where_that_is_asked_for(files, look):
    page = look(files["ring"], reduced_motion="reduce", color_scheme="dark")
    page.focus(".view")
    page.keyboard.press("Home")
    page.keyboard.press(" ")
    times = page.evaluate(
        """async () => {
      const seen = new Set(), until = performance.now() + 1300;
      while (performance.now() < until) {
        seen.add(window.netkf.time());
        await new Promise(requestAnimationFrame);
      }
      return seen.size;
    }"""
    )
    assert 2 <= times <= 4


@pytest.mark.skipif(not AXE, reason="NETKF_AXE does not name axe.min.js")
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_nothing_serious(files, look, kind, scheme):
    page = look(files[kind], color_scheme=scheme)
    page.evaluate("document.querySelectorAll('details').forEach((d) => { d.open = true; })")
    page.evaluate(Path(AXE).read_text(encoding="utf-8"))
    found = page.evaluate("axe.run()")["violations"]
    serious = [v for v in found if v["impact"] in ("serious", "critical")]
    assert [(v["id"], v["nodes"][0]["html"][:200]) for v in serious] == []
