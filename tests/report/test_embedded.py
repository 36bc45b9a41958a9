"""Pages of results in memory, as notebooks show them."""

import html
import re
from html.parser import HTMLParser

import pytest

import netkf
from netkf.cli.main import main
from tests.conftest import SCENARIOS

RING = SCENARIOS / "poisson_ring.toml"


class Frames(HTMLParser):
    """Collects the documents of iframes, with references resolved as a browser does."""

    def __init__(self):
        super().__init__()
        self.documents = []

    def handle_starttag(self, tag, attrs):
        if tag == "iframe":
            self.documents.append(dict(attrs)["srcdoc"])


def test_a_notebook_shows_the_page_of_the_command(tmp_path, monkeypatch):
    scenario = netkf.load(RING, {"horizon": 2.0})
    run = netkf.simulate(scenario, engine="simpy")
    page = netkf.page(run)
    frames = Frames()
    frames.feed(page._repr_html_())
    assert frames.documents == [page.html]
    assert repr(page).startswith("<netkf page, ")
    assert not re.search(r"tmp\w{8}", page.html)  # no folder that is gone
    monkeypatch.chdir(tmp_path)
    netkf.save(run, scenario, "RUN1")
    assert main(["report", "RUN1", "--out", "page.html"]) == 0
    written = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert " --out page.html" in html.unescape(written)
    assert written.replace(" --out page.html", "") == page.html
    assert netkf.page(netkf.open("RUN1")).html == page.html
    assert page.save("saved.html").read_text(encoding="utf-8") == page.html
    with pytest.raises(netkf.ScenarioError, match="give a run, an ensemble or its directory"):
        netkf.page(None)


def test_the_page_of_an_ensemble_in_memory_is_that_of_the_command(tmp_path, monkeypatch):
    scenario = netkf.load(RING, {"horizon": 1.0})
    ensemble = netkf.monte_carlo(scenario, 3, seed=7, engine="simpy", workers=1)
    page = netkf.page(ensemble)
    monkeypatch.chdir(tmp_path)
    options = ["--set", "horizon=1.0", "--seed", "7", "--engine", "simpy", "--runs", "3"]
    assert main(["run", str(RING), *options, "--no-plot", "--out", "RUN1"]) == 0
    assert netkf.page("RUN1").html == page.html


def test_results_in_memory_have_classes_that_are_imported_and_directories_have_not(
    tmp_path, monkeypatch
):
    """The page of a run with a filter of one's own was refused, and asked for a trust argument."""
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own_alone.py").write_text(
        "import netkf.parts\n\nclass Own(netkf.parts.Filter):\n"
        "    def absorb(self, state, messages, exchange):\n        return state\n"
    )
    table = {"kind": "own_alone:Own"}
    scenario = netkf.load(RING, {"horizon": 1.0, "filter": table, "network.activation.at": "nodes"})
    run = netkf.simulate(scenario, engine="simpy")
    page = netkf.page(run)
    assert "--trust" in page.html
    netkf.save(run, scenario, "RUN1")
    with pytest.raises(netkf.ScenarioError, match=r"in Python: trust=True"):
        netkf.page("RUN1")
    assert netkf.page(netkf.open("RUN1", trust=True)).html == page.html
    with pytest.raises(netkf.ScenarioError, match=r"in Python: trust=True"):
        netkf.page(run, "RUN1")


def test_a_notebook_shows_the_sentences_of_an_explanation():
    run = netkf.simulate(netkf.load(RING, {"horizon": 2.0}), engine="simpy")
    found = netkf.why(run, 1, 1.0)
    frame = found._repr_html_()
    assert frame.startswith("<pre>")
    assert html.unescape(frame)[5:-6] == str(found)
