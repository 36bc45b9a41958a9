"""``check_channel``: checks of a loss, a delay or a channel against its contract."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import numpy as np

from netkf.checks.parts.delays import delay_law
from netkf.checks.parts.network_rows import loss_twice
from netkf.checks.parts.sources import stated_part
from netkf.linalg.arrays import FloatArray
from netkf.network.channels import (
    Channel,
    ChannelSampler,
    Delay,
    GilbertElliott,
    Loss,
    stream_purposes,
)
from netkf.network.channels import delay_depends_on_message as overrides_message_delay
from netkf.network.graphs import Complete, Link, Topology
from netkf.rng.streams import Streams
from netkf.testing.generators import RecordingGenerator, describe_calls
from netkf.testing.noise import (
    divergence,
    kolmogorov_distance,
    largest_deviation,
    minus_log_level,
)
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
PROBABILITY_TOLERANCE, MAX_LAG = 1e-9, 3
"""Difference of probabilities that is rounding, and messages apart at which outcomes are tested."""


def check_channel(channel: Any, /, topology: Topology | None = None, **settings: Any) -> None:
    """Check a Channel, a Loss or a Delay, or a class of these with its ``settings``.

    It is checked on every directed link of a complete graph of 4 nodes, or of ``topology``.

    Exact checks: delivery probabilities are numbers from 0 to 1 (0 or 1 if ``deterministic``), use
    no randomness and do not depend on earlier calls; links with equal entries in the graph's table
    have equal ones, unless the class defines a ``mean_delivery`` of its own; ``next_state`` and
    ``draw`` use only the generator they are given, and make the same draws in each call, none if
    ``stateful`` is False or the delay is ``fixed``; delays are not negative, at most ``longest``,
    and equal to ``fixed`` if it is not None.

    Statistical checks find these errors with probability 0.9. From 20,000 messages over each
    directed link: a delivered fraction p of one link that differs from ``mean_delivery`` by
    7.8 sqrt(p (1 - p) / 20,000) (0.022 at p = 0.8), and one of all 12 links together that differs
    by a third of that; for losses in bursts, sqrt(1 + r) / sqrt(1 - r) times as much, where r is
    the correlation of neighbouring outcomes. If ``independent`` is True: a correlation of 0.08 of
    outcomes 1, 2 or 3 messages apart, or of two links with streams of their own. From 20,000
    delays: a correlation of 0.06 of neighbouring ones. If a class derives from a built-in delay, or
    from GilbertElliott, and states nothing of its own: a law of delays at a distance of 0.035 from
    that of its parent, or a probability of two losses in a row that is off by 0.02. A correct class
    fails once in a million checks.

    Raises AssertionError with one line: the method, the rule, the value got, what to do.
    """
    part = make_part(channel, (Channel, Loss, Delay), settings)
    check_channel_object(part, topology, 0)


def check_channel_object(part: Any, topology: Topology | None, seed: int) -> None:
    """Check a Channel, Loss or Delay ``part``: delivery probabilities, delays, and simulated
    outcomes against them, with random streams of ``seed``.

    Without a ``topology`` the links are those of a complete graph of 4 nodes. Raises AssertionError
    for the first rule that is broken; ``check_channel`` lists them.
    """
    if isinstance(part, Channel):
        check_channel_object(part.loss, topology, seed)
        check_channel_object(part.delay, topology, seed)
        return
    watched = WatchedPart(part)
    watched.pickle_copy()
    graph = Complete(nodes=4).build(seed=0) if topology is None else topology
    links = table_entries(graph)
    if isinstance(part, Delay):
        _check_delays(watched, tuple(links))
        return
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
    """Check that delivery probabilities do not depend on earlier calls.

    ``links`` are directed links with their entries in the graph's table. The same calls are made
    in one order and in the reverse order.
    """
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
    """Check that links with equal entries in the graph's table have equal delivery probabilities.

    Links may differ if the class that defines ``delivery_probability``, or one derived from it,
    defines ``mean_delivery`` too.
    """
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
    """Check that the delivery probabilities of a link are from 0 to 1, in both states of the
    channel, and 0 or 1 if the loss is deterministic; the mean may be nan.

    ``table_probability`` is the entry of the graph's table for the link.
    """
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
            demand(
                not part.deterministic or probability in (0.0, 1.0),
                where,
                "must be 0 or 1 where the loss is deterministic",
                probability,
                "let deterministic be False",
            )
    mean = watched.call("mean_delivery", link, table_probability)
    is_mean = math.isnan(mean) or 0.0 <= mean <= 1.0
    demand(is_mean, f"{watched.name}.mean_delivery", "must be a number from 0 to 1, or nan", mean)


def _check_channel_state(watched: WatchedPart) -> None:
    """Check ``next_state``: the state is True or False, each call makes the same draws (none if the
    loss is not ``stateful``), and equal generators give equal states.
    """
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
                demand(
                    not calls,
                    where,
                    "must draw nothing where stateful is False",
                    describe_calls(calls),
                    "let stateful be True",
                )
            elif calls != history[0][1]:
                fail(
                    where,
                    "must draw the same at each activation",
                    f"{describe_calls(history[0][1])} at the first and {describe_calls(calls)} at "
                    f"number {k}",
                    "draw first, then decide",
                )
        histories.append(history)
    demand(
        histories[0] == histories[1],
        where,
        "must use no generator but the one it is given",
        "another outcome from an equal generator",
    )


def _check_fractions(watched: WatchedPart, links: dict[Link, float], seed: int) -> None:
    """Check simulated outcomes on all directed ``links`` against ``mean_delivery``, ``independent``
    and the law of bursts of a class derived from GilbertElliott.

    ``links`` has for each link its entry in the graph's table of probabilities; ``seed`` is that of
    the simulations.
    """
    part, where = watched.part, f"{watched.name}.mean_delivery"
    stated = np.array([part.mean_delivery(link, p) for link, p in links.items()])
    if np.isnan(stated).all() and not part.independent:
        return
    with guard_user_code(watched.name):
        delivered = _simulate_deliveries(part, links, seed)
    rule = "must be the delivered fraction in the long run"
    # All links that state a mean together, then each link by itself.
    for group in [~np.isnan(stated), *np.eye(len(links), dtype=bool)]:
        if not group.any() or np.isnan(stated[group]).any():
            continue
        outcomes = delivered[:, :, group]
        deviation = _fraction_deviation(outcomes, stated[group], part.independent)
        if deviation is not None:
            group_name = list(links)[int(np.argmax(group))] if group.sum() == 1 else "all links"
            mean = stated[group].mean()
            fail(
                where,
                rule,
                f"{mean:.4g}, and {mean + deviation:.4g} of {outcomes.size:,} simulated messages "
                f"came over {group_name}",
            )
    if part.independent:
        _check_independent(watched, delivered, tuple(links))
    elif type(chain := stated_part(part, "loss")) is GilbertElliott:
        _check_bursts(watched, chain, delivered)


def _check_bursts(watched: WatchedPart, chain: GilbertElliott, delivered: FloatArray) -> None:
    """Check how often two messages in a row are lost, from the outcomes ``delivered`` (C, K, L), 0
    or 1, of C runs, K messages and L links, against the built-in ``chain`` with the same
    parameters.
    """
    lost, expected = 1.0 - delivered, loss_twice(chain)
    excess = (lost[:, 1:] * lost[:, :-1]).mean(axis=1) - expected
    deviation = largest_deviation(excess.reshape(-1, 1))
    if deviation is not None:
        frequency = f"{expected + deviation.mean:.4g} (+- {deviation.error:.2g})"
        fail(
            f"{watched.name}.next_state",
            "losses must follow each other as in GilbertElliott, from which it derives",
            f"two in a row: {frequency} instead of {expected:.4g}",
            "define mean_delivery too if it differs by design",
        )


def _fraction_deviation(
    delivered: FloatArray, stated: FloatArray, independent: bool
) -> float | None:
    """Return the difference of the delivered fraction from the mean of the ``stated`` ones (L,), or
    None if it is not significant.

    ``delivered`` (C, K, L) are outcomes 0 or 1 of C runs, K messages and L links; ``independent``
    says whether they are independent, as the class states.
    """
    difference = float((delivered.mean(axis=(0, 1)) - stated).mean())
    if independent:
        p, f = stated.mean(), stated.mean() + difference
        # With unequal probabilities the bound is on the safe side: sums of outcomes vary less.
        exponent = delivered.size * divergence(np.array([f]), np.array([p]))[0]
        return difference if exponent > minus_log_level(1 + delivered.shape[2]) else None
    means = (delivered.mean(axis=1) - stated).reshape(-1, 1)
    # A difference as small as 12 runs of a link can make alone, all delivered instead of all lost,
    # is not significant: the means of runs may be far from normal, most of them 0 or 1.
    threshold = 12.0 / (CHAINS * len(stated))
    deviation = largest_deviation(means, min_values=100)
    return difference if deviation is not None and abs(difference) > threshold else None


def _check_independent(
    watched: WatchedPart, delivered: FloatArray, links: tuple[Link, ...]
) -> None:
    """Check that the outcomes ``delivered`` (C, K, L), 0 or 1, of C runs, K messages and L links
    are independent of those of other links, and of those up to MAX_LAG messages later, as the loss
    states by ``independent``.
    """
    p = delivered.mean(axis=(0, 1))
    expected = np.outer(p, p)
    for lag in range(MAX_LAG + 1):
        early, late = delivered[:, : LENGTH - lag], delivered[:, lag:]
        count = early[..., 0].size
        # Entry [l, m]: how often message k over link l and message k + lag over link m arrive.
        both = np.einsum("ckl,ckm->lm", early, late) / count
        unlikely = count * divergence(both, expected) > minus_log_level(both.size)
        if lag == 0:
            np.fill_diagonal(unlikely, False)
        if unlikely.any():
            index = np.unravel_index(int(np.argmax(unlikely * np.abs(both - expected))), both.shape)
            first, second = (list(links[k]) for k in index)
            relation = "neighbouring activations" if first == second else "different links"
            fail(
                f"{watched.name}.independent",
                f"must be False where outcomes of {relation} are related",
                f"message k over link {first} and message k + {lag} over link {second}: both "
                f"arrive in {both[index]:.4g} of cases instead of {expected[index]:.4g}",
                "return False: theory relies on it",
            )


def _simulate_deliveries(part: Loss, links: dict[Link, float], seed: int) -> FloatArray:
    """Return outcomes (CHAINS, LENGTH, L) of messages over L directed links: 1 if the engine would
    deliver the message, else 0.

    ``links`` has for each link its entry in the graph's table of probabilities. As in the engine,
    each directed link has random streams of its own, derived from ``seed``.
    """
    delivered, channel = np.zeros((CHAINS, LENGTH, len(links))), Channel(loss=part)
    for chain in range(CHAINS):
        # All seeds in one call: each alone takes longer than the draws.
        streams = Streams(seed + 7, chain).with_seeds(stream_purposes(channel), tuple(links))
        for k, (link, table_probability) in enumerate(links.items()):
            sampler = ChannelSampler(channel, partial(_make_generator, streams, link))
            uniform, bad, _ = sampler.draws(LENGTH)
            probabilities = [
                part.delivery_probability(link, message, is_bad, table_probability)
                for message, is_bad in enumerate(bad.tolist())
            ]
            delivered[chain, :, k] = uniform < probabilities
    return delivered


def _make_generator(streams: Streams, link: Link, purpose: str) -> np.random.Generator:
    """Return the random generator for a purpose of a directed link."""
    return streams.generator(purpose, *link)


def _check_delays(watched: WatchedPart, links: tuple[Link, ...]) -> None:
    """Check a delay: the delays of messages on all ``links``, its draws and its law."""
    _check_message_delays(watched, links)
    delays, repeated = (_draw_delays(watched) for _ in range(2))
    demand(
        delays == repeated,
        f"{watched.name}.draw",
        "must use no generator but the one it is given",
        "other delays from an equal generator",
    )
    if watched.part.is_random:
        _check_draws(watched)
    _check_delay_law(watched, links)


def _check_delay_law(watched: WatchedPart, links: tuple[Link, ...]) -> None:
    """Check delays against the law of the built-in class from which a class derives, unless it
    defines ``longest`` itself.

    A constant delay is compared on every link, others by DELAYS messages over all links in turn.
    """
    stated, part = stated_part(watched.part, "delay"), watched.part
    where = f"{watched.name}.message_delay"
    rule = f"delays must have the law of {type(stated).__name__}, from which it derives"
    remedy = "define longest too if it differs by design"
    if type(stated) is type(part):
        return
    if stated.fixed is not None:
        for link in links:
            seconds = part.message_delay(link, 0, stated.fixed)
            is_equal = math.isnan(seconds) or seconds == stated.fixed
            got = f"{seconds:g} s for link {list(link)} instead of {stated.fixed:g}"
            demand(is_equal, where, rule, got, remedy)
        return
    link_indices = np.arange(DELAYS) % len(links)
    with guard_user_code(where):
        random = Streams(7, 0).generator("delay")
        delays = [
            part.message_delay(links[index], k, part.draw(random))
            for k, index in enumerate(link_indices.tolist())
        ]
    # Values of the stated distribution function: uniform in [0, 1] if the law is right.
    uniform = delay_law(stated, np.array(delays))
    if uniform is None or np.isnan(uniform).any():
        return
    # Means over all links (column 0) and over each link.
    centred = uniform[:, None] - 0.5
    of_link = link_indices[:, None] == np.arange(len(links))
    deviation = largest_deviation(np.concatenate([centred, centred * of_link], axis=1))
    distance = kolmogorov_distance(uniform)
    # P(sqrt(N) D > x) <= 2 exp(-2 x^2), Massart 1990.
    limit = math.sqrt(0.5 * minus_log_level(1) / uniform.size)
    if deviation is not None or distance > limit:
        column = deviation.position[0] if deviation is not None else 0
        group_name = list(links[column - 1]) if column else "all links"
        text = f"a distance of {distance:.3g} from it, furthest off {group_name}"
        fail(where, rule, text, remedy)


def _check_draws(watched: WatchedPart) -> None:
    """Check that delays are drawn from the given generator and that neighbouring ones are
    independent.
    """
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
    deviation = largest_deviation((centred[1:] * centred[:-1])[:, None]) if varies else None
    if deviation is not None:
        # The variance of uniform numbers in [-0.5, 0.5] is 1/12.
        correlation = f"{12.0 * deviation.mean:.3g} (+- {12.0 * deviation.error:.2g})"
        rule = "delays of neighbouring messages must be independent"
        fail(where, rule, f"a correlation of ranks of {correlation}")


def _check_message_delays(watched: WatchedPart, links: tuple[Link, ...]) -> None:
    """Check ``message_delay`` on every link: from 0 to ``longest`` seconds or nan, equal to
    ``fixed`` unless that is None, and independent of earlier calls.
    """
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
    """Return DRAWS delays in seconds from a generator with a fixed seed; check each of them, and
    that each takes the same calls of the generator.
    """
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
