"""The path of the plant and the noise of increment sensors, drawn in blocks of steps of the sensing
grid, for one run or for several together.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np

from netkf.engines.compiled.per_scenario import once_per_scenario
from netkf.engines.compiled.state import PathBlock, Sensing
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import aligned, unset, with_spare
from netkf.linalg.portable import cholesky
from netkf.plants.diffusion import NO_TIMES
from netkf.plants.laws import course_width
from netkf.plants.paths import BLOCK, StepBlock
from netkf.plants.sensors import step_noise
from netkf.rng.draws import Ziggurat
from netkf.rng.normals import StreamNormals
from netkf.rng.numbers import next_normal, normal_ziggurat
from netkf.rng.streams import Streams
from netkf.scenario.model import PlacedSensor
from netkf.scenario.scenario import Scenario

MAX_STEP_BLOCKS = 16  # blocks of steps that are drawn at once
MAX_NORMALS = 1 << 20  # normals of all sensors that are drawn at once
COURSES = 16
"""Pieces of a run whose courses (polynomials of the path) are cached at a time, a power of two: the
times of the nodes differ by few pieces, and all courses would not fit the processor's cache.
"""


def blocks_to_the_end(scenario: Scenario) -> int:
    """Return the number of blocks of BLOCK steps that reach the horizon."""
    return -(-steps_to_the_end(scenario) // BLOCK)


def steps_to_the_end(scenario: Scenario) -> int:
    """Return the number of steps of the sensing grid that reach the horizon."""
    period = scenario.diffusion.sensing_period
    assert period is not None
    # A first guess from below; the loop counts the rest.
    steps = max(1, int(scenario.horizon / period) - 1)
    while scenario.time_grid.instant(steps * period) < scenario.horizon:
        steps += 1
    return steps


def increments(scenario: Scenario) -> list[tuple[int, PlacedSensor]]:
    """Return all increment sensors as pairs (id of the node, sensor), in the order of nodes."""
    by_node = scenario.increment_sensors.items()
    return [(node, sensor) for node, placed in by_node for sensor in placed]


def blocks_at_once(scenario: Scenario) -> int:
    """Return the number of blocks that a run draws at once: few if many sensors need noise."""
    rows = [len(scenario.sensors[placed.entry].R) for _, placed in increments(scenario)]
    # Two moments for each row of each sensor and step share the budget of normals.
    share = MAX_NORMALS // max(2 * sum(rows), 1)
    return min(MAX_STEP_BLOCKS, max(1, share // BLOCK), blocks_to_the_end(scenario))


class Paths:
    """The paths of R runs, drawn ``blocks`` blocks of BLOCK steps at a time. Steps are cut into
    pieces at the times ``sampled`` (T,), in seconds, at which a state is sampled.
    """

    def __init__(
        self, scenario: Scenario, streams: Streams, blocks: int, sampled: FloatArray = NO_TIMES
    ) -> None:
        self._blocks = blocks
        # Separate streams for the path, for the states at probes and for those at samples, so that
        # none depends on how many numbers the others take.
        plant, probe, samples = (
            StreamNormals(streams.states(purpose, [()]))
            for purpose in ("plant", "probe", "samples")
        )
        self._paths = scenario.diffusion.paths(
            plant,
            probe,
            scenario.times,
            samples,
            sampled,
            scenario.exact_errors,
            None if scenario.input_responses is None else scenario.input_responses.surprise,
        )
        self._senses, self._horizon = bool(scenario.increment_sensors), scenario.horizon
        self.frame_times = self._paths.frame_times(scenario.horizon)

    def following(self, max_steps: int | None = None) -> StepBlock:
        """Return the next steps of all runs, at most ``max_steps``; the last reach the horizon."""
        return self._paths.following(self._blocks, max_steps)

    def block(self, block: StepBlock, together: int = 1) -> PathBlock:
        """Return a block of steps as arrays for the event loop of ``together`` runs."""
        ends, laws = block.ends, self._paths.laws
        n = laws.n
        # A Struct takes C-contiguous arrays only.
        parts = (block.x_start, block.x_end, block.moments, block.cubic)
        x_start, x_stop, moments, cubic = (np.ascontiguousarray(part) for part in parts)
        return PathBlock(
            end=float(ends[-1]),
            start=block.start,
            stop=block.end,
            x_start=x_start,
            x_stop=x_stop,
            moments=moments,
            cubic=cubic,
            step=block.step,
            last=ends[block.step],
            grid=ends[ends < self._horizon] if self._senses else np.empty(0),
            table=laws.course_table,
            course=aligned((together, COURSES, len(laws.course_table), course_width(n))),
            known=np.full((together, COURSES), -1, dtype=np.int64),
        )


@cache
def no_path(n: int) -> PathBlock:
    """Return an endless path of states 0, for runs without increment sensors."""
    rows = {name: np.zeros((1, 1, n)) for name in ("x_start", "x_stop")}
    return PathBlock(
        end=math.inf,
        start=np.zeros(1),
        stop=np.array([math.inf]),
        moments=np.zeros((1, 1, 2, n)),
        cubic=np.zeros((1, 1, 3, n)),
        step=np.zeros(1, dtype=np.int64),
        last=np.array([math.inf]),
        grid=np.empty(0),
        **rows,
        table=np.zeros((1, 1, 1)),
        course=np.zeros((1, 1, 1, 1)),
        known=np.zeros((1, 1), dtype=np.int64),
    )


@once_per_scenario
def _sensor_fields(scenario: Scenario) -> tuple[dict[str, np.ndarray], list[tuple[int, int]]]:
    """Return the fields of a Sensing that all runs share, and the keys of the sensors."""
    placed = increments(scenario)
    # Many nodes may have the same sensor: its R is factored once.
    entries = {placed_sensor.entry for _, placed_sensor in placed}
    roots = {entry: cholesky(scenario.sensors[entry].R) for entry in entries}
    rows = np.array([len(roots[one.entry]) for _, one in placed], dtype=np.int64)
    # Sensors with fewer rows are padded to the most.
    n, count, max_rows = scenario.plant.n, len(placed), int(rows.max(initial=0))
    H, root = np.zeros((count, max_rows, n)), np.zeros((count, max_rows, max_rows))
    for k, (_, placed_sensor) in enumerate(placed):
        p = rows[k]
        H[k, :p] = scenario.sensors[placed_sensor.entry].H
        root[k, :p, :p] = roots[placed_sensor.entry]
    index, pooled = scenario.topology.index, scenario.node_filter.timing.pooled
    indices = [0 if pooled else index[node] for node in scenario.increment_sensors]
    shared = {
        "rows": rows,
        "kind": np.array([placed_sensor.entry for _, placed_sensor in placed], dtype=np.int64),
        "H": H,
        "root": root,
        "index": np.array(indices, dtype=np.int64),
        "node": np.array(list(scenario.increment_sensors), dtype=np.int64),
    }
    return shared, [(node, placed_sensor.ordinal) for node, placed_sensor in placed]


@once_per_scenario
def no_sensing(scenario: Scenario) -> Sensing:
    """Return the sensors of all runs of a scenario in which none reads increments."""
    return Noise(scenario, Streams(0), 0).sensing


class Noise:
    """The noise of all S increment sensors in R runs, drawn in blocks of ``steps`` steps of the
    sensing grid into ``sensing.noise``.
    """

    def __init__(self, scenario: Scenario, streams: Streams, steps: int) -> None:
        shared, keys = _sensor_fields(scenario)
        self._noise = streams.states("noise", keys)
        # Without increment sensors the period is not used; it only must not be None.
        self._period = float(scenario.diffusion.sensing_period or 1.0) if keys else 1.0
        runs, ziggurat = streams.runs, normal_ziggurat()
        count, most = shared["H"].shape[:2]
        even = bool((shared["rows"] == most).all())
        self.sensing = Sensing(
            **shared,
            # Rows that a sensor does not have stay 0.
            noise=with_spare((runs * count * steps, 2, most), unset if even else aligned),
            steps=steps,
            cuts=streams.states("cut", keys),
            **ziggurat._asdict(),
        )

    def following(self, count: int | None = None) -> None:
        """Draw noise of the next block of steps, or the first ``count``, into ``sensing``."""
        sensing = self.sensing
        # Streams of all runs and sensors, run by run.
        shape = len(sensing.cuts), sensing.steps, *sensing.noise.shape[1:]
        normals, steps = sensing.noise.reshape(shape), count or sensing.steps
        noise = normals if steps == sensing.steps else np.ascontiguousarray(normals[:, :steps])
        # Standard normals become moments of white noise over one step: variances h and h / 3.
        scales = step_noise(np.ones((2, 1)), self._period)[:, 0]
        fill_noise(self._noise, sensing.rows, normal_ziggurat(), scales, noise)
        if noise is not normals:
            normals[:, :steps] = noise


@kernel
def fill_noise(
    states: np.ndarray, rows: np.ndarray, ziggurat: Ziggurat, scales: FloatArray, out: FloatArray
) -> None:
    """Write the noise moments of C steps, with standard deviations ``scales`` (2,), into ``out``
    (K, C, 2, >= p): the next numbers of each of K = R S streams, of ``rows`` (S,) by sensor.
    """
    for k in range(len(out)):
        # Streams are numbered run by run, so the sensor is the remainder.
        p = rows[k % len(rows)]
        # Rows beyond p are padding and draw nothing, so that streams do not depend on it.
        for c in range(out.shape[1]):
            for half in range(2):
                for i in range(p):
                    out[k, c, half, i] = scales[half] * next_normal(states, k, ziggurat)
