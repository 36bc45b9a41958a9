"""Promises about clocks, losses, delays and matchings, from the counts of many runs."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np

from netkf.checks import evidence
from netkf.checks.evidence import Assumption, Finding, Promise, find_identity
from netkf.checks.laws import find
from netkf.checks.parts import events
from netkf.checks.parts.events import PartSamples, loss_law, stated_delay
from netkf.core.clock import Entity
from netkf.core.errors import ScenarioError
from netkf.laws import losses, ticks
from netkf.laws.intervals import LawComparison, with_drawn
from netkf.laws.stating import stated_part
from netkf.laws.ticks import ClockGroup
from netkf.linalg.arrays import FloatArray
from netkf.network.contacts import Contacts
from netkf.network.delays import delay_depends_on_message
from netkf.network.matchings import Matching
from netkf.scenario.registry import name_of
from netkf.scenario.scenario import Scenario
from netkf.theory.common.random_links import has_recorded_broadcasts

RATE_TOLERANCE, DISPERSION_TOLERANCE = 0.05, 0.25
"""Tolerated relative error of a rate; and of the variance of Poisson counts, or correlation of two
clocks.
"""
PROBABILITY_TOLERANCE, CORRELATION_TOLERANCE = 0.05, 0.2
"""Tolerated error of a share of messages or slots, and of a correlation of losses."""
SHARE_TOLERANCE, MEAN_TOLERANCE = 0.02, 0.05
"""Tolerated error of the share of waiting times in a cell, and of the mean rank of delays."""
TIME_TOLERANCE = 1e-9
"""Seconds, for each second of the run, by which rounding may move a tick or an arrival."""
WANTED_RATE = 0.02
"""Relative error of the rate of one clock that the test should detect."""
ENOUGH_TICKS, MAX_DRAWN, MAX_DRAWN_TICKS, DRAWN_PER_RUN = 80_000, 20_000, 3e6, 4
"""Ticks of one clock that reveal an error of WANTED_RATE. Limits on the extra replicas in which
only the clocks are drawn: clocks times replicas, ticks of all clocks, and replicas for each run.
"""
MIN_DRAWN_SHARE = 0.1
"""Share of the runs below which so few extra replicas would hardly narrow the intervals."""
Test = Callable[[PartSamples, float], Finding]
"""A test of a row: a function of the samples of all runs and a level."""
Draw = Callable[[Scenario, Sequence[Entity], int, int], list[FloatArray]]
"""Function of (scenario, entities, seed, replica) that returns the ticks of clocks in a replica of
which nothing else is simulated.
"""


class JudgedClocks(NamedTuple):
    """The clocks of the network, or of sensors: which these are in a scenario, the field of
    PartSamples with their counts, how they are drawn, the group of their rows, and words of these.
    """

    group: Callable[[Scenario], ClockGroup]
    field: str
    draw: Draw
    about: str
    act: str
    noun: str


NETWORK = JudgedClocks(
    events.network_clocks, "ticks", events.redraw_ticks, evidence.CLOCKS, "clocks tick", "ticks"
)
SENSORS = JudgedClocks(
    events.sampling_clocks, "sampling", events.redraw_samples, evidence.SAMPLING, "sensors sample",
    "samples",
)  # fmt: skip
CONTACT_SENTENCE = "links tick in their contacts only"


@lru_cache(maxsize=4)
def _drawn_counts(
    clocks: JudgedClocks, scenario: Scenario, seed: int, first: int, count: int
) -> np.ndarray:
    entities, replicas = clocks.group(scenario).entities, range(first, first + count)
    drawn = (clocks.draw(scenario, entities, seed, replica) for replica in replicas)
    return np.array([[len(times) for times in ticks] for ticks in drawn])


def _number_drawn(group: ClockGroup, horizon: float, runs: float) -> int:
    """Return the number of replicas of clocks alone that reveal an error WANTED_RATE."""
    expected = group.rates * horizon
    further = min(
        math.ceil(ENOUGH_TICKS / expected.min() - runs),
        int(DRAWN_PER_RUN * runs),
        int(MAX_DRAWN / len(expected)),
        int(MAX_DRAWN_TICKS / expected.sum()),
    )
    return int(further) if further >= MIN_DRAWN_SHARE * runs else 0


def _check_rates(clocks: JudgedClocks, samples: PartSamples, level: float) -> Finding:
    scenario, group = samples.scenario, clocks.group(samples.scenario)
    found, horizon = getattr(samples, clocks.field), scenario.horizon
    windows = found.ticks
    counts, runs = windows.sum(axis=1), len(windows)
    further = _number_drawn(group, horizon, runs)
    if further:
        drawn = _drawn_counts(clocks, scenario, samples.seed, runs, further)
        counts = np.concatenate([counts, drawn])
    slack = ticks.slack_of_start(group, counts, found.path)

    def sample_factor(factor: float) -> float:
        """Return the factor on the number of counts of a clock for a factor on the runs."""
        more = factor * runs + _number_drawn(group, horizon, factor * runs)
        return more / len(counts)

    singles = [
        with_drawn(one, sample_factor)
        for one in ticks.rates_of_each(group, counts, slack, horizon, level / 3.0)
    ]
    distances = ticks.rates_of_all(group, windows, float(slack.sum()), horizon, level / 3.0)
    distances += zip(singles, group.labels, strict=True)
    text = f"{windows.sum():,.0f} ticks, relative difference from the rates,"
    finding = find(LawComparison(distances, text, overall=1), RATE_TOLERANCE)
    # A reader is told where more ticks are needed, and not a better test.
    worst = max(range(len(singles)), key=lambda k: singles[k].detectable)
    if singles[worst].detectable <= WANTED_RATE or not group.poisson:
        return finding
    number = float(group.rates[worst]) * horizon * len(counts)
    note = f"no test at this level finds less than {ticks.smallest_error(number, level):.2g} in"
    return finding._replace(message=f"{finding.message}; of one clock, {note} {number:,.0f} ticks")


def _check_gaps(clocks: JudgedClocks, samples: PartSamples, level: float) -> Finding:
    shares, neighbours = ticks.compare_gaps(getattr(samples, clocks.field), level)
    finding = find(shares, SHARE_TOLERANCE)
    # The correlation is reported if it is significant, and the law of single gaps is not wrong.
    if neighbours.worst is not None and not finding.margin[2] < 0.0:
        return find(neighbours, SHARE_TOLERANCE)
    for distance, _ in neighbours.distances:
        text = f"{finding.message}; correlation of neighbouring gaps {distance.seen:.2g}"
        return finding._replace(message=f"{text}, {distance.detectable:.2g} is detectable")
    return finding


def _check_lattice(clocks: JudgedClocks, samples: PartSamples, level: float) -> Finding:
    counts = getattr(samples, clocks.field)
    message = f"{counts.ticks.sum():,.0f} ticks, times in units of the length of a run"
    off = float(counts.off.max()) / samples.scenario.horizon
    return find_identity(off, TIME_TOLERANCE, message)


def _clocks_apart(clocks: JudgedClocks, samples: PartSamples, level: float) -> Finding:
    group, counts = clocks.group(samples.scenario), getattr(samples, clocks.field)
    comparison = ticks.compare_clocks(group, counts.ticks, samples.scenario.horizon, level)
    return find(comparison, DISPERSION_TOLERANCE)


def _clock_promises(clocks: JudgedClocks, samples: PartSamples) -> list[Promise]:
    counts, group = getattr(samples, clocks.field), clocks.group(samples.scenario)
    act, noun, rows = clocks.act, clocks.noun, []

    def add(text: str, test: Callable[..., Finding], exact: bool = False) -> None:
        rows.append(_row(text, clocks.about, partial(test, clocks), exact=exact))

    if counts is None:
        return []
    if clocks is NETWORK and isinstance(samples.scenario.network.activation, Contacts):
        add(CONTACT_SENTENCE, _check_lattice, exact=True)
    if not np.isfinite(group.rates).all():
        return rows
    if group.on_lattice:
        add(f"{act} at the times of the scenario", _check_lattice, exact=True)
    add(f"{act} at the rates of the scenario", _check_rates)
    if group.poisson:
        exponential = f"gaps between {noun} are exponential, and independent of those before"
        add(exponential, _check_gaps)
        add(f"{act} independently of each other", _clocks_apart)
    elif counts.cells.any():
        law = f"{noun} follow the law of their clocks, and do not depend on those before"
        add(law, _check_gaps)
    return rows


@lru_cache(maxsize=8)
def pair_probabilities(scenario: Scenario) -> FloatArray | None:
    """Return the probability (L,) of each link to be in a matching; None if unknown."""
    stated = stated_part(scenario.network.activation, "slot activation")
    if not isinstance(stated, Matching) or not scenario.topology.links:
        return None
    try:
        mean = stated.mean(scenario.topology)
    except ScenarioError:
        return None
    i, j = scenario.topology.ends.T
    return np.asarray(mean[i, j])


def _check_matchings(samples: PartSamples, level: float) -> Finding:
    p, links = pair_probabilities(samples.scenario), samples.scenario.topology.links
    assert p is not None
    return find(losses.compare_matchings(p, samples.pairs, links, level), PROBABILITY_TOLERANCE)


def _check_fixed(samples: PartSamples, level: float) -> Finding:
    off = float(samples.delays.off.max()) / samples.scenario.horizon
    return find_identity(off, TIME_TOLERANCE, "delays in units of the length of a run")


def _check_delays(samples: PartSamples, level: float) -> Finding:
    links = samples.scenario.topology.directions
    law, means = losses.compare_delays(samples.delays, links, level)
    finding = find(law, SHARE_TOLERANCE)
    # The law of all delays is reported if it is wrong, or if no direction is significantly off.
    if finding.margin[2] < 0.0 or means.worst is None:
        return finding
    return find(means, MEAN_TOLERANCE)


DRAWN, STATED = "losses are drawn, not recorded", "losses state how often messages are lost"
SAME = "all messages of a link are lost with one probability"


def _row(text: str, group: str, test: Test, *needs: str, exact: bool = False) -> Promise:
    return Promise(text, "the scenario", needs, test, exact, group)


def _loss_row(
    text: str, compare: Callable[..., LawComparison], tolerance: float, *needs: str
) -> Promise:
    def test(samples: PartSamples, level: float) -> Finding:
        return find(compare(loss_law(samples.scenario), samples.fates, level), tolerance)

    return _row(text, evidence.LOSSES, test, DRAWN, STATED, *needs)


LOSS_ROW = _loss_row(
    "messages are lost as often as the scenario says, in each direction",
    losses.compare_losses,
    PROBABILITY_TOLERANCE,
)
LOSSES_APART = _loss_row(
    "messages are lost independently of each other",
    losses.compare_independence,
    CORRELATION_TOLERANCE,
    SAME,
)
BURSTS = _loss_row(
    "losses follow each other as the scenario says", losses.compare_bursts, PROBABILITY_TOLERANCE
)
SHARED_ROW = _loss_row(
    "hearers of a broadcast lose it together as often as the scenario says",
    losses.compare_joint_losses,
    PROBABILITY_TOLERANCE,
    SAME,
)
MATCHING_ROW = _row(
    "links are paired as often as the protocol says, whatever happened before",
    evidence.MATCHINGS,
    _check_matchings,
)
FIXED = _row("messages take the time of the scenario", evidence.DELAYS, _check_fixed, exact=True)
DELAY_LAW = _row(
    "delays of messages have the law of the scenario, independent of each other",
    evidence.DELAYS,
    _check_delays,
)


def loss_assumptions(scenario: Scenario) -> list[Assumption]:
    """Return assumptions of tests of losses: a stated law, one for all messages of a link."""
    channel, law = scenario.network.channel, loss_law(scenario)
    loss: Any = stated_part(channel.loss, "loss")
    drawn, why = True, "links are up unless a message is lost"
    if loss.deterministic and not loss.independent:
        drawn, why = False, "a table lists which messages arrive"
    elif delay_depends_on_message(channel.delay):
        # Such a delay may lose a message (nan), which the law of losses does not state.
        drawn, why = False, "delays depend on the message, and may lose it"
    elif scenario.network.radio is not None and scenario.network.radio.queue == "drop":
        drawn, why = False, "a radio that is busy loses messages"
    elif has_recorded_broadcasts(scenario):
        drawn, why = False, "a table lists the links that are up; others lose their messages"
    source, name = "the scenario", f"the loss {name_of('loss', channel.loss)!r}"
    stated = bool(np.isfinite(law.lost).all())
    changes = "" if law.steady else f"{name}, or the number of frames, changes it with the message"
    return [
        Assumption(DRAWN, source, drawn, why),
        Assumption(STATED, source, stated, "for each link" if stated else f"{name} does not"),
        Assumption(SAME, source, law.steady, changes),
    ]


def network_promises(samples: PartSamples) -> list[Promise]:
    """Return promises about clocks, matchings, losses and delays with a stated law."""
    scenario = samples.scenario
    if scenario.network.lives:
        # Who is down does not tick, and what it would hear is lost.
        return _clock_promises(SENSORS, samples)
    promises = [*_clock_promises(NETWORK, samples), *_clock_promises(SENSORS, samples)]
    drawn = samples.pairs is not None and scenario.node_filter.timing.talks
    if drawn and pair_probabilities(scenario) is not None:
        promises.append(MATCHING_ROW)
    if samples.fates is None or not samples.fates.sent.any():
        return promises
    law = loss_law(scenario)
    promises.append(LOSS_ROW)
    if law.independent and ((law.lost > 0.0) & (law.lost < 1.0)).any():
        promises.append(LOSSES_APART)
    if law.chain is not None and law.hops is None:
        promises.append(BURSTS)
    if law.share > 0.0 and np.ptp(law.lost) == 0.0:
        promises.append(SHARED_ROW)
    if samples.delays is not None:
        promises.append(DELAY_LAW if stated_delay(scenario)[0] is None else FIXED)
    return promises
