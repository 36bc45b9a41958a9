"""The replay of a log among runs of the laws that were fitted to it."""

from __future__ import annotations

import math
import time
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from scipy.special import betaln, expit, logit
from scipy.stats import t as student_t

from netkf.core.fields import SourceFile
from netkf.ensembles.pools import PoolOptions
from netkf.ensembles.replicas import Progress, replicate
from netkf.linalg.arrays import FloatArray, cached_by_entries
from netkf.network.losses import GilbertElliott
from netkf.network.scheduled import ScheduledLoss
from netkf.runs.connectivity import ConnectivitySink
from netkf.runs.files import write_text
from netkf.runs.simulate import simulate
from netkf.scenario.scenario import Scenario
from netkf.trace.run import Run

COLUMNS = ["law", "quantity", "replay", "low", "median", "high", "p", "inside", "runs"]
RUNS, FEW_RUNS, BUDGET = 200, 20, 180.0
MIN_TO_GOOD = 1e-9  # a burst ends
STRENGTHS = 2.0 ** np.arange(21)
"""Packets that the mean of all links may count as for each of them."""
STREAM = 0x6C617773
"""Seeds the posterior draws apart from the streams of the runs."""


NAMES: dict[str, tuple[str, ...]] = {
    "bernoulli": ("delivery",),
    "gilbert-elliott": ("to_bad", "to_good", "deliver_good", "deliver_bad"),
    "distance": ("half", "width"),
    "shared": ("delivery", "share"),
}
"""The parameters of each law but that of links."""


Interval = tuple[float, float, tuple[str, str], int]
"""From and until (s), a link, and the index of the delivery that it then has."""


class FittedLaw(NamedTuple):
    """A law of losses fitted to a log.

    values : of NAMES; per-link: the deliveries of the L ``links``; per-link-bursts: to_bad of each
             and to_good of each; of ``rows``: K deliveries
    counts : tries and successes of each value, (1, 2) to (2 L, 2), as independent ones: see
             ``_draw_alike``
    cov    : of the other laws: covariance of the values, of a chain of their logits, whose
             posterior is Gaussian
    rows   : of deliveries that change: which of the values (K,) a link has when
    """

    kind: str
    values: FloatArray
    likelihood: float
    counts: FloatArray | None = None
    cov: FloatArray | None = None
    links: tuple[tuple[str, str], ...] = ()
    rows: tuple[Interval, ...] = ()

    def draw(self, random: np.random.Generator) -> FloatArray:
        """Return parameters drawn from their posterior."""
        if self.counts is not None:
            # to_bad and to_good of a link are no more alike than different laws.
            alike = np.split(self.counts, 2 if self.kind == "per-link-bursts" else 1)
            return np.concatenate([_draw_alike(counts, random) for counts in alike])
        assert self.cov is not None
        if self.kind == "gilbert-elliott":
            return expit(random.multivariate_normal(logit(self.values), self.cov))
        while True:
            one, two = random.multivariate_normal(self.values, self.cov)
            if self.kind == "shared":
                return np.asarray(np.clip([one, two], 0.0, 1.0))
            if one >= 0.0 and two > 0.0:  # a width is above 0
                return np.array([one, two])

    def describe(self) -> str:
        """Return the parameters as text."""
        values = [f"{value:.3g}" for value in self.values]
        if self.kind == "per-link-bursts":
            bad, good = np.split(self.values, 2)
            return f"mean burst {1.0 / max(good):.3g} to {1.0 / min(good):.3g} on {len(bad)} links"
        parts = {"per-link": "links", "scheduled": "windows of time", "hopping": "channels"}
        if self.kind in parts:
            low, high = min(self.values), max(self.values)
            return f"{low:.3g} to {high:.3g} on {len(values)} {parts[self.kind]}"
        pairs = zip(NAMES[self.kind], values, strict=True)
        return ", ".join(f"{name} {value}" for name, value in pairs)

    @property
    def file(self) -> str:
        """The name of the table of the law, "" if it has none."""
        is_table = self.rows or self.kind == "per-link-bursts"
        return f"fit_{self.kind.replace('-', '_')}.csv" if is_table else ""

    def text(self, values: FloatArray) -> str:
        """Return the table of a law with a ``file``."""
        own = values.tolist()
        if self.rows:
            lines = [f"{a!r},{b!r},{i},{j},{own[k]!r}" for a, b, (i, j), k in self.rows]
            return "\n".join(["from,until,sender,receiver,delivery", *lines, ""])
        both = zip(self.links, own, own[len(self.links) :], strict=False)
        lines = [f"{i},{j},{bad!r},{max(good, MIN_TO_GOOD)!r}" for (i, j), bad, good in both]
        return "\n".join(["sender,receiver,to_bad,to_good", *lines, ""])

    def loss_table(self, values: FloatArray) -> dict[str, Any]:
        """Return the table network.channel.loss with these ``values``, which may name ``file``."""
        if self.rows:
            return {"kind": "scheduled", "path": self.file}
        if self.file:
            # Directions without a packet in the log have the mean chain.
            to_bad, to_good = (float(part.mean()) for part in np.split(values, 2))
            chain = {"to_bad": to_bad, "to_good": max(to_good, MIN_TO_GOOD)}
            return {"kind": "gilbert-elliott", "path": self.file, **chain}
        own = values.tolist()
        table = {} if self.kind == "per-link" else dict(zip(NAMES[self.kind], own, strict=True))
        if self.kind == "distance":
            return {"kind": "distance", "delivery": {"kind": "logistic", **table}}
        return {"kind": self.kind, **table}

    def channel(self, loss: Any) -> dict[str, Any]:
        """Return the keys of network.channel that the law sets: each direction has its own chain
        of bursts, though others may share one fate.
        """
        alone = {"symmetric": False} if self.kind == "per-link-bursts" else {}
        return {"loss": loss, **alone}

    def apply(self, scenario: Scenario, values: FloatArray, folder: Path) -> Scenario:
        """Return a scenario with the losses of the law, and its ``file`` in an empty ``folder``."""
        loss: Any = self.loss_table(values)
        if self.file:
            write_text(folder / self.file, self.text(values))
            make = ScheduledLoss if loss.pop("kind") == "scheduled" else GilbertElliott
            loss = make(**loss | {"path": SourceFile(self.file, folder)})
        keys = self.channel(loss).items()
        changed: dict[str, Any] = {f"network.channel.{key}": value for key, value in keys}
        if self.kind == "per-link":
            changed["network.graph"] = edges_with(
                scenario, dict(zip(self.links, values, strict=True))
            )
        return scenario.replace(changed)


def _draw_alike(counts: FloatArray, random: np.random.Generator) -> FloatArray:
    """Return probabilities (K,) drawn from their posterior, given tries and successes (K, 2)."""
    # One by itself has Beta(successes + 1/2, failures + 1/2). Such a prior of each would move
    # thousands of links with a few packets to one side: of several ones the mean is drawn so, and
    # counts for each as many packets as the counts, which differ so much, make likeliest.
    total, (count, heard) = counts.sum(axis=0), counts.T
    mean = random.beta(total[1] + 0.5, total[0] - total[1] + 0.5)
    if len(counts) == 1:
        return np.array([mean])
    strength = _likeliest_strength(counts)
    lost = count - heard + strength * (1.0 - mean)
    return np.asarray(random.beta(heard + strength * mean, lost))


@cached_by_entries(maxsize=8)
def _likeliest_strength(counts: FloatArray) -> float:
    """Return the one of STRENGTHS under which tries and successes (K, 2) are likeliest."""
    (count, heard), (tries, successes) = counts.T, counts.sum(axis=0)
    center = (successes + 0.5) / (tries + 1.0)
    a, b = STRENGTHS[:, None] * center, STRENGTHS[:, None] * (1.0 - center)
    likelihood = (betaln(heard + a, count - heard + b) - betaln(a, b)).sum(axis=1)
    return float(STRENGTHS[likelihood.argmax()])


def edges_with(scenario: Scenario, deliveries: dict[tuple[str, str], float]) -> dict[str, Any]:
    """Return the graph of a scenario as edges with these deliveries, the mean for other links."""
    topology, mean = scenario.topology, float(np.mean([*deliveries.values()]))
    name = {node: getattr(node, "name", int(node)) for node in topology.nodes}
    table: dict[str, Any] = {"kind": "edges", "nodes": [name[node] for node in topology.nodes]}
    table["edges"] = [[name[i], name[j]] for i, j in topology.links]
    table["directed"] = topology.directed
    ends = [(str(i), str(j)) for i, j in topology.links]
    forth = [deliveries.get(link, mean) for link in ends]
    back = [deliveries.get((j, i), a) for (i, j), a in zip(ends, forth, strict=True)]
    pairs = zip(forth, forth if topology.directed else back, strict=True)
    table["delivery"] = [float(0.5 * (a + b)) for a, b in pairs]
    if topology.positions is not None:
        table["positions"] = [[*map(float, topology.positions[node])] for node in topology.nodes]
    return table


def compare_with_laws(
    scenario: Scenario,
    laws: list[FittedLaw],
    delay: dict[str, Any],
    runs: int | None,
    confidence: float,
    pool: PoolOptions,
    progress: Progress | None,
) -> pd.DataFrame:
    """Return a row for each law and quantity: the value of the replay, which is replica 0, and the
    range of ``runs`` runs of the law, by default as many as take about BUDGET seconds.

    If a law is true its runs and the replay are exchangeable: p is twice the smaller rank of the
    replay among all of them, over their number; by Student's t where ranks reject nothing.
    """
    simulate(scenario, scenario.seed, 0)  # what is compiled, or read, is so once
    begin = time.perf_counter()
    replay = measure_run(scenario, simulate(scenario, scenario.seed, 0))
    if runs is None:
        affordable = BUDGET / (time.perf_counter() - begin) / len(laws)
        runs = int(min(max(affordable, FEW_RUNS), RUNS))
    level = (1.0 - confidence) / len(replay)
    rows = []
    for number, law in enumerate(laws):

        def advance(done: int, _: int, before: int = number * runs) -> None:
            if progress is not None:
                progress(before + done, len(laws) * runs)

        task = partial(law_run, law=law, delay=delay)
        found = replicate(task, scenario, runs, first=1, pool=pool, progress=advance)
        for name, value in replay.items():
            drawn = np.array([one[name] for one in found])
            rank = 1 + min(int((drawn <= value).sum()), int((drawn >= value).sum()))
            low, median, high = np.quantile(drawn, [level / 2, 0.5, 1.0 - level / 2])
            p, spread = min(1.0, 2.0 * rank / (runs + 1)), float(drawn.std(ddof=runs > 1))
            # A quantity of few values, such as a share of time that is nearly 1, is not normal.
            is_normal = spread > 0.0 and len(np.unique(drawn)) > runs // 2
            if 2.0 / (runs + 1) > level and is_normal:
                spread *= math.sqrt(1.0 + 1.0 / runs)  # of a new value about the mean of these
                off = (value - drawn.mean()) / spread
                p = 2.0 * float(student_t.sf(abs(off), runs - 1))
                half = spread * float(student_t.isf(level / 2, runs - 1))
                low, high = drawn.mean() - half, drawn.mean() + half
            rows.append((law.kind, name, value, low, median, high, p, p >= level, runs))
    return pd.DataFrame(rows, columns=COLUMNS)


def law_run(
    scenario: Scenario, seed: int, replica: int, law: FittedLaw, delay: dict[str, Any]
) -> dict[str, float]:
    """Return the quantities of one run of a law with parameters drawn from their posterior."""
    values = law.draw(np.random.default_rng([STREAM, seed, replica]))
    if delay:
        scenario = scenario.replace({"network.channel.delay": delay})
    with TemporaryDirectory() as folder:
        drawn = law.apply(scenario, values, Path(folder))
        return measure_run(drawn, simulate(drawn, seed, replica))


def measure_run(scenario: Scenario, run: Run) -> dict[str, float]:
    """Return errors (P without truth), mean age, messages heard, and the share connected."""
    later = run.times > 0.0
    squares = run.sq_error if run.truth_known else np.trace(run.P, axis1=2, axis2=3)
    by_time = squares[later].mean(axis=1)
    kind = "error" if run.truth_known else "deviation by P"
    network = ConnectivitySink(scenario, {}, by_messages=True)
    network.events(run.log)
    t, *samples = (part[later] for part in (run.times, run.x, run.xhat, run.P, run.error))
    network.states(t, *samples)
    network.finish()
    return {
        f"RMS {kind}": float(np.sqrt(by_time.mean())),
        f"{kind} at the worst instant": float(np.sqrt(by_time.max())),
        "mean age (s)": float(t.mean() - np.mean([one.mean() for one in network.newest_heard(t)])),
        "messages heard": float(run.count("deliver")),
        "time connected": float(network.shares()[-1]),
    }
