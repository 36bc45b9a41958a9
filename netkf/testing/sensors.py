"""``check_sensor``: checks of the readings of a sensor against its matrices."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from netkf.checks.parts.noises import Pieces, read_pieces
from netkf.core.clock import Clock
from netkf.laws.intervals import LawComparison
from netkf.laws.noise import whiten
from netkf.laws.ticks import count_interval
from netkf.linalg.arrays import FloatArray
from netkf.plants.nonlinear import NonlinearSensor
from netkf.plants.readings import read_many
from netkf.plants.regressors import RegressorSensor
from netkf.plants.sensors import LinearSensor, Sensor
from netkf.rng.streams import Generators, Streams
from netkf.scenario.plugins import describe_failure
from netkf.testing.noise import (
    NoiseLabels,
    check_independent,
    check_uncorrelated,
    check_white,
    demand_agreement,
    family_level,
    whitened,
)
from netkf.testing.plants import check_derivatives
from netkf.testing.watching import (
    ROUNDING,
    WatchedPart,
    checker,
    component_sizes,
    demand,
    demand_array,
    demand_close,
    demand_vector,
    fail,
    guard_user_code,
    make_part,
)

READINGS, LENGTH, MAX_NODES = 100_000, 250, 8
"""Readings of all nodes together, readings in a run, and nodes that are checked, for statistics."""
STEPS, RUNS = 500, 10
"""Steps of increments in a run, and runs."""
REGRESSOR_RUNS, REGRESSOR_SLOTS = 2000, 12
"""Runs in which the law of H of a RegressorSensor is tested, and slots in a run."""
SHORT_LENGTH = 40
"""Readings that are compared exactly."""
TIMES_RUNS, EXPECTED_SAMPLES = 400, 50.0
"""Runs in which samples are counted, and the mean number of them in a run."""
MAX_STATES = 12
"""Largest number of components of a state with which a nonlinear sensor is tried."""
PERIOD, HORIZON = 1.0, 1e6  # seconds of a slot, and of a run: readings end before
STEP = 0.1  # seconds of a step of increments
CUTS: tuple[tuple[float, ...], ...] = ((), (0.3,), (0.2, 0.65), (0.9,))
"""Shares of a step at which increments are cut; steps take these entries in turn."""


@checker
def check_sensor(sensor: Any, /, **settings: Any) -> None:
    """Check a sensor, or a class with its ``settings``.

    Its law is y = H x + v, where v is white noise of covariance R that does not depend on anything
    else. At most 8 of its nodes are checked.

    Exact checks: shapes; equal streams give equal readings, whichever other sensors are read,
    whether readings are taken one by one, several at once or with some left out, and however the
    steps of increments are cut; another state changes a reading by H times the difference; only the
    given generators are used; the sensor survives pickle; H is the same in all readings unless the
    sensor is ``varying``.

    Statistical checks find these errors with probability 0.9 each. From 100,000 readings of all
    nodes together (of increments, 10,000 pieces of steps): a bias of 0.03 standard deviations
    (increments 0.08), a variance off by 4 % (increments 11 %), a correlation of 0.03 (increments
    0.08) between components, between readings 1, 2, 3 or 7 apart or between two nodes, and a mean
    or variance that depends on a varying H by 0.05 of a standard deviation or 7 %. Errors at only
    one of N nodes must be sqrt(N) times as large, in one quarter of a run twice as large. Of the H
    of a RegressorSensor: a mean off by 0.18 standard deviations, a variance by 24 %. Sample times
    must increase, lie inside the run, not depend on its length, and be as many as the clock states
    (off by 8 %). Recorded sensors are only pickled. A correct class fails once in a million.

    Raises AssertionError with one line: the method, the rule, the value got, what to do.
    """
    _check_sensor(make_part(sensor, (Sensor,), settings), 0)


class ReadingSeries(NamedTuple):
    """Readings y (K, p) with their matrices H (K, p, n)."""

    y: FloatArray
    H: FloatArray


class SensorReader:
    """Reads a sensor in slots, or its ``samples`` of a diffusion. ``name``: that of the class.

    A path, which a method of the sensor returns, gives the readings of one node in one run. ``p``
    is the number of rows of a reading, ``n`` that of states.
    """

    def __init__(self, sensor: Any, name: str, method: str = "slot_path") -> None:
        """Take the ``sensor``, with a matrix H (p, n), and the name of its class."""
        self.sensor, self.where, self.samples = sensor, f"{name}.{method}", method == "samples"
        self.p, self.n = len(sensor.R), sensor.H.shape[1]

    def make_path(self, streams: Streams, node: int) -> Any:
        """Return the path of a node in one run, made with the run's random ``streams``."""
        generator = generators(streams, node)
        with guard_user_code(self.where):
            if self.samples:
                return self.sensor.samples(node, generator, HORIZON)
            return self.sensor.slot_path(node, PERIOD, generator)

    def read_several(self, path: Any, ks: Sequence[int], x: FloatArray) -> ReadingSeries:
        """Return y (K, p) and H (K, p, n) of readings ``ks`` at ``x`` (K, n), in one call."""
        with guard_user_code(self.where):
            y, H = read_many(path, ks, x)
        y = demand_array(self.where, "y of several", y, (len(ks), self.p))
        return ReadingSeries(y, demand_array(self.where, "H of several", H, (*y.shape, self.n)))

    def read_one(self, path: Any, k: int, x: FloatArray) -> ReadingSeries:
        """Return reading number ``k`` at the state ``x`` (n,) as a series of one reading."""
        with guard_user_code(self.where):
            # In the order in which engines call them.
            y, H = path.reading(k, x) if self.samples else (path.reading(k, x), path.matrix(k))
        y = demand_array(self.where, "a reading", y, (self.p,))
        return ReadingSeries(y[None], demand_array(self.where, "H", H, (self.p, self.n))[None])


def generators(streams: Streams, node: int) -> Generators:
    """Return the function from purposes to random generators of the first sensor of a node."""
    return lambda purpose: streams.generator(purpose, node, 0)


def make_reader(sensor: Sensor, name: str) -> SensorReader:
    """Return the reader of samples, or else of readings in slots."""
    has_clock = getattr(sensor, "sampling", None) is not None
    overrides_samples = type(sensor).samples not in (Sensor.samples, LinearSensor.samples)
    samples = has_clock or (overrides_samples and not sensor.varying)
    return SensorReader(sensor, name, "samples" if samples else "slot_path")


class IncrementReader(SensorReader):
    """Reads the increments of a sensor of a constant state, over steps that may be cut."""

    def __init__(self, sensor: Any, name: str) -> None:
        super().__init__(sensor, name, "path")

    def read(self, streams: Streams, node: int, x: FloatArray, steps: int, cut: bool) -> Pieces:
        """Return increments over ``steps`` at a constant ``x`` (n,), each ``cut`` or not."""
        generator, still = generators(streams, node), np.stack([x, np.zeros_like(x)])
        with guard_user_code(self.where):
            path = self.sensor.path(generator("noise"), generator("cut"))
            pieces = read_pieces(path, STEP, steps, CUTS if cut else CUTS[:1], lambda g: g * still)
        shape = (len(pieces.step), 2, self.p)
        return pieces._replace(moments=demand_array(self.where, "moments", pieces.moments, shape))


def combine(pieces: Pieces) -> FloatArray:
    """Return the moments (S, 2, p) of increments over whole steps."""
    total = np.zeros((int(pieces.step[-1]) + 1, *pieces.moments.shape[1:]))
    for moments, _, (start, end), k in zip(*pieces, strict=True):
        # On a piece, P_1 of the step is its value in the middle of the piece plus the share of the
        # piece times P_1 of the piece.
        middle = ((start - k * STEP) - ((k + 1) * STEP - end)) / STEP
        total[k, 0] += moments[0]
        total[k, 1] += middle * moments[0] + (end - start) / STEP * moments[1]
    return total


def _check_sensor(part: Any, seed: int) -> None:
    watched = WatchedPart(part)
    copy, name = watched.pickle_copy(), watched.name
    if isinstance(part, NonlinearSensor):
        _check_nonlinear(part, name)
        return
    if not part.is_random:
        return
    for field in ("H", "R"):
        matrix = getattr(part, field, None)
        is_matrix = isinstance(matrix, np.ndarray) and matrix.ndim == 2
        demand(is_matrix, f"{name}.{field}", "must be a matrix: filters are told it")
    H, R = part.H, part.R
    rule = f"must have the shape {(len(H), len(H))}, one row for each of H"
    demand(R.shape == (len(H), len(H)), f"{name}.R", rule, str(R.shape))
    nodes, sampling = part.nodes[:MAX_NODES], getattr(part, "sampling", None)
    with watched.guard():
        reader = make_reader(part, name)
        _check_same_readings(reader, make_reader(copy, name), nodes, seed)
        _check_linear(reader, nodes[0], seed)
        _check_laws(reader, nodes, seed)
        if isinstance(part, LinearSensor) and sampling is None:  # it is read continuously
            _check_increments(IncrementReader(part, name), nodes[0], seed)
        if isinstance(part, RegressorSensor):
            _check_regressors(part, SensorReader(part, name), nodes, seed)
        if sampling is not None:
            _check_times(part, f"{name}.sample_times", nodes, seed)


def _make_states(seed: int, count: int, n: int, run: int = 0) -> FloatArray:
    """Return random states (count, n) at which sensors are read, others for each run."""
    return 3.0 * Streams(seed, run).generator("testing").normal(size=(count, n))


def _check_same_readings(
    reader: SensorReader, copy: SensorReader, nodes: tuple[int, ...], seed: int
) -> None:
    streams, x = Streams(seed), _make_states(seed, SHORT_LENGTH, reader.n)
    numbers = list(range(SHORT_LENGTH))
    series = reader.read_several(reader.make_path(streams, nodes[0]), numbers, x)
    # Paths of other nodes are made and read in between, as in a simulation.
    others = [reader.make_path(Streams(seed, 1 + k), other) for k, other in enumerate(nodes)]
    remedy = "use only the generators given, and draw for each reading in order"
    for when, of, groups, between in (
        (
            "when other sensors are read between its readings, one by one",
            reader,
            [[k] for k in numbers],
            others,
        ),
        ("when readings are left out", reader, [[0], [1], [5], [6], [20], [39]], ()),
        ("when they are asked for in other groups", reader, [[0, 3], [4, 5, 6, 17], [39]], ()),
        ("of a pickled sensor", copy, [numbers], ()),
    ):
        path, readings = of.make_path(streams, nodes[0]), []
        for ks in groups:
            for other in between:
                reader.read_one(other, ks[0], x[ks[0]])
            one = of.read_one(path, ks[0], x[ks[0]]) if len(ks) == 1 else None
            readings.append(one or of.read_several(path, ks, x[ks]))
        chosen = [k for ks in groups for k in ks]
        names = "readings", "matrices H"
        for name, first, parts in zip(names, series, zip(*readings, strict=True), strict=True):
            rule = f"{name} must be the same for equal streams"
            demand_close(first[chosen], np.concatenate(parts), reader.where, rule, when, remedy)


def _check_linear(reader: SensorReader, node: int, seed: int) -> None:
    streams, numbers = Streams(seed), list(range(LENGTH))
    x, other_x = (_make_states(seed, LENGTH, reader.n, run) for run in (0, 1))
    series = reader.read_several(reader.make_path(streams, node), numbers, x)
    other = reader.read_several(reader.make_path(streams, node), numbers, other_x)
    demand_close(series.H, other.H, reader.where, "H must not depend on the state")
    expected = np.einsum("kpn,kn->kp", series.H, other_x - x)
    error = (np.abs(other.y - series.y - expected) / component_sizes(series.y, expected)).max()
    rule = "another state must change a reading by H times the difference, and the noise not at all"
    remedy = "return H @ x plus noise that does not depend on x"
    demand(error <= ROUNDING, reader.where, rule, f"{error:.3g} of the change left over", remedy)
    if not reader.sensor.varying:
        own = np.broadcast_to(reader.sensor.H, series.H.shape)
        rule = "H must be the sensor's own unless varying is True"
        demand_close(series.H, own, reader.where, rule)


def _check_laws(reader: SensorReader, nodes: tuple[int, ...], seed: int) -> None:
    labels = NoiseLabels(reader.where, "the noise y - H x", "R")
    runs = max(2, READINGS // (LENGTH * len(nodes)))
    factor = whiten(reader.sensor.R).factor
    noise = np.empty((len(nodes), runs, LENGTH, len(factor)))
    H = np.empty((len(nodes), runs, LENGTH, reader.p, reader.n))
    numbers = list(range(LENGTH))
    x = _make_states(seed, LENGTH, reader.n)
    for a, node in enumerate(nodes):
        for run in range(runs):
            series = reader.read_several(reader.make_path(Streams(seed, run), node), numbers, x)
            residual = series.y - np.einsum("kpn,kn->kp", series.H, x)
            noise[a, run], H[a, run] = residual @ factor.T, series.H
    check_white(noise.reshape(-1, LENGTH, reader.p), labels)
    for a in range(len(nodes)) if len(nodes) > 1 else ():
        check_white(noise[a], labels._replace(noise=f"the noise y - H x of node {nodes[a]}"))
        for b in range(a):
            check_uncorrelated(noise[a], noise[b], labels, f"of nodes {nodes[a]} and {nodes[b]}")
    if reader.sensor.varying:
        flat_H = H.reshape(-1, reader.p * reader.n)
        check_independent(noise.reshape(len(flat_H), -1), flat_H, labels, "H")


def _check_increments(reader: IncrementReader, node: int, seed: int) -> None:
    x, other_x = _make_states(seed, 2, reader.n)
    read = partial(reader.read, Streams(seed), node)
    cut, uncut = (read(x, SHORT_LENGTH, cut=is_cut) for is_cut in (True, False))
    rule = "increments of the pieces of a step must add up to those of the step"
    remedy = "draw the noise of the grid first, and cut it by its conditional law"
    demand_close(combine(cut), uncut.moments, reader.where, rule, remedy=remedy)
    repeated = read(x, SHORT_LENGTH, cut=True)
    rule, remedy = "increments must be the same for equal streams", "use only the generators given"
    demand_close(cut.moments, repeated.moments, reader.where, rule, remedy=remedy)
    other, H = read(other_x, SHORT_LENGTH, cut=True), reader.sensor.H
    rule = "another state must change increments by H times its integral, and the noise not at all"
    demand_close(other.moments, cut.moments + (other.x - cut.x) @ H.T, reader.where, rule)
    factor, runs = whiten(reader.sensor.R).factor, (Streams(seed, run) for run in range(RUNS))
    noise = np.array([reader.read(streams, node, x, STEPS, True).noise(H) for streams in runs])
    text = f"the noise of increments (their two moments, over steps of {STEP:g} s)"
    labels = NoiseLabels(reader.where, text, "R")
    check_white((noise @ factor.T).reshape(*noise.shape[:2], -1), labels)


def _check_regressors(
    sensor: RegressorSensor, reader: SensorReader, nodes: tuple[int, ...], seed: int
) -> None:
    """Check that H is C s, with s[k+1] = A s[k] + B xi and s[0] = ``start``."""
    slots, x = range(REGRESSOR_SLOTS), np.zeros((REGRESSOR_SLOTS, reader.n))
    pair = nodes[:2]
    H = np.empty((len(pair), REGRESSOR_RUNS, REGRESSOR_SLOTS, reader.n))
    noise = np.empty(H.shape[:-1])
    for a, node in enumerate(pair):
        for run in range(REGRESSOR_RUNS):
            path = reader.make_path(Streams(seed, run), node)
            series = reader.read_several(path, list(slots), x)
            H[a, run], noise[a, run] = series.H[:, 0], series.y[:, 0]  # x = 0: y is noise
    mean, cov = sensor.start, np.zeros_like(sensor.A)
    drive_cov = sensor.B @ sensor.xi_cov @ sensor.B.T
    H_labels = NoiseLabels(
        reader.where, "the deviation of H from its mean", "A, B, C, xi_cov and start"
    )
    noise_labels = NoiseLabels(reader.where, "the noise y - H x", "R")
    for k in slots:
        rule = "H must be C s, s[k+1] = A s[k] + B xi"
        deviation, S = H[:, :, k] - sensor.C @ mean, sensor.C @ cov @ sensor.C.T
        unit = whitened(deviation, S, component_sizes(H[:, :, k]), reader.where, rule)
        v = noise[:, :, k].reshape(-1, 1) / np.sqrt(sensor.R[0, 0])
        check_independent(v, H[:, :, k].reshape(len(v), -1), noise_labels, f"H, in slot {k}")
        if unit.size:
            check_white(unit.reshape(-1, 1, unit.shape[-1]), H_labels)
        if unit.size and len(pair) > 1:
            check_uncorrelated(unit[0], unit[1], H_labels, f"of nodes {pair[0]} and {pair[1]}")
        mean, cov = sensor.A @ mean, sensor.A @ cov @ sensor.A.T + drive_cov
    _check_regressor_steps(sensor, H.reshape(-1, REGRESSOR_SLOTS, reader.n), H_labels)


def _check_regressor_steps(sensor: RegressorSensor, H: FloatArray, labels: NoiseLabels) -> None:
    m = len(sensor.A)
    if len(sensor.C) < m or np.linalg.cond(sensor.C) > 1e6:
        return
    s = H @ np.linalg.pinv(sensor.C).T
    steps = s[:, 1:] - s[:, :-1] @ sensor.A.T
    unit = steps @ whiten(sensor.B @ sensor.xi_cov @ sensor.B.T).factor.T
    check_white(unit, labels._replace(noise="the steps of H"))


def _check_times(sensor: Any, where: str, nodes: tuple[int, ...], seed: int) -> None:
    rate = sensor.sampling.mean_rate((nodes[0], 0)) if isinstance(sensor.sampling, Clock) else 1.0
    horizon = EXPECTED_SAMPLES / rate if rate > 0.0 else 30.0
    if sensor.sampling.mean_rate((nodes[0], 0)) > 0.0:
        runs = 1 + TIMES_RUNS // len(nodes)
        counts = [
            len(_read_times(sensor, where, node, seed + 1 + run, horizon))
            for node in nodes
            for run in range(runs)
        ]
        # The phase of a clock may add or remove one tick in each run.
        level, values = family_level(), np.array(counts)
        distance = count_interval(values, EXPECTED_SAMPLES, level, False, 1.0)
        comparison = LawComparison([(distance, "all nodes")], "samples over the stated number")
        demand_agreement(comparison, where, "must be as many as the mean rate of `sampling` states")
    for node in nodes:
        ends = (horizon, 0.4 * horizon, horizon)
        first, shorter, repeated = (_read_times(sensor, where, node, seed, end) for end in ends)
        for times, end in zip((first, shorter), ends, strict=False):
            is_inside = not len(times) or (times[0] > 0.0 and times[-1] < end)
            rule = f"must lie in (0, {end:g}), the run"
            demand(is_inside, where, rule, times[:: max(len(times) - 1, 1)])
            demand((np.diff(times) > 0.0).all(), where, "must increase")
        rule, remedy = "must be the same for equal streams", "use the generators given"
        demand(np.array_equal(first, repeated), where, rule, remedy=remedy)
        is_same = np.array_equal(first[first < 0.4 * horizon], shorter)
        rule = "must not depend on the length of the run"
        demand(is_same, where, rule, f"{len(shorter)} times before 0.4 T")


def _read_times(sensor: Any, where: str, node: int, seed: int, horizon: float) -> FloatArray:
    with guard_user_code(where):
        generator = generators(Streams(seed), node)
        times = np.asarray(sensor.sample_times(node, 0, generator, horizon))
    return demand_vector(where, times)


def _check_nonlinear(sensor: NonlinearSensor, name: str) -> None:
    sensor = sensor.located({node: (0.7 * k, -0.4 * k) for k, node in enumerate(sensor.nodes)})
    p, n = len(sensor.R), _find_state_size(sensor, name)
    for node in sensor.nodes[:MAX_NODES]:
        h, jacobian = (partial(of, node=node) for of in (sensor.h, sensor.jacobian))
        for x in _make_states(0, SHORT_LENGTH, n):
            with guard_user_code(name):
                value = np.asarray(h(x.copy()))
                rule = f"must give {p} numbers, as R says"
                demand(value.shape == (p,), f"{name}.h", rule, value)
                check_derivatives((name, "h", "x and node"), h, jacobian, x, sensor.difference)


def _find_state_size(sensor: NonlinearSensor, name: str) -> int:
    failure = ""
    for n in range(1, MAX_STATES + 1):
        try:
            sensor.check_state(n)
            sensor.h(np.ones(n), sensor.nodes[0])
            if np.shape(sensor.jacobian(np.ones(n), sensor.nodes[0]))[-1:] == (n,):
                return n
        except Exception as error:  # of a user's class
            failure = f"; for a state of {n} the class {describe_failure(error)}"
    rule = f"h and jacobian must read a state of at most {MAX_STATES} components{failure}"
    return fail(name, rule)
