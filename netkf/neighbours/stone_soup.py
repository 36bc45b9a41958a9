"""A run as objects of Stone Soup: ground truth paths, detections and tracks."""

from __future__ import annotations

import datetime
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from netkf.core.errors import ScenarioError
from netkf.core.extras import require
from netkf.linalg.arrays import FloatArray
from netkf.runs.files import require_run
from netkf.runs.readings import collect_readings
from netkf.runs.simulate import ENGINES
from netkf.trace.run import Run

START = datetime.datetime(2000, 1, 1)
"""The time of simulated 0, unless another is given."""


class StoneSoupRun(NamedTuple):
    """A run as Stone Soup has it: sets of GroundTruthPath, Detection and Track."""

    truths: set[Any]
    detections: set[Any]
    tracks: set[Any]


def to_stonesoup(run: Run, start: datetime.datetime | None = None) -> StoneSoupRun:
    """Return a run as objects of Stone Soup, see ``Run.to_stonesoup``."""
    scenario = require_run(run)
    if start is not None and not isinstance(start, datetime.datetime):
        raise ScenarioError(
            "start", "must be a datetime", start, "give datetime.datetime(2000, 1, 1)"
        )
    stamps = [_stamp(t, start) for t in run.times.tolist()]
    if len(set(stamps)) < len(stamps):
        rule = "must be a microsecond apart, which the times of Stone Soup resolve"
        raise ScenarioError("times", rule, None, "choose a longer probe")
    types, path = _import("types.state"), _import("types.groundtruth").GroundTruthPath
    track, truths, tracks = _import("types.track").Track, set(), set()
    for place in scenario.layout.places:
        if run.truth_known:
            states = _states(types.State, stamps, run.x[:, place.entries])
            truths.add(path(states, id=place.label))
        for k, node in enumerate(run.nodes):
            places = scenario.estimated[k]
            if place not in places:
                continue
            first = sum(one.n for one in places[: places.index(place)])
            own = slice(first, first + place.n)
            P = run.P[:, k, own, own]
            # Some filters have no covariance.
            made = (types.GaussianState, P) if np.isfinite(P).all() else (types.State,)
            states = _states(made[0], stamps, run.xhat[:, k, own], *made[1:])
            about = {"node": node, "block": place.name, "owner": place.node}
            tracks.add(track(states, init_metadata=about))
    return StoneSoupRun(truths, _detections(run, start), tracks)


def _import(name: str) -> Any:
    return require(f"stonesoup.{name}", "neighbours", "to_stonesoup")


def _stamp(t: float, start: datetime.datetime | None) -> datetime.datetime:
    return (start or START) + datetime.timedelta(microseconds=round(t * 1e6))


def _states(make: Any, stamps: list[Any], *columns: FloatArray) -> list[Any]:
    """Return what ``make`` makes of rows of ``columns`` (T, ...) where the first is finite."""
    rows = zip(stamps, *columns, strict=True)
    return [make(*row, timestamp=t) for t, *row in rows if np.isfinite(row[0]).all()]


def _detections(run: Run, start: datetime.datetime | None) -> set[Any]:
    scenario = run.scenario
    placed = scenario.placed_sensors if scenario.slotted else scenario.sampled_sensors
    engine = run.engine if run.engine in ENGINES else "auto"
    found = collect_readings(scenario, run.seed, run.replica, placed, all_slots=True, engine=engine)
    detection = _import("types.detection").Detection
    detections = set()
    for one in found.readings:
        origin, y = found.origin[one.number], one.y
        if isinstance(one.H, np.ndarray):
            # Readings are counted without the response to an input that filters know.
            y = y + one.H @ origin
        model = _model_class()(
            ndim_state=scenario.plant.n,
            mapping=(),
            noise_covar=one.R,
            reading=one.H,
            origin=origin[:, None],
        )
        detections.add(
            detection(
                _with_angles(y[:, None], one.H),
                timestamp=_stamp(float(found.times[one.number]), start),
                measurement_model=model,
                metadata={"node": one.node, "sensor": one.placed.ordinal},
            )
        )
    return detections


def _with_angles(y: FloatArray, H: Any) -> Any:
    """Return readings (p, k) with angles of Stone Soup, which subtracts and averages them as such:
    where H is a function that finds no difference between readings a turn apart.
    """
    if isinstance(H, np.ndarray):
        return y
    turns = 2.0 * np.pi * np.eye(len(y))
    angles = [abs(H.difference(one, 0.0 * one)[k]) < 1.0 for k, one in enumerate(turns)]
    marked = y.astype(object if any(angles) else float)
    for k in np.flatnonzero(angles):
        marked[k] = [_import("types.angle").Bearing(value) for value in y[k]]
    return marked


@cache
def _model_class() -> Any:
    """Return a measurement model of Stone Soup for entries of x, or for one kind of radar."""
    base, types = _import("base"), _import("types.array")
    gaussian = _import("models.measurement.nonlinear").NonLinearGaussianMeasurement

    class Reading(gaussian):  # type: ignore[misc,valid-type]
        """``y = H x + v`` or ``y = h(x - origin) + v``; ``reading`` is H (p, n) or a Linearised
        of states without the known response ``origin`` (n, 1) to an input.
        """

        # Not an annotation: Python 3.14 hides those of this module, whose evaluation is postponed.
        reading = base.Property(Any, doc="H, or h with its Jacobian")
        origin = base.Property(Any, doc="what h takes off states")

        @property
        def ndim_meas(self) -> int:
            return len(self.noise_covar)

        def function(self, state: Any, noise: Any = False, **_: Any) -> Any:
            xs = np.asarray(state.state_vector, dtype=np.float64)
            H = self.reading
            is_linear = isinstance(H, np.ndarray)
            y = H @ xs if is_linear else np.column_stack([H.value(x) for x in (xs - self.origin).T])
            drawn = self.rvs(num_samples=xs.shape[1]) if noise is True else noise
            cls = types.StateVector if y.shape[1] == 1 else types.StateVectors
            return cls(_with_angles(y, H)) + (0 if drawn is False or drawn is None else drawn)

        def jacobian(self, state: Any, **_: Any) -> FloatArray:
            if isinstance(self.reading, np.ndarray):
                return self.reading
            x = (np.asarray(state.state_vector, dtype=np.float64) - self.origin)[:, 0]
            jacobian: FloatArray = self.reading(self.reading.value(x), x)[1]
            return jacobian

        def matrix(self, **_: Any) -> FloatArray:
            matrix: FloatArray = self.reading
            return matrix

    return Reading
