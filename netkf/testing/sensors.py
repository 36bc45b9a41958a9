"""Check that a sensor reads what its matrices say."""

from __future__ import annotations

from typing import Any

import numpy as np

from netkf.core.clock import Clock
from netkf.core.errors import ScenarioError
from netkf.linalg.arrays import FloatArray
from netkf.plants.nonlinear import NonlinearSensor
from netkf.plants.regressors import RegressorSensor
from netkf.plants.sensors import Sensor
from netkf.rng.streams import Streams
from netkf.testing.noise import (
    Stated,
    check_uncorrelated,
    check_unrelated,
    check_white,
    largest_deviation,
    whitening,
)
from netkf.testing.readings import (
    STEP,
    IncrementReader,
    ReadingSeries,
    SensorReader,
    demand_matrices,
    gives_increments,
    readers,
)
from netkf.testing.watching import Watched, attempt, demand, distance, fail, make_part, user_code

READINGS, LENGTH, MAX_NODES = 100_000, 250, 8
STEPS, RUNS = 500, 10
REGRESSOR_RUNS, REGRESSOR_SLOTS = 2000, 12
SHORT = 40
TIMES_RUNS, SAMPLES = 400, 50.0
ROUNDING = 1e-9
DERIVATIVE_STEP, DERIVATIVE_TOLERANCE = 1e-5, 1e-6
MAX_STATES = 12
"""Components of a state that a nonlinear sensor is tried with."""


def check_sensor(sensor: Any, /, **settings: Any) -> None:
    """Check a sensor, or a class with its ``settings``: y = H x + v, where v is white noise of
    covariance R that depends on nothing else.

    Exactly: shapes; equal streams give equal readings, whichever other sensors are read, whether
    readings are taken one by one, several at once or with some left out, and however the steps of
    increments are cut; another state changes a reading by H times the difference; only the given
    generators are used; the sensor survives pickle; H is the same everywhere unless ``varying``.
    At most 8 of its nodes are looked at.

    By 100,000 readings of all nodes together (10,000 pieces of the steps of increments), with
    probability 0.9 each: a bias of 0.03 standard deviations (increments 0.08), a variance that is
    wrong by 4 % (increments 11 %), a correlation of 0.03 (increments 0.08) between components, in
    time (1, 2, 3 or 7 readings apart) or between two nodes, and a mean or variance that depends on
    a varying H by 0.05 of a standard deviation or 7 %. Errors at one of N nodes, or in one quarter
    of a run, must be sqrt(N) times, or twice, as large. The law of a RegressorSensor's H: means
    off by 0.18 standard deviations, variances by 24 %. Times of samples increase, lie inside the
    run, do not depend on its length, and are as many as the clock states (off by 8 %). Recorded
    sensors are not drawn: pickle only. A sound class fails once in a million checks.

    Raises AssertionError with one line: the method, the rule, the value got, what to do.
    """
    part = make_part(sensor, (Sensor,), settings)
    check_made_sensor(part, 0)


def check_made_sensor(part: Any, seed: int) -> None:
    """Run ``check_sensor`` on an object, with streams of the given seed."""
    watched = Watched(part)
    copy = watched.pickle_copy()
    if isinstance(part, NonlinearSensor):
        _check_nonlinear(part, watched.name, seed)
        return
    if not part.is_random:
        return
    demand_matrices(part, watched.name)
    before = watched.attributes()
    nodes = part.nodes[:MAX_NODES]
    with user_code(watched.name):
        for reader in readers(part, watched.name):
            _check_same_readings(reader, type(reader)(copy, watched.name), nodes, seed)
            _check_linear(reader, nodes[0], seed)
            _check_laws(reader, nodes, seed)
        if gives_increments(part):
            _check_increments(IncrementReader(part, watched.name), nodes[0], seed)
        if isinstance(part, RegressorSensor):
            _check_regressors(part, SensorReader(part, watched.name), nodes, seed)
        if getattr(part, "sampling", None) is not None:
            _check_times(part, watched.name, nodes, seed)
    watched.demand_unchanged(before)


def _make_states(seed: int, count: int, n: int, which: int = 0) -> FloatArray:
    """Return states (count, n) at which sensors are read."""
    return 3.0 * Streams(seed, which).generator("testing").normal(size=(count, n))


def _check_same_readings(
    reader: SensorReader, copy: SensorReader, nodes: tuple[int, ...], seed: int
) -> None:
    """Check that readings depend on streams, numbers and states alone."""
    node, streams, x = nodes[0], Streams(seed), _make_states(seed, SHORT, reader.n)
    numbers = list(range(SHORT))
    whole = reader.several(reader.path(streams, node), numbers, x)
    # Others are made and read in between, as in a simulation.
    path = reader.path(streams, node)
    others = [reader.path(Streams(seed, 1 + k), other) for k, other in enumerate(nodes)]
    between = []
    for k in numbers:
        for other in others:
            reader.one(other, k, x[k])
        between.append(reader.one(path, k, x[k]))
    apart = "when other sensors are read between its readings, one by one"
    _demand_equal(reader, whole, _concatenate(between), apart)
    path, some = reader.path(streams, node), [0, 1, 5, 6, 20, 39]
    found = _concatenate([reader.one(path, k, x[k]) for k in some])
    _demand_equal(reader, _select(whole, some), found, "when readings are left out")
    path = reader.path(streams, node)
    parts = [reader.several(path, ks, x[ks]) for ks in ([0, 3], [4, 5, 6, 17], [39])]
    found = _concatenate(parts)
    left = [0, 3, 4, 5, 6, 17, 39]
    _demand_equal(reader, _select(whole, left), found, "when they are asked for in other groups")
    _demand_equal(
        reader, whole, copy.several(copy.path(streams, node), numbers, x), "of a pickled sensor"
    )


def _demand_equal(
    reader: SensorReader, one: ReadingSeries, other: ReadingSeries, when: str
) -> None:
    """Check that two series of readings are equal."""
    for name, a, b in zip(("readings", "matrices H"), one, other, strict=True):
        apart = distance(a, b)
        demand(
            apart <= ROUNDING,
            reader.where,
            f"{name} must be the same for equal streams",
            f"a difference of {apart:.3g} of their size {when}",
            "use only the generators given, and draw for each reading in order",
        )


def _concatenate(parts: list[ReadingSeries]) -> ReadingSeries:
    """Return several series one after the other."""
    return ReadingSeries(*(np.concatenate(some) for some in zip(*parts, strict=True)))


def _select(whole: ReadingSeries, ks: list[int]) -> ReadingSeries:
    """Return some readings of a series."""
    return ReadingSeries(whole.y[ks], whole.H[ks])


def _check_linear(reader: SensorReader, node: int, seed: int) -> None:
    """Check that another state changes a reading by H times the difference, and H not at all."""
    streams, numbers = Streams(seed), list(range(LENGTH))
    x, other = (_make_states(seed, LENGTH, reader.n, which) for which in (0, 1))
    one = reader.several(reader.path(streams, node), numbers, x)
    two = reader.several(reader.path(streams, node), numbers, other)
    apart = distance(one.H, two.H)
    demand(apart <= ROUNDING, reader.where, "H must not depend on the state", f"{apart:.3g} apart")
    added = np.einsum("kpn,kn->kp", one.H, other - x)
    gap = np.abs(two.y - one.y - added).max() / (1.0 + np.abs(added).max())
    demand(
        gap <= ROUNDING,
        reader.where,
        "another state must change a reading by H times the difference, and the noise not at all",
        f"{gap:.3g} of the change left over",
        "return H @ x plus noise that does not depend on x",
    )
    varies = max(distance(one.H[k], reader.sensor.H) for k in range(LENGTH))
    if not reader.sensor.varying:
        demand(
            varies <= ROUNDING,
            reader.where,
            "H must be the sensor's own unless varying is True",
            f"{varies:.3g} of its size apart",
        )


def _check_laws(reader: SensorReader, nodes: tuple[int, ...], seed: int) -> None:
    """Check the noise of all nodes, all together and each by itself."""
    stated = Stated(reader.where, "the noise y - H x", "R")
    runs = max(2, READINGS // (LENGTH * len(nodes)))
    white = whitening(reader.sensor.R).free
    noise = np.empty((len(nodes), runs, LENGTH, reader.p))
    rows = np.empty((len(nodes), runs, LENGTH, reader.p, reader.n))
    numbers = list(range(LENGTH))
    x = _make_states(seed, LENGTH, reader.n)
    for a, node in enumerate(nodes):
        for r in range(runs):
            found = reader.several(reader.path(Streams(seed, r), node), numbers, x)
            residual = found.y - np.einsum("kpn,kn->kp", found.H, x)
            noise[a, r], rows[a, r] = residual @ white.T, found.H
    check_white(noise.reshape(-1, LENGTH, reader.p), stated)
    for a in range(len(nodes)) if len(nodes) > 1 else ():
        check_white(noise[a], stated._replace(noise=f"the noise y - H x of node {nodes[a]}"))
        for b in range(a):
            check_uncorrelated(noise[a], noise[b], stated, f"of nodes {nodes[a]} and {nodes[b]}")
    if reader.sensor.varying:
        flat = rows.reshape(-1, reader.p * reader.n)
        check_unrelated(noise.reshape(len(flat), -1), flat, stated, "H")


def _check_increments(reader: IncrementReader, node: int, seed: int) -> None:
    """Check the moments of increments: additive over cuts, linear, white."""
    x, other = _make_states(seed, 2, reader.n)
    streams = Streams(seed)
    cut = reader.pieces(streams, node, x, SHORT, cut=True)
    uncut = reader.pieces(streams, node, x, SHORT, cut=False)
    apart = distance(reader.whole(cut), uncut.moments)
    demand(
        apart <= ROUNDING,
        reader.where,
        "increments of the pieces of a step must add up to those of the step",
        f"{apart:.3g} of their size apart",
        "draw the noise of the grid first, and cut it by its conditional law",
    )
    again = reader.pieces(streams, node, x, SHORT, cut=True).moments
    demand(
        distance(cut.moments, again) <= ROUNDING,
        reader.where,
        "increments must be the same for equal streams",
        f"{distance(cut.moments, again):.3g} of their size apart",
        "use only the generators given",
    )
    moved, spans, _ = reader.pieces(streams, node, other, SHORT, cut=True)
    added = (spans[:, 1] - spans[:, 0])[:, None] * (reader.sensor.H @ (other - x))
    expected = cut.moments + np.stack([added, np.zeros_like(added)], axis=1)
    demand(
        distance(moved, expected) <= ROUNDING,
        reader.where,
        "another state must change increments by H times its integral, and the noise not at all",
        f"{distance(moved, expected):.3g} of their size left over",
    )
    _check_increment_noise(reader, node, x, seed)


def _check_increment_noise(reader: IncrementReader, node: int, x: FloatArray, seed: int) -> None:
    """Check that the noise of increments is white with the stated R."""
    white = whitening(reader.sensor.R).free
    found = []
    for r in range(RUNS):
        moments, spans, _ = reader.pieces(Streams(seed, r), node, x, STEPS, cut=True)
        gaps = (spans[:, 1] - spans[:, 0])[:, None, None]
        drift = np.stack([gaps[:, 0] * (reader.sensor.H @ x), np.zeros((len(gaps), reader.p))], 1)
        # The moments of unit noise over g seconds have the variances g and g / 3.
        unit = np.sqrt(gaps * np.array([[1.0], [1.0 / 3.0]]))
        found.append(((moments - drift) / unit @ white.T).reshape(len(moments), -1))
    noise = f"the noise of increments (their two moments, over steps of {STEP:g} s)"
    check_white(np.array(found), Stated(reader.where, noise, "R"))


def _check_regressors(
    sensor: RegressorSensor, reader: SensorReader, nodes: tuple[int, ...], seed: int
) -> None:
    """Check that H is C s, with s[k+1] = A s[k] + B xi from ``start`` on."""
    numbers, x = list(range(REGRESSOR_SLOTS)), np.zeros((REGRESSOR_SLOTS, reader.n))
    pair = nodes[:2]
    rows = np.empty((len(pair), REGRESSOR_RUNS, REGRESSOR_SLOTS, reader.n))
    noise = np.empty(rows.shape[:-1])
    for a, node in enumerate(pair):
        for r in range(REGRESSOR_RUNS):
            found = reader.several(reader.path(Streams(seed, r), node), numbers, x)
            rows[a, r], noise[a, r] = found.H[:, 0], found.y[:, 0]
    mean, spread = sensor.start, np.zeros_like(sensor.A)
    drive = sensor.B @ sensor.xi_cov @ sensor.B.T
    stated = Stated(reader.where, "the deviation of H from its mean", "A, B, C, xi_cov and start")
    for k in numbers:
        law = whitening(sensor.C @ spread @ sensor.C.T)
        gap = rows[:, :, k] - sensor.C @ mean
        off = float(np.abs(gap @ law.certain.T).max(initial=0.0)) / (
            1.0 + float(np.abs(mean).max())
        )
        if off > 1e-6:
            rule = "H must be C s with s[0] = start and s[k+1] = A s[k] + B xi"
            fail(reader.where, rule, f"{off:.3g} off where it is certain, in slot {k}")
        unit = gap @ law.free.T
        v = noise[:, :, k].reshape(-1, 1) / np.sqrt(sensor.R[0, 0])
        text = Stated(reader.where, "the noise y - H x", "R")
        check_unrelated(v, rows[:, :, k].reshape(len(v), -1), text, f"H, in slot {k}")
        if unit.size:
            check_white(unit.reshape(-1, 1, unit.shape[-1]), stated)
        if unit.size and len(pair) > 1:
            check_uncorrelated(unit[0], unit[1], stated, f"of nodes {pair[0]} and {pair[1]}")
        mean, spread = sensor.A @ mean, sensor.A @ spread @ sensor.A.T + drive
    _check_steps_of_regressors(sensor, rows.reshape(-1, REGRESSOR_SLOTS, reader.n), stated)


def _check_steps_of_regressors(sensor: RegressorSensor, rows: FloatArray, stated: Stated) -> None:
    """Check what H does from slot to slot, where its state s can be told from it."""
    m = len(sensor.A)
    if len(sensor.C) < m or np.linalg.cond(sensor.C) > 1e6:
        return
    s = rows @ np.linalg.pinv(sensor.C).T
    steps = s[:, 1:] - s[:, :-1] @ sensor.A.T
    drive = sensor.B @ sensor.xi_cov @ sensor.B.T
    unit = steps @ whitening(drive).free.T
    check_white(unit, stated._replace(noise="the steps of H"))


def _check_times(sensor: Any, name: str, nodes: tuple[int, ...], seed: int) -> None:
    """Check the times of samples: inside the run, increasing, not dependent on its length."""
    where, horizon = f"{name}.sample_times", 30.0
    rate = sensor.sampling.mean_rate((nodes[0], 0)) if isinstance(sensor.sampling, Clock) else 1.0
    if rate > 0.0:
        horizon = 50.0 / rate
    _check_sampling_rate(sensor, where, nodes, seed)
    for node in nodes:
        times = [
            _read_times(sensor, where, node, seed, end) for end in (horizon, 0.4 * horizon, horizon)
        ]
        for some, end in zip(times, (horizon, 0.4 * horizon, horizon), strict=True):
            inside = not len(some) or (some[0] > 0.0 and some[-1] < end)
            demand(
                inside,
                where,
                f"must lie in (0, {end:g}), the run",
                some[[0, -1]] if len(some) else "",
            )
            demand((np.diff(some) > 0.0).all(), where, "must increase")
        same = np.array_equal(times[0], times[2])
        demand(same, where, "must be the same for equal streams", None, "use the generators given")
        shorter = times[0][times[0] < 0.4 * horizon]
        rule = "must not depend on the length of the run"
        demand(
            np.array_equal(shorter, times[1]), where, rule, f"{len(times[1])} times before 0.4 T"
        )


def _check_sampling_rate(sensor: Any, where: str, nodes: tuple[int, ...], seed: int) -> None:
    """Check the number of samples against the mean rate of the clock, where it is known."""
    rate = sensor.sampling.mean_rate((nodes[0], 0))
    if not rate > 0.0:
        return
    runs = 1 + TIMES_RUNS // len(nodes)
    expected = SAMPLES
    counts = np.array(
        [
            len(_read_times(sensor, where, node, seed + 1 + run, expected / rate))
            for node in nodes
            for run in range(runs)
        ]
    )
    found = largest_deviation(counts[:, None] / expected - 1.0, fewest=TIMES_RUNS // 2)
    # One tick more or less in a run is a matter of its phase.
    if found is not None and abs(found.mean) > 1.0 / expected:
        text = f"{1.0 + found.mean:.4g} (+- {found.error:.2g}) of the stated number of samples"
        fail(where, "must be as many as the mean rate of `sampling` states", text)


def _read_times(sensor: Any, where: str, node: int, seed: int, horizon: float) -> FloatArray:
    """Return the sampling times of a sensor after a check of their form."""
    streams = Streams(seed)

    def generator(purpose: str) -> np.random.Generator:
        """Return the random generator of a purpose."""
        return streams.generator(purpose, node, 0)

    found = np.asarray(attempt(where, sensor.sample_times, node, 0, generator, horizon))
    vector = found.ndim == 1 and found.dtype == np.float64
    demand(vector, where, "must be a vector of float64", f"{found.dtype} {found.shape}")
    return found


def _check_nonlinear(sensor: NonlinearSensor, name: str, seed: int) -> None:
    """Check that ``h`` and ``jacobian`` depend on the state and the node alone, have shapes that
    fit R, and that the Jacobian has the derivatives of ``h``.
    """
    positions = {node: (0.7 * k, -0.4 * k) for k, node in enumerate(sensor.nodes)}
    sensor = sensor.located(positions)
    p, n = len(sensor.R), _states_read(sensor, name)
    for node in sensor.nodes[:MAX_NODES]:
        for x in _make_states(seed, SHORT, n):
            with user_code(name):
                value = np.asarray(sensor.h(x.copy(), node))
                again = np.asarray(sensor.h(x.copy(), node))
                J = np.asarray(sensor.jacobian(x.copy(), node))
            demand(value.shape == (p,), f"{name}.h", f"must give {p} numbers, as R says", value)
            remedy = "return what is read without noise, which netkf adds"
            demand(
                np.array_equal(value, again), f"{name}.h", "must be one for a state", again, remedy
            )
            demand(J.shape == (p, n), f"{name}.jacobian", f"must be {p} x {n}", str(J.shape))
            apart = _derivative_error(sensor, node, x, J)
            demand(
                apart <= DERIVATIVE_TOLERANCE * (1.0 + float(np.abs(J).max())),
                f"{name}.jacobian",
                "must be the derivatives of h",
                f"entries that are off by {apart:.2g} at x = {np.round(x, 3).tolist()}",
                "compare it with differences of h",
            )


def _states_read(sensor: NonlinearSensor, name: str) -> int:
    """Return the smallest number of components, up to MAX_STATES, of a state that h can read."""
    for n in range(1, MAX_STATES + 1):
        if _can_read(sensor, n):
            return n
    return fail(name, f"h and jacobian must read a state of at most {MAX_STATES} components")


def _can_read(sensor: NonlinearSensor, n: int) -> bool:
    """Return True if a sensor reads states of n components."""
    try:
        sensor.check_state(n)
        sensor.h(np.ones(n), sensor.nodes[0])
        return np.shape(sensor.jacobian(np.ones(n), sensor.nodes[0]))[-1:] == (n,)
    except (ScenarioError, IndexError, ValueError):
        return False


def _derivative_error(sensor: NonlinearSensor, node: int, x: FloatArray, J: FloatArray) -> float:
    """Return the largest difference of a Jacobian from central differences of h."""
    found = np.empty_like(J)
    for k, step in enumerate(np.eye(len(x)) * DERIVATIVE_STEP):
        ends = [np.asarray(sensor.h(x + sign * step, node)) for sign in (1.0, -1.0)]
        found[:, k] = sensor.difference(*ends) / (2.0 * DERIVATIVE_STEP)
    return float(np.abs(found - J).max())
