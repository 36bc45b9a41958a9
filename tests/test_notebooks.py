"""Notebooks are those of their scripts, run from an empty folder, and say what the page says."""

import re

import pytest

from tests.documents import DOCS, blocks
from tests.notebooks import SCRIPTS, notebook, run_cells

TUTORIAL = DOCS / "tutorials" / "first_verdict.md"


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_a_notebook_is_that_of_its_script(script):
    kept = script.with_suffix(".ipynb").read_text(encoding="utf-8")
    assert kept == notebook(script), "write it again: python -m tests.notebooks"


@pytest.mark.slow
def test_the_ten_minutes_are_the_same_on_the_page_and_in_the_notebook(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    _, _, error, run, _, alone, _, theory, size, verdict = run_cells(TUTORIAL.with_suffix(".ipynb"))
    page = TUTORIAL.read_text(encoding="utf-8")
    (toml,) = (block.text for block in blocks(TUTORIAL) if block.name == "line.toml")
    assert (tmp_path / "line.toml").read_text() == toml
    assert error.strip() in page
    # Its tables: node, RMS error, mean trace P of a run, with the network and without.
    rows = re.findall(r"^ +([012]) +([\d.]+) +([\d.]+) +\S+ +\S+ +[\d.]+$", page, re.MULTILINE)
    told = re.findall(r"node (\d): RMS error ([\d.]+), mean trace P ([\d.]+)", run)
    assert told == rows[:3]
    traces = [float(number) for number in re.findall(r"\d+\.\d+", alone)]
    assert traces == pytest.approx([float(row[2]) for row in rows[3:]], rel=1e-3)
    assert "[1.252 2.475 1.252] - one filter with all readings: 0.8073" in theory
    assert "network.activation.rate = 8.537," in size
    holds, undecided = re.search(r"(\d+) holds, (\d+) undecided; 50 runs", page).groups()
    assert "no promise is broken: True" in verdict
    assert re.search(rf"holds +{holds}\nundecided +{undecided}\n", verdict)
