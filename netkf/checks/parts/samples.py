"""Statistics of the parts of a scenario: sums and counts of each run, stacked over runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from netkf.checks.parts.events import delays_of, losses_of, pairs_of, samples_of, ticks_of
from netkf.checks.parts.noises import plant_noises, reading_noises
from netkf.laws.delays import DelayCounts
from netkf.laws.losses import LossCounts, PairCounts
from netkf.laws.noise import NoiseDraws
from netkf.laws.ticks import TickCounts
from netkf.rng.streams import Streams
from netkf.scenario.scenario import Scenario
from netkf.trace.run import Run


class PartSummary(NamedTuple):
    """Counts and draws of one run for each part; None where the scenario has no such part.

    ticks, sampling : ticks of the clocks of the network and of sampled sensors
    fates, delays   : losses and delays of messages
    pairs           : matchings of slots
    steps, readings : noises of the plant and of the sensors
    """

    ticks: TickCounts | None
    fates: LossCounts | None
    pairs: PairCounts | None
    steps: NoiseDraws | None
    readings: NoiseDraws | None
    delays: DelayCounts | None
    sampling: TickCounts | None


PART_TYPES: dict[str, type[Any]] = dict(
    zip(
        PartSummary._fields,
        (TickCounts, LossCounts, PairCounts, NoiseDraws, NoiseDraws, DelayCounts, TickCounts),
        strict=True,
    )
)
"""The classes of the fields of :class:`PartSummary`."""


def summarise_parts(scenario: Scenario, run: Run) -> PartSummary:
    """Return counts and draws of a run to compare parts with their laws; noises are drawn again."""
    streams = Streams(run.seed, run.replica)
    return PartSummary(
        ticks=ticks_of(scenario, run),
        fates=losses_of(scenario, run),
        pairs=pairs_of(scenario, run),
        steps=plant_noises(scenario, streams),
        readings=reading_noises(scenario, streams),
        delays=delays_of(scenario, run),
        sampling=samples_of(scenario, streams),
    )


@dataclass(frozen=True)
class PartSamples:
    """The summaries of R runs of one seed, which all tests of parts get, with the fields of
    :class:`PartSummary`; the arrays in them have a first axis of length R.
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


def stack_parts(scenario: Scenario, seed: int, summaries: Sequence[PartSummary]) -> PartSamples:
    """Return the ``summaries`` of R runs of ``seed`` as one object for the tests."""
    columns: dict[str, Any] = {}
    for name in PartSummary._fields:
        present = [part for summary in summaries if (part := getattr(summary, name)) is not None]
        if present:
            arrays = (np.array(column) for column in zip(*present, strict=True))
            columns[name] = type(present[0])(*arrays)
    return PartSamples(scenario, seed, **columns)
