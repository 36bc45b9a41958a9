"""Classes that define something anew run beside the built-in one that they derive from."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from netkf.algorithms.filter import STEPS
from netkf.algorithms.gossip import Gossip
from netkf.algorithms.hybrid import Hybrid
from netkf.algorithms.registry import own_attributes
from netkf.checks.check import SAME_AS_BASE, _error_difference, check
from netkf.checks.evidence import BROKEN, HOLDS, NOT_PROMISED
from netkf.scenario.reading import from_table
from tests.checks.broken import HeavierLinks, LateSwaps, SameWeights, SwapsOnlyX
from tests.checks.test_check import GOSSIP, RING


def beside(table, name, folder):
    chosen = {**table["filter"], "kind": f"tests.checks.broken:{name}"}
    verdict = check(from_table({**table, "filter": chosen}, folder), 10, workers=1)
    rows = [row for row in verdict.rows if row.promise == SAME_AS_BASE.statement]
    assert len(rows) == 1
    return verdict, rows[0]


@pytest.mark.parametrize(
    ("part", "own"),
    [
        (Gossip(), []),
        (Hybrid(epsilon=0.3), []),
        (HeavierLinks(epsilon=0.3), ["link_weights"]),
        (LateSwaps(), ["timing"]),
        (SwapsOnlyX(), ["absorb"]),
        (object(), []),
    ],
    ids=lambda value: type(value).__name__,
)
def test_own_attributes_are_those_that_a_class_defines_anew(part, own):
    assert own_attributes(part) == own


@pytest.mark.slow
def test_own_weights_are_a_design_and_the_row_says_so(tmp_path):
    verdict, row = beside(RING, "HeavierLinks", tmp_path)
    assert row.verdict == NOT_PROMISED
    assert "link_weights is its own" in row.assumptions
    # Its promises are those of the filter with these weights.
    assert bool(verdict)


@pytest.mark.slow
def test_weights_that_change_nothing_hold(tmp_path):
    verdict, row = beside(RING, "SameWeights", tmp_path)
    assert row.verdict == HOLDS
    assert "its own: link_weights" in row.evidence
    assert bool(verdict)
    assert own_attributes(SameWeights(epsilon=0.3)) == ["link_weights"]


@pytest.mark.one_in(2)
@pytest.mark.parametrize(("name", "own"), [("LateSwaps", "timing"), ("SwapsOnlyX", "absorb")])
def test_what_should_be_the_same_and_is_not_is_broken(name, own, tmp_path):
    verdict, row = beside(GOSSIP, name, tmp_path)
    if name == "SwapsOnlyX":  # its P departs too, which says more
        assert 'follows from the broken row "pairs are swapped first' in row.assumptions
    else:
        assert row.verdict == BROKEN
    assert row.off > 1e-3
    assert own in row.evidence
    assert [one.replica for one in verdict.rows if one.verdict == BROKEN] == [0]


def test_each_state_of_each_node_is_compared_in_its_own_unit():
    """A small state beside a large one, and of a node with fewer blocks, whose last are nan."""
    P = np.array([[np.diag([1.0, 1e-18]), np.diag([1e-18, np.nan])]])
    twin = SimpleNamespace(
        times=[1.0], P=P, error=np.full((1, 2, 2), 1e-9), rounding=np.array([1e-24])
    )
    for node, state in ((0, 0), (0, 1), (1, 0)):
        error = twin.error.copy()
        error[0, node, state] += 0.1 * P[0, node, state, state] ** 0.5
        run = SimpleNamespace(**vars(twin) | {"error": error})
        assert _error_difference(run, twin) == pytest.approx(0.1)


def same(verb):
    def method(self, *arguments):
        return getattr(Hybrid, verb)(self, *arguments)

    return method


SAME = {
    f"Same{verb}": dataclasses.dataclass(frozen=True, eq=False)(
        type(f"Same{verb}", (Hybrid,), {verb: same(verb)} if verb else {})
    )
    for verb in ("", *STEPS)
}
globals().update(SAME)


@pytest.mark.one_in(4)
@pytest.mark.parametrize("name", SAME)
def test_a_class_that_changes_nothing_is_not_accused(name, tmp_path):
    chosen = {**RING["filter"], "kind": f"{__name__}:{name}"}
    verdict = check(from_table({**RING, "filter": chosen}, tmp_path), 10, workers=1)
    assert bool(verdict)
    rows = [row.verdict for row in verdict.rows if row.promise == SAME_AS_BASE.statement]
    assert rows == ([] if name == "Same" else [HOLDS])
