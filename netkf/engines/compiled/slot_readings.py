"""The readings of R runs in slots: drawn by kernels, or made in Python from records, by users'
sensors, and where sensors are bad or nodes are down.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from netkf.algorithms.kernels.nonlinear_rows import NonlinearRows, add_values
from netkf.algorithms.kernels.pairs import Pairs
from netkf.core.places import Place
from netkf.engines.compiled.life_tables import LifeTable
from netkf.engines.compiled.nonlinear_rows import NonlinearSetup
from netkf.engines.compiled.own_sensors import read_whitened
from netkf.engines.compiled.slot_messages import SlotTimes
from netkf.engines.compiled.slot_pairs import matrix_of
from netkf.engines.compiled.slot_setup import AssignedSensor, SlotSetup
from netkf.engines.compiled.slot_steps import absent, step_times
from netkf.engines.compiled.slot_truth import draw_path
from netkf.linalg.arrays import FloatArray
from netkf.linalg.lanes import LANES, MANY, blocks_of, in_lanes, unset
from netkf.linalg.portable import cholesky, solve_lower
from netkf.plants.faults import FaultyReadings
from netkf.plants.slot_paths import Path, draw_readings
from netkf.rng.numbers import normal_ziggurat
from netkf.rng.streams import Streams
from netkf.scenario.scenario import Scenario


class SlotReadings:
    """The readings of R runs of one scenario, of some slots after the other. ``lives`` say when
    nodes are down in each run; without them no node ever is.

    nonlinear : NonlinearRows or None, what filters linearise in place of ready rows
    pairs : Pairs or None, the readings about a node's own states and another block
    """

    def __init__(
        self, scenario: Scenario, setup: SlotSetup, streams: Streams, lives: list[LifeTable]
    ) -> None:
        self._scenario, self._setup, self._lives = scenario, setup, lives
        self._blocks = blocks_of(streams.runs)
        method, active = scenario.filter.linearise, min(streams.runs, LANES)
        self.pairs: Pairs | None = None
        if setup.pairs is not None:
            self.pairs = setup.pairs.tables(method, active)
        self.nonlinear: NonlinearRows | None = None
        if setup.nonlinear is not None:
            self.nonlinear = self._drawn = setup.nonlinear.tables(method, active)
            if setup.drawn is not setup.nonlinear:
                self._drawn = setup.drawn.tables(method, active)
        self._begin_drawn(streams)
        self._begin_in_python(streams)

    def _begin_drawn(self, streams: Streams) -> None:
        setup = self._setup
        entities = [(s.node, s.placed_sensor.ordinal) for s in setup.kernel_sensors]
        # One stream for each drawn sensor of each run.
        self._noise = streams.states("noise", entities)
        self._regressors: list[tuple[Path, np.ndarray]] = []
        for s, (A, drive, start) in zip(setup.regressor_sensors, setup.regressors, strict=True):
            x = in_lanes(start, self._blocks)
            # Frame 0: the origin never moves, as regressors do not grow as an unstable plant does.
            path = Path(A, drive, 0, x, np.zeros(x.shape))
            states = streams.states("regressor", [(s.node, s.placed_sensor.ordinal)])
            self._regressors.append((path, states))

    def _begin_in_python(self, streams: Streams) -> None:
        scenario, setup = self._scenario, self._setup
        first = Streams(streams.seed, streams.replica)
        self._recorded: list[tuple[AssignedSensor, Any]] = [
            (s, scenario.slot_path(first, s.node, s.placed_sensor)) for s in setup.recorded_sensors
        ]
        # One path for each run.
        self._own: list[tuple[AssignedSensor, list[Any]]] = [
            (s, [scenario.slot_path(r, s.node, s.placed_sensor) for r in streams.per_replica])
            for s in setup.own_sensors
        ]
        # What is not linear is read by kernels: what a bad sensor gives instead, in each run.
        given, when = scenario.given_readings, scenario.slot_plant.slot_time
        self._bad: list[tuple[AssignedSensor, list[FaultyReadings]]] = [
            (s, [given(None, r, s.node, s.placed_sensor, when) for r in streams.per_replica])
            for s in setup.nonlinear_sensors
            if scenario.fault_of(s.node, s.placed_sensor) is not None
        ]

    def draw(
        self, times: SlotTimes, local: FloatArray, rebased: np.ndarray
    ) -> tuple[FloatArray, FloatArray]:
        """Draw whitened readings (B, S, H, p, L) at states ``local`` (B, S, n, L), and their H."""
        setup, count = self._setup, local.shape[1]
        shape = self._blocks, count, setup.estimators, setup.p
        y: FloatArray = unset((*shape, LANES))
        H: FloatArray = setup.H
        if setup.varies:
            H = unset((*shape, setup.columns.width, LANES))
            H[:] = setup.H
        x = local
        if rebased.any() and setup.algorithm.timing.predicts:
            # The origin moves before the reading: the state in the new frame is 0.
            x = local.copy()
            x[:, rebased] = 0.0
        # The states from which sensors with a random H draw it.
        k = setup.sensors.C.shape[2]
        regressors: FloatArray = unset((len(self._regressors), self._blocks, count, k, LANES))
        for path, (steps, states) in zip(regressors, self._regressors, strict=True):
            draw_path(steps, states, path, path)
        noise, scratch = self._noise, np.zeros((setup.p, LANES))
        draw_readings(MANY, setup.sensors, noise, normal_ziggurat(), x, regressors, scratch, y, H)
        if setup.nonlinear is not None:
            self._add_nonlinear(setup.nonlinear, times, x, y)
        self._give_bad_readings(times, y)
        if (self._recorded or self._own) and times.sensed.any():
            self._read_in_python(times, x, y, H)
        if self._lives:
            self._silence(times, y, H)
        return y, H

    def _add_nonlinear(
        self, rows: NonlinearSetup, times: SlotTimes, x: FloatArray, y: FloatArray
    ) -> None:
        """Add to the noise in ``y`` what sensors read at ``x`` that are not linear."""
        assert self.nonlinear is not None
        believed = self._scenario.origin_response
        if believed is not None:
            origin = believed.states(np.arange(times.first, times.first + len(times.start)))
            self.nonlinear.origin = self._drawn.origin = origin
            if self.pairs is not None:
                self.pairs.rows.origin = origin
        flat_y = y.reshape(-1, *y.shape[3:])
        add_values(self._drawn, x, flat_y, self._setup.places, self._setup.drawn.drawn)
        rows.raise_error()

    def _give_bad_readings(self, times: SlotTimes, y: FloatArray) -> None:
        """Write what sensors that are bad, and not linear, give in place of their readings."""
        for k in np.flatnonzero(times.sensed).tolist() if self._bad else ():
            for s, given in self._bad:
                readings = y[:, k, s.estimator, s.row : s.row + s.rows]
                for run, bad in enumerate(given):
                    b, lane = divmod(run, LANES)
                    healthy = readings[b, :, lane].copy()
                    readings[b, :, lane] = bad.given(times.first + k, healthy)

    def _silence(self, times: SlotTimes, y: FloatArray, H: FloatArray) -> None:
        """Take away the readings of nodes that are down."""
        setup = self._setup
        steps = step_times(self._scenario, setup, times.first, len(times.start))
        for r, lives in enumerate(self._lives):
            down = absent(setup, lives, steps)
            b, lane = divmod(r, LANES)
            for s in setup.assigned:
                gone = down[:, self._scenario.topology.index[s.node]]
                rows = slice(s.row, s.row + s.rows)
                # What is not linear is read at estimates, unless there is no value.
                y[b, :, s.estimator, rows, lane][gone] = (
                    np.nan if s in setup.nonlinear_sensors else 0.0
                )
                H[b, :, s.estimator, rows, :, lane][gone] = 0.0

    def _read_in_python(
        self, times: SlotTimes, x: FloatArray, y: FloatArray, H: FloatArray
    ) -> None:
        """Write what recorded sensors and those of users read in S slots."""
        slots = (times.first + np.flatnonzero(times.sensed)).tolist()
        for s, paths in self._own:
            rows = slice(s.row, s.row + s.rows)
            y[:, times.sensed, s.estimator, rows] = 0.0  # in lanes without a run
            place = self._setup.block_beside(s)
            for run, path in enumerate(paths):
                b, lane = divmod(run, LANES)
                read, of_all = read_whitened(path, slots, x[b, times.sensed, :, lane], s.R, s.root)
                own = read, self._setup.columns.of(s.estimator, of_all, place)
                for out, values in zip((y, H), own, strict=True):
                    out[b, times.sensed, s.estimator, rows, ..., lane] = values
        self._make_room(len(times.start))
        for s, path in self._recorded:
            if s.pair >= 0:
                self._read_pairs(s, path, times, y, H)
            elif s in self._setup.nonlinear_sensors:
                self._read_nonlinear(s, path, times, y, H)
            else:
                # L^-1 y and L^-1 H, with the R = L L' that filters believe; the same in all runs.
                whitened_y, whitened_H = path.whitened(slots, s.R, s.rows)
                rows = slice(s.row, s.row + s.rows)
                y[:, times.sensed, s.estimator, rows] = whitened_y[..., None]
                own_H = self._setup.columns.of(s.estimator, whitened_H)
                H[:, times.sensed, s.estimator, rows] = own_H[..., None]

    def _make_room(self, count: int) -> None:
        """Make room for what records say of the rows and the pairs of ``count`` slots."""
        pairs, nonlinear = self.pairs, self.nonlinear
        is_recorded = any(s in self._setup.nonlinear_sensors for s, _ in self._recorded)
        if nonlinear is not None and is_recorded and len(nonlinear.R) != count:
            nonlinear.R = np.repeat(nonlinear.R[:1], count, axis=0)
        if pairs is None or all(s.pair < 0 for s, _ in self._recorded):
            return
        pairs.block = np.repeat(pairs.block[:1], count, axis=0)
        pairs.rows.R = np.repeat(pairs.rows.R[:1], count, axis=0)
        for s, _ in self._recorded:
            if s.pair >= 0:
                pairs.block[:, s.pair : s.pair + s.rows // len(s.R)] = -1

    def _read_pairs(
        self, s: AssignedSensor, path: Any, times: SlotTimes, y: FloatArray, H: FloatArray
    ) -> None:
        """Write the recorded values of a sensor that reads pairs."""
        columns, pairs, h, p = self._setup.columns, self.pairs, s.estimator, len(s.R)
        assert pairs is not None
        sensor: Any = self._scenario.located_sensors[s.placed_sensor.entry]
        believed = self._scenario.origin_response
        y[:, times.sensed, h, s.row : s.row + s.rows] = 0.0 if sensor.linear else np.nan
        for k in np.flatnonzero(times.sensed).tolist():
            for m, (values, anchor, R) in enumerate(path.readings_at(times.first + k, s.R)):
                place = columns.of_reading(h, sensor, anchor)
                pair, first = s.pair + m, s.row + m * p
                if place is not None:
                    first = int(pairs.row[pair])
                    pairs.block[k, pair] = columns.number(place)
                if sensor.linear:
                    matrix, z = matrix_of(sensor, anchor, self._setup.n), values
                    if believed is not None:
                        z = values - matrix @ believed.states(np.array([times.first + k]))[0]
                    self._write_linear(s, k, first, (z, matrix, R), place, y, H)
                elif place is None:
                    self._write_nonlinear(s, k, first, (values, anchor, R), y, H)
                else:
                    y[:, k, h, first : first + p] = values[:, None]
                    pairs.rows.R[k, pair, :p, :p] = R

    def _write_linear(
        self,
        s: AssignedSensor,
        k: int,
        first: int,
        reading: tuple[FloatArray, FloatArray, FloatArray],
        place: Place | None,
        y: FloatArray,
        H: FloatArray,
    ) -> None:
        """Write a ``reading`` of slot k, values, H and R, whitened into the rows from ``first`` on,
        which is also about the block ``place``; values that are nan are missing.
        """
        (values, matrix, R), h, p = reading, s.estimator, len(s.R)
        there = np.isfinite(values)
        both = np.column_stack([values, matrix])[there]
        white = solve_lower(cholesky(R[there][:, there]), both)
        y[:, k, h, first : first + p], H[:, k, h, first : first + p] = 0.0, 0.0
        rows = slice(first, first + len(white))
        y[:, k, h, rows] = white[:, :1]
        H[:, k, h, rows] = self._setup.columns.of(h, white[:, 1:], place)[..., None]

    def _read_nonlinear(
        self, s: AssignedSensor, path: Any, times: SlotTimes, y: FloatArray, H: FloatArray
    ) -> None:
        """Write recorded values of a nonlinear sensor, their origins, and covariances."""
        y[:, times.sensed, s.estimator, s.row : s.row + s.rows] = np.nan
        for k in np.flatnonzero(times.sensed).tolist():
            for m, reading in enumerate(path.readings_at(times.first + k, s.R)):
                self._write_nonlinear(s, k, s.row + m * len(s.R), reading, y, H)

    def _write_nonlinear(
        self,
        s: AssignedSensor,
        k: int,
        first: int,
        reading: tuple[FloatArray, int, FloatArray],
        y: FloatArray,
        H: FloatArray,
    ) -> None:
        """Write a ``reading`` of slot k, values, anchor and R, into the rows from ``first`` on."""
        (values, anchor, R), setup, nonlinear = reading, self._setup.nonlinear, self.nonlinear
        assert nonlinear is not None
        assert setup is not None
        sensor: Any = self._scenario.located_sensors[s.placed_sensor.entry]
        rows = slice(first, first + len(s.R))
        place = setup.reference(sensor, s.node if anchor < 0 else anchor, s.estimator)
        y[:, k, s.estimator, rows] = values[:, None]
        H[:, k, s.estimator, rows, : len(place)] = place[:, None]
        nonlinear.R[k, s.estimator, rows, rows] = R
