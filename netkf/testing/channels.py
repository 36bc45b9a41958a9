"""Check that a loss, a delay or a channel keeps its contract."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.network.channels import Channel, ChannelSampler, Delay, Loss
from netkf.network.graphs import Link
from netkf.rng.streams import Streams
from netkf.testing.generators import RecordingGenerator, describe_calls
from netkf.testing.watching import Watched, demand, fail, global_randomness, made

CHAINS, LENGTH, DRAWS = 1000, 50, 200
SURE = 5.0
"""Standard errors that count as different: a false alarm in about a million."""
FEW = 12.0
LINKS = ((0, 1), (1, 0))


def check_channel(channel: Any, /, **settings: Any) -> None:
    """Check a Channel, a Loss or a Delay, or a class of these with its ``settings``.

    Delivery probabilities are numbers from 0 to 1 (0 or 1 where ``deterministic``) and need no
    randomness; ``next_state`` and ``draw`` use only the generator they are given, make the same
    draws at each activation, and none where ``stateful`` is False or the delay is ``fixed``;
    ``mean_delivery`` and ``independent`` agree with a simulation of 50,000 activations; delays are
    not negative and equal ``fixed`` if it is not None. Raises AssertionError with one line.
    """
    part = made(channel, (Channel, Loss, Delay), settings)
    if isinstance(part, Channel):
        check_channel(part.loss)
        check_channel(part.delay)
        return
    watched = Watched(part)
    watched.pickled()
    if isinstance(part, Delay):
        _delays(watched)
        return
    for link, table_probability in ((LINKS[0], 1.0), (LINKS[1], 0.6)):
        _chances(watched, link, table_probability)
    _weather(watched)
    for link, table_probability in ((LINKS[0], 1.0), (LINKS[1], 0.6)):
        _fractions(watched, link, table_probability)


def _chances(watched: Watched, link: Link, table_probability: float) -> None:
    part, where = watched.part, f"{watched.name}.{watched.spoken('delivery_probability')}"
    for bad in (False, True):
        for message in (0, 1, 2, 1000):
            chance = watched.call("delivery_probability", link, message, bad, table_probability)
            number = isinstance(chance, (int, float, np.floating)) and 0.0 <= chance <= 1.0
            demand(number, where, f"must be a number from 0 to 1 for message {message}", chance)
            sure = not part.deterministic or chance in (0.0, 1.0)
            demand(
                sure,
                where,
                "must be 0 or 1 where the loss is deterministic",
                chance,
                "let deterministic be False",
            )
    mean = watched.call("mean_delivery", link, table_probability)
    known = math.isnan(mean) or 0.0 <= mean <= 1.0
    demand(known, f"{watched.name}.mean_delivery", "must be a number from 0 to 1, or nan", mean)


def _weather(watched: Watched) -> None:
    part, where = watched.part, f"{watched.name}.{watched.spoken('next_state')}"
    seen: dict[bool, list[Any]] = {}
    for twin in range(2):
        random, bad, history = RecordingGenerator(5), None, []
        for k in range(DRAWS):
            bad = watched.call("next_state", bad, random, repeatable=False)
            demand(bad is True or bad is False, where, "must be True or False", bad)
            calls = random.taken()
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
        seen[bool(twin)] = history
    demand(
        seen[False] == seen[True],
        where,
        "must use no generator but the one it is given",
        "another outcome from an equal generator",
    )


def _fractions(watched: Watched, link: Link, table_probability: float) -> None:
    part = watched.part
    stated = part.mean_delivery(link, table_probability)
    if math.isnan(stated) and not part.independent:
        return
    arrived = _simulated(part, link, table_probability)
    fractions = arrived.mean(axis=1)
    found, error = float(fractions.mean()), float(fractions.std()) / math.sqrt(CHAINS)
    few = FEW / (arrived.size if part.independent else CHAINS)
    off = abs(found - stated) > SURE * error + few
    demand(
        not off,
        f"{watched.name}.mean_delivery",
        "must be the delivered fraction in the long run",
        f"{stated:.4g}, and {found:.4g} +- {error:.2g} of {arrived.size:,} simulated messages came",
    )
    if part.independent:
        _independent(watched, arrived, found)


def _independent(watched: Watched, arrived: FloatArray, mean: float) -> None:
    products = ((arrived[:, 1:] - mean) * (arrived[:, :-1] - mean)).mean(axis=1)
    value, error = float(products.mean()), float(products.std()) / math.sqrt(CHAINS)
    related = abs(value) > SURE * error + FEW / arrived.size
    demand(
        not related,
        f"{watched.name}.independent",
        "must be False where outcomes of neighbouring activations are related",
        f"a covariance of {value:.3g} +- {error:.2g}",
        "return False: theory relies on it",
    )


def _simulated(part: Loss, link: Link, table_probability: float) -> FloatArray:
    """(chains, length) of 0 and 1: what the engine would have delivered."""
    arrived = np.zeros((CHAINS, LENGTH))
    before = global_randomness()
    for chain in range(CHAINS):
        sampler = ChannelSampler(Channel(loss=part), Streams(7, chain).generator)
        for message in range(LENGTH):
            uniform, bad, _ = sampler.draw()
            arrived[chain, message] = uniform < part.delivery_probability(
                link, message, bad, table_probability
            )
    demand(global_randomness() == before, type(part).__name__, "must not use global generators")
    return arrived


def _delays(watched: Watched) -> None:
    seen = [_drawn(watched) for _ in range(2)]
    demand(
        seen[0] == seen[1],
        f"{watched.name}.draw",
        "must use no generator but the one it is given",
        "other delays from an equal generator",
    )


def _drawn(watched: Watched) -> list[float]:
    """Delays, each checked by itself."""
    fixed, where, random = watched.part.fixed, f"{watched.name}.draw", RecordingGenerator(6)
    first, rule = None, "must be a finite number of at least 0 seconds"
    delays: list[float] = []
    for k in range(DRAWS):
        seconds = watched.call("draw", random, repeatable=False)
        number = isinstance(seconds, (int, float, np.floating)) and math.isfinite(seconds)
        demand(number and seconds >= 0.0, where, rule, seconds, "shift or clip the law")
        calls = random.taken()
        first = calls if first is None else first
        demand(
            calls == first,
            where,
            "must draw the same for each message",
            f"{describe_calls(first)} for the first and {describe_calls(calls)} for number {k}",
            "draw a fixed number of values, then decide",
        )
        same = fixed is None or seconds == fixed
        words = "must be what draw returns, or None"
        demand(same, f"{watched.name}.fixed", words, f"{fixed} for {seconds}")
        delays.append(seconds)
    return delays
