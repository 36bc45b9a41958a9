"""``netkf fit``: laws of losses fitted to a recorded network, and what it says against them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from scipy.special import expit, xlog1py, xlogy

from netkf.core.errors import ScenarioError
from netkf.core.fields import SourceFile, as_path, number
from netkf.core.notebook import NotebookTable
from netkf.ensembles.pools import PoolOptions
from netkf.ensembles.replicas import Progress
from netkf.figures.names import FIT_FILE
from netkf.linalg.arrays import FloatArray, IntArray
from netkf.logs import outcomes as stats
from netkf.logs.envelope import COLUMNS, FittedLaw, Interval, compare_with_laws
from netkf.logs.outcomes import LogOutcomes, Test, make_outcomes
from netkf.logs.packets import UNREPORTED, parse_numbers, read_text_rows
from netkf.network.delays import ExponentialDelay, LognormalDelay, UniformDelay
from netkf.network.recorded import RecordedDelay, RecordedLoss
from netkf.runs.files import write_text
from netkf.scenario.reading import load
from netkf.scenario.scenario import Scenario
from netkf.scenario.writing import as_table, to_toml

ASSUMPTIONS = {
    "time": "packets are independent in time",
    "memory": "the last outcome is the state",
    "fate": "hearers are independent",
    "constancy": "quality does not change in time",
    "links": "all links have one delivery",
    "channel": "channels have one delivery",
    "directions": "both directions have one delivery",
    "distance": "the distance decides the delivery",
    "delay": "delays are independent and have the likeliest law",
}
NEEDS = {
    "bernoulli": ("links", "time", "fate", "constancy", "channel"),
    "per-link": ("time", "fate", "constancy", "channel"),
    "gilbert-elliott": ("links", "fate", "constancy", "channel"),
    "per-link-bursts": ("memory", "fate", "constancy", "channel"),
    "shared": ("links", "time", "constancy", "channel"),
    "distance": ("distance", "time", "fate", "constancy", "channel"),
    "scheduled": ("links", "time", "fate", "channel"),
    "hopping": ("links", "time", "fate", "constancy"),
}
"""What each law of losses assumes."""
MAKERS = {
    "time": "gilbert-elliott",
    "memory": "gilbert-elliott with deliver_good and deliver_bad",
    "fate": "shared",
    "constancy": "scheduled",
    "links": "per-link, distance",
    "channel": "hopping",
    "directions": "per-link",
    "distance": "per-link",
    "delay": "recorded delays",
}
"""Laws that do without an assumption."""
MAYBE = 0.05
"""Below this p a departure is allowed for in other tests, whether it is there or not."""
SAME_DELAY = 1e-9
"""Standard deviation of the logarithms of delays below which all are the same."""
MAX_LOG = 600.0
"""Logarithm of the largest mean of delays: that of a law without a mean to speak of."""
DELAYS = {"lognormal": LognormalDelay, "exponential": ExponentialDelay, "uniform": UniformDelay}
KEY = ["sender", "receiver", "message"]
UNKNOWN, REPLAY = "unknown.csv", "fit_replay.csv"
FILES = ("fit_links.csv", "fit_tests.csv", "fit_laws.csv", FIT_FILE)


@dataclass(frozen=True, eq=False, repr=False)
class LogFit(NotebookTable):
    """The laws of a recorded network.

    links : a row for each link: packets, heard, unknown, delivery with its interval, bursts
    tests : a row for each assumption: departure, what is detectable, p, verdict
    laws  : a row for each law: parameters, log-likelihood, what rejects it
    envelope : a row for each quantity and law: value of the replay, range of the law, p; empty
               without runs
    scenarios : the files of the laws, by law
    """

    scenario: Scenario
    links: pd.DataFrame
    tests: pd.DataFrame
    laws: pd.DataFrame
    envelope: pd.DataFrame
    confidence: float
    notes: tuple[str, ...] = ()
    scenarios: Mapping[str, Path] = field(default_factory=dict)

    @property
    def table(self) -> pd.DataFrame:
        """The table ``laws``."""
        return self.laws

    def __repr__(self) -> str:
        """Return one line: the log, its links, and the laws that are not rejected."""
        kept = ", ".join(self.laws["law"][self.laws["rejected_by"] == ""]) or "none"
        return (
            f"<netkf fit of {self.scenario.name!r}: {len(self.links)} links, not rejected: {kept}>"
        )


def read_fit(directory: Path) -> SimpleNamespace:
    """Return the ``envelope`` that ``netkf fit`` left in a directory; raises ScenarioError."""
    path = directory / FIT_FILE
    try:
        table = pd.read_csv(path)
        if not len(table) or list(table.columns) != COLUMNS or table["inside"].dtype != bool:
            raise ValueError
    except ValueError:  # of pandas too
        rule = "is not a table that netkf fit left"
        raise ScenarioError(str(path), rule, None, "run netkf fit again") from None
    return SimpleNamespace(envelope=table)


@np.errstate(under="ignore")
def fit_log(
    directory: str | Path,
    runs: int | None = None,
    *,
    confidence: float = 0.95,
    trust: bool = True,
    workers: int | None = None,
    progress: Progress | None = None,
) -> LogFit:
    """Fit laws of losses to the recorded outcomes of ``directory``, as ``netkf import`` leaves it,
    or of a scenario file, and write ``fit_links.csv``, ``fit_tests.csv``, ``fit_laws.csv``,
    ``fit_envelope.csv`` and a scenario of each law beside it.

    runs       : of each law, in which the replay is looked for; 0 for none, by default 200, or
                 fewer where these take long. Each draws the parameters of its law from their
                 posterior
    confidence : with which all intervals of links hold together, and none of the tests rejects
                 what is true
    Raises ScenarioError unless the scenario's loss is recorded.
    """
    path = as_path("directory", directory)
    path = path / "scenario.toml" if path.is_dir() else path
    confidence = float(number(above=0.0, below=1.0)("confidence", confidence))
    scenario, folder = load(path, trust=trust), path.parent
    table, notes = read_outcomes(scenario)
    table, channels = _tell_channels(table, scenario.seed, notes)
    outcomes = make_outcomes(table)
    distance = _distances(scenario, outcomes, table)
    tests, share, time, edges = run_tests(outcomes, distance)
    delay, delay_test = _fit_delays(scenario, table, notes)
    tests |= channels | delay_test
    level = (1.0 - confidence) / max(sum(np.isfinite(t.p) for t in tests.values()), 1)
    test_table = _test_table(tests, level)
    rejected = {key for key, test in tests.items() if test.p < level}
    # Packets count for less where the next one has the fate of the last.
    shrink = time if "time" in rejected else 1.0
    links = _link_table(outcomes, table, 1.0 - confidence, shrink, distance)
    bursty = min(tests["time"].p, tests["constancy"].p) < MAYBE
    if not bursty:
        notes.append("no bursts are to be seen: gilbert-elliott is not fitted")
    laws = _fit_laws(outcomes, links, distance, shrink, bursty)
    if tests["fate"].p < MAYBE and share.value > 0.0:
        laws.append(_shared_law(outcomes, laws[0].values[0], share, shrink))
    laws += _varying_laws(outcomes, edges, tests, shrink, scenario.horizon)
    needs = dict(NEEDS)
    if scenario.positions.moving:
        # What follows from places that change shows as bursts, changes and shared fate.
        needs["distance"] = ("distance", "channel")
        told = "assumes nothing of time and hearers that is tested"
        told = told if distance is not None else "is not fitted: places follow the state"
        notes.append(f"nodes move: the law of the distance {told}")
    law_table = _law_table(laws, rejected, len(table), needs)
    if np.isfinite(share.value):
        notes.append(
            f"shared fate of hearers: {share.value:.3f} +- {share.error:.3f}; {share.lasting:.3f} "
            "of it lasts to the next transmission (slow changes, or shared bursts)"
        )
    envelope = pd.DataFrame()
    if runs is None or runs > 0:
        replay = _complete_replay(folder, scenario, table, links, notes)
        pool = PoolOptions(workers=workers)
        envelope = compare_with_laws(replay, laws, delay, runs, confidence, pool, progress)
        runs = int(envelope["runs"].iloc[0])
        need = math.ceil(2.0 * envelope["quantity"].nunique() / (1.0 - confidence)) - 1
        if runs < need:
            notes.append(f"{runs} runs of each law: p by Student's t, since ranks take {need}")
    scenarios = _write(folder, scenario, (links, test_table, law_table, envelope), laws, delay)
    fields = (links, test_table, law_table, envelope, confidence, tuple(notes), scenarios)
    return LogFit(scenario, *fields)


def read_outcomes(scenario: Scenario) -> tuple[pd.DataFrame, list[str]]:
    """Return recorded outcomes by message, with how many their link ``sent``, and notes. What
    nobody reported counts as lost: without it deliveries would be too high. Raises ScenarioError.
    """
    loss = scenario.network.channel.loss
    if not isinstance(loss, RecordedLoss):
        rule, remedy = "must be recorded to be fitted", "name a folder that netkf import left"
        raise ScenarioError("network.channel.loss.kind", rule, type(loss).__name__, remedy)
    table = _read_table(loss.path.full, loss.path)
    table["unreported"] = False
    path, last = loss.path.full.with_name(UNKNOWN), table[KEY]
    if path.is_file():
        silent = _read_table(path)
        last = pd.concat([last, silent[KEY]])
        silent = silent[[why == UNREPORTED for why in silent.get("why", [""] * len(silent))]]
        table = pd.concat([table, silent.assign(delivered=0, unreported=True)])
        table = table.drop_duplicates(KEY).reset_index(drop=True)
    table = table.join(last.groupby(KEY[:2])["message"].max().rename("sent") + 1, on=KEY[:2])
    if "t" not in table:
        table["t"] = table["message"].astype(float)
    if "transmission" not in table:
        table["transmission"] = table["sender"] + " " + table["message"].astype(str)
    sent = int(table.groupby(KEY[:2])["sent"].first().sum())
    notes = [f"{len(table):,} of {sent:,} outcomes are known"]
    count = int(table["unreported"].sum())
    if count:
        notes.append(
            f"{count:,} of them are of packets that nobody reported and count as lost; at_least "
            "and at_most in fit_links.csv say what else they may have been"
        )
    if len(table) < sent and loss.after == "deliver":
        notes.append("messages that are not listed count as unknown, not as delivered")
    return table, notes


def _tell_channels(
    table: pd.DataFrame, seed: int, notes: list[str]
) -> tuple[pd.DataFrame, dict[str, Test]]:
    """Return messages that all have a channel, or none, and the test of those told, or {}."""
    untold = int((table["channel"] == "").sum()) if "channel" in table else 0
    if not 0 < untold < len(table):
        return table, {}
    found, *_ = run_tests(make_outcomes(table), None)
    test = {"channel": found["channel"]} if "channel" in found else {}
    differ = bool(test) and test["channel"].p < MAYBE
    what = "drawn, once, by how likely they are" if differ else "that of the others is not used"
    notes.append(
        f"{untold:,} of them are of packets whose channel nobody tells: {what}"
        + ("; the test of channels is of the others" if test else "")
    )
    if differ:
        return stats.draw_channels(table, np.random.default_rng(seed)), test
    return table.drop(columns="channel"), test


def _read_table(path: Path, source: SourceFile | None = None) -> pd.DataFrame:
    """Return a table of messages, one row each, of a scenario as the ``source`` was when that was
    made; raises ScenarioError, with the line.
    """
    table = read_text_rows(path, source)
    for name in [*KEY, "t", "transmission", "delivered"]:
        if name in table and name not in KEY[:2]:
            table[name] = parse_numbers(path, table, name)
        elif name not in table and name in KEY:
            rule = f"must have a column {name}"
            raise ScenarioError(str(path), rule, list(table.columns), "import the log again")
    return table.astype({"message": int}).drop_duplicates(KEY)


def _complete_replay(
    folder: Path, scenario: Scenario, table: pd.DataFrame, links: pd.DataFrame, notes: list[str]
) -> Scenario:
    """Return the scenario with unknown outcomes drawn once, by the deliveries of their links."""
    missing = int(links["unknown"].sum())
    if not missing:
        return scenario
    random, parts = np.random.default_rng(scenario.seed), [table[[*KEY, "delivered"]]]
    for sender, receiver, delivery in links[[*KEY[:2], "delivery_probability"]].to_numpy().tolist():
        own = (table["sender"] == sender) & (table["receiver"] == receiver)
        unknown = np.setdiff1d(np.arange(table["sent"][own].max()), table["message"][own])
        drawn = (random.random(len(unknown)) < delivery).astype(int)
        part = {"sender": sender, "receiver": receiver, "message": unknown, "delivered": drawn}
        parts.append(pd.DataFrame(part))
    write_text(folder / REPLAY, pd.concat(parts).astype({"delivered": int}).to_csv(index=False))
    notes.append(
        f"in the envelope {missing:,} outcomes of the replay that are not known are drawn, once, "
        f"by the deliveries of their links ({REPLAY})"
    )
    loss = RecordedLoss(path=SourceFile(REPLAY, folder), after="lose")
    return scenario.replace({"network.channel.loss": loss})


def run_tests(
    outcomes: LogOutcomes, distance: Distances | None
) -> tuple[dict[str, Test], stats.Share, float, FloatArray]:
    """Return a test of each assumption, the shared fate, the correlation time in packets, and the
    edges of windows of time in which quality hardly changes.
    """
    constancy = stats.test_constancy(outcomes)
    edges = stats.choose_windows(outcomes) if constancy.p < MAYBE else np.empty(0)
    # Slow changes are neither bursts nor shared fate.
    steady = stats.split_at(outcomes, edges)
    time, test_time = stats.correlation_time(steady), stats.test_time(steady)
    lags = min(30, math.ceil(3.0 * time)) if test_time.p < MAYBE else 0
    share, fate = stats.shared_fate(steady, lags)
    slack = time if test_time.p < MAYBE else 1.0
    counts = outcomes.counts.astype(float)
    spread = stats.residual_spread(outcomes, share.value, slack)
    pooled = np.full(len(counts), counts[:, 1].sum() / counts[:, 0].sum())
    found = {
        "time": test_time,
        "memory": stats.test_memory(steady),
        "fate": fate,
        "constancy": constancy,
        "links": stats.test_identical(counts, pooled, spread, 1),
    }
    parts = outcomes.by_channel.astype(float)
    if len(parts) > 1:
        sent, heard = parts.sum(axis=0).T  # without packets whose channel nobody tells
        own = np.tile(heard / np.maximum(sent, 1.0), (len(parts), 1)).ravel()
        flat, spreads = parts.reshape(-1, 2), np.tile(spread, len(parts))
        used = _count_uncertain(own[: len(counts)])
        found["channel"] = stats.test_identical(flat, own, spreads, used)
    found |= _direction_test(outcomes, counts, slack)
    if distance is not None and len(counts) > 2:
        values, _ = stats.fit_distance(*distance[:3], slack)
        curve = distance.mean_by_link(expit((values[0] - distance.value) / values[1]))
        found["distance"] = stats.test_identical(counts, curve, spread, 2)
    return found, share, time, edges


def _count_uncertain(delivery: FloatArray) -> int:
    """Return how many deliveries were estimated from packets that were not all heard, or lost."""
    return int(((delivery > 0.0) & (delivery < 1.0)).sum())


def _direction_test(outcomes: LogOutcomes, counts: FloatArray, slack: float) -> dict[str, Test]:
    """Return the test that both directions of pairs have one delivery, if any have two."""
    index = {link: k for k, link in enumerate(outcomes.links)}
    both = [(k, index[j, i]) for (i, j), k in index.items() if i < j and (j, i) in index]
    if not both:
        return {}
    order = np.array(both).T.ravel()
    together = counts[order].reshape(2, -1, 2).sum(axis=0)
    expected = np.tile(together[:, 1] / np.maximum(together[:, 0], 1.0), 2)
    spread = np.full(len(order), slack)
    used = _count_uncertain(expected[: len(both)])
    return {"directions": stats.test_identical(counts[order], expected, spread, used)}


def _test_table(tests: Mapping[str, Test], level: float) -> pd.DataFrame:
    columns = ["key", "assumption", "departure", "estimate", "detectable", "p", "verdict"]
    columns.append("made_by")
    rows = []
    for key, test in tests.items():
        verdict = "rejected" if test.p < level else "not rejected"
        verdict = verdict if np.isfinite(test.p) else "not tested"
        told = (test.what, test.estimate, test.detectable(level), test.p)
        rows.append((key, ASSUMPTIONS[key], *told, verdict, MAKERS[key]))
    return pd.DataFrame(rows, columns=columns)


class Distances(NamedTuple):
    """Distances ``value`` (M,) at which so many ``packets`` (M,) were sent, of which ``heard`` (M,)
    arrived, on the ``link`` (M,) of that number: a row for each link where nodes stand still, for
    each outcome where they move.
    """

    value: FloatArray
    packets: FloatArray
    heard: FloatArray
    link: IntArray

    def mean_by_link(self, values: FloatArray) -> FloatArray:
        """Return the mean (L,) over the packets of each link."""
        total = np.bincount(self.link, self.packets)
        return np.asarray(np.bincount(self.link, self.packets * values) / np.maximum(total, 1.0))


def _distances(scenario: Scenario, outcomes: LogOutcomes, table: pd.DataFrame) -> Distances | None:
    """Return the distances of the ends of links; None if the log does not tell them."""
    places, nodes = scenario.positions, {str(node): node for node in scenario.nodes}
    if places.of_state or not all(places.has(node) for node in nodes.values()):
        return None
    ends = [(nodes[i], nodes[j]) for i, j in outcomes.links]
    if not places.moving:
        value, (packets, heard) = np.array([places.distance(e) for e in ends]), outcomes.counts.T
        return Distances(value, packets.astype(float), heard.astype(float), np.arange(len(ends)))
    if (table["t"] == table["message"]).all():
        return None
    rows = [
        (places.distance(ends[link], t), 1.0, x, link)
        for group in outcomes.groups
        for t, own in zip(group.t.tolist(), group.x, strict=True)
        for link, x in zip(group.links.tolist(), own.tolist(), strict=True)
        if math.isfinite(x)
    ]
    value, packets, heard, link = np.array(rows).T
    return Distances(value, packets, heard, link.astype(int))


def _link_table(
    outcomes: LogOutcomes,
    table: pd.DataFrame,
    level: float,
    shrink: float,
    distance: Distances | None,
) -> pd.DataFrame:
    """Return a row for each link; intervals hold together with probability 1 - ``level``."""
    count, heard = outcomes.counts.T.astype(float)
    each = level / len(count)
    low, high = stats.binomial_interval(heard / shrink, count / shrink, each)
    sent = table.groupby(KEY[:2])["sent"].first()
    rows = pd.DataFrame(outcomes.links, columns=["sender", "receiver"])
    rows["packets"], rows["heard"] = count.astype(int), heard.astype(int)
    rows["unknown"] = [int(sent[link]) for link in outcomes.links] - rows["packets"]
    rows["delivery_probability"], rows["low"], rows["high"] = heard / count, low, high
    silent = table.groupby(["sender", "receiver"])["unreported"].sum()
    rows["unreported"] = [int(silent[link]) for link in outcomes.links]
    whole = rows["packets"] + rows["unknown"]
    rows["at_least"] = heard / whole
    rows["at_most"] = (heard + rows["unknown"] + rows["unreported"]) / whole
    moves = outcomes.transitions
    for k, name in enumerate(("to_bad", "to_good")):
        tries, turns = moves[:, 2 * k], moves[:, 2 * k + 1]
        with np.errstate(invalid="ignore"):
            rows[name] = np.where(tries > 0, turns / tries, np.nan)
        rows[f"{name}_low"], rows[f"{name}_high"] = stats.binomial_interval(turns, tries, each / 2)
    with np.errstate(divide="ignore"):
        rows["mean_burst"] = 1.0 / rows["to_good"]
    if distance is not None:
        rows["distance"] = distance.mean_by_link(distance.value)
    return rows


def _fit_laws(
    outcomes: LogOutcomes,
    links: pd.DataFrame,
    distance: Distances | None,
    shrink: float,
    bursty: bool,
) -> list[FittedLaw]:
    count, heard = outcomes.counts.T.astype(float)
    total = np.array([count.sum(), heard.sum()])
    laws = [
        FittedLaw(
            "bernoulli", total[1:] / total[0], _likelihood(total[1], total[0]), total[None] / shrink
        ),
        FittedLaw(
            "per-link",
            heard / count,
            _likelihood(heard, count),
            np.stack([count, heard], 1) / shrink,
        ),
    ]
    if bursty:
        laws.append(stats.fit_chain(outcomes))
        # Of each link heard packets that turn to lost ones, and the other way.
        turns = np.concatenate(np.split(outcomes.transitions, 2, axis=1))
        values = (turns[:, 1] + 0.5) / (turns[:, 0] + 1.0)
        fit = _likelihood(turns[:, 1], np.maximum(turns[:, 0], 1.0))
        # Outcomes after one that is not known have the law of all times.
        bad, good = np.split(values, 2)
        (tries, lost), (losses, found) = (part.T for part in np.split(turns, 2))
        n, k = count - tries - losses, heard - (tries - lost + found)
        fit += float(np.sum(xlogy(k, good / (bad + good)) + xlogy(n - k, bad / (bad + good))))
        laws.append(FittedLaw("per-link-bursts", values, fit, turns))
    if distance is not None and len(count) > 2:
        # What follows from places that change is no correlation in time.
        moves = len(distance.value) > len(count)
        values, cov = stats.fit_distance(*distance[:3], 1.0 if moves else shrink)
        p, count, heard = expit((values[0] - distance.value) / values[1]), *distance[1:3]
        fit = float((xlogy(heard, p) + xlog1py(count - heard, -p)).sum())
        if values[1] > 0.0 and values[0] >= 0.0:
            laws.append(FittedLaw("distance", values, fit, cov=cov))
    pairs = tuple(links[["sender", "receiver"]].itertuples(index=False, name=None))
    return [law._replace(links=pairs) for law in laws]


def _shared_law(
    outcomes: LogOutcomes, delivery: float, share: stats.Share, shrink: float
) -> FittedLaw:
    part = min(share.value, 1.0)
    likelihood, variance = stats.shared_law(outcomes, delivery, part)
    cov = np.diag([variance * shrink, share.error**2])
    return FittedLaw("shared", np.array([delivery, part]), likelihood, cov=cov)


def _varying_laws(
    outcomes: LogOutcomes, edges: FloatArray, tests: Mapping[str, Test], shrink: float, end: float
) -> list[FittedLaw]:
    """Return laws whose delivery changes in time or with the channel, where the log tells of it."""
    index, laws = list(outcomes.links), []
    if len(edges):
        counts = stats.counts_in(outcomes, edges)
        begins = [0.0, *edges.tolist()]
        rows = [
            (a, b, link, k)
            for k, (a, b) in enumerate(zip(begins, [*edges.tolist(), end], strict=True))
            for link in index
        ]
        laws.append(_varying_law("scheduled", counts, rows, shrink))
    if "channel" in tests and tests["channel"].p < MAYBE:
        counts = outcomes.by_channel.sum(axis=1).astype(float)
        numbers = {name: k for k, name in enumerate(outcomes.channel_names)}
        laws.append(_varying_law("hopping", counts, _hops(outcomes, numbers, end), shrink))
    return laws


def _hops(outcomes: LogOutcomes, numbers: Mapping[str, int], end: float) -> list[Interval]:
    """Return an interval around each transmission, with the number of its channel."""
    sent: dict[int, list[tuple[float, int]]] = {}
    for group, channel in zip(outcomes.groups, outcomes.channels, strict=True):
        for link in group.links.tolist() if channel in numbers else ():
            sent.setdefault(link, []).extend((t, numbers[channel]) for t in group.t.tolist())
    rows = []
    for link, own in sent.items():
        own.sort()
        middles = [0.5 * (a[0] + b[0]) for a, b in pairwise(own)]
        parts = zip([0.0, *middles], [*middles, end], own, strict=True)
        # Stamps of one instant leave no interval between them.
        rows += [(a, b, outcomes.links[link], k) for a, b, (_, k) in parts if b > a]
    return rows


def _varying_law(kind: str, counts: FloatArray, rows: list[Interval], shrink: float) -> FittedLaw:
    heard, likelihood = counts[:, 1], _likelihood(counts[:, 1], counts[:, 0])
    return FittedLaw(kind, heard / counts[:, 0], likelihood, counts / shrink, rows=tuple(rows))


def _likelihood(heard: Any, count: Any) -> float:
    p = heard / count
    return float(np.sum(xlogy(heard, p) + xlog1py(count - heard, -p)))


def _law_table(
    laws: list[FittedLaw], rejected: set[str], count: int, needs: Mapping[str, tuple[str, ...]]
) -> pd.DataFrame:
    rows = []
    for law in laws:
        failed = "; ".join(ASSUMPTIONS[key] for key in needs[law.kind] if key in rejected)
        bic = len(law.values) * math.log(count) - 2.0 * law.likelihood
        rows.append((law.kind, law.describe(), law.likelihood, bic, failed))
    return pd.DataFrame(rows, columns=["law", "parameters", "log_likelihood", "bic", "rejected_by"])


def _fit_delays(
    scenario: Scenario, table: pd.DataFrame, notes: list[str]
) -> tuple[dict[str, Any], dict[str, Test]]:
    """Return a delay law in place of a recorded one, without lost messages, and its test, or {}."""
    delay = scenario.network.channel.delay
    if not isinstance(delay, RecordedDelay):
        return {}, {}
    listed = delay.rows[delay.rows < scenario.horizon]
    seconds = listed[listed > 0.0]
    if not len(seconds):
        return {"kind": "none"}, {}
    heard = table[table["delivered"] == 1].get("delay", pd.Series(dtype=float))
    if at_once := int((pd.to_numeric(heard, errors="coerce") == 0.0).sum()):
        notes.append(
            f"{at_once:,} of {at_once + len(seconds):,} delays are 0, below the resolution of the "
            "stamps: the law of delays is that of the others"
        )
    logs = np.log(seconds)
    mean, sigma = float(seconds.mean()), float(logs.std())
    if sigma < SAME_DELAY:
        notes.append(f"delays: all are {mean:.3g} s")
        return {"kind": "constant", "seconds": mean}, {}
    low, high, count = float(seconds.min()), float(seconds.max()), len(seconds)
    second = 0.5 * math.log(count)  # what a second parameter costs, as in bic
    lognormal = -count * math.log(sigma * math.sqrt(2.0 * math.pi * math.e)) - logs.sum() - second
    likeliest = math.exp(min(float(logs.mean()) + 0.5 * sigma**2, MAX_LOG))
    _, kind, values = max(
        (float(lognormal), "lognormal", {"mean": likeliest, "sigma": sigma}),
        (-count * (1.0 + math.log(mean)), "exponential", {"mean": mean}),
        (-count * math.log(high - low) - second, "uniform", {"low": low, "high": high}),
    )
    told = ", ".join(f"{key} {value:.3g}" for key, value in values.items())
    notes.append(f"delays (s): likeliest of exponential, lognormal and uniform is {kind}, {told}")
    law = DELAYS[kind](**values).law
    if law is None or at_once:
        return {"kind": kind, **values}, {}
    return {"kind": kind, **values}, {"delay": stats.test_law(seconds, law)}


def _write(
    folder: Path,
    scenario: Scenario,
    tables: tuple[pd.DataFrame, ...],
    laws: list[FittedLaw],
    delay: dict[str, Any],
) -> dict[str, Path]:
    """Write the tables, and a scenario for each law; return the paths of these by law."""
    for name, table in zip(FILES, tables, strict=True):
        if len(table):
            write_text(folder / name, table.to_csv(index=False))
    base, paths = as_table(scenario), {}
    for law in laws:
        if law.file:
            write_text(folder / law.file, law.text(law.values))
        document = {**base, "name": f"{scenario.name}-{law.kind}"}
        document["claim"] = f"losses by the law {law.kind}, fitted to the log of {scenario.name}"
        network = {**base["network"]}
        channel = network["channel"] | law.channel(law.loss_table(law.values))
        network["channel"] = channel | ({"delay": delay} if delay else {})
        if law.kind == "per-link":
            network["graph"] = {"kind": "csv", "path": FILES[0]}
            network["graph"]["directed"] = scenario.topology.directed
        paths[law.kind] = folder / f"fit_{law.kind.replace('-', '_')}.toml"
        write_text(paths[law.kind], to_toml({**document, "network": network}))
    return paths
