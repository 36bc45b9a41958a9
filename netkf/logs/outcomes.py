"""Statistics of the outcomes of packets: deliveries, bursts, shared fate, and tests of what laws
of losses assume.

Senders are taken as independent of each other. What hearers share, and what follows in time, is
kept in all variances: sums go over transmissions, which are the units.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations_with_replacement
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy.optimize import brentq, minimize
from scipy.special import expit, logit
from scipy.stats import beta, chi2, kstwo, ncx2, norm

from netkf.core.laws import WaitingLaw
from netkf.linalg.arrays import FloatArray
from netkf.logs.envelope import FittedLaw

POWER = 0.9
"""The probability with which a departure of the size ``detectable`` is found."""
BLOCKS = 48
"""Parts of a log whose means tell of slow changes."""
LAGS = 4
"""Lags of these means that are tested together."""
EM_STEPS = 300
MIN_PACKETS = 10
"""Packets of a link below which no test is made of it."""


class Test(NamedTuple):
    """What the log says of one assumption about outcomes.

    estimate : of the departure, in the words of ``what``
    p        : of a departure as large or larger by chance; nan where nothing can be tested
    unit     : of the departure: its standard error, or for a chi-square with ``freedom`` degrees
               of freedom what makes the noncentrality 1 if it is raised to ``power``
    rise     : by how much the variance grows with the departure, of a chi-square with its square,
               as a share of that without one
    """

    what: str
    estimate: float = math.nan
    p: float = math.nan
    unit: float = math.nan
    freedom: float = 0.0
    power: int = 2
    rise: float = 0.0

    def detectable(self, level: float) -> float:
        """Return the departure that a test of this level finds with probability POWER."""
        if not self.freedom or not np.isfinite(self.unit):
            limit, found = float(norm.isf(level / 2.0)), 0.0
            for _ in range(30):
                spread = math.sqrt(1.0 + self.rise * found)
                found = self.unit * (limit + spread * float(norm.ppf(POWER)))
            return found
        limit = float(chi2.isf(level, self.freedom))

        def miss(noncentrality: float) -> float:
            return float(ncx2.sf(limit, self.freedom, noncentrality)) - POWER

        noncentrality = float(brentq(miss, 1e-6, 100.0 * (limit + 10.0)))
        found = self.unit * float(noncentrality ** (1.0 / self.power))
        rest = 1.0 - self.rise * found**2
        return found / math.sqrt(rest) if rest > 0.0 else math.nan


def test_law(values: FloatArray, law: WaitingLaw) -> Test:
    """Return the test that independent ``values`` (K,) have a ``law`` that was fitted to them: by
    Kolmogorov and Smirnov, whose p is then too large, never too small.
    """
    found, counts = np.unique(values, return_counts=True)
    # Stamps do not tell more than the shortest gap between two values.
    step = float(np.diff(found).min(initial=np.inf))
    up_to = np.cumsum(counts) / len(values)
    above = up_to - law.cdf(found + step)
    below = law.cdf(np.maximum(found - step, 0.0)) - (up_to - counts / len(values))
    distance = float(max(above.max(), below.max(), 0.0))
    # Of a normal law with this standard error about as much is found as of Kolmogorov's.
    unit = 0.62 / math.sqrt(len(values))
    what = "distance of distribution functions"
    return Test(what, distance, float(kstwo.sf(distance, len(values))), unit)


class Group(NamedTuple):
    """The transmissions of one sender on one channel in the order of time: outcomes x (T, h) of its
    h hearers, 1, 0 or nan; times (T,); which row follows the one before in one stretch (T,); and
    the indices (h,) of the links.
    """

    x: FloatArray
    t: FloatArray
    follows: np.ndarray
    links: np.ndarray

    @property
    def mean(self) -> FloatArray:
        """Deliveries (h,) of the hearers in the group."""
        with np.errstate(invalid="ignore"):
            return np.asarray(np.nansum(self.x, axis=0) / np.isfinite(self.x).sum(axis=0))

    @property
    def residuals(self) -> FloatArray:
        """The outcomes less their mean (T, h), 0 where it is not known."""
        return np.nan_to_num(self.x - self.mean)


@dataclass(frozen=True, eq=False)
class LogOutcomes:
    """The outcomes of a log: L ``links`` (sender, receiver), and the ``groups``."""

    links: tuple[tuple[str, str], ...]
    groups: tuple[Group, ...]
    channels: tuple[str, ...]

    @cached_property
    def counts(self) -> np.ndarray:
        """Known outcomes and packets heard of each link, (L, 2)."""
        return self._sum(self.groups)

    def _sum(self, groups: tuple[Group, ...]) -> np.ndarray:
        total = np.zeros((len(self.links), 2), dtype=int)
        for group in groups:
            total[group.links, 0] += np.isfinite(group.x).sum(axis=0)
            total[group.links, 1] += np.nansum(group.x, axis=0).astype(int)
        return total

    @cached_property
    def transitions(self) -> FloatArray:
        """Counts by link (L, 4): heard with a next, these then lost; lost, these then heard."""
        moves = np.zeros((len(self.links), 4))
        for group in self.groups:
            last, now = group.x[:-1], group.x[1:]
            both = np.isfinite(last + now) & group.follows[1:, None]
            for k, flags in enumerate((last == 1, (last == 1) & (now == 0), last == 0)):
                moves[group.links, k] += (both & flags).sum(axis=0)
            moves[group.links, 3] += (both & (last == 0) & (now == 1)).sum(axis=0)
        return moves

    @property
    def channel_names(self) -> list[str]:
        """The C channels, "" for one that is not known only if no other is."""
        return sorted({*self.channels} - {""}) or [""]

    @cached_property
    def by_channel(self) -> np.ndarray:
        """``counts`` for each channel, (C, L, 2)."""
        pairs = list(zip(self.groups, self.channels, strict=True))
        names = self.channel_names
        return np.stack([self._sum(tuple(g for g, c in pairs if c == name)) for name in names])


def draw_channels(table: pd.DataFrame, random: np.random.Generator) -> pd.DataFrame:
    """Return a ``table`` of messages in which those whose channel nobody tells, since nobody heard
    them, have one drawn by how likely it is then: by EM, for hearers that are independent.
    """
    columns = {"n": ("delivered", "count"), "k": ("delivered", "sum"), "name": ("channel", "first")}
    sends = table.groupby("transmission").agg(**columns)
    untold = sends[sends["name"] == ""]
    known = sends.drop(untold.index).groupby("name").agg(n=("n", "sum"), k=("k", "sum"))
    told = known.to_numpy(dtype=float)
    sent = sends["name"].value_counts()[known.index].to_numpy(dtype=float)
    kinds, of, numbers = np.unique(
        untold[["n", "k"]].to_numpy(dtype=float), axis=0, return_inverse=True, return_counts=True
    )
    counts, share, weights = told, sent, np.empty(0)
    for _ in range(EM_STEPS):
        p = np.clip(counts[:, 1] / counts[:, 0], 1e-9, 1.0 - 1e-9)
        weights = share * p ** kinds[:, 1:] * (1.0 - p) ** (kinds[:, :1] - kinds[:, 1:])
        weights /= weights.sum(axis=1, keepdims=True)
        added = weights * numbers[:, None]
        counts, share = told + added.T @ kinds, sent + added.sum(axis=0)
    uniform = random.random(len(untold))[:, None]
    drawn = (uniform > weights.cumsum(axis=1)[of.ravel(), :-1]).sum(axis=1)
    found = table["transmission"].map(pd.Series(known.index[drawn], untold.index))
    return table.assign(channel=table["channel"].where(table["channel"] != "", found))


def make_outcomes(table: pd.DataFrame) -> LogOutcomes:
    """Return the outcomes of a ``table`` of messages: sender, receiver, message, t, transmission,
    delivered (nan: unknown), and maybe channel.
    """
    pairs = table[["sender", "receiver"]].drop_duplicates().sort_values(["sender", "receiver"])
    links = [(str(i), str(j)) for i, j in pairs.itertuples(index=False)]
    index = {link: k for k, link in enumerate(links)}
    channel = (
        table["channel"].fillna("").astype(str)
        if "channel" in table
        else pd.Series("", table.index)
    )
    groups, channels = [], []
    # Hearers of one broadcast belong together; other messages only with those of their link.
    is_broadcast = table.duplicated("transmission").any()
    parts = ["sender", *([] if is_broadcast else ["receiver"]), "channel"]
    for (sender, *_, name), rows in table.assign(channel=channel).groupby(parts):
        wide = rows.pivot_table("delivered", "transmission", "receiver", "max", dropna=False)
        order = rows.drop_duplicates("transmission").set_index("transmission")
        order = (
            order.loc[wide.index].assign(at=np.arange(len(wide))).sort_values("t", kind="stable")
        )
        wide = wide.iloc[order["at"].to_numpy()]
        follows = np.concatenate([[False], np.diff(order["message"]) == 1])
        ids = np.array([index[str(sender), str(receiver)] for receiver in wide.columns])
        groups.append(Group(wide.to_numpy(dtype=float), order["t"].to_numpy(), follows, ids))
        channels.append(str(name))
    return LogOutcomes(tuple(links), tuple(groups), tuple(channels))


def split_at(outcomes: LogOutcomes, edges: FloatArray) -> LogOutcomes:
    """Return the outcomes with groups of one window of time each, which ``edges`` (K - 1,) part."""
    groups, channels = [], []
    for group, channel in zip(outcomes.groups, outcomes.channels, strict=True):
        window = np.searchsorted(edges, group.t, side="right")
        for k in np.unique(window):
            own = np.flatnonzero(window == k)
            groups.append(Group(group.x[own], group.t[own], group.follows[own], group.links))
            channels.append(channel)
    return LogOutcomes(outcomes.links, tuple(groups), tuple(channels))


def counts_in(outcomes: LogOutcomes, edges: FloatArray) -> np.ndarray:
    """Return known outcomes and packets heard in the K windows of ``edges`` (K - 1,), (K, 2)."""
    counts = np.zeros((len(edges) + 1, 2))
    for group in outcomes.groups:
        window = np.searchsorted(edges, group.t, side="right")
        np.add.at(counts[:, 0], window, np.isfinite(group.x).sum(axis=1))
        np.add.at(counts[:, 1], window, np.nansum(group.x, axis=1))
    return counts


def choose_windows(outcomes: LogOutcomes) -> FloatArray:
    """Return the edges (K - 1,) of windows of time, each of which parts what stood undivided best:
    by more than chance would at any of its places.
    """
    t = np.concatenate([group.t for group in outcomes.groups])
    order = np.argsort(t, kind="stable")
    z = np.concatenate([group.residuals.sum(axis=1) for group in outcomes.groups])[order]
    size = np.concatenate(
        [np.isfinite(g.x) @ np.nan_to_num(g.mean * (1.0 - g.mean)) for g in outcomes.groups]
    )[order]
    spread = fast_time(outcomes, BLOCKS) * float((z**2).sum() / max(size.sum(), 1e-300))
    sums, sizes = (np.append(0.0, np.cumsum(part)) for part in (z, size))
    least, need = MIN_PACKETS * len(outcomes.groups), 2.0 * math.log(len(t)) * spread
    edges, open_parts = [], [(0, len(t))]
    while open_parts:
        a, b = open_parts.pop()
        k = np.arange(a + least, b - least + 1)
        if not len(k):
            continue
        (s, S), (n, N) = ((part[k] - part[a], part[b] - part[a]) for part in (sums, sizes))
        apart = (s * N - S * n) ** 2 / np.maximum(n * (N - n) * N, 1e-300)
        best = int(np.argmax(apart))
        if apart[best] > need:
            edges.append(t[order[k[best] - 1 : k[best] + 1]].mean())
            open_parts += [(a, int(k[best])), (int(k[best]), b)]
    return np.sort(edges)


def binomial_interval(
    heard: FloatArray, count: FloatArray, level: float
) -> tuple[FloatArray, FloatArray]:
    """Return the ends of Clopper-Pearson intervals of error ``level``; counts may be fractions."""
    with np.errstate(invalid="ignore"):
        low = np.where(heard > 0.0, beta.ppf(level / 2, heard, count - heard + 1.0), 0.0)
        high = np.where(heard < count, beta.ppf(1 - level / 2, heard + 1.0, count - heard), 1.0)
    return low, high


def _z_test(what: str, units: FloatArray, scale: float) -> Test:
    """Return a test that ``units`` (T,), as large as ``scale`` for 1, have mean 0."""
    deviation = math.sqrt(long_run_sum(units, 0))
    # No departure is above 1.
    if not 0.0 < deviation <= 0.5 * scale or len(units) < MIN_PACKETS:
        return Test(what)
    p = 2.0 * float(norm.sf(abs(units.sum()) / deviation))
    return Test(what, float(units.sum() / scale), p, deviation / scale)


def long_run_sum(units: FloatArray, lags: int) -> float:
    """Return the variance of the sum of correlated ``units`` (T,), with Bartlett weights."""
    total = float(units @ units)
    for lag in range(1, min(lags, len(units) - 1) + 1):
        total += 2.0 * (1.0 - lag / (lags + 1.0)) * float(units[lag:] @ units[:-lag])
    return max(total, 0.0)


def lagged_products(outcomes: LogOutcomes, lag: int) -> tuple[FloatArray, float]:
    """Return products of residuals ``lag`` sends apart (T,), and the sum for a correlation of 1."""
    units, scale = [], 0.0
    for group in outcomes.groups:
        z, known = group.residuals, np.isfinite(group.x)
        if len(z) <= lag:
            continue
        both = known[lag:] & known[:-lag] & _unbroken(group.follows, lag)[:, None]
        size = np.nan_to_num(group.mean * (1.0 - group.mean))
        # The mean is that of the same packets: products are smaller by its variance.
        lift = size / np.maximum(known.sum(axis=0), 1)
        units.append((z[lag:] * z[:-lag] * both + both * lift).sum(axis=1))
        scale += float((both * size).sum())
    return np.concatenate([*units, np.empty(0)]), scale


def _unbroken(follows: np.ndarray, lag: int) -> np.ndarray:
    """Return flags (T - lag,): all of the ``lag`` steps up to a transmission are in one stretch."""
    steps = np.cumsum(np.concatenate([[0], follows]))
    return np.asarray(steps[lag + 1 :] - steps[1:-lag] == lag)


def correlation_time(outcomes: LogOutcomes) -> float:
    """Return 1 + 2 sum of autocorrelations, cut at noise: packets for one independent packet."""
    total = 0.0
    longest = max(len(group.t) for group in outcomes.groups)
    for lag in range(1, longest // 4):
        units, scale = lagged_products(outcomes, lag)
        if scale <= 0.0 or units.sum() < 2.0 * math.sqrt(long_run_sum(units, 0)):
            break
        # The mean of correlated packets takes more than that of independent ones.
        total, taken = total + 2.0 * float(units.sum() / scale), 2.0 * lag / longest
    return 1.0 + (total / (1.0 - taken) if total else 0.0)


def fast_time(outcomes: LogOutcomes, parts: int) -> float:
    """Return the correlation time within so many parts of the log: slow changes are not seen."""
    t = np.concatenate([group.t for group in outcomes.groups])
    return correlation_time(split_at(outcomes, np.quantile(t, np.arange(1, parts) / parts)))


def test_time(outcomes: LogOutcomes) -> Test:
    """Test that a packet's outcome does not depend on that of the one before."""
    units, scale = lagged_products(outcomes, 1)
    return _z_test("correlation with the next", units, scale)


def test_memory(outcomes: LogOutcomes) -> Test:
    """Test that given the last outcome the one before says nothing, as in a chain of two states."""
    units, scale = [], 0.0
    for group in outcomes.groups:
        if len(group.t) < 3:
            continue
        x, unbroken = group.x, _unbroken(group.follows, 2)
        now, last, first = x[2:], x[1:-1], x[:-2]
        known = np.isfinite(now + last + first) & unbroken[:, None]
        pieces = np.cumsum(np.diff(known, axis=0, prepend=False) & known, axis=0)
        part = np.zeros_like(now)
        for state in (0.0, 1.0):
            chosen = known & (last == state)
            chosen &= chosen.sum(axis=0) >= MIN_PACKETS
            n = np.maximum(chosen.sum(axis=0), 1)
            a, b = (np.where(chosen, v, 0.0).sum(axis=0) / n for v in (now, first))
            size = np.sqrt(a * (1 - a) * b * (1 - b))
            # The one before is what came after the last time, in an unbroken piece.
            seen = np.maximum.accumulate(np.where(chosen, pieces, 0), axis=0)
            again = 1.0 - (np.diff(seen, axis=0, prepend=0) > 0).sum(axis=0) / n
            part += np.where(chosen, (now - a) * (first - b) + again * size / n, 0.0)
            scale += float((chosen.sum(axis=0) * size).sum())
        units.append(part.sum(axis=1))
    return _z_test("correlation given the last", np.concatenate([*units, np.empty(0)]), scale)


class Share(NamedTuple):
    """How far hearers share one fate, 0 (none) to 1, with its standard error; ``lasting`` is what
    remains of it from one transmission to the next: slow changes, or bursts that are shared.
    """

    value: float
    error: float
    lasting: float


def shared_fate(outcomes: LogOutcomes, lags: int) -> tuple[Share, Test]:
    """Return the share c of transmissions whose hearers have one fate, which makes covariances of
    hearers c (min(p, q) - p q), and the test that it is 0.
    """
    sums, sizes, slopes, lasting = [], [], [], 0.0
    alone = together = 0.0
    shrink = _shrinkage(outcomes)
    for group in outcomes.groups:
        z, m, p = group.residuals, np.isfinite(group.x).astype(float), np.nan_to_num(group.mean)
        size = p * (1.0 - p)
        p = p.mean() + shrink * (p - p.mean())
        least = np.minimum(p[:, None], p) - np.outer(p, p)
        np.fill_diagonal(least, 0.0)
        # By p of a row, of min(p, q) - p q.
        slope = (p[:, None] < p) + 0.5 * (p[:, None] == p) - p
        np.fill_diagonal(slope, 0.0)
        sums.append(0.5 * (z.sum(axis=1) ** 2 - (z**2).sum(axis=1)))
        sizes.append(0.5 * np.einsum("ti,ij,tj->t", m, least, m))
        slopes.append(np.einsum("ti,ij,tj->t", z, slope, m))
        # Mean squares of these sums if all are independent, and if all have one fate.
        alone += 0.5 * float(((m @ size) ** 2 - m @ size**2).sum())
        pairs, mean = 0.5 * m.sum(axis=1) * (m.sum(axis=1) - 1.0), float(size.mean())
        together += float((pairs**2).sum()) * mean * (1.0 - 3.0 * mean)
        near = group.follows[1:]
        lasting += float(((z[1:].sum(1) * z[:-1].sum(1) - (z[1:] * z[:-1]).sum(1)) * near).sum())
    what, scale = "share of one fate", float(sum(D.sum() for D in sizes))
    if scale <= 0.0 or alone <= 0.0 or sum(map(len, sums)) < MIN_PACKETS:
        return Share(np.nan, np.nan, np.nan), Test(what)
    share = float(sum(S.sum() for S in sums)) / scale
    # Each group is a series of its own, whatever the order of groups.
    parts = zip(sums, sizes, slopes, strict=True)
    error = math.sqrt(sum(long_run_sum(S - share * (D + G), lags) for S, D, G in parts)) / scale
    # Without shared fate; with bursts of each link neighbouring sums are correlated all the same.
    lasts, once = (sum(long_run_sum(S, many) for S in sums) for many in (lags, 0))
    slack = lasts / max(once, 1e-300) if lags else 1.0
    unit = math.sqrt(alone * max(slack, 1.0)) / scale
    p_value = 2.0 * float(norm.sf(abs(share) / unit))
    found = Test(what, share, p_value, unit, rise=max(together / alone - 1.0, 0.0))
    return Share(share, error, 0.5 * lasting / scale), found


def shared_law(outcomes: LogOutcomes, delivery: float, share: float) -> tuple[float, float]:
    """Return the log-likelihood of one delivery and share, and the variance of the mean."""
    likelihood = spread = 0.0
    for group in outcomes.groups:
        n, k = np.isfinite(group.x).sum(axis=1), np.nansum(group.x, axis=1)
        alone = delivery**k * (1.0 - delivery) ** (n - k)
        one = np.where(k == n, delivery, 0.0) + np.where(k == 0, 1.0 - delivery, 0.0)
        likelihood += float(np.log(np.maximum((1.0 - share) * alone + share * one, 1e-300)).sum())
        spread += float(((k - n * delivery) ** 2).sum())
    return likelihood, spread / float(outcomes.counts[:, 0].sum()) ** 2


def _shrinkage(outcomes: LogOutcomes) -> float:
    """Return the share of the spread of estimated deliveries that is not noise."""
    between = noise = 0.0
    for group in outcomes.groups:
        p, n = group.mean, np.isfinite(group.x).sum(axis=0)
        if len(p) > 1 and np.isfinite(p).all():
            between += float(p.var(ddof=1)) * (len(p) - 1)
            products = group.residuals.T @ group.residuals
            size = np.sqrt(np.outer(np.diag(products), np.diag(products)))
            together = (products / np.where(size > 0.0, size, 1.0)).clip(0.0, 1.0)
            alone = 1.0 - (together.sum() - np.trace(together)) / (len(p) * (len(p) - 1))
            noise += alone * float((p * (1.0 - p) / n).mean()) * (len(p) - 1)
    return max(0.0, 1.0 - noise / between) if between > 0.0 else 0.0


def test_constancy(outcomes: LogOutcomes) -> Test:
    """Test by correlations of BLOCKS means that deliveries do not change slowly."""
    time = fast_time(outcomes, 3 * LAGS)
    what = "deviation of delivery over time"
    t = np.concatenate([group.t for group in outcomes.groups])
    z = np.concatenate([group.residuals.sum(axis=1) for group in outcomes.groups])
    n = np.concatenate([np.isfinite(group.x).sum(axis=1) for group in outcomes.groups])
    longest = max(len(group.t) for group in outcomes.groups)
    blocks = int(min(BLOCKS, len(t) // 8, longest / (5.0 * time)))
    if blocks < 3 * LAGS:
        return Test(what)
    rank = np.argsort(np.argsort(t, kind="stable"), kind="stable")
    block = rank * blocks // len(t)
    sums, packets = np.bincount(block, z, blocks), np.bincount(block, n, blocks)
    r = sums / np.sqrt(np.maximum(packets, 1.0))
    r = r - r.mean()
    square = float(r @ r)
    if square <= 0.0:
        return Test(what, 0.0, 1.0)
    lag = np.arange(1, LAGS + 1)
    # Residuals of a mean sum to 0, which makes each correlation -1 / blocks by chance.
    rho = np.array([r[k:] @ r[:-k] for k in lag]) / square + 1.0 / blocks
    statistic = blocks * (blocks + 2.0) * float((rho**2 / (blocks - lag)).sum())
    deviation = math.sqrt(square / blocks / packets.mean())
    slow = max(float(rho[0]), 0.0)
    p = float(chi2.sf(statistic, LAGS))
    # A step halfway that is the share s of the variance of blocks makes the correlations s seen.
    seen = np.maximum(1.0 - 3.0 * lag / blocks, 0.0)
    noise = deviation**2 * (1.0 - min(slow, 0.9))
    scale = float((seen**2 / (blocks - lag)).sum()) * blocks * (blocks + 2.0)
    # The step that blocks show is larger or smaller by chance, in all correlations alike.
    unit = math.sqrt(noise) * scale**-0.25 * (1.0 + 0.8 / math.sqrt(blocks))
    return Test(what, deviation * math.sqrt(slow), p, unit, LAGS, 4, 1.0 / noise)


def test_identical(counts: FloatArray, expected: FloatArray, spread: FloatArray, used: int) -> Test:
    """Test that deliveries, by packets and those heard ``counts`` (K, 2), are ``expected`` (K,).

    ``spread`` (K,) are the eigenvalues of the covariance of their standardised residuals, of which
    ``used`` are taken by estimated parameters.
    """
    what = "deviation of deliveries"
    variance = expected * (1.0 - expected) / np.maximum(counts[:, 0], 1.0)
    usable = (variance > 0.0) & (counts[:, 0] > 0.0)
    if usable.sum() <= used:
        return Test(what)
    off = counts[usable, 1] / counts[usable, 0] - expected[usable]
    square, size = float((off**2 / variance[usable]).sum()), float(variance[usable].mean())
    share = (usable.sum() - used) / len(spread)
    mean, second = float(spread.sum() * share), float((spread**2).sum() * share)
    # Satterthwaite: a weighted sum of chi-squares is nearly one of fewer degrees of freedom.
    scale, freedom = second / mean, mean**2 / second
    excess = max(square - mean, 0.0) / usable.sum()
    unit = math.sqrt(scale * size / usable.sum())
    p = float(chi2.sf(square / scale, freedom))
    return Test(what, math.sqrt(excess * size), p, unit, freedom)


def residual_spread(outcomes: LogOutcomes, share: float, time: float) -> FloatArray:
    """Return the eigenvalues (L,) of the covariance of standardised residuals of links."""
    share = min(max(share, 0.0), 1.0) if np.isfinite(share) else 0.0
    senders = pd.Series([sender for sender, _ in outcomes.links]).value_counts().to_numpy()
    parts = [np.append(np.full(n - 1, 1.0 - share), 1.0 + share * (n - 1)) for n in senders]
    return time * np.concatenate(parts)


def fit_chain(outcomes: LogOutcomes) -> FittedLaw:
    """Return the Gilbert-Elliott chain that makes the outcomes likeliest, links alike."""
    stretches = _pad_stretches(outcomes)
    count, heard = outcomes.counts.sum(axis=0)
    p = (heard + 0.5) / (count + 1.0)
    lagged = [lagged_products(outcomes, lag) for lag in (1, 2)]
    first = [float(units.sum() / scale) if scale > 0.0 else 0.0 for units, scale in lagged]
    keep = min(max(first[1] / first[0] if first[0] > 0.0 else 0.5, 0.1), 0.99)
    best = None
    for good, bad in ((0.98, 0.02), (min(p + 0.1, 0.98), max(p - 0.3, 0.02))):
        share = min(max((good - p) / (good - bad), 0.02), 0.98)
        start = logit(
            np.clip([(1 - keep) * share, (1 - keep) * (1 - share), good, bad], 1e-3, 0.999)
        )
        found = minimize(
            _surprise, start, args=(stretches,), method="L-BFGS-B", bounds=[(-9, 9)] * 4
        )
        if best is None or found.fun < best.fun:
            best = found
    assert best is not None
    values, x = expit(best.x), best.x
    if values[2] < values[3]:  # the states changed their names
        x = x[[1, 0, 3, 2]]
    cov = _inverse_curvature(x, stretches)
    return FittedLaw("gilbert-elliott", expit(x), -float(best.fun), cov=cov)


def _pad_stretches(outcomes: LogOutcomes) -> np.ndarray:
    """Return outcomes of unbroken stretches, (S, T) codes 0, 1, 2 unknown, 3 beyond the end."""
    parts = [
        np.where(np.isfinite(part), part, 2.0)
        for group in outcomes.groups
        for x in np.split(group.x, np.flatnonzero(~group.follows[1:]) + 1)
        for part in x.T
    ]
    longest = max(map(len, parts))
    whole = np.full((len(parts), 1 << max(longest - 1, 0).bit_length()), 3, dtype=np.int64)
    for k, part in enumerate(parts):
        whole[k, : len(part)] = part
    return whole


def _surprise(x: FloatArray, stretches: np.ndarray) -> float:
    """Return minus the log-likelihood: products of 2 x 2 matrices in a tree over time."""
    to_bad, to_good, good, bad = expit(x)
    move = np.array([[1.0 - to_bad, to_bad], [to_good, 1.0 - to_good]])
    emit = np.array([[1.0 - good, 1.0 - bad], [good, bad], [1.0, 1.0]])
    # Row vectors of states are multiplied from the right by each step: move, then emit.
    steps = np.concatenate([move * emit[:, None, :], np.eye(2)[None]])
    start = np.array([to_good, to_bad]) / (to_bad + to_good)
    product, total = steps[stretches], 0.0
    while product.shape[1] > 1:
        product = np.matmul(product[:, ::2], product[:, 1::2])
        size = product.max(axis=(2, 3), keepdims=True)
        total += float(np.log(size).sum())
        product = product / size
    # The stationary law is that of the state before the first step too.
    return -total - float(np.log((start @ product[:, 0]).sum(axis=-1)).sum())


def _inverse_curvature(x: FloatArray, stretches: np.ndarray) -> FloatArray:
    """Return the inverse second derivatives (4, 4) of the surprise, with a wide prior."""
    step, size = 0.02, len(x)
    H = np.zeros((size, size))
    base, unit = _surprise(x, stretches), step * np.eye(size)
    ahead = [_surprise(x + unit[i], stretches) for i in range(size)]
    for j, i in combinations_with_replacement(range(size), 2):
        if i == j:
            H[i, i] = (ahead[i] - 2.0 * base + _surprise(x - unit[i], stretches)) / step**2
        else:
            both = _surprise(x + unit[i] + unit[j], stretches)
            H[i, j] = H[j, i] = (both - ahead[i] - ahead[j] + base) / step**2
    values, vectors = np.linalg.eigh(H)
    return np.asarray((vectors / (np.maximum(values, 0.0) + 0.25)) @ vectors.T)


def fit_distance(
    distance: FloatArray, count: FloatArray, heard: FloatArray, spread: float
) -> tuple[FloatArray, FloatArray]:
    """Return half and width of the likeliest logistic delivery, and their covariance (2, 2)."""
    X = np.stack([np.ones_like(distance), -distance], axis=1)
    slopes = np.array([0.0, 1.0 / max(float(distance.std()), 1e-9)])
    slopes[0] = slopes[1] * float(distance.mean())
    scale = np.array([1.0, max(float(distance.std()), 1e-9)])
    information = np.eye(2)
    for _ in range(100):
        p = np.clip(expit(X @ slopes), 1e-9, 1.0 - 1e-9)
        information = (X * (count * p * (1.0 - p))[:, None]).T @ X + np.diag(1e-6 * scale**2)
        step = np.linalg.solve(information, X.T @ (heard - count * p))
        size = float(np.abs(step * scale).max())
        slopes = slopes + step * min(1.0, 2.0 / max(size, 1e-12))
        if size < 1e-10:
            break
    a, b = slopes
    jacobian = np.array([[1.0 / b, -a / b**2], [0.0, -1.0 / b**2]])
    return np.array([a / b, 1.0 / b]), spread * (jacobian @ np.linalg.inv(information) @ jacobian.T)
