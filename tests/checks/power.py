"""The power of ``check`` through whole runs, a slow study.

``python -m tests.checks.power --runs 100 --seeds 40`` takes the error that a row of a healthy
scenario says it would have found, gives a part of the scenario an error of that size, and counts
the seeds whose verdict is broken there; likewise with 1.5 times the error and with a 1.5th of it. A
row states its error rightly if the smallest error that is found with probability 0.9 lies between.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from netkf.algorithms.baselines import Central
from netkf.checks.check import judge_replicas, run_replica, with_check_times
from netkf.checks.evidence import BROKEN
from netkf.network.clocks import Poisson
from netkf.network.losses import Bernoulli
from netkf.plants.linear import LinearPlant
from netkf.plants.sensors import LinearSensor
from netkf.scenario.reading import from_table
from netkf.scenario.scenario import Scenario
from tests.checks.parts.test_parts import CLOCKS, SLOTS
from tests.checks.parts.wrong_parts import Wrong

SLACK = 1.5
"""Within this factor the stated errors should hold."""


@dataclass(frozen=True, eq=False)
class LossierBy(Bernoulli):
    """Loses a larger share of the messages."""

    size: float = 0.0

    def delivery_probability(self, sent):
        return self.delivery - self.size


@dataclass(frozen=True, eq=False)
class FasterBy(Poisson):
    """Ticks at a larger rate."""

    size: float = 0.0

    def ticks(self, entity, origin, index, now, random, count):
        times = super().ticks(entity, origin, index, now, random, count)
        return now + (times - now) / (1.0 + self.size)


@dataclass(frozen=True, eq=False)
class LouderBy(LinearSensor):
    """Has noise of a larger covariance."""

    size: float = 0.0

    def slot_path(self, node, period, generator):
        factor = math.sqrt(1.0 + self.size)
        change = lambda y, seen: seen + factor * (y - seen)  # noqa: E731
        return Wrong(self.H, self.R, generator("noise"), change=change)


@dataclass(frozen=True, eq=False)
class BiasedBy(LinearSensor):
    """Has a bias of so many standard deviations at one of its nodes, as its row speaks of one."""

    size: float = 0.0

    def slot_path(self, node, period, generator):
        shift = self.size * math.sqrt(self.R[0, 0]) if node == 0 else 0.0
        return Wrong(self.H, self.R, generator("noise"), change=lambda y, seen: y + shift)


@dataclass(frozen=True, eq=False)
class NoisierBy(LinearPlant):
    """Has noise of a larger covariance, from a start of a larger one where ``start``."""

    size: float = 0.0
    start: float = 0.0

    def truth(self, random, frames=False):
        return LinearPlant(
            mean=self.mean,
            cov=(1.0 + self.start) * self.cov,
            F=self.F,
            Q=(1.0 + self.size) * self.Q,
            period=self.period,
        ).truth(random, frames)


@dataclass(frozen=True, eq=False)
class BlurredBy(Central):
    """Shows estimates with further errors of a share of the covariance, and its P as it is."""

    size: float = 0.0

    def estimate(self, state):
        xhat, P = super().estimate(state)
        # Independent of everything else, and the same whenever it is asked for.
        random = np.random.default_rng(np.frombuffer(xhat.tobytes(), dtype=np.uint32))
        return xhat + math.sqrt(self.size) * state.root @ random.standard_normal(len(xhat)), P


HERE = "tests.checks.power"
Table = dict[str, Any]


def _with(table: Table, **parts: Table) -> Table:
    return {**table, **parts}


def _loss(size: float) -> Table:
    loss = {"kind": f"{HERE}:LossierBy", "delivery": 0.7, "size": size}
    return _with(SLOTS, network={**SLOTS["network"], "channel": {"loss": loss}})


def _clock(size: float) -> Table:
    activation = {"kind": f"{HERE}:FasterBy", "rate": 2.0, "size": size}
    sensors = CLOCKS["sensors"][1:]  # without increments, which take most of the time
    return _with(CLOCKS, sensors=sensors, network={**CLOCKS["network"], "activation": activation})


def _sensors(kind: str, size: float) -> Table:
    sensors = [{**one, "kind": f"{HERE}:{kind}", "size": size} for one in SLOTS["sensors"]]
    return _with(SLOTS, sensors=sensors)


def _plant(size: float, start: float = 0.0) -> Table:
    plant = {**SLOTS["plant"], "kind": f"{HERE}:NoisierBy", "size": size, "start": start}
    return _with(SLOTS, plant=plant)


def _errors(size: float, **start: Any) -> Table:
    return _with(SLOTS, filter={"kind": f"{HERE}:BlurredBy", "size": size, **start})


class Study(NamedTuple):
    """A row, by how its promise begins, and the table of a scenario with an error of a size."""

    promise: str
    table: Callable[[float], Table]


STUDIES = {
    "losses": Study("messages are lost as often", _loss),
    "rates of clocks": Study("clocks tick at the rates", _clock),
    "noise of sensors": Study(
        "noises of the sensors have their covariance", lambda size: _sensors("LouderBy", size)
    ),
    "bias of sensors": Study("readings have no bias", lambda size: _sensors("BiasedBy", size)),
    "noise of the plant": Study("the plant's noise has its covariance", _plant),
    "start": Study("the state starts with its covariance", lambda size: _plant(0.0, size)),
    "errors": Study("errors have the covariance", _errors),
    "errors from another start": Study(
        "errors have the covariance", lambda size: _errors(size, cov=[[5.0, 0.0], [0.0, 3.0]])
    ),
}


def _judge(table: Table, promise: str, runs: int, seed: int) -> tuple[bool, float]:
    """Return whether a row is broken, and the error that it states."""
    scenario: Scenario = with_check_times(from_table(table, Path()))
    results = [run_replica(scenario, seed, replica) for replica in range(runs)]
    rows = judge_replicas(scenario, results, seed, 0.99).rows
    (row,) = [row for row in rows if row.promise.startswith(promise)]
    return row.verdict == BROKEN, row.detectable


def measured_power(name: str, runs: int, seeds: int) -> tuple[float, list[float]]:
    """Return the error that a row states, and the shares of the seeds in which it finds a 1.5th of
    it, the error itself and 1.5 times it.
    """
    promise, table = STUDIES[name]
    stated = _judge(table(0.0), promise, runs, 0)[1]
    shares = []
    for size in (stated / SLACK, stated, SLACK * stated):
        broken = [_judge(table(size), promise, runs, 1 + seed)[0] for seed in range(seeds)]
        shares.append(sum(broken) / seeds)
    return stated, shares


def _main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--seeds", type=int, default=40)
    parser.add_argument("names", nargs="*", default=list(STUDIES))
    options = parser.parse_args()
    print(f"{'row':28s} {'stated':>8s}   found at /1.5   x1   x1.5")
    for name in options.names:
        stated, shares = measured_power(name, options.runs, options.seeds)
        found = "   ".join(f"{share:5.2f}" for share in shares)
        print(f"{name:28s} {stated:8.4f}   {found}", flush=True)


if __name__ == "__main__":
    _main()
