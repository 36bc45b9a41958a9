"""What runs show of the parts of a scenario: sums and counts, stacked over runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from netkf.checks.parts.delays import DelayCounts, count_delays
from netkf.checks.parts.events import (
    LossCounts,
    PairCounts,
    count_losses,
    count_pairs,
)
from netkf.checks.parts.moments import NoiseMoments
from netkf.checks.parts.noises import plant_moments, reading_moments
from netkf.checks.parts.ticks import TickCounts, count_samples, count_ticks
from netkf.rng.streams import Streams
from netkf.scenario.scenario import Scenario
from netkf.trace.run import Run


class PartSummary(NamedTuple):
    """What one run shows of each part; None where the scenario has no such part."""

    ticks: TickCounts | None
    fates: LossCounts | None
    pairs: PairCounts | None
    steps: NoiseMoments | None
    readings: NoiseMoments | None
    delays: DelayCounts | None
    sampling: TickCounts | None


PART_TYPES: dict[str, type[Any]] = {
    "ticks": TickCounts,
    "fates": LossCounts,
    "pairs": PairCounts,
    "steps": NoiseMoments,
    "readings": NoiseMoments,
    "delays": DelayCounts,
    "sampling": TickCounts,
}
"""The classes of the fields of :class:`PartSummary`."""


def summarise_parts(scenario: Scenario, run: Run) -> PartSummary:
    """Return the summary of one run."""
    streams = Streams(run.seed, run.replica)
    return PartSummary(
        count_ticks(scenario, run),
        count_losses(scenario, run),
        count_pairs(scenario, run),
        plant_moments(scenario, streams),
        reading_moments(scenario, streams),
        count_delays(scenario, run),
        count_samples(scenario, streams),
    )


@dataclass(frozen=True)
class PartSamples:
    """The summaries of R runs, every field of which has a first axis of length R, and the seed of
    the runs.
    """

    scenario: Scenario
    seed: int
    ticks: Any
    fates: Any
    pairs: Any
    steps: Any
    readings: Any
    delays: Any
    sampling: Any


def stack_parts(scenario: Scenario, seed: int, summaries: Sequence[PartSummary]) -> PartSamples:
    """Return the samples of all runs; a part that is missing in one run is missing."""
    columns = {}
    for name in PartSummary._fields:
        parts = [getattr(one, name) for one in summaries]
        kept = [part for part in parts if part is not None]
        columns[name] = (
            type(kept[0])(*(np.array(column) for column in zip(*kept, strict=True)))
            if kept
            else None
        )
    return PartSamples(scenario, seed, **columns)
