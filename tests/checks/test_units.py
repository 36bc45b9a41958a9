"""A scenario with a state in another unit has the same verdict, of healthy and of broken runs."""

import copy

import numpy as np
import pytest

from netkf.checks.check import check
from netkf.scenario.reading import from_table
from tests.checks.test_check import DIFFUSION, GOSSIP, INTERMITTENT, PUSH_SUM, RING, is_caught

MIXED = 1.0, 2.0**-20
"""Units of both states: powers of two, so that numbers have the same digits."""


def in_units(table, units):
    """Return the table of a scenario whose states (n,) are ``units`` times as large."""
    scaled, column = copy.deepcopy(table), np.array(units)[:, None]
    plant = scaled["plant"]
    for key in {"A", "F"} & plant.keys():
        plant[key] = (column * np.array(plant[key]) / column.T).tolist()
    for key in {"Q", "cov"} & plant.keys():
        plant[key] = (column * np.array(plant[key]) * column.T).tolist()
    if "B" in plant:
        plant["B"] = (column * np.array(plant["B"])).tolist()
    for sensor in scaled["sensors"]:
        sensor["H"] = (np.array(sensor["H"]) / column.T).tolist()
    return scaled


@pytest.mark.one_in(2)
@pytest.mark.parametrize("table", [GOSSIP, INTERMITTENT, RING, PUSH_SUM, DIFFUSION])
def test_rows_about_the_filter_have_no_units(table, tmp_path):
    given, mixed = (
        check(from_table(one, tmp_path), 20, workers=1) for one in (table, in_units(table, MIXED))
    )
    assert [row.promise for row in mixed.rows] == [row.promise for row in given.rows]
    for row, other in zip(given.rows, mixed.rows, strict=True):
        assert other.verdict == row.verdict, row.promise
        # The noise of the plant is drawn by other roots, which its own rows are about.
        if row.promise != "the plant follows its equation without a bias":
            assert other.detectable == pytest.approx(row.detectable, rel=0.05, nan_ok=True)


@pytest.mark.one_in(2)
def test_a_covariance_that_is_wrong_in_a_small_state_is_found(tmp_path):
    chosen = {"kind": "tests.checks.broken:OverconfidentInOneState"}
    given, mixed = (
        {
            row.source
            for row in check(from_table({**one, "filter": chosen}, tmp_path), 10, workers=1).rows
            if is_caught(row)
        }
        for one in (GOSSIP, in_units(GOSSIP, MIXED))
    )
    assert mixed == given
    assert "G Lemma 14" in given
