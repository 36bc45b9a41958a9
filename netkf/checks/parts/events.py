"""Counts of the ticks, messages and pairs of runs, and the laws that are stated of them; all
statistics of the parts of a scenario, stacked over runs.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from functools import lru_cache, partial
from typing import Any

import numpy as np

from netkf.checks.parts.noises import plant_noises, reading_noises
from netkf.core.clock import Entity, generate_ticks
from netkf.core.laws import EXPONENTIAL
from netkf.laws import stack_runs
from netkf.laws.losses import (
    DelayCounts,
    LossCounts,
    LossLaw,
    PairCounts,
    count_delays,
    count_fixed,
)
from netkf.laws.noise import NoiseDraws
from netkf.laws.stating import stated_law, stated_part
from netkf.laws.ticks import ClockGroup, TickCounts, count_by_window, count_ticks
from netkf.linalg.arrays import FloatArray, IntArray
from netkf.network.clocks import LinkClock
from netkf.network.contacts import Contacts
from netkf.network.losses import stated_delivery
from netkf.network.matchings import Matching
from netkf.rng.streams import Streams
from netkf.scenario.scenario import Scenario
from netkf.theory.common.random_links import has_constant_losses
from netkf.trace.messages import LOST, join_messages
from netkf.trace.run import Run
from netkf.trace.schema import rows_of

NO_CLOCKS = ClockGroup((), np.empty(0), (), ())


@lru_cache(maxsize=8)
def network_clocks(scenario: Scenario) -> ClockGroup:
    """Return the clocks of nodes or links that are compared with their laws; maybe empty."""
    clock = scenario.network.activation
    if not scenario.filter.algorithm.timing.talks or not isinstance(clock, LinkClock):
        return NO_CLOCKS
    entities = tuple(clock.entities(scenario.topology))
    stated, law, share = stated_part(clock, "activation"), stated_law(clock, "activation"), {}
    if isinstance(clock, Contacts):
        # A Poisson clock that ticks in contacts only is one in the time of its contacts; stretched
        # to the length of a run it has a rate that is smaller by the share of contacts.
        share = {entity: _contact_time(clock, entity, scenario.horizon) for entity in entities}
        entities = tuple(entity for entity in entities if share[entity] > 0.0)
        if stated_law(clock.clock, "activation") is EXPONENTIAL:
            stated, law = clock.clock, EXPONENTIAL
    rates = [
        stated.mean_rate(entity) * share.get(entity, scenario.horizon) / scenario.horizon
        for entity in entities
    ]
    labels = tuple(f"clock {'-'.join(map(str, entity))}" for entity in entities)
    return ClockGroup(entities, np.array(rates), (law,) * len(entities), labels)


def _contact_time(clock: Contacts, entity: Entity, horizon: float) -> float:
    return float(clock.time_in_contact(entity, np.array([horizon]))[0])


@lru_cache(maxsize=8)
def sampling_clocks(scenario: Scenario) -> ClockGroup:
    """Return the clocks at which sensors sample; empty unless every sampled sensor has one."""
    entities, rates, laws, labels = [], [], [], []
    law_of: dict[int, Any] = {}  # clocks of one law share one object
    for node, placed_sensors in scenario.sampled_sensors.items():
        for placed_sensor in placed_sensors:
            clock = getattr(scenario.sensors[placed_sensor.entry], "sampling", None)
            if clock is None:
                return NO_CLOCKS
            entities.append((node, placed_sensor.ordinal))
            rates.append(stated_part(clock, "sampling").mean_rate(entities[-1]))
            laws.append(law_of.setdefault(placed_sensor.entry, stated_law(clock, "sampling")))
            sensor_label = f"sensor {placed_sensor.ordinal} of " if len(placed_sensors) > 1 else ""
            labels.append(f"the clock of {sensor_label}node {node}")
    return ClockGroup(tuple(entities), np.array(rates), tuple(laws), tuple(labels))


def tick_counts(scenario: Scenario, run: Run) -> TickCounts | None:
    """Return counts of ticks, None without clocks. Links that tick in contacts are counted in the
    time of contacts; ``off`` is the largest distance of a tick from one.
    """
    group = network_clocks(scenario)
    if not group.entities:
        return None
    clock: Any = scenario.network.activation
    rows = rows_of(run.log, "tick")
    columns = [rows[name] for name in (("node",) if clock.at == "nodes" else ("node", "peer"))]
    if clock.at == "links":
        # Both nodes share the clock of a link, whose entity has the smaller id first.
        columns = [np.minimum(*columns), np.maximum(*columns)]
    owners = _entity_indices(group.entities, columns)
    if not isinstance(clock, Contacts):
        return count_ticks(group, rows["t"], owners, scenario.horizon)
    ids = list(zip(*(column.tolist() for column in columns), strict=True))
    off, inner, inner_owners = 0.0, [np.empty(0)], [np.empty(0, dtype=np.int64)]
    for entity in set(ids):
        off = max(off, clock.distance(entity, rows["t"][[e == entity for e in ids]]))
    for k, entity in enumerate(group.entities):
        ticks = rows["t"][owners == k]
        met = clock.time_in_contact(entity, ticks[clock.in_contact(entity, ticks)])
        inner.append(met * (scenario.horizon / _contact_time(clock, entity, scenario.horizon)))
        inner_owners.append(np.full(len(met), k))
    times, owners = np.concatenate(inner), np.concatenate(inner_owners)
    return count_ticks(group, times, owners, scenario.horizon)._replace(off=np.array(off))


def sample_counts(scenario: Scenario, run: Run) -> TickCounts | None:
    """Return counts of samples of sensors, drawn again; None without clocks."""
    group = sampling_clocks(scenario)
    if not group.entities:
        return None
    times = redraw_samples(scenario, group.entities, run.seed, run.replica)
    owners = np.repeat(np.arange(len(times)), [len(t) for t in times])
    return count_ticks(group, np.concatenate(times), owners, scenario.horizon)


def redraw_samples(
    scenario: Scenario, entities: Sequence[Entity], seed: int, replica: int
) -> list[FloatArray]:
    """Return the times (s) of samples of each of the ``entities`` in a ``replica``, drawn again."""
    times = scenario.sample_times(Streams(seed, replica))
    return [times[entity] for entity in entities]


def redraw_ticks(
    scenario: Scenario, entities: Sequence[Entity], seed: int, replica: int
) -> list[FloatArray]:
    """Return the ticks (s) of each of the ``entities`` in a ``replica``, drawn again."""
    clock: Any = scenario.network.activation
    streams, horizon = Streams(seed, replica), scenario.horizon
    ticks = (
        generate_ticks(
            clock,
            entity,
            partial(streams.generator, "phase", *entity),
            streams.generator("clock", *entity),
            horizon,
        )
        for entity in entities
    )
    return [scenario.time_grid.before(horizon, times) for times in ticks]


@lru_cache(maxsize=8)
def loss_law(scenario: Scenario) -> LossLaw:
    """Return what a scenario states of losses on its directions."""
    channel, clock = scenario.network.channel, scenario.network.activation
    loss, links = stated_part(channel.loss, "loss"), scenario.topology.directions
    stated = dataclasses.replace(channel, loss=loss)
    delivery = [
        sum(share * stated.mean_delivery(sent, scenario.horizon) for share, sent in messages)
        for messages in map(scenario.messages_of_slot, links)
    ]
    at_once = getattr(clock, "at", "links") == "links"
    senders, receivers = np.array(links, dtype=np.int64).reshape(-1, 2).T
    opposite = _entity_indices(links, [receivers, senders])
    hops = None
    if channel.channels is not None:
        alone = [
            stated_delivery(loss, scenario.transmission(link), scenario.horizon) for link in links
        ]
        on_hops = [channel.channels.on_hops(link) for link in links]
        hops = 1.0 - np.array(alone)[:, None] * np.array(on_hops)
    # Broadcasts of two nodes at different times would both step a chain that they share.
    one_step = isinstance(clock, Matching) or (
        isinstance(clock, LinkClock) and (clock.at == "links" or not channel.symmetric)
    )
    # Nor does a chain that a sender's links share step once between two messages of one of them.
    one_step &= loss.state_of == "link" or scenario.has_broadcasts
    share = loss.fate_share if scenario.has_broadcasts else 0.0
    return LossLaw(
        lost=1.0 - np.array(delivery),
        independent=stated.independent and share == 0.0 and _redraws_links(scenario),
        chain=stated_law(channel.loss, "loss") if one_step else None,
        steady=has_constant_losses(scenario),
        shared=bool(scenario.network.one_fate and (opposite >= 0).any()),
        opposite=opposite,
        at_once=at_once and not channel.symmetric,
        links=links,
        share=share,
        hops=hops,
    )


def _redraws_links(scenario: Scenario) -> bool:
    """Return True if every exchange redraws the links, which a filter may keep within a slot."""
    filter_ = scenario.node_filter
    if not scenario.slotted:
        return True
    phases = range(filter_.timing.exchanges)
    steps = [(phase, k) for phase in phases for k in range(filter_.timing.steps(phase))]
    return all(filter_.timing.redraws(*step) for step in steps)


def loss_counts(scenario: Scenario, messages: np.ndarray) -> LossCounts | None:
    """Return sent and lost counts by window and direction from MESSAGE rows (M,), or None."""
    size, horizon = len(scenario.topology.directions), scenario.horizon
    if not size:
        return None
    direction, times = _directions(scenario, messages), messages["sent"]
    is_lost = messages["outcome"] == LOST
    sent = count_by_window(times, direction, size, horizon)
    lost = count_by_window(times[is_lost], direction[is_lost], size, horizon)
    # Of a message and the next one of its direction.
    first = direction[:-1][is_lost[:-1] & (direction[1:] == direction[:-1])]
    twice = direction[:-1][is_lost[:-1] & is_lost[1:] & (direction[1:] == direction[:-1])]
    # Of a message and that of the same number in the opposite direction.
    back, begins = loss_law(scenario).opposite[direction], np.searchsorted(direction, range(size))
    has_other = (back >= 0) & (messages["number"] < sent.sum(axis=0)[back])
    other = np.where(has_other, begins[back] + messages["number"], 0)
    both = direction[is_lost & has_other & is_lost[other]]
    counts = [np.bincount(column, minlength=size) for column in (first, twice, both)]
    of_broadcasts = slice(None) if scenario.has_broadcasts else slice(0)
    hearers = _pairs_of_hearers(messages[of_broadcasts], is_lost[of_broadcasts])
    # Those of hundreds of runs are in memory at once.
    short = np.int16 if sent.max() < 1 << 15 else np.int32
    return LossCounts(*(column.astype(short) for column in (sent, lost, *counts)), *hearers)


def _directions(scenario: Scenario, messages: np.ndarray) -> IntArray:
    return _entity_indices(scenario.topology.directions, [messages["sender"], messages["receiver"]])


def _pairs_of_hearers(messages: np.ndarray, is_lost: np.ndarray) -> list[np.ndarray]:
    """Return the number of pairs of messages (K,) of one broadcast, and of those both lost."""
    import pandas as pd

    names = ["sender", "phase", "sent"]
    lost = pd.DataFrame({name: messages[name] for name in names} | {"lost": is_lost})
    counts = lost.groupby(names)["lost"].agg(["size", "sum"]).to_numpy(dtype=np.int64).T
    return [np.array(float((k * (k - 1) // 2).sum())) for k in counts]


def _entity_indices(entities: Sequence[Entity], columns: Sequence[np.ndarray]) -> IntArray:
    """Return the index among ``entities`` of each row of the ``columns`` of ids, -1 for none."""
    known = np.array(entities, dtype=np.int64).reshape(-1, len(columns)).T
    ids = np.unique(known)

    def codes(part: np.ndarray) -> IntArray:
        places = np.searchsorted(ids, part)
        # The last place stands for an id of no entity.
        places[np.append(ids, 0)[places] != part] = len(ids)
        return np.asarray(np.ravel_multi_index(tuple(places), (len(ids) + 1,) * len(columns)))

    keys, wanted = codes(known), codes(np.stack(columns))
    order = np.argsort(keys)
    found = order[np.minimum(np.searchsorted(keys[order], wanted), len(order) - 1)]
    return np.where(keys[found] == wanted, found, -1).astype(np.int64)


def pair_counts(scenario: Scenario, run: Run) -> PairCounts | None:
    """Return for L links the slots in the matching, and in two in a row; None if not drawn."""
    if not isinstance(scenario.network.activation, Matching):
        return None
    links = {link: k for k, link in enumerate(scenario.topology.links)}
    rows = rows_of(run.log, "tick")
    slots = scenario.slot_plant.slots_of(rows["t"])
    ids = zip(rows["node"].tolist(), rows["peer"].tolist(), strict=True)
    link_of_row = np.array([links[min(e), max(e)] for e in ids], dtype=np.int64)
    count = np.bincount(link_of_row, minlength=len(links))
    # One integer for each link and slot: the same link one slot before has that less len(links).
    keys = slots * len(links) + link_of_row
    repeated = np.isin(keys - len(links), keys)
    first = scenario.node_filter.timing.first_exchange  # filters may exchange nothing in slot 0
    total = int(np.ceil(scenario.horizon / scenario.slot_plant.period - 1e-9)) - first
    return PairCounts(
        count, np.bincount(link_of_row[repeated], minlength=len(links)), np.array(float(total))
    )


@lru_cache(maxsize=8)
def stated_delay(scenario: Scenario) -> tuple[float | None, Any]:
    """Return the constant that the scenario states for its delays, and their law, or None each."""
    if scenario.messages_queue:
        return None, None
    delay = scenario.network.channel.delay
    return stated_part(delay, "delay").fixed, stated_law(delay, "delay")


def delay_counts(scenario: Scenario, messages: np.ndarray) -> DelayCounts | None:
    """Return counts of delays by direction, from MESSAGE rows (M,); None without links or a stated
    law. Messages that have not arrived when the run ends take longer than that.
    """
    (fixed, law), losses = stated_delay(scenario), loss_law(scenario)
    if not losses.links or (fixed is None and law is None):
        return None
    if fixed is not None:
        return count_fixed(messages["age"][np.isfinite(messages["age"])], fixed)
    second = np.array([i > j for i, j in losses.links]) & (losses.opposite >= 0) & losses.shared
    direction = _directions(scenario, messages)
    followed = (messages["outcome"] != LOST) & ~second[direction]
    if not _redraws_links(scenario):
        # All messages of a held link in one phase of a slot have one delay: the first has it.
        slots = scenario.slot_plant.slots_of(messages["sent"])
        keys = np.stack([direction, messages["phase"], slots])
        followed[1:] &= (keys[:, 1:] != keys[:, :-1]).any(axis=0)
    ages = np.nan_to_num(messages["age"][followed], nan=np.inf)
    sent, direction, size = messages["sent"][followed], direction[followed], len(losses.links)
    return count_delays(law, sent, ages, direction, size, scenario.horizon)


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


@dataclasses.dataclass(frozen=True)
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
