"""Check that a loss, a delay or a channel keeps its contract."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import numpy as np

from netkf.checks.parts.delays import delay_law
from netkf.checks.parts.network_rows import loss_twice
from netkf.checks.parts.sources import stated_part
from netkf.linalg.arrays import FloatArray
from netkf.network.channels import Channel, ChannelSampler, Delay, GilbertElliott, Loss
from netkf.network.channels import delay_depends_on_message as overrides_message_delay
from netkf.network.graphs import Complete, Link, Topology
from netkf.rng.streams import Streams
from netkf.testing.generators import RecordingGenerator, describe_calls
from netkf.testing.noise import divergence, largest_deviation, log_level
from netkf.testing.watching import Watched, demand, fail, make_part, user_code

CHAINS, LENGTH, DRAWS = 400, 50, 200
DELAYS = 20_000
MESSAGES = (0, 1, 2, 7, 1000)
TABLE = (1.0, 0.6, 0.85)
"""Entries of the graph's table, for one direction after the other."""
# Probabilities that differ less are equal; messages apart up to which losses are compared.
EQUAL, LAGS = 1e-9, 3


def check_channel(channel: Any, /, topology: Topology | None = None, **settings: Any) -> None:
    """Check a Channel, a Loss or a Delay, or a class of these with its ``settings``, on every
    direction of every link of a complete graph of 4 nodes, or of ``topology``.

    Exactly: delivery probabilities are numbers from 0 to 1 (0 or 1 where ``deterministic``), need
    no randomness and do not depend on what was asked before; links with equal entries in the
    graph's table have equal ones, unless the class says otherwise by a ``mean_delivery`` of its
    own; ``next_state`` and ``draw`` use only the generator they are given, make the same draws at
    each activation, and none where ``stateful`` is False or the delay is ``fixed``; delays are not
    negative, at most ``longest``, and equal ``fixed`` if it is not None.

    By 20,000 activations of each direction, with probability 0.9: a delivered fraction p of one
    direction that differs from its ``mean_delivery`` by 7.8 sqrt(p (1 - p) / 20,000) (0.022 at
    p = 0.8), and one of all 12 directions by a third of that (losses in bursts: by sqrt(1 + r) /
    sqrt(1 - r) times as much, r the correlation of neighbouring outcomes); where ``independent``
    is True, a correlation of 0.08 of outcomes 1, 2 or 3 activations apart, or of those of two
    directions that have streams of their own. By 20,000 delays: a correlation of 0.06 of
    neighbouring ones. A class that derives from a built-in delay, or from GilbertElliott, and
    states nothing of its own is held to that law: a distance of 0.035 of delays, a probability of
    two losses in a row that is off by 0.02. A sound class fails once in a million checks.

    Raises AssertionError with one line: the method, the rule, the value got, what to do.
    """
    part = make_part(channel, (Channel, Loss, Delay), settings)
    check_made_channel(part, topology, 0)


def check_made_channel(part: Any, topology: Topology | None, seed: int) -> None:
    """Run ``check_channel`` on an object, with streams of the given seed."""
    if isinstance(part, Channel):
        check_made_channel(part.loss, topology, seed)
        check_made_channel(part.delay, topology, seed)
        return
    watched = Watched(part)
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
    """Return the entry of the graph's table for each direction: its own, or some of each size."""
    if topology.delivery is not None:
        return {link: topology.delivery.get(link, 1.0) for link in topology.directions}
    return {link: TABLE[k % len(TABLE)] for k, link in enumerate(topology.directions)}


def _check_pure(watched: Watched, links: dict[Link, float]) -> None:
    """Check that probabilities do not depend on earlier calls."""
    asked = [(link, m, bad, p) for link, p in links.items() for m in MESSAGES for bad in (0, 1)]
    there, back = (
        {one: watched.part.delivery_probability(*one[:2], bool(one[2]), one[3]) for one in order}
        for order in (asked, asked[::-1])
    )
    for one in asked:
        demand(
            there[one] == back[one],
            f"{watched.name}.{watched.defined_name('delivery_probability')}",
            "must not depend on which links and messages were asked for before",
            f"{there[one]:.4g} and {back[one]:.4g} for message {one[1]} of link {list(one[0])}",
            "use nothing but the arguments",
        )


def _check_identical_links(watched: Watched, links: tuple[Link, ...]) -> None:
    """Check that links with equal entries of the table are treated alike, unless the class that
    defines the delivery probabilities says otherwise by ``mean_delivery``.
    """
    part = watched.part
    order = type(part).__mro__
    owners = [
        next(k for k, cls in enumerate(order) if name in vars(cls))
        for name in ("mean_delivery", "delivery_probability")
    ]
    if owners[0] <= owners[1] and order[owners[0]] is not Loss:
        return
    for bad in (False, True):
        for message in MESSAGES:
            probabilities = [part.delivery_probability(link, message, bad, 0.8) for link in links]
            usual = float(np.median(probabilities))
            for link, probability in zip(links, probabilities, strict=True):
                demand(
                    abs(probability - usual) <= EQUAL,
                    f"{watched.name}.{watched.defined_name('delivery_probability')}",
                    "must be the same for links with equal entries in the graph's table",
                    f"{probability:.4g} for link {list(link)} and {usual:.4g} for others",
                    "define mean_delivery beside it if links differ by design",
                )


def _check_delivery_probabilities(watched: Watched, link: Link, table_probability: float) -> None:
    """Check the delivery probabilities of some messages in both states of the channel."""
    part, where = watched.part, f"{watched.name}.{watched.defined_name('delivery_probability')}"
    for bad in (False, True):
        for message in (0, 1, 2, 1000):
            probability = watched.call(
                "delivery_probability", link, message, bad, table_probability
            )
            number = (
                isinstance(probability, (int, float, np.floating)) and 0.0 <= probability <= 1.0
            )
            demand(
                number, where, f"must be a number from 0 to 1 for message {message}", probability
            )
            allowed = not part.deterministic or probability in (0.0, 1.0)
            demand(
                allowed,
                where,
                "must be 0 or 1 where the loss is deterministic",
                probability,
                "let deterministic be False",
            )
    mean = watched.call("mean_delivery", link, table_probability)
    known = math.isnan(mean) or 0.0 <= mean <= 1.0
    demand(known, f"{watched.name}.mean_delivery", "must be a number from 0 to 1, or nan", mean)


def _check_channel_state(watched: Watched) -> None:
    """Check that the next state is True or False and draws the same at each activation."""
    part, where = watched.part, f"{watched.name}.{watched.defined_name('next_state')}"
    histories: dict[bool, list[Any]] = {}
    for twin in range(2):
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
        histories[bool(twin)] = history
    demand(
        histories[False] == histories[True],
        where,
        "must use no generator but the one it is given",
        "another outcome from an equal generator",
    )


def _check_fractions(watched: Watched, links: dict[Link, float], seed: int) -> None:
    """Check what arrives over all directions against ``mean_delivery`` and ``independent``."""
    part, where = watched.part, f"{watched.name}.mean_delivery"
    stated = np.array([part.mean_delivery(link, p) for link, p in links.items()])
    if np.isnan(stated).all() and not part.independent:
        return
    with user_code(watched.name):
        arrived = _simulate_arrivals(part, links, seed)
    rule = "must be the delivered fraction in the long run"
    for known in [~np.isnan(stated), *(np.arange(len(links)) == k for k in range(len(links)))]:
        if not known.any() or np.isnan(stated[known]).any():
            continue
        if (off := _deviation(arrived[:, :, known], stated[known], part.independent)) is not None:
            some = list(links)[int(np.argmax(known))] if known.sum() == 1 else "all links"
            text = f"{stated[known].mean():.4g}, and {stated[known].mean() + off:.4g} of "
            count = f"{arrived[:, :, known].size:,} simulated messages came over {some}"
            fail(where, rule, text + count)
    if part.independent:
        _check_independent(watched, arrived, tuple(links))
    elif type(chain := stated_part(part, "loss")) is GilbertElliott:
        _check_bursts(watched, chain, arrived)


def _check_bursts(watched: Watched, chain: GilbertElliott, arrived: FloatArray) -> None:
    """Check how often two messages in a row are lost, of outcomes (C, K, L)."""
    lost, expected = 1.0 - arrived, loss_twice(chain)
    twice = (lost[:, 1:] * lost[:, :-1]).mean(axis=1) - expected
    found = largest_deviation(twice.reshape(-1, 1))
    if found is not None:
        text = f"{expected + found.mean:.4g} (+- {found.error:.2g}) instead of {expected:.4g}"
        rule = "losses must follow each other as in GilbertElliott, from which it derives"
        remedy = "define mean_delivery too if it differs by design"
        demand(False, f"{watched.name}.next_state", rule, f"two in a row: {text}", remedy)


def _deviation(arrived: FloatArray, stated: FloatArray, independent: bool) -> float | None:
    """Return by how much the delivered fraction of some links (C, K, L) differs significantly from
    the stated ones (L,).
    """
    off = float((arrived.mean(axis=(0, 1)) - stated).mean())
    if independent:
        p, f = stated.mean(), stated.mean() + off
        # Sums of outcomes with different probabilities vary less than those with equal ones.
        beyond = arrived.size * divergence(np.array([f]), np.array([p]))[0]
        return off if beyond > log_level(1 + arrived.shape[2]) else None
    means = (arrived.mean(axis=1) - stated).reshape(-1, 1)
    # One chain of a few outcomes may say little, and many say nothing but 0 or 1.
    few = 12.0 / (CHAINS * len(stated))
    found = largest_deviation(means, fewest=100)
    return off if found is not None and abs(off) > few else None


def _check_independent(watched: Watched, arrived: FloatArray, links: tuple[Link, ...]) -> None:
    """Check that outcomes (C, K, L) are independent in time and of different directions."""
    p = arrived.mean(axis=(0, 1))
    for lag in range(LAGS + 1):
        early, late = arrived[:, : LENGTH - lag], arrived[:, lag:]
        both = np.einsum("ckl,ckm->lm", early, late) / early[..., 0].size
        expected = np.outer(p, p)
        unlikely = early[..., 0].size * divergence(both, expected) > log_level(both.size)
        if lag == 0:
            np.fill_diagonal(unlikely, False)
        if unlikely.any():
            index = np.unravel_index(int(np.argmax(unlikely * np.abs(both - expected))), both.shape)
            one, other = (list(links[k]) for k in index)
            text = f"both arrive in {both[index]:.4g} of cases instead of {expected[index]:.4g}"
            apart = f"message k over link {one} and message k + {lag} over link {other}"
            same = index[0] == index[1]
            which = "neighbouring activations" if same else "different links"
            demand(
                False,
                f"{watched.name}.independent",
                f"must be False where outcomes of {which} are related",
                f"{apart}: {text}",
                "return False: theory relies on it",
            )


def _simulate_arrivals(part: Loss, links: dict[Link, float], seed: int) -> FloatArray:
    """Return what the engine would have delivered, (chains, length, links) of 0 and 1, with own
    streams for each direction.
    """
    arrived = np.zeros((CHAINS, LENGTH, len(links)))
    for chain in range(CHAINS):
        streams = Streams(seed + 7, chain)
        for k, (link, table_probability) in enumerate(links.items()):
            sampler = ChannelSampler(Channel(loss=part), partial(_make_generator, streams, link))
            uniform, bad, _ = sampler.draws(LENGTH)
            probabilities = [
                part.delivery_probability(link, message, here, table_probability)
                for message, here in enumerate(bad.tolist())
            ]
            arrived[chain, :, k] = uniform < probabilities
    return arrived


def _make_generator(streams: Streams, link: Link, purpose: str) -> np.random.Generator:
    """Return the random generator of a purpose for a directed link."""
    return streams.generator(purpose, *link)


def _check_delays(watched: Watched, links: tuple[Link, ...]) -> None:
    """Check the delays of a channel."""
    _check_message_delays(watched, links)
    first_draws = [_draw_delays(watched) for _ in range(2)]
    demand(
        first_draws[0] == first_draws[1],
        f"{watched.name}.draw",
        "must use no generator but the one it is given",
        "other delays from an equal generator",
    )
    if watched.part.is_random:
        _check_draws(watched)
    _check_delay_law(watched, links)


def _check_delay_law(watched: Watched, links: tuple[Link, ...]) -> None:
    """Check delays against the built-in law from which a class derives without a bound of its own.

    The constant one by the messages of all links, others by DELAYS messages of all links in turn.
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
            off = not math.isnan(seconds) and seconds != stated.fixed
            got = f"{seconds:g} s for link {list(link)} instead of {stated.fixed:g}"
            demand(not off, where, rule, got, remedy)
        return
    with user_code(where):
        random = Streams(7, 0).generator("delay")
        chosen = [links[k % len(links)] for k in range(DELAYS)]
        seconds = [part.message_delay(link, k, part.draw(random)) for k, link in enumerate(chosen)]
    law = delay_law(stated, np.array(seconds))
    if law is None or np.isnan(law).any():
        return
    apart = law[:, None] - 0.5
    groups = np.array([k % len(links) for k in range(DELAYS)])[:, None] == np.arange(len(links))
    found = largest_deviation(np.concatenate([apart, apart * groups], axis=1))
    values = np.sort(law)
    steps = np.arange(values.size + 1) / values.size
    distance = float(max((steps[1:] - values).max(), (values - steps[:-1]).max()))
    # P(sqrt(N) D > x) <= 2 exp(-2 x^2), Massart 1990.
    far = distance > math.sqrt(0.5 * log_level(1) / values.size)
    if found is not None or far:
        which = list(links[found.position[0] - 1]) if found and found.position[0] else "all links"
        text = f"a distance of {distance:.3g} from it, furthest off {which}"
        demand(False, where, rule, text, remedy)


def _check_draws(watched: Watched) -> None:
    """Check that draws are independent of each other and use the generator."""
    where = f"{watched.name}.draw"
    with user_code(where):
        random, other = (Streams(6, k).generator("delay") for k in range(2))
        drawn = np.array([watched.part.draw(random) for _ in range(DELAYS)])
        again = np.array([watched.part.draw(other) for _ in range(DRAWS)])
    varies = drawn.std() > 1e-9 * (1.0 + np.abs(drawn).max())
    same = varies and np.array_equal(drawn[:DRAWS], again)
    demand(
        not same, where, "must draw from the generator given", "equal delays from two generators"
    )
    from scipy.stats import rankdata

    # Ranks, so that long tails do not hide a relation; equal delays have equal ranks.
    unit = (rankdata(drawn) - 0.5) / len(drawn) - 0.5
    found = largest_deviation((unit[1:] * unit[:-1])[:, None]) if varies else None
    if found is not None:
        text = f"a correlation of ranks of {12.0 * found.mean:.3g} (+- {12.0 * found.error:.2g})"
        fail(where, "delays of neighbouring messages must be independent", text)


def _check_message_delays(watched: Watched, links: tuple[Link, ...]) -> None:
    """Check the delays of messages on every link: 0 or more, at most ``longest``, or nan."""
    part, where, longest = watched.part, f"{watched.name}.message_delay", watched.part.longest
    drawn = part.fixed or 0.0
    asked = [(link, message) for link in links for message in MESSAGES]
    found = {one: watched.call("message_delay", *one, drawn) for one in asked}
    for (link, message), seconds in found.items():
        subject = f"message {message} of link {list(link)}"
        number = isinstance(seconds, (int, float, np.floating))
        demand(number, where, f"must be a number for {subject}", seconds)
        fine = math.isnan(seconds) or 0.0 <= seconds <= longest
        rule = f"must be from 0 to `longest` ({longest:g}) seconds, or nan where it is lost"
        demand(fine, where, rule, f"{seconds:g} for {subject}")
        kept = part.fixed is None or seconds == drawn or overrides_message_delay(part)
        demand(kept, where, "must be `fixed` where delays are", f"{seconds:g} for {subject}")
    for one in reversed(asked):
        same = watched.part.message_delay(*one, drawn)
        equal = same == found[one] or (math.isnan(same) and math.isnan(found[one]))
        rule = "must not depend on which messages were asked for before"
        demand(equal, where, rule, f"{found[one]:g} and {same:g}")


def _draw_delays(watched: Watched) -> list[float]:
    """Return some delays, each checked by itself."""
    fixed, where, random = watched.part.fixed, f"{watched.name}.draw", RecordingGenerator(6)
    first, rule = None, "must be a finite number of at least 0 seconds"
    delays: list[float] = []
    for k in range(DRAWS):
        seconds = watched.call("draw", random, repeatable=False)
        number = isinstance(seconds, (int, float, np.floating)) and math.isfinite(seconds)
        demand(number and seconds >= 0.0, where, rule, seconds, "shift or clip the law")
        calls = random.take_calls()
        first = calls if first is None else first
        demand(
            calls == first,
            where,
            "must draw the same for each message",
            f"{describe_calls(first)} for the first and {describe_calls(calls)} for number {k}",
            "draw a fixed number of values, then decide",
        )
        same = fixed is None or seconds == fixed
        text = "must be what draw returns, or None"
        demand(same, f"{watched.name}.fixed", text, f"{fixed} for {seconds}")
        delays.append(seconds)
    return delays
