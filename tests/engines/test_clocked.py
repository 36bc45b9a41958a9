"""Everything that runs in continuous time: both engines, one event after the other."""

import collections

import numpy as np
import pytest

import netkf
from netkf.engines.compiled.engine import CompiledEngine
from tests.engines.agreement import assert_agree
from tests.engines.drawn import FILTERS, LITERATURE, drawn_scenario

FEW, MANY, TOGETHER = 32, 360, 8
SIZES = 1, 2, 5
"""Numbers of states: loops are unrolled up to 4, by code that is compiled for each."""


def agree(seeds, folder, sizes=SIZES, filters=FILTERS):
    """Runs of the scenarios of these seeds."""
    runs = {}
    for seed in seeds:
        place = folder / str(seed)
        place.mkdir()
        scenario = drawn_scenario(seed, place, sizes, filters)
        runs[seed] = scenario, assert_agree(scenario)
    return runs


@pytest.mark.one_in(8)
@pytest.mark.parametrize("first", range(0, FEW, 4))
def test_drawn_scenarios_agree(first, tmp_path):
    agree(range(first, first + 4), tmp_path)


LATER = range(TOGETHER, FEW + 2 * TOGETHER, TOGETHER)


@pytest.mark.slow
@pytest.mark.parametrize("first", [0, *LATER])
def test_filters_of_the_literature_agree(first, tmp_path):
    """Fusion with the best weight, constant gains, consensus on predictions, beliefs."""
    for scenario, run in agree(
        range(first, first + TOGETHER), tmp_path, filters=LITERATURE
    ).values():
        # Runs side by side have the same bits.
        for batch in CompiledEngine().run_many(scenario, scenario.seed, range(2)):
            alone = [netkf.simulate(scenario, replica=k) for k in batch.replicas]
            for one, k in zip(alone, range(len(alone)), strict=True):
                count = len(one.times)
                np.testing.assert_array_equal(batch.xhat[k, :count], one.xhat)
                np.testing.assert_array_equal(batch.P[k, :count], one.P)
                assert batch.counts[k].sum() == len(one.log)
        assert run.engine == "compiled"


@pytest.mark.slow
def test_many_drawn_scenarios_agree_and_leave_nothing_out(tmp_path):
    runs = agree(range(FEW, FEW + MANY), tmp_path, range(1, 6))
    filters = collections.Counter(
        type(scenario.node_filter).__name__ for scenario, _ in runs.values()
    )
    assert len(filters) == len(FILTERS)
    assert min(filters.values()) >= 30
    counts = collections.Counter()
    for scenario, run in runs.values():
        kinds = ("tick", "transmit", "send", "lost", "late", "deliver", "absorb", "sense")
        counts.update(kind for kind in kinds if run.count(kind))
        mixed = scenario.increment_sensors and scenario.sampled_sensors
        counts["frames"] += scenario.exact_errors
        counts["directed"] += scenario.topology.directed
        counts["mixed"] += bool(mixed)
        counts["on one node"] += bool(mixed and set(mixed) & set(scenario.increment_sensors))
    assert min(counts.values()) >= 5, counts
