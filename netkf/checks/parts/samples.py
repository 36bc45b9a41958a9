"""Statistics of the parts of a scenario: sums and counts of each run, stacked over runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from netkf.checks.parts.events import (
    delay_counts,
    loss_counts,
    pair_counts,
    sample_counts,
    tick_counts,
)
from netkf.checks.parts.noises import plant_noises, reading_noises
from netkf.laws import stack_runs
from netkf.laws.delays import DelayCounts
from netkf.laws.losses import LossCounts, PairCounts
from netkf.laws.noise import NoiseDraws
from netkf.laws.ticks import TickCounts
from netkf.rng.streams import Streams
from netkf.scenario.scenario import Scenario
from netkf.trace.messages import join_messages
from netkf.trace.run import Run

PART_TYPES: dict[str, type[Any]] = {
    "ticks": TickCounts,
    "fates": LossCounts,
    "pairs": PairCounts,
    "steps": NoiseDraws,
    "readings": NoiseDraws,
    "delays": DelayCounts,
    "sampling": TickCounts,
}
"""The statistics of a run: ticks and samples of the clocks of the network and of sensors, losses
and delays of messages, matchings of slots, and noises of the plant and of the readings.
"""


def summarise_parts(scenario: Scenario, run: Run) -> dict[str, Any]:
    """Return counts and draws of a run by the names of PART_TYPES, to compare parts with their
    laws; without those of parts that the scenario has not. Noises are drawn again.
    """
    streams, messages = Streams(run.seed, run.replica), join_messages(run.log)
    found = {
        "ticks": tick_counts(scenario, run),
        "fates": loss_counts(scenario, messages),
        "pairs": pair_counts(scenario, run),
        "steps": plant_noises(scenario, streams),
        "readings": reading_noises(scenario, streams),
        "delays": delay_counts(scenario, messages),
        "sampling": sample_counts(scenario, run),
    }
    return {name: part for name, part in found.items() if part is not None}


@dataclass(frozen=True)
class PartSamples:
    """The summaries of R runs of one seed, which all tests of parts get, by the names of
    PART_TYPES, None without such a part; the arrays in them have a first axis of length R.
    """

    scenario: Scenario
    seed: int
    ticks: Any = None
    fates: Any = None
    pairs: Any = None
    steps: Any = None
    readings: Any = None
    delays: Any = None
    sampling: Any = None


def stack_parts(
    scenario: Scenario, seed: int, summaries: Sequence[Mapping[str, Any]]
) -> PartSamples:
    """Return the ``summaries`` of R runs of ``seed`` as one object for the tests."""
    present = {name: [one[name] for one in summaries if name in one] for name in PART_TYPES}
    columns = {name: stack_runs(counts) for name, counts in present.items() if counts}
    return PartSamples(scenario, seed, **columns)
