"""False alarms of ``check`` on healthy scenarios drawn at random.

``python -m tests.checks.calibration --count 300 --runs 30`` draws scenarios by number, runs
``check`` on each at two confidences and prints every broken row, then how many scenarios were
accused at each level. The confidence is that of all intervals of a verdict together, so that at
most one healthy scenario in a hundred may be accused at 99 %, and one in five at 80 %; exact rows
never.
``--seeds`` repeats each scenario with as many seeds, ``--any`` draws filters, tables and networks
of all kinds.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from netkf.checks.check import Verdict, judge_replicas, run_replica, with_check_times
from netkf.checks.evidence import BROKEN, Evidence
from netkf.core.errors import NetkfError
from netkf.scenario.scenario import Scenario
from tests.checks.any_scenario import draw_any
from tests.checks.healthy import draw_scenario

LEVELS = (0.01, 0.2)


class Accusation(NamedTuple):
    """A broken row of a healthy scenario at a level."""

    name: str
    seed: int
    level: float
    row: Evidence


def judge_at(
    scenario: Scenario, runs: int, seed: int, levels: Sequence[float] = LEVELS
) -> list[Verdict]:
    """Return one verdict on the same replicas for each level; raises NetkfError if refused."""
    chosen = with_check_times(scenario)
    results = [run_replica(chosen, seed, replica) for replica in range(runs)]
    return [judge_replicas(chosen, results, seed, 1.0 - level) for level in levels]


def accusations(
    scenario: Scenario, runs: int, seed: int, levels: Sequence[float] = LEVELS
) -> list[Accusation]:
    """Return the broken rows of a scenario at all levels."""
    verdicts = judge_at(scenario, runs, seed, levels)
    return [
        Accusation(scenario.name, seed, level, row)
        for level, verdict in zip(levels, verdicts, strict=True)
        for row in verdict.rows
        if row.verdict == BROKEN
    ]


def _main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--first", type=int, default=0, help="number of the first scenario")
    parser.add_argument("--count", type=int, default=300)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--runs", type=int, default=30)
    parser.add_argument("--any", action="store_true", help="of any_scenario, not of healthy")
    options = parser.parse_args()
    judged, refused, accused = 0, 0, dict.fromkeys(LEVELS, 0)
    with tempfile.TemporaryDirectory() as folder:
        for number in range(options.first, options.first + options.count):
            draw = draw_any if options.any else draw_scenario
            scenario = draw(number, Path(folder))
            # Seeds of their own: rows about streams of one name would else share one outcome.
            for seed in range(1000 * number, 1000 * number + options.seeds):
                try:
                    found = accusations(scenario, options.runs, seed)
                except NetkfError as error:
                    refused += 1
                    print(f"{number} {scenario.name}: refused: {error}", flush=True)
                    break
                judged += 1
                for level in {one.level for one in found}:
                    accused[level] += 1
                for _, _, level, row in found:
                    print(
                        f"{number} {scenario.name}, seed {seed}, level {level}: {row}", flush=True
                    )
    for level, count in accused.items():
        print(f"level {level:g}: {count} of {judged} verdicts accuse, {refused} refused")
    return int(any(count > 3.0 * level * judged + 3.0 for level, count in accused.items()))


if __name__ == "__main__":
    sys.exit(_main())
