"""Pages of results in memory, as notebooks show them."""

import html
import re
from html.parser import HTMLParser

import pytest

import netkf
from netkf.cli.main import main
from tests.conftest import SCENARIOS


class Frames(HTMLParser):
    """Collects the documents of iframes, with references resolved as a browser does."""

    def __init__(self):
        super().__init__()
        self.documents = []

    def handle_starttag(self, tag, attrs):
        if tag == "iframe":
            self.documents.append(dict(attrs)["srcdoc"])


def test_a_notebook_shows_the_page_of_the_command(tmp_path, monkeypatch):
    scenario = netkf.load(SCENARIOS / "poisson_ring.toml", {"horizon": 2.0})
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
    with pytest.raises(netkf.ScenarioError, match="give a run or its directory"):
        netkf.page(None)
