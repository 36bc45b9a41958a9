"""Short runs of a filter on small random systems, in slots and in continuous time."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy

from netkf.algorithms.filter import Filter
from netkf.algorithms.traits import Timing
from netkf.engines.simpy.engine import SimpyEngine
from netkf.linalg.arrays import FloatArray, square_root
from netkf.network.channels import Channel
from netkf.network.clocks import LinkClock, OnReadings, Periodic
from netkf.network.delays import Delay
from netkf.network.graphs import Complete
from netkf.network.lives import Life
from netkf.network.losses import Transmission
from netkf.network.matchings import Broadcast, Matching, SlotActivation
from netkf.plants.diffusion import Diffusion
from netkf.plants.linear import LinearPlant
from netkf.plants.sensors import LinearSensor
from netkf.rng.streams import Streams
from netkf.runs.simulate import simulate
from netkf.scenario.model import Filtering, Network
from netkf.scenario.scenario import Scenario
from netkf.testing.observed import Log, Observed, Seen, Shift
from netkf.testing.watching import WatchedPart
from netkf.trace.run import Run

SLOTS, MAX_FIRST_SLOT, SLOTS_AFTER_SHIFT = 5, 20, 3
"""Slots with exchanges, slots before the first one at most, and slots after the shift."""
TICKS, RELIABLE = 6, 2
"""Ticks of a clock, and messages of a link in continuous time that arrive when they are sent."""
SAMPLE_TICK, INCREMENT_TICK = 0.4, 0.05
"""Seconds between ticks of a clock with sensors that take samples, and that give increments."""
SHIFT = np.array([7.0, -11.0, 5.0])
"""Large compared with the estimates, so that an error of one percent shows."""


class System(NamedTuple):
    """A small random system in slots of one second.

    M, Q      : (n, n), transition matrix and noise covariance of a slot; A = M - I and Q per second
                in continuous time
    H, R      : (p, n) and (p, p), matrix and covariance of the noise of the sensor
    mean, cov : (n,) and (n, n), mean and covariance of x(0)
    """

    M: FloatArray
    Q: FloatArray
    H: FloatArray
    R: FloatArray
    mean: FloatArray
    cov: FloatArray


def make_systems(inverts: bool) -> list[System]:
    """Return systems with n = 1 .. 3, p = 0 .. 2; one has cov = 0 unless the filter ``inverts``."""
    random, systems = Streams(0).generator("testing"), []
    for n, p, is_certain in ((1, 1, False), (2, 1, True), (3, 0, False), (3, 2, False)):
        noise_factor, cov_factor = random.normal(size=(2, n, n))
        eye = np.eye(n)
        cov = cov_factor @ cov_factor.T + eye
        system = System(
            M=0.8 * eye + 0.3 * random.normal(size=(n, n)) / np.sqrt(n),
            Q=noise_factor @ noise_factor.T / n + 0.1 * eye,
            H=random.normal(size=(p, n)),
            R=np.diag(random.uniform(0.5, 1.5, p)),
            mean=random.normal(size=n),
            cov=np.zeros((n, n)) if is_certain and not inverts else cov,
        )
        systems.append(system)
    return systems


@dataclass(frozen=True, eq=False)
class Unreliable(Delay):
    """The first messages of a link arrive at once; of later ones, in slots none does, and under
    clocks one in four is lost and two are late by a share of a second.
    """

    first: int
    late: float

    @property
    def longest(self) -> float:
        """Seconds, beyond the end of a run."""
        return 1.0

    def draw(self, random: np.random.Generator) -> float:
        """Return 0: nothing is drawn."""
        return 0.0

    def message_delay(self, sent: Transmission, drawn: float) -> float:
        """Return the seconds that a message takes, nan if it is lost."""
        if sent.number < self.first:
            return 0.0
        pattern = (self.late, self.late, math.nan, 0.0) if self.late else (math.nan,)
        return pattern[(sent.number - self.first) % len(pattern)]


class Kind(NamedTuple):
    """The kind of time of a run: the ``clock`` by which nodes transmit (of algorithms.filter.CLOCKS
    or None), whether sensors give ``increments`` or samples; ``slots`` of them, 0 under clocks.
    """

    slots: int = 0
    clock: str | None = None
    increments: bool = False


def kinds_of(*parts: Any) -> list[Kind]:
    """Return the kinds of time in which all of several filters run, slots first."""
    timings, kinds = [part.timing for part in parts], []
    if all(timing.schedule is not None for timing in timings):
        first = max(min(int(timing.first_exchange), MAX_FIRST_SLOT) for timing in timings)
        kinds.append(Kind(slots=first + SLOTS))
    clocks: list[str | None] = [None]
    if any(timing.talks for timing in timings):
        clocks = [c for c in timings[0].clocks if all(c in timing.clocks for timing in timings)]
    for clock in clocks:
        kinds.append(Kind(clock=clock))
        # The clock "readings" ticks when a node has taken a sample.
        if clock != "readings" and not any(part.needs.samples for part in parts):
            kinds.append(Kind(clock=clock, increments=True))
    return kinds


def setups(*parts: Any) -> Iterator[tuple[System, Kind]]:
    """Yield the systems and kinds of time in which filters are run."""
    kinds = kinds_of(*parts)
    systems = make_systems(any(part.needs.inverts for part in parts))
    regular = make_systems(any(part.needs.inverts_under_clocks for part in parts))
    first = next((kind.clock for kind in kinds if not kind.slots), None)
    for system, definite in zip(systems, regular, strict=True):
        for kind in kinds:
            # All clocks on one system only: a fault that depends on it shows under any clock.
            is_first = kind.slots or kind.clock == first
            can_run = kind.clock != "readings" or len(system.H)
            if can_run and (is_first or system is systems[-1]):
                yield (system if kind.slots or system.cov.any() else definite), kind


def run(
    watched: WatchedPart, system: System, kind: Kind, shifted: bool = False, spread: float = 0.0
) -> tuple[list[Seen], Run]:
    """Run a filter on a complete network of 2 or 3 nodes, node 1 without a sensor; return estimates
    and run. ``shifted`` shifts truth and states on the way, ``spread`` is between first estimates.
    """
    timing, n, tick = watched.part.timing, len(system.M), tick_of(kind)
    A = system.M - np.eye(n)

    def transition(seconds: float) -> FloatArray:
        if kind.slots:
            return np.linalg.matrix_power(system.M, round(seconds))
        return np.asarray(scipy.linalg.expm(A * seconds))

    since = kind.slots - SLOTS_AFTER_SHIFT if kind.slots else (RELIABLE + 0.5) * tick
    observed = Observed(
        watched,
        Log(),
        period=1.0 if kind.slots else 0.0,
        reliable=RELIABLE,
        shift_of_truth=Shift(since, SHIFT[:n], transition) if shifted else None,
        spread=spread,
        composes=not kind.slots and kind.clock in (None, *timing.clocks[:1]),
    )
    scenario = small_scenario(observed, system, kind, Channel(delay=_delay(kind, timing, tick)))
    return observed.log.seen, simulate(scenario, engine=SimpyEngine())


def tick_of(kind: Kind) -> float:
    """Return the seconds between slots, or ticks of a clock."""
    return 1.0 if kind.slots else INCREMENT_TICK if kind.increments else SAMPLE_TICK


def small_scenario(
    algorithm: Filter, system: System, kind: Kind, channel: Channel, lives: tuple[Life, ...] = ()
) -> Scenario:
    """Return a scenario of a filter on 2 or 3 nodes, all linked, node 1 without a sensor."""
    weights, tick = algorithm.link_weights, tick_of(kind)
    count = 3 if weights.largest_degree >= 2.0 else 2
    count = count if weights.matrix is None else len(weights.matrix)
    start: Any = {"mean": system.mean, "cov": system.cov}
    return Scenario(
        name="check_filter",
        horizon=tick * (kind.slots or TICKS),
        plant=LinearPlant(F=system.M, Q=system.Q, period=1.0, **start)
        if kind.slots
        else Diffusion(A=system.M - np.eye(len(system.M)), B=square_root(system.Q), **start),
        sensors=_sensors(system, kind, count),
        network=Network(
            graph=Complete(nodes=count),
            activation=_activation(kind, algorithm.timing, tick),
            channel=channel,
            lives=lives,
        ),
        filter=Filtering(algorithm=algorithm),
        probe=tick,
    )


def _sensors(system: System, kind: Kind, count: int) -> tuple[LinearSensor, ...]:
    if not len(system.H):
        return ()
    samples = not kind.slots and not kind.increments
    sampling = Periodic(period=0.7 * SAMPLE_TICK, phase="random") if samples else None
    nodes = tuple(node for node in range(count) if node != 1)
    return (LinearSensor(nodes=nodes, H=system.H, R=system.R, sampling=sampling),)


def _activation(kind: Kind, timing: Timing, tick: float) -> LinkClock | SlotActivation | None:
    if not timing.talks:
        return None
    if kind.slots:
        return Matching(protocol="one-edge") if timing.pairwise else Broadcast()
    if kind.clock == "readings":
        return OnReadings()
    return Periodic(at=str(kind.clock), period=tick)


def _delay(kind: Kind, timing: Timing, tick: float) -> Delay:
    if not kind.slots:
        return Unreliable(RELIABLE, 0.7 * tick)
    steps = [timing.steps(phase) for phase in range(timing.exchanges)]
    # All messages of the last slot are lost.
    return Unreliable((kind.slots - 1 - timing.first_exchange) * sum(steps), 0.0)
