"""``check_channel``: checks of a loss, a delay or a channel against its contract."""

from __future__ import annotations

import math
from itertools import compress
from typing import Any

import numpy as np

from netkf.laws.delays import DelayCounts, compare_delays, count_delays
from netkf.laws.losses import (
    LossLaw,
    compare_bursts,
    compare_coincidences,
    compare_losses,
    count_outcomes,
)
from netkf.laws.noise import compare_with
from netkf.laws.stating import stated_law, stated_part
from netkf.network.channels import Channel, ChannelSampler
from netkf.network.delays import Delay
from netkf.network.delays import delay_depends_on_message as overrides_message_delay
from netkf.network.graphs import Complete, Link, Topology
from netkf.network.losses import Loss
from netkf.rng.streams import Streams
from netkf.testing.generators import RecordingGenerator, describe_calls
from netkf.testing.noise import demand_agreement, family_level
from netkf.testing.watching import WatchedPart, demand, fail, guard_user_code, make_part

CHAINS, LENGTH = 400, 50
"""Simulated runs, and messages over each directed link in a run."""
DRAWS, DELAYS = 200, 20_000
"""Draws that are checked one by one, and delays whose law is tested."""
MESSAGES = (0, 1, 2, 7, 1000)
"""Numbers of the messages whose probabilities and delays are checked."""
TABLE = (1.0, 0.6, 0.85)
"""Delivery probabilities of a graph without a table of its own: directed links take them in turn.
"""
DISTANCES = (0.0, 1.0, 10.0, 1e3, 1e9)
"""Distances of nodes at which delivery is checked."""
PROBABILITY_TOLERANCE, MAX_LAG, FOREVER = 1e-9, 3, 1e300
"""Difference of probabilities that is rounding, messages apart at which outcomes are tested, and
the end in seconds of a run that shows all delays.
"""


def check_channel(channel: Any, /, topology: Topology | None = None, **settings: Any) -> None:
    """Check a Channel, a Loss or a Delay, or a class of these with its ``settings``.

    It is checked on every directed link of a complete graph of 4 nodes, or of ``topology``.

    Exact checks: delivery probabilities, also those ``at_distance`` of a loss that follows it, are
    numbers from 0 to 1 (0 or 1 if ``deterministic``), use no randomness and do not depend on
    earlier calls; links with equal entries in the graph's table have equal ones, unless the class
    defines a ``mean_delivery`` of its own; ``next_state`` and
    ``draw`` use only the generator they are given, and make the same draws in each call, none if
    ``stateful`` is False or the delay is ``fixed``; delays are not negative, at most ``longest``,
    and equal to ``fixed`` if it is not None.

    Statistical checks find these errors with probability 0.9. From 20,000 messages over each
    directed link: a delivered fraction p of one link that differs from ``mean_delivery`` by
    7.8 sqrt(p (1 - p) / 20,000) (0.022 at p = 0.8), and one of all 12 links together that differs
    by a third of that; for losses in bursts, sqrt(1 + r) / sqrt(1 - r) times as much, where r is
    the correlation of neighbouring outcomes. If ``independent`` is True: a correlation of 0.08 of
    outcomes 1, 2 or 3 messages apart, or of two links with streams of their own. From 20,000
    delays: a correlation of 0.06 of neighbouring ones. Of a class that states the ``law`` of its
    delays or the ``chain`` of its losses, or derives from a built-in class that does and states
    nothing of its own: a sixteenth of the law that has 0.013 more or fewer delays, a mean rank of
    the delays on one link that is off by 0.06, and a probability of a loss after a loss that is off
    by 0.05. A correct class fails once in a million checks.

    Raises AssertionError with one line: the method, the rule, the value got, what to do.
    """
    part = make_part(channel, (Channel, Loss, Delay), settings)
    _check_channel(part, topology, 0)


def _check_channel(part: Any, topology: Topology | None, seed: int) -> None:
    if isinstance(part, Channel):
        _check_channel(part.loss, topology, seed)
        _check_channel(part.delay, topology, seed)
        return
    watched = WatchedPart(part)
    watched.pickle_copy()
    graph = Complete(nodes=4).build(seed=0) if topology is None else topology
    links = table_entries(graph)
    if isinstance(part, Delay):
        _check_message_delays(watched, tuple(links))
        delays, repeated = (_draw_delays(watched) for _ in range(2))
        rule, got = (
            "must use no generator but the one it is given",
            "other delays from an equal generator",
        )
        demand(delays == repeated, f"{watched.name}.draw", rule, got)
        if part.is_random:
            _check_draws(watched)
        _check_delay_law(watched, tuple(links))
        return
    for distance in DISTANCES if part.follows_distance else ():
        value = watched.call("at_distance", distance)
        rule = f"must be a number from 0 to 1 at the distance {distance:g}"
        demand(0.0 <= value <= 1.0, f"{watched.name}.at_distance", rule, value)
    for link, table_probability in links.items():
        _check_delivery_probabilities(watched, link, table_probability)
    _check_pure(watched, links)
    _check_identical_links(watched, tuple(links))
    _check_channel_state(watched)
    _check_fractions(watched, links, seed)


def table_entries(topology: Topology) -> dict[Link, float]:
    """Return the entry of the graph's table of delivery probabilities for each directed link.

    Graphs without a table get the entries of TABLE in turn.
    """
    if topology.delivery is not None:
        return {link: topology.delivery.get(link, 1.0) for link in topology.directions}
    return {link: TABLE[k % len(TABLE)] for k, link in enumerate(topology.directions)}


def _check_pure(watched: WatchedPart, links: dict[Link, float]) -> None:
    calls = [
        (link, message, bad, table_probability)
        for link, table_probability in links.items()
        for message in MESSAGES
        for bad in (False, True)
    ]
    probability = watched.part.delivery_probability
    forwards = {call: probability(*call) for call in calls}
    backwards = {call: probability(*call) for call in reversed(calls)}
    for call in calls:
        link, message = call[:2]
        demand(
            forwards[call] == backwards[call],
            f"{watched.name}.delivery_probability",
            "must not depend on which links and messages were asked for before",
            f"{forwards[call]:.4g} and {backwards[call]:.4g} for message {message} of link "
            f"{list(link)}",
            "use nothing but the arguments",
        )


def _check_identical_links(watched: WatchedPart, links: tuple[Link, ...]) -> None:
    part = watched.part
    ancestors = type(part).__mro__
    mean_owner, probability_owner = (
        next(k for k, cls in enumerate(ancestors) if name in vars(cls))
        for name in ("mean_delivery", "delivery_probability")
    )
    if mean_owner <= probability_owner and ancestors[mean_owner] is not Loss:
        return
    for bad in (False, True):
        for message in MESSAGES:
            probabilities = [part.delivery_probability(link, message, bad, 0.8) for link in links]
            median = float(np.median(probabilities))
            for link, probability in zip(links, probabilities, strict=True):
                demand(
                    abs(probability - median) <= PROBABILITY_TOLERANCE,
                    f"{watched.name}.delivery_probability",
                    "must be the same for links with equal entries in the graph's table",
                    f"{probability:.4g} for link {list(link)} and {median:.4g} for others",
                    "define mean_delivery beside it if links differ by design",
                )


def _check_delivery_probabilities(
    watched: WatchedPart, link: Link, table_probability: float
) -> None:
    part, where = watched.part, f"{watched.name}.delivery_probability"
    for bad in (False, True):
        for message in (0, 1, 2, 1000):
            probability = watched.call(
                "delivery_probability", link, message, bad, table_probability
            )
            is_probability = (
                isinstance(probability, (int, float, np.floating)) and 0.0 <= probability <= 1.0
            )
            rule = f"must be a number from 0 to 1 for message {message}"
            demand(is_probability, where, rule, probability)
            rule = "must be 0 or 1 where the loss is deterministic"
            got = probability
            remedy = "let deterministic be False"
            demand(not part.deterministic or probability in (0.0, 1.0), where, rule, got, remedy)
    mean = watched.call("mean_delivery", link, table_probability)
    is_mean = math.isnan(mean) or 0.0 <= mean <= 1.0
    demand(is_mean, f"{watched.name}.mean_delivery", "must be a number from 0 to 1, or nan", mean)


def _check_channel_state(watched: WatchedPart) -> None:
    part, where = watched.part, f"{watched.name}.next_state"
    histories: list[list[Any]] = []
    for _ in range(2):
        random, bad, history = RecordingGenerator(5), None, []
        for k in range(DRAWS):
            bad = watched.call("next_state", bad, random, repeatable=False)
            demand(bad is True or bad is False, where, "must be True or False", bad)
            calls = random.take_calls()
            history.append((bad, calls))
            if not part.stateful:
                rule = "must draw nothing where stateful is False"
                demand(not calls, where, rule, describe_calls(calls), "let stateful be True")
            elif calls != history[0][1]:
                fail(
                    where,
                    "must draw the same at each activation",
                    f"{describe_calls(history[0][1])} at the first and {describe_calls(calls)} at "
                    f"number {k}",
                    "draw first, then decide",
                )
        histories.append(history)
    rule = "must use no generator but the one it is given"
    demand(histories[0] == histories[1], where, rule, "another outcome from an equal generator")


def _check_fractions(watched: WatchedPart, links: dict[Link, float], seed: int) -> None:
    part, where = watched.part, f"{watched.name}.mean_delivery"
    stated = np.array([part.mean_delivery(link, p) for link, p in links.items()])
    if np.isnan(stated).all() and not part.independent:
        return
    with guard_user_code(watched.name):
        lost = _simulate_losses(part, links, seed)
    # Links have streams of their own.
    chain, none, known = stated_law(part, "loss"), np.full(len(links), -1), ~np.isnan(stated)
    law = LossLaw(
        1.0 - stated, part.independent, chain, False, False, False, none, False, tuple(links)
    )
    if known.any():
        counts = count_outcomes(lost[..., known], none[known])
        of_known = law._replace(lost=law.lost[known], links=list(compress(links, known)))
        shares = compare_losses(of_known, counts, family_level())
        demand_agreement(shares, where, "must be the delivered fraction in the long run")
    if part.independent:
        rule = "must be False where outcomes of neighbouring activations or links are related"
        labels = [str(list(link)) for link in links]
        coincidences = compare_coincidences(lost, range(MAX_LAG + 1), labels, family_level())
        remedy = "return False: theory relies on it"
        demand_agreement(coincidences, f"{watched.name}.independent", rule, remedy)
    elif law.chain is not None and known.all():
        stated = stated_part(part, "loss")
        derives = type(stated) is not type(part)
        parent = f"{type(stated).__name__}, from which it derives" if derives else "its `chain`"
        bursts = compare_bursts(law, count_outcomes(lost, law.opposite), family_level())
        rule = f"losses must follow each other as in {parent}"
        remedy = "define mean_delivery too if it differs by design"
        demand_agreement(bursts, f"{watched.name}.next_state", rule, remedy)


def _simulate_losses(part: Loss, links: dict[Link, float], seed: int) -> np.ndarray:
    """Return the mask (CHAINS, LENGTH, L) of messages that the engine would lose."""
    lost, channel = np.zeros((CHAINS, LENGTH, len(links)), dtype=bool), Channel(loss=part)
    for chain in range(CHAINS):
        streams = Streams(seed + 7, chain)
        for k, (link, table_probability) in enumerate(links.items()):
            sampler = ChannelSampler(channel, lambda purpose: streams.generator(purpose, *link))  # noqa: B023
            uniform, bad, _ = sampler.draws(LENGTH)
            probabilities = [
                part.delivery_probability(link, message, is_bad, table_probability)
                for message, is_bad in enumerate(bad.tolist())
            ]
            lost[chain, :, k] = uniform >= probabilities
    return lost


def _check_delay_law(watched: WatchedPart, links: tuple[Link, ...]) -> None:
    stated, part = stated_part(watched.part, "delay"), watched.part
    where = f"{watched.name}.message_delay"
    derives, law = type(stated) is not type(part), stated_law(part, "delay")
    parent = f"{type(stated).__name__}, from which it derives" if derives else "its `law`"
    rule, remedy = (
        f"delays must have the law of {parent}",
        "define longest too if it differs by design",
    )
    if stated.fixed is not None and derives:
        for link in links:
            seconds = part.message_delay(link, 0, stated.fixed)
            is_equal = math.isnan(seconds) or seconds == stated.fixed
            got = f"{seconds:g} s for link {list(link)} instead of {stated.fixed:g}"
            demand(is_equal, where, rule, got, remedy)
        return
    if law is None:
        return
    directions = np.repeat(np.arange(len(links)), DELAYS // len(links))
    with guard_user_code(where):
        random = Streams(7, 0).generator("delay")
        delays = [
            part.message_delay(links[index], k, part.draw(random))
            for k, index in enumerate(directions.tolist())
        ]
    sent = np.zeros(len(delays))
    if np.isnan(delays).any():  # messages that the delay loses have no law
        return
    counts = count_delays(law, sent, np.array(delays), directions, len(links), FOREVER)
    several = DelayCounts(*(count[None] for count in counts))
    for comparison in compare_delays(several, links, 2.0 * family_level()):
        demand_agreement(comparison, where, rule, remedy)


def _check_draws(watched: WatchedPart) -> None:
    where = f"{watched.name}.draw"
    with guard_user_code(where):
        random, other_random = (Streams(6, k).generator("delay") for k in range(2))
        delays = np.array([watched.part.draw(random) for _ in range(DELAYS)])
        others = np.array([watched.part.draw(other_random) for _ in range(DRAWS)])
    varies = delays.std() > 1e-9 * (1.0 + np.abs(delays).max())
    is_same = varies and np.array_equal(delays[:DRAWS], others)
    rule = "must draw from the generator given"
    demand(not is_same, where, rule, "equal delays from two generators")
    from scipy.stats import rankdata

    # Ranks, so that long tails do not hide a correlation; equal delays have equal ranks.
    centred = (rankdata(delays) - 0.5) / len(delays) - 0.5
    if varies:
        one, other = centred[1:, None], centred[:-1, None]
        rule = "delays of neighbouring messages must be independent"
        demand_agreement(
            compare_with(one, other, ["a delay"], ["the one before"], family_level()), where, rule
        )


def _check_message_delays(watched: WatchedPart, links: tuple[Link, ...]) -> None:
    part, where, longest = watched.part, f"{watched.name}.message_delay", watched.part.longest
    drawn_delay = part.fixed or 0.0
    calls = [(link, message) for link in links for message in MESSAGES]
    delays = {call: watched.call("message_delay", *call, drawn_delay) for call in calls}
    for (link, message), seconds in delays.items():
        subject = f"message {message} of link {list(link)}"
        is_number = isinstance(seconds, (int, float, np.floating))
        demand(is_number, where, f"must be a number for {subject}", seconds)
        in_range = math.isnan(seconds) or 0.0 <= seconds <= longest
        rule = f"must be from 0 to `longest` ({longest:g}) seconds, or nan where it is lost"
        demand(in_range, where, rule, f"{seconds:g} for {subject}")
        is_fixed = part.fixed is None or seconds == drawn_delay or overrides_message_delay(part)
        demand(is_fixed, where, "must be `fixed` where delays are", f"{seconds:g} for {subject}")
    # The same calls again, in reverse order.
    for call in reversed(calls):
        first, second = delays[call], part.message_delay(*call, drawn_delay)
        is_equal = second == first or (math.isnan(second) and math.isnan(first))
        rule = "must not depend on which messages were asked for before"
        demand(is_equal, where, rule, f"{first:g} and {second:g}")


def _draw_delays(watched: WatchedPart) -> list[float]:
    fixed, where, random = watched.part.fixed, f"{watched.name}.draw", RecordingGenerator(6)
    first_calls, rule = None, "must be a finite number of at least 0 seconds"
    delays: list[float] = []
    for k in range(DRAWS):
        seconds = watched.call("draw", random, repeatable=False)
        is_number = isinstance(seconds, (int, float, np.floating)) and math.isfinite(seconds)
        demand(is_number and seconds >= 0.0, where, rule, seconds, "shift or clip the law")
        calls = random.take_calls()
        first_calls = calls if first_calls is None else first_calls
        demand(
            calls == first_calls,
            where,
            "must draw the same for each message",
            f"{describe_calls(first_calls)} for the first and {describe_calls(calls)} for number "
            f"{k}",
            "draw a fixed number of values, then decide",
        )
        demand(
            fixed is None or seconds == fixed,
            f"{watched.name}.fixed",
            "must be what draw returns, or None",
            f"{fixed} for {seconds}",
        )
        delays.append(seconds)
    return delays
