"""``check_channel``: checks of a loss, a delay or a channel against its contract."""

from __future__ import annotations

import math
from functools import partial
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
from netkf.network.channels import BroadcastSampler, Channel, ChannelSampler, conditions_of
from netkf.network.delays import Delay
from netkf.network.delays import delay_depends_on_message as overrides_message_delay
from netkf.network.graphs import Complete, Link, Topology
from netkf.network.losses import Loss, Transmission, delivery_probabilities, has_conditions
from netkf.rng.streams import Streams
from netkf.testing.generators import RecordingGenerator, describe_calls
from netkf.testing.noise import demand_agreement, family_level
from netkf.testing.watching import WatchedPart, demand, fail, guard_user_code, make_part

CHAINS, LENGTH = 400, 50
"""Simulated runs, and messages over each directed link in a run."""
DRAWS, DELAYS = 200, 20_000
"""Draws that are checked one by one, and delays whose law is tested."""
MESSAGES, TIMES, HORIZON = (0, 1, 2, 7, 1000), (0.0, 0.3, 11.0, 55.5, 99.0), 100.0
"""Numbers of the messages whose probabilities and delays are checked, when they are sent, and the
end of these runs in seconds.
"""
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

    Exact checks: delivery probabilities, at all times and distances, are numbers from 0 to 1 (0 or
    1 if ``deterministic``), use no randomness and do not depend on earlier calls, and those of many
    messages at once are those of each, if the class is ``vectorised``; links with equal entries in
    the graph's table have equal ones, unless the class defines a ``mean_delivery`` of its own;
    ``conditions``, ``next_state`` and ``draw`` use only the generator they are given, and the last
    two make the same draws in each call, none if ``stateful`` is False or the delay is ``fixed``;
    delays are not negative, at most ``longest``, and equal to ``fixed`` if it is not None.

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
    conditions = _check_conditions(watched)
    near = DISTANCES[0] if part.follows_distance else math.nan
    sent = [
        Transmission(link, table_probability=p, distance=near, conditions=conditions)
        for link, p in links.items()
    ]
    for one in sent:
        _check_delivery_probabilities(watched, one)
    _check_pure(watched, sent)
    _check_identical_links(watched, sent)
    _check_channel_state(watched)
    _check_fractions(watched, links, seed)


def table_entries(topology: Topology) -> dict[Link, float]:
    """Return the entries of the graph's table by directed link, or those of TABLE in turn."""
    if topology.delivery is not None:
        return {link: topology.delivery.get(link, 1.0) for link in topology.directions}
    return {link: TABLE[k % len(TABLE)] for k, link in enumerate(topology.directions)}


def _check_conditions(watched: WatchedPart) -> Any:
    """Return the conditions of a run, which must depend on the generator alone."""
    if not has_conditions(watched.part):
        return None
    where, drawn = f"{watched.name}.conditions", []
    for _ in range(2):
        random = np.random.default_rng(5)
        drawn.append(watched.call("conditions", random, HORIZON, repeatable=False))
    rule = "must use no generator but the one it is given"
    demand(repr(drawn[0]) == repr(drawn[1]), where, rule, "others from an equal generator")
    return drawn[0]


def _messages(one: Transmission) -> list[Transmission]:
    """Return messages of one link, at several times and in both states."""
    return [
        one._replace(number=number, time=time, bad=bad)
        for number, time in zip(MESSAGES, TIMES, strict=True)
        for bad in (False, True)
    ]


def _check_pure(watched: WatchedPart, sent: list[Transmission]) -> None:
    calls = [message for one in sent for message in _messages(one)]
    probability, where = watched.part.delivery_probability, f"{watched.name}.delivery_probability"
    forwards = [float(probability(call)) for call in calls]
    backwards = [float(probability(call)) for call in reversed(calls)][::-1]
    for call, first, second in zip(calls, forwards, backwards, strict=True):
        demand(
            first == second,
            where,
            "must not depend on which links and messages were asked for before",
            f"{first:.4g} and {second:.4g} for message {call.number} of link {list(call.link)}",
            "use nothing but the arguments",
        )
    per_link = np.reshape(forwards, (len(sent), -1))
    for one, expected in zip(sent, per_link, strict=True):
        number, time, bad = np.transpose([(m.number, m.time, m.bad) for m in _messages(one)])
        many = one._replace(number=number.astype(int), time=time, bad=bad.astype(bool))
        with guard_user_code(where):
            together = delivery_probabilities(watched.part, many)
        rule = "must give many messages the probabilities of each, where the class is vectorised"
        off = np.flatnonzero(together != expected)
        got = [f"{together[k]:.4g} and {expected[k]:.4g}" for k in off[:1].tolist()]
        demand(not off.size, where, rule, "".join(got), "use operations of numpy on whole arrays")


def _check_identical_links(watched: WatchedPart, sent: list[Transmission]) -> None:
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
            alike = [one._replace(number=message, bad=bad, table_probability=0.8) for one in sent]
            probabilities = [float(part.delivery_probability(one)) for one in alike]
            median = float(np.median(probabilities))
            for (link, *_), probability in zip(sent, probabilities, strict=True):
                demand(
                    abs(probability - median) <= PROBABILITY_TOLERANCE,
                    f"{watched.name}.delivery_probability",
                    "must be the same for links with equal entries in the graph's table",
                    f"{probability:.4g} for link {list(link)} and {median:.4g} for others",
                    "define mean_delivery beside it if links differ by design",
                )


def _check_delivery_probabilities(watched: WatchedPart, one: Transmission) -> None:
    part, where = watched.part, f"{watched.name}.delivery_probability"
    for distance in DISTANCES if part.follows_distance else (one.distance,):
        for message in _messages(one._replace(distance=distance)):
            probability = watched.call("delivery_probability", message)
            is_number = isinstance(probability, (int, float, np.floating)) or (
                isinstance(probability, np.ndarray) and probability.shape == ()
            )
            subject = f"for message {message.number}"
            if part.follows_distance:
                subject = f"at the distance {distance:g}"
            rule = f"must be a number from 0 to 1 {subject}"
            demand(is_number and 0.0 <= probability <= 1.0, where, rule, probability)
            rule = "must be 0 or 1 where the loss is deterministic"
            got = probability
            remedy = "let deterministic be False"
            demand(not part.deterministic or probability in (0.0, 1.0), where, rule, got, remedy)
    mean = watched.call("mean_delivery", one)
    is_mean = math.isnan(mean) or 0.0 <= mean <= 1.0
    demand(is_mean, f"{watched.name}.mean_delivery", "must be a number from 0 to 1, or nan", mean)


def _check_channel_state(watched: WatchedPart) -> None:
    part, where = watched.part, f"{watched.name}.next_state"
    histories: list[list[Any]] = []
    for _ in range(2):
        random, bad, history = RecordingGenerator(5), None, []
        for k in range(DRAWS):
            bad = watched.call("next_state", (0, 1), bad, random, repeatable=False)
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
    stated = np.array(
        [
            part.mean_delivery(Transmission(link, table_probability=p, distance=DISTANCES[0]))
            for link, p in links.items()
        ]
    )
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
    times = np.linspace(0.0, HORIZON, LENGTH, endpoint=False)
    for chain in range(CHAINS):
        streams = Streams(seed + 7, chain)
        conditions = conditions_of(part, streams, HORIZON)
        for k, (link, table_probability) in enumerate(links.items()):
            sampler = ChannelSampler(channel, link, partial(_stream, streams, link))
            uniform, bad, _ = sampler.draws(LENGTH)
            if part.state_of == "sender":
                bad = (
                    BroadcastSampler(part, link, False, partial(_stream, streams, link[:1]))
                    .draws(LENGTH)
                    .bad
                )
            sent = Transmission(
                link, np.arange(LENGTH), times, bad, table_probability, DISTANCES[0],
                conditions=conditions,
            )  # fmt: skip
            lost[chain, :, k] = uniform >= delivery_probabilities(part, sent)
    return lost


def _stream(streams: Streams, link: tuple[int, ...], purpose: str) -> np.random.Generator:
    return streams.generator(purpose, *link)


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
            seconds = part.message_delay(Transmission(link), stated.fixed)
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
            part.message_delay(Transmission(links[index], k), part.draw(random))
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
    calls = [Transmission(link, number) for link in links for number in MESSAGES]
    delays = [watched.call("message_delay", call, drawn_delay) for call in calls]
    for (link, message, *_), seconds in zip(calls, delays, strict=True):
        subject = f"message {message} of link {list(link)}"
        is_number = isinstance(seconds, (int, float, np.floating))
        demand(is_number, where, f"must be a number for {subject}", seconds)
        in_range = math.isnan(seconds) or 0.0 <= seconds <= longest
        rule = f"must be from 0 to `longest` ({longest:g}) seconds, or nan where it is lost"
        demand(in_range, where, rule, f"{seconds:g} for {subject}")
        is_fixed = part.fixed is None or seconds == drawn_delay or overrides_message_delay(part)
        demand(is_fixed, where, "must be `fixed` where delays are", f"{seconds:g} for {subject}")
    # The same calls again, in reverse order.
    for call, first in zip(reversed(calls), reversed(delays), strict=True):
        second = part.message_delay(call, drawn_delay)
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
