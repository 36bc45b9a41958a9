"""Forecasts of ``check`` against the runs that it takes, a slow study.

``python -m tests.checks.forecasts scenarios/gossip_ring.toml --first 60 --runs 600 --blocks 4``
runs a scenario, judges blocks of replicas at ``--first`` runs, and looks for the number of runs at
which each row that was undecided there holds. It prints the median over the blocks of the forecast
over that number, for each row; a forecast should hold within a factor of 1.5.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Iterator, Sequence

import numpy as np

from netkf.checks.check import ReplicaResult, judge_replicas, run_replica, with_check_times
from netkf.checks.evidence import BROKEN, HOLDS, UNDECIDED, Evidence
from netkf.core.errors import ScenarioError
from netkf.scenario.reading import load
from netkf.scenario.scenario import Scenario

GROWTH = 1.12
"""Factor from one number of runs to the next at which rows are looked at."""


def _rows(
    scenario: Scenario, results: Sequence[ReplicaResult], seed: int
) -> dict[tuple[str, str], Evidence]:
    verdict = judge_replicas(scenario, results, seed, 0.99)
    return {(row.promise, row.source): row for row in verdict.rows}


def forecast_ratios(
    scenario: Scenario, results: Sequence[ReplicaResult], first: int, seed: int
) -> Iterator[tuple[str, float]]:
    """Yield the promise and the forecast at ``first`` runs over the runs at which it holds; inf if
    all ``results`` do not decide it, nan if it is broken on the way.
    """
    undecided = {
        key: row.needed
        for key, row in _rows(scenario, results[:first], seed).items()
        if row.verdict == UNDECIDED and row.needed is not None
    }
    steps = int(np.log(len(results) / first) / np.log(GROWTH))
    for runs in np.geomspace(first, len(results), steps + 1)[1:].astype(int).tolist():
        found = _rows(scenario, results[:runs], seed)
        for key in [key for key in undecided if found[key].verdict in (HOLDS, BROKEN)]:
            needed = undecided.pop(key)
            yield key[0], needed / runs if found[key].verdict == HOLDS else np.nan
    yield from ((promise, np.inf) for promise, _ in undecided)


def _main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenario")
    parser.add_argument("--first", type=int, default=60, help="runs at which forecasts are made")
    parser.add_argument("--runs", type=int, default=600, help="runs of a block")
    parser.add_argument("--blocks", type=int, default=4)
    options = parser.parse_args()
    scenario = load(options.scenario)
    try:
        scenario = with_check_times(scenario)
    except ScenarioError as error:
        parser.error(str(error))
    found = defaultdict(list)
    for seed in range(options.blocks):
        results = [run_replica(scenario, seed, replica) for replica in range(options.runs)]
        for promise, ratio in forecast_ratios(scenario, results, options.first, seed):
            found[promise].append(ratio)
    for promise, ratios in found.items():
        shown = " ".join(f"{ratio:.2f}" for ratio in sorted(ratios))
        print(f"{np.median(ratios):5.2f}  {promise}: {shown}", flush=True)


if __name__ == "__main__":
    _main()
