"""What is checked of nodes that estimate blocks of the state."""

from __future__ import annotations

from pathlib import Path

import pytest

import netkf
from netkf.checks.check import find_checks
from netkf.checks.evidence import BROKEN
from tests.algorithms.test_block_intersection import BELIEF, CLOCKED, KEPT, ROBOTS, load

CRASHES = [{"kind": "crashes", "nodes": [2], "mean_up": 1.5, "mean_down": 0.5}]
BOUND = "P is at least the covariance of the error, given the events"


@pytest.mark.parametrize(
    ("text", "kind", "changes"),
    [
        (CLOCKED, "block-intersection", {}),
        (ROBOTS, "block-intersection", {"filter__rule": "naive"}),
        (ROBOTS, "central", {"filter__estimates": "own+neighbours"}),
        (CLOCKED, "block-belief-propagation", {"network__lives": CRASHES}),
        (ROBOTS, "partition", {"filter__estimates": "own+neighbours"}),
    ],
    ids=["split", "naive", "central", "lives", "partition"],
)
def test_overconfident_filters_of_blocks_are_found_and_no_others(
    tmp_path: Path, text: str, kind: str, changes: dict[str, object]
) -> None:
    scenario = load(text, tmp_path, horizon=3.0, filter__kind=kind, **changes)
    verdict = netkf.check(scenario, runs=10)
    rows = {row.promise: row for row in verdict.rows}
    broken = [row.promise for row in verdict.rows if row.verdict == BROKEN]
    assert broken == ([BOUND] if "filter__rule" in changes else [])
    assert rows["P follows the equations along the events of each run"].verdict == "holds"
    assert rows["files hold the run, and the summary counts it"].verdict == "holds"
    assert rows["estimates, covariances and weights begin as [filter] says"].verdict == "holds"


@pytest.mark.parametrize("lives", [[], CRASHES], ids=["up", "lives"])
@pytest.mark.parametrize("text", [ROBOTS, CLOCKED], ids=["slots", "clocks"])
@pytest.mark.parametrize("kind", [KEPT, BELIEF], ids=lambda kind: kind["kind"])
def test_what_papers_say_of_blocks_is_promised(
    tmp_path: Path, text: str, kind: dict[str, object], lives: list[dict[str, object]]
) -> None:
    changes = {"filter": kind | {"estimates": "own"}, "network__lives": lives}
    scenario = load(text, tmp_path, **changes)
    names = [promise.statement for promise in find_checks(scenario).promises(scenario)]
    assert "P is the covariance of the error, given the events" in names
