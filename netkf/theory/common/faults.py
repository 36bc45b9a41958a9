"""Whether a gate can notice a bad sensor: laws of innovations of a sensor with a stated fault.

The innovation of a consistent filter is normal with covariance S = H P H' + R. If readings are off
by b, and so the innovation by z, its z' S^-1 z is noncentral chi-square with that of the mean. A
filter of this sensor alone knows least and follows the fault most; one that knows the state has
S = R and never follows. If no other sensor is bad, the filter of a node lies between the two.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import scipy

from netkf.algorithms.gates import Gate
from netkf.core.errors import TheoryError
from netkf.core.laws import Lattice
from netkf.linalg.arrays import FloatArray
from netkf.linalg.portable import noise_root
from netkf.plants.faults import Fault, Outliers
from netkf.plants.transitions import Transitions
from netkf.scenario.model import PlacedSensor
from netkf.scenario.scenario import Scenario
from netkf.theory.intermittent.riccati import steady_covariance

MAX_READINGS = 100_000
"""Readings of a bad time that are looked at."""


class Refusals(NamedTuple):
    """Probabilities (K,) that a gate refuses readings at ``times`` (K,) of a bad sensor, while it
    has refused none before: of the filter that hears nobody, nan if that has no steady state, and
    of one that knows the state.
    """

    times: FloatArray
    alone: FloatArray
    knowing: FloatArray


class _Alone(NamedTuple):
    """The Kalman filter of one sensor in its steady state: transition F, gain K, H and S."""

    F: FloatArray
    K: FloatArray
    H: FloatArray
    S: FloatArray


def refusals(scenario: Scenario, placed: PlacedSensor, fault: Fault, gate: Gate) -> Refusals | None:
    """Return how likely the gate refuses readings of a bad sensor; None if not fixed beforehand,
    as where filters believe in other matrices than the true ones.
    """
    sensor, step = scenario.sensors[placed.entry], _step(scenario, placed)
    is_steady = sensor.linear and not sensor.varying and scenario.filters_know_the_truth
    if step is None or not is_steady:
        return None
    R = scenario.noise_covariance(placed.entry, believed=True)
    # The first reading of a sensor, in slots too where most filters have none in slot 0.
    first = max(int(np.ceil(fault.since / step - 1e-9)), 1)
    count = min(int(scenario.horizon / step) + 1, MAX_READINGS)
    times = np.asarray(step * np.arange(first, first + count), dtype=np.float64)
    times = times[[fault.holds(time) and time < scenario.horizon for time in times.tolist()]]
    if not len(times):
        return Refusals(times, times, times)
    alone = _alone(scenario, sensor.matrix_of(scenario.plant.n), R, step)
    if isinstance(fault, Outliers):
        values = [np.nan if alone is None else _of_outliers(gate, fault, alone.S)]
        values.append(_of_outliers(gate, fault, R))
        return Refusals(times[:1], np.array(values[:1]), np.array(values[1:]))
    stated = [fault.bias(time) for time in times.tolist()]
    known = [np.zeros(len(R)) + bias for bias in stated if bias is not None]
    if not known or len(known) < len(stated):
        return None
    biases = np.array(known)
    knowing = refused_with_bias(gate, biases, R)
    if alone is None:
        return Refusals(times, np.full(len(times), np.nan), knowing)
    off = innovation_biases(alone, biases)
    return Refusals(times, refused_with_bias(gate, off, alone.S), knowing)


def innovation_biases(alone: _Alone, biases: FloatArray) -> FloatArray:
    """Return biases (K, p) of innovations z = b - H e, e <- F (e + K z), b those of readings."""
    found, e = [], np.zeros(len(alone.F))
    for bias in biases:
        found.append(bias - alone.H @ e)
        e = alone.F @ (e + alone.K @ found[-1])
    return np.array(found)


def refused_with_bias(gate: Gate, biases: FloatArray, S: FloatArray) -> FloatArray:
    """Return the probabilities (K,) of refusal: the tail of the noncentral chi-square law."""
    noncentral = np.einsum("ki,ki->k", biases, np.linalg.solve(S, biases.T).T)
    return np.asarray(scipy.stats.ncx2.sf(gate.limit(len(S)), len(S), noncentral))


def _of_outliers(gate: Gate, fault: Outliers, S: FloatArray) -> float:
    """Return the least probability that an outlier is refused, exact for one value."""
    # z is normal with covariance S + sigma^2; its least spread in units of S.
    least = 1.0 + fault.sigma**2 / np.linalg.eigvalsh(S)[-1]
    return float(scipy.stats.chi2.sf(gate.limit(len(S)) / least, len(S)))


def _step(scenario: Scenario, placed: PlacedSensor) -> float | None:
    """Return the seconds between readings of a sensor, None if they differ."""
    if len(scenario.plant.changes) or not scenario.plant.linear:
        return None
    if scenario.slotted:
        return float(scenario.slot_plant.period)
    clock = getattr(scenario.sensors[placed.entry], "sampling", None)
    lattice: Any = getattr(clock, "gaps", None)
    is_even = isinstance(lattice, Lattice) and lattice == Lattice(lattice.period, lattice.period)
    return float(lattice.period) if is_even else None


def _alone(scenario: Scenario, H: FloatArray, R: FloatArray, step: float) -> _Alone | None:
    if scenario.slotted:
        F, Q = scenario.slot_belief
    else:
        A, BB = scenario.belief
        F, Q = Transitions(A, noise_root(BB)).law(step)
    try:
        P = steady_covariance(F, Q, H, R)
    except TheoryError:
        return None
    S = H @ P @ H.T + R
    return _Alone(F, P @ H.T @ np.linalg.inv(S), H, S)


def fault_evidence(scenario: Scenario) -> str:
    """Return what a gate makes of the faults of a scenario, as the end of a sentence."""
    gate = scenario.filter.gate
    if gate is None:
        return "; no gate refuses their readings (filter.gate)"
    told: dict[str, None] = {}
    for bad in scenario.faults.values():
        for placed, fault in bad:
            told.setdefault(_about(fault, refusals(scenario, placed, fault, gate), gate))
    return "".join(f"; {one}" for one in told)


def _about(fault: Fault, found: Refusals | None, gate: Gate) -> str:
    name = type(fault).__name__.lower()
    if found is None:
        return f"how often the gate refuses {name} readings is not known beforehand"
    if not len(found.times):
        return f"the sensor takes no reading while it is bad ({name})"
    first, last = (
        f"{'0' if np.isnan(found.alone[k]) else f'{found.alone[k]:.3g}'} to {found.knowing[k]:.3g}"
        for k in (0, -1)
    )
    if isinstance(fault, Outliers):
        return f"the gate refuses an outlier with probability {first}"
    if found.knowing.max() <= 2.0 * (1.0 - gate.probability):
        return (
            f"the gate can never tell {name} readings from healthy ones: it refuses them with "
            f"probability {found.knowing.max():.3g} at most"
        )
    times = [found.times[p >= 0.5] for p in (found.knowing, found.alone)]
    soonest, latest = (f"from {t[0]:g} s on" if len(t) else "never" for t in times)
    return (
        f"the gate refuses the first {name} reading with probability {first} and, if none before, "
        f"the last with {last} (a node that hears nobody, one that knows the state); with at least "
        f"1/2 {latest} and {soonest}"
    )
