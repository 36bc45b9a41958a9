"""A run as objects of Stone Soup: ground truth paths, detections and tracks."""

from __future__ import annotations

import datetime
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from netkf.core.errors import ScenarioError
from netkf.core.extras import require
from netkf.linalg.arrays import FloatArray
from netkf.neighbours.files import require_run
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
    _import("types.state")
    stamps = [_stamp(t, start) for t in run.times.tolist()]
    if len(set(stamps)) < len(stamps):
        rule = "must be a microsecond apart, which the times of Stone Soup resolve"
        raise ScenarioError("times", rule, None, "choose a longer probe")
    truths, tracks = set(), set()
    for place in scenario.layout.places:
        about = {"block": place.name, "owner": place.node}
        if run.truth_known:
            truths.add(_truth(run.x[:, place.entries], stamps, place.label, about))
        for k, node in enumerate(run.nodes):
            places = scenario.estimated[k]
            if place in places:
                first = sum(one.n for one in places[: places.index(place)])
                own = slice(first, first + place.n)
                metadata = {"node": node, **about}
                tracks.add(_track(run.xhat[:, k, own], run.P[:, k, own, own], stamps, metadata))
    return StoneSoupRun(truths, _detections(run, start), tracks)


def _import(name: str) -> Any:
    return require(f"stonesoup.{name}", "neighbours", "to_stonesoup")


def _stamp(t: float, start: datetime.datetime | None) -> datetime.datetime:
    return (start or START) + datetime.timedelta(microseconds=round(t * 1e6))


def _truth(x: FloatArray, stamps: list[Any], label: str, about: dict[str, Any]) -> Any:
    types = _import("types.groundtruth")
    states = [
        types.GroundTruthState(row, timestamp=t, metadata=about)
        for row, t in zip(x, stamps, strict=True)
        if np.isfinite(row).all()
    ]
    return types.GroundTruthPath(states, id=label)


def _track(xhat: FloatArray, P: FloatArray, stamps: list[Any], about: dict[str, Any]) -> Any:
    """Return the track of estimates (T, n) with their covariances (T, n, n), nan for none."""
    types = _import("types.state")
    states = [
        types.GaussianState(row, cov, timestamp=t)
        if np.isfinite(cov).all()
        else types.State(row, timestamp=t)
        for row, cov, t in zip(xhat, P, stamps, strict=True)
        if np.isfinite(row).all()
    ]
    return _import("types.track").Track(states, init_metadata=about)


def _detections(run: Run, start: datetime.datetime | None) -> set[Any]:
    """Return a detection for each reading of the run, with its model of the whole state."""
    scenario = run.scenario
    placed = scenario.placed_sensors if scenario.slotted else scenario.sampled_sensors
    engine = run.engine if run.engine in ENGINES else "auto"
    found = collect_readings(scenario, run.seed, run.replica, placed, all_slots=True, engine=engine)
    detection, models = _import("types.detection").Detection, {}
    detections = set()
    for one in found.readings:
        origin, y = found.origin[one.number], one.y
        key: tuple[Any, ...] = (one.node, one.placed.ordinal, one.rows.tobytes(), one.R.tobytes())
        is_linear = isinstance(one.H, np.ndarray)
        if is_linear:
            # Readings are counted without the response to an input that filters know.
            y, key = y + one.H @ origin, (*key, one.H.tobytes())
        if key not in models:
            cls = _linear_model() if is_linear else _nonlinear_model()
            about = {"ndim_state": scenario.plant.n, "mapping": (), "noise_covar": one.R}
            models[key] = cls(reading=one.H, **about)
        detections.add(
            detection(
                y,
                timestamp=_stamp(float(found.times[one.number]), start),
                measurement_model=models[key],
                metadata={"node": one.node, "sensor": one.placed.ordinal},
            )
        )
    return detections


@cache
def _linear_model() -> Any:
    """Return a class of Stone Soup's linear models with any H (p, n) as ``reading``."""
    base, linear = _import("base"), _import("models.measurement.linear")

    class LinearReading(linear.LinearGaussian):  # type: ignore[name-defined,misc]
        """``y = H x + v`` with H (p, n) as ``reading``."""

        reading: Any = base.Property(doc="H (p, n)")

        @property
        def ndim_meas(self) -> int:
            return len(self.reading)

        def matrix(self, **_: Any) -> FloatArray:
            matrix: FloatArray = self.reading
            return matrix

    return LinearReading


@cache
def _nonlinear_model() -> Any:
    """Return a class of Stone Soup's nonlinear models with any h(x) as ``reading``, a
    ``plants.nonlinear.Linearised``.
    """
    base, types = _import("base"), _import("types.array")
    nonlinear = _import("models.measurement.nonlinear")

    class Reading(nonlinear.NonLinearGaussianMeasurement):  # type: ignore[name-defined,misc]
        """``y = h(x) + v``."""

        reading: Any = base.Property(doc="h and its Jacobian")

        @property
        def ndim_meas(self) -> int:
            return int(self.reading.size)

        def function(self, state: Any, noise: Any = False, **_: Any) -> Any:
            vectors = np.asarray(state.state_vector, dtype=np.float64)
            values = np.column_stack([self.reading.value(x) for x in vectors.T])
            drawn = self.rvs(num_samples=vectors.shape[1]) if noise is True else noise
            cls = types.StateVector if values.shape[1] == 1 else types.StateVectors
            return cls(values) + (0 if drawn is False or drawn is None else drawn)

        def jacobian(self, state: Any, **_: Any) -> FloatArray:
            x = np.asarray(state.state_vector, dtype=np.float64)[:, 0]
            jacobian: FloatArray = self.reading(self.reading.value(x), x)[1]
            return jacobian

    return Reading
