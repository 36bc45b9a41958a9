"""``check_channel``: checks of a loss, a delay or a channel against its contract."""

from __future__ import annotations

import inspect
import math
import warnings
from collections.abc import Callable
from functools import partial
from itertools import compress
from typing import Any

import numpy as np
import scipy.stats

from netkf.laws import stack_runs
from netkf.laws.losses import (
    LossLaw,
    compare_bursts,
    compare_coincidences,
    compare_delays,
    compare_losses,
    count_delays,
    count_outcomes,
)
from netkf.laws.noise import compare_with
from netkf.laws.stating import stated_law, stated_part, stating_class
from netkf.linalg.arrays import FloatArray
from netkf.network.channels import BroadcastSampler, Channel, ChannelSampler, conditions_of
from netkf.network.delays import Delay, checked_delays
from netkf.network.delays import delay_depends_on_message as overrides_message_delay
from netkf.network.graphs import Complete, Link, Topology
from netkf.network.losses import (
    KernelLoss,
    Loss,
    Transmission,
    delivery_probabilities,
    has_conditions,
)
from netkf.rng.streams import Streams
from netkf.testing.noise import demand_agreement, family_level
from netkf.testing.watching import (
    OTHER_GENERATOR,
    Calls,
    RecordingGenerator,
    WatchedPart,
    checker,
    demand_kind,
    describe_calls,
    guard_user_code,
    is_number,
    make_part,
)

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


@checker
def check_channel(channel: Any, /, topology: Topology | None = None, **settings: Any) -> None:
    """Check a Channel, a Loss or a Delay, or a class of these with its ``settings``.

    It is checked on every directed link of a complete graph of 4 nodes, or of ``topology``.

    Exact checks: delivery probabilities, at all times and distances, are numbers from 0 to 1 (0 or
    1 if ``deterministic``), use no randomness and do not depend on earlier calls, and those of many
    messages at once are those of each, if the class is ``vectorised``; links with equal entries in
    the graph's table have equal ones, unless the class defines a ``mean_delivery`` of its own;
    ``conditions``, ``next_state`` and ``draw`` use only the generator they are given, and the last
    two make the same draws in each call, none if ``stateful`` is False or the delay is ``fixed``;
    delays are not negative, at most ``longest``, and equal to ``fixed`` if it is not None; those of
    many messages at once are those of each, if the class is ``vectorised``.

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

    A UserWarning tells of ``conditions`` that draw nothing: they are the same in all runs.
    Raises AssertionError with one line: the method, the rule, the value got, what to do.
    """
    part = make_part(channel, (Channel, Loss, Delay), settings)
    demand_kind("topology", topology, Topology)
    _check_channel(part, topology, 0)


def _check_channel(part: Any, topology: Topology | None, seed: int) -> None:
    if isinstance(part, Channel):
        _check_channel(part.loss, topology, seed)
        _check_channel(part.delay, topology, seed)
        return
    watched = WatchedPart(part)
    watched.pickle_copy()
    links = table_entries(Complete(nodes=4).build(seed=0) if topology is None else topology)
    if isinstance(part, Delay):
        _check_message_delays(watched, tuple(links))
        _draw_equally(watched, "draw", "for each message", lambda random, _: _draw(watched, random))
        if part.is_random:
            _check_draws(watched)
        _check_delay_law(watched, tuple(links))
        return
    conditions = None
    if has_conditions(part):
        draw = partial(watched.call, "conditions", repeatable=False)
        conditions = watched.repeat("conditions", lambda random: draw(random, HORIZON))
        random = RecordingGenerator(5)
        draw(random, HORIZON)
        if not random.take_calls():
            # Not an error: they may be recorded, or not random for these settings.
            message = "takes no numbers from its generator, so that they are the same in all runs"
            remedy = "draw from it what is random"
            warnings.warn(f"{watched.name}.conditions: {message}; {remedy}", stacklevel=4)
    near = DISTANCES[0] if part.follows_distance else math.nan
    sent = [
        Transmission(link, table_probability=p, distance=near, conditions=conditions)
        for link, p in links.items()
    ]
    for one in sent:
        _check_delivery_probabilities(watched, one)
    if isinstance(part, KernelLoss):
        _check_law_in_python(watched, sent)
    _check_pure(watched, sent)
    _check_identical_links(watched, sent)
    _check_channel_state(watched)
    _check_fractions(watched, links, seed)


def table_entries(topology: Topology) -> dict[Link, float]:
    """Return the entries of the graph's table by directed link, or those of TABLE in turn."""
    if topology.delivery is not None:
        return {link: topology.delivery.get(link, 1.0) for link in topology.directions}
    return {link: TABLE[k % len(TABLE)] for k, link in enumerate(topology.directions)}


def _draw_equally(
    watched: WatchedPart, method: str, each: str, step: Callable[[RecordingGenerator, Any], Any]
) -> Calls:
    """Return the calls of a generator that every ``step``, after the one before, must make."""
    first_calls: Calls = []

    def draw(random: RecordingGenerator) -> list[Any]:
        results: list[Any] = [None]
        for k in range(DRAWS):
            results.append(step(random, results[-1]))
            calls = random.take_calls()
            first_calls[:] = first_calls if k else calls
            got = (
                f"{describe_calls(first_calls)} at first and {describe_calls(calls)} at number {k}"
            )
            rule, remedy = f"must draw the same {each}", "draw first, then decide"
            watched.demand(method, calls == first_calls, rule, got, remedy)
        return results

    watched.repeat(method, draw)
    return first_calls


def _messages(one: Transmission) -> list[Transmission]:
    """Return messages of one link, at several times and in both states."""
    return [
        one._replace(number=number, time=time, bad=bad)
        for number, time in zip(MESSAGES, TIMES, strict=True)
        for bad in (False, True)
    ]


def _check_law_in_python(watched: WatchedPart, sent: list[Transmission]) -> None:
    """Compiled code would not notice a setting that is not there, or a law that writes nothing."""
    part, law = watched.part, inspect.getattr_static(type(watched.part), "law")
    loops, rule = getattr(law, "loops", law), "must give as plain Python what it gives compiled"
    for one in sent:
        out = np.full(1, np.nan)
        with guard_user_code(f"{watched.name}.law"):
            loops(part.describe(one)[0], part.settings, one.time, out)
        compiled = part.delivery_probability(one)
        is_same = abs(out[0] - compiled) <= PROBABILITY_TOLERANCE
        watched.demand("law", is_same, rule, f"{out[0]:.4g} and {compiled:.4g}")


def _check_pure(watched: WatchedPart, sent: list[Transmission]) -> None:
    method, remedy = "delivery_probability", "use nothing but the arguments"
    calls = [message for one in sent for message in _messages(one)]
    probability = watched.part.delivery_probability
    forwards = [float(probability(call)) for call in calls]
    backwards = [float(probability(call)) for call in reversed(calls)][::-1]
    rule = "must not depend on which links and messages were asked for before"
    for call, first, second in zip(calls, forwards, backwards, strict=True):
        got = f"{first:.4g} and {second:.4g} for message {call.number} of link {list(call.link)}"
        watched.demand(method, first == second, rule, got, remedy)
    for one, expected in zip(sent, np.reshape(forwards, (len(sent), -1)), strict=True):
        number, time, bad = np.transpose([(m.number, m.time, m.bad) for m in _messages(one)])
        many = one._replace(number=number.astype(int), time=time, bad=bad.astype(bool))
        with guard_user_code(f"{watched.name}.{method}"):
            together = delivery_probabilities(watched.part, many)
        _demand_each(watched, method, "probabilities", together, expected)


def _demand_each(
    watched: WatchedPart, method: str, what: str, together: FloatArray, expected: FloatArray
) -> None:
    """Demand that many messages ``together`` (K,) have what each of them has, ``expected``."""
    off = np.flatnonzero((together != expected) & ~(np.isnan(together) & np.isnan(expected)))
    rule = f"must give many messages the {what} of each, where the class is vectorised"
    got = "".join(f"{together[k]:.4g} and {expected[k]:.4g}" for k in off[:1])
    watched.demand(method, not off.size, rule, got, "use operations of numpy on whole arrays")


def _check_identical_links(watched: WatchedPart, sent: list[Transmission]) -> None:
    part = watched.part
    ancestors = type(part).__mro__
    mean_owner, probability_owner = (
        next(k for k, cls in enumerate(ancestors) if name in vars(cls))
        for name in ("mean_delivery", "delivery_probability")
    )
    if mean_owner <= probability_owner and ancestors[mean_owner] is not Loss:
        return
    rule = "must be the same for links with equal entries in the graph's table"
    remedy = "define mean_delivery beside it if links differ by design"
    for message in _messages(Transmission((0, 1))):
        alike = [m._replace(number=message.number, bad=message.bad) for m in sent]
        found = [float(part.delivery_probability(m._replace(table_probability=0.8))) for m in alike]
        median = float(np.median(found))
        for (link, *_), probability in zip(sent, found, strict=True):
            is_same = abs(probability - median) <= PROBABILITY_TOLERANCE
            got = f"{probability:.4g} for link {list(link)} and {median:.4g} for others"
            watched.demand("delivery_probability", is_same, rule, got, remedy)


def _check_delivery_probabilities(watched: WatchedPart, one: Transmission) -> None:
    part, method = watched.part, "delivery_probability"
    for distance in DISTANCES if part.follows_distance else (one.distance,):
        for message in _messages(one._replace(distance=distance)):
            probability = watched.call(method, message)
            known = is_number(probability) or (
                isinstance(probability, np.ndarray) and probability.shape == ()
            )
            subject = f"for message {message.number}"
            if part.follows_distance:
                subject = f"at the distance {distance:g}"
            rule = f"must be a number from 0 to 1 {subject}"
            watched.demand(method, known and 0.0 <= probability <= 1.0, rule, probability)
            rule = "must be 0 or 1 where the loss is deterministic"
            remedy = "let deterministic be False"
            is_sure = not part.deterministic or probability in (0.0, 1.0)
            watched.demand(method, is_sure, rule, probability, remedy)
    mean = watched.call("mean_delivery", one)
    is_mean = is_number(mean) and (math.isnan(mean) or 0.0 <= mean <= 1.0)
    watched.demand("mean_delivery", is_mean, "must be a number from 0 to 1, or nan", mean)


def _check_channel_state(watched: WatchedPart) -> None:
    method = "next_state"

    def step(random: RecordingGenerator, before: Any) -> Any:
        bad = watched.call(method, (0, 1), before, random, repeatable=False)
        watched.demand(method, bad is True or bad is False, "must be True or False", bad)
        return bad

    calls = _draw_equally(watched, method, "at each activation", step)
    rule, remedy = "must draw nothing where stateful is False", "let stateful be True"
    is_silent = watched.part.stateful or not calls
    watched.demand(method, is_silent, rule, describe_calls(calls), remedy)


def _check_fractions(watched: WatchedPart, links: dict[Link, float], seed: int) -> None:
    part = watched.part
    sent = [Transmission(w, table_probability=p, distance=DISTANCES[0]) for w, p in links.items()]
    stated = np.array([part.mean_delivery(one) for one in sent])
    if np.isnan(stated).all() and not part.independent:
        return
    with guard_user_code(watched.name):
        lost = _simulate_losses(part, sent, seed)
    # Links have streams of their own.
    none, known = np.full(len(links), -1), ~np.isnan(stated)
    law = LossLaw(1.0 - stated, part.independent, stated_law(part, "loss"), none, tuple(links))
    if known.any():
        counts = count_outcomes(lost[..., known], none[known])
        of_known = law._replace(lost=law.lost[known], links=list(compress(links, known)))
        shares = compare_losses(of_known, counts, family_level())
        rule = "must be the delivered fraction in the long run"
        remedy = "define it; nan if it is unknown"
        demand_agreement(shares, f"{watched.name}.mean_delivery", rule, remedy)
    if part.independent:
        rule = "must be False where outcomes of neighbouring activations or links are related"
        labels = [str(list(link)) for link in links]
        coincidences = compare_coincidences(lost, range(MAX_LAG + 1), labels, family_level())
        remedy = "return False: theory relies on it"
        demand_agreement(coincidences, f"{watched.name}.independent", rule, remedy)
    elif law.chain is not None and known.all():
        bursts = compare_bursts(law, count_outcomes(lost, none), family_level())
        rule = f"losses must follow each other as in {stating_class(part, 'loss', 'chain')}"
        remedy = "define mean_delivery too if it differs by design"
        demand_agreement(bursts, f"{watched.name}.next_state", rule, remedy)


def _simulate_losses(part: Loss, sent: list[Transmission], seed: int) -> np.ndarray:
    """Return the mask (CHAINS, LENGTH, L) of messages that the engine would lose."""
    lost, channel = np.zeros((CHAINS, LENGTH, len(sent)), dtype=bool), Channel(loss=part)
    times = np.linspace(0.0, HORIZON, LENGTH, endpoint=False)
    for chain in range(CHAINS):
        streams = Streams(seed + 7, chain)
        conditions = conditions_of(part, streams, HORIZON)
        for k, one in enumerate(sent):
            sampler = ChannelSampler(channel, one.link, partial(_stream, streams, one.link))
            uniform, bad, _ = sampler.draws(LENGTH)
            of_sender = partial(_stream, streams, one.link[:1])
            shared = BroadcastSampler(part, one.link, False, of_sender).draws(LENGTH).bad
            many = one._replace(number=np.arange(LENGTH), time=times, conditions=conditions)
            many = many._replace(bad=bad if shared is None else shared)
            lost[chain, :, k] = uniform >= delivery_probabilities(part, many)
    return lost


def _stream(streams: Streams, entity: tuple[int, ...], purpose: str) -> np.random.Generator:
    return streams.generator(purpose, *entity)


def _check_delay_law(watched: WatchedPart, links: tuple[Link, ...]) -> None:
    stated, part, method = stated_part(watched.part, "delay"), watched.part, "message_delay"
    law, where = stated_law(part, "delay"), f"{watched.name}.message_delay"
    rule = f"delays must have the law of {stating_class(part, 'delay', 'law')}"
    remedy = "define longest too if it differs by design"
    if stated.fixed is not None and stated is not part:
        for link in links:
            seconds = part.message_delay(Transmission(link), stated.fixed)
            is_equal = math.isnan(seconds) or seconds == stated.fixed
            got = f"{seconds:g} s for link {list(link)} instead of {stated.fixed:g}"
            watched.demand(method, is_equal, rule, got, remedy)
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
    if np.isnan(delays).any():  # messages that the delay loses have no law
        return
    sent = np.zeros(len(delays))
    counts = count_delays(law, sent, np.array(delays), directions, len(links), FOREVER)
    for comparison in compare_delays(stack_runs([counts]), links, 2.0 * family_level()):
        demand_agreement(comparison, where, rule, remedy)


def _check_draws(watched: WatchedPart) -> None:
    where, part = f"{watched.name}.draw", watched.part
    with guard_user_code(where):
        random, other_random = (Streams(6, k).generator("delay") for k in range(2))
        delays = np.array([part.draw(random) for _ in range(DELAYS)])
        others = np.array([part.draw(other_random) for _ in range(DRAWS)])
    if delays.std() <= 1e-9 * np.abs(delays).max():
        return
    is_same, got = np.array_equal(delays[:DRAWS], others), "equal delays from two generators"
    watched.demand("draw", not is_same, OTHER_GENERATOR, got)
    # Ranks, so that long tails do not hide a correlation; equal delays have equal ranks.
    centred = (scipy.stats.rankdata(delays) - 0.5)[:, None] / len(delays) - 0.5
    names = ["a delay"], ["the one before"]
    comparison = compare_with(centred[1:], centred[:-1], *names, family_level())
    demand_agreement(comparison, where, "delays of neighbouring messages must be independent")


def _check_message_delays(watched: WatchedPart, links: tuple[Link, ...]) -> None:
    part, method, longest = watched.part, "message_delay", watched.part.longest
    drawn_delay = part.fixed or 0.0
    calls = [Transmission(link, number) for link in links for number in MESSAGES]
    delays = [watched.call(method, call, drawn_delay) for call in calls]
    for (link, message, *_), seconds in zip(calls, delays, strict=True):
        subject = f"message {message} of link {list(link)}"
        watched.demand(method, is_number(seconds), f"must be a number for {subject}", seconds)
        in_range = math.isnan(seconds) or 0.0 <= seconds <= longest
        got = f"{seconds:g} for {subject}"
        rule = f"must be from 0 to `longest` ({longest:g}) seconds, or nan where it is lost"
        watched.demand(method, in_range, rule, got)
        is_fixed = part.fixed is None or seconds == drawn_delay or overrides_message_delay(part)
        watched.demand(method, is_fixed, "must be `fixed` where delays are", got)
    # The same calls again, in reverse order.
    rule = "must not depend on which messages were asked for before"
    for call, first in zip(reversed(calls), reversed(delays), strict=True):
        second = part.message_delay(call, drawn_delay)
        is_equal = second == first or (math.isnan(second) and math.isnan(first))
        watched.demand(method, is_equal, rule, f"{first:g} and {second:g}")
    for link, expected in zip(links, np.reshape(delays, (len(links), -1)), strict=True):
        many, drawn = Transmission(link, np.array(MESSAGES)), np.full(len(MESSAGES), drawn_delay)
        with guard_user_code(f"{watched.name}.{method}"):
            together = checked_delays(part, many, drawn)
        _demand_each(watched, method, "delays", together, expected)


def _draw(watched: WatchedPart, random: RecordingGenerator) -> float:
    fixed, seconds = watched.part.fixed, watched.call("draw", random, repeatable=False)
    rule, remedy = "must be a finite number of at least 0 seconds", "shift or clip the law"
    is_right = is_number(seconds) and 0.0 <= seconds < math.inf
    watched.demand("draw", is_right, rule, seconds, remedy)
    is_fixed, got = fixed is None or seconds == fixed, f"{fixed} for {seconds}"
    watched.demand("fixed", is_fixed, "must be what draw returns, or None", got)
    longest = watched.part.longest
    rule, remedy = f"must be at most `longest`, {longest:g} seconds", "state a longer one"
    watched.demand("draw", seconds <= longest, rule, seconds, remedy)
    return float(seconds)
