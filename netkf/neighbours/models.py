"""Scenarios from models of other libraries: python-control, scipy.signal and filterpy.

None of them is imported: a model is known by its attributes.
"""

from __future__ import annotations

from collections.abc import Mapping
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np

from netkf.core.errors import ScenarioError
from netkf.core.fields import covariance, definite_covariance, matrix, positive, vector
from netkf.core.printable import one_line
from netkf.core.stamps import EXACT
from netkf.linalg.arrays import FloatArray
from netkf.linalg.portable import noise_root
from netkf.plants.transitions import decimal_below
from netkf.scenario.reading import from_table, require_changes
from netkf.scenario.scenario import Scenario
from netkf.scenario.tables import change_table

SLOTS, SAMPLES, TIME_CONSTANTS = 100, 100, 20.0
"""Length of a run: slots, or samples over so many times 1 / |fastest eigenvalue|."""
Changes = Mapping[str, Any] | None


def from_control(
    system: Any, Q: Any = None, R: Any = None, changes: Changes = None, *, G: Any = None
) -> Scenario:
    """Return a scenario that runs from a linear ``system``: a StateSpace of python-control, an lti
    or dlti of scipy.signal, continuous or discrete.

    The state is driven by ``G w``, G (n, m), by default the identity, with the covariance ``Q``
    (m, m) of w, in continuous time its intensity; ``G=system.B`` is noise at the inputs, as
    ``control.lqe(system, Q, R)`` has it. ``R`` (p, p) is the covariance, or the intensity, of the
    noise of the outputs; by default both are identities, since a state space has no noise. If R is
    diagonal, node k reads output k, else node 0 reads all of them. States have the names that
    python-control has for them.

    The network is complete, and the filter ``central``, the Kalman filter of all readings.
    ``changes`` are values by key, as in ``netkf.load``, for what a state space does not say:
    ``{"network.graph": graph, "network.activation": ..., "filter": ..., "horizon": 20.0,
    "sensors.0.nodes": [3]}``. There is no input without a "plant.input", whose G is ``system.B`` by
    default.

    Raises ScenarioError for what is no state space, matrices of the wrong shape, a feedthrough D
    with an input, and what ``netkf.load`` refuses.
    """
    space = _as_space(system)
    A, C = (matrix(name, np.asarray(getattr(space, name))) for name in "AC")
    gain = np.eye(len(A)) if G is None else _shaped("G", matrix("G", np.atleast_2d(G)), len(A))
    hint = "correct it"
    if G is None and space is system:
        hint += ", or give G = system.B for noise at the inputs"
    given = np.eye(gain.shape[1]) if Q is None else np.atleast_2d(Q)
    noise = _shaped("Q", covariance("Q", given), gain.shape[1], hint)
    named = str(getattr(system, "name", None) or "")
    table: dict[str, Any] = {"name": named if named and "[" not in named else "system"}
    table |= _dynamics(space.dt, A, gain, noise)
    states = [str(label) for label in getattr(system, "state_labels", ())]
    if states and not any("[" in name for name in states):  # x[0], .. if nobody named them
        table["plant"]["states"] = states
    scenario = _scenario(table, C, np.eye(len(C)) if R is None else R, space.B, changes)
    if np.any(space.D) and getattr(scenario.plant, "input", None) is not None:
        rule = "feeds the input through to the readings, which netkf does not"
        remedy = "subtract D u from the outputs and set D = 0"
        raise ScenarioError("system.D", rule, np.asarray(space.D), remedy)
    return scenario


def _as_space(system: Any) -> Any:
    """Return ``system`` as a state space; raises ScenarioError if it is none."""
    space = system
    if not (hasattr(system, "A") and hasattr(system, "C")) and hasattr(system, "to_ss"):
        try:
            space = system.to_ss()
        except TypeError:  # responses by frequency have no state
            pass
        except (ValueError, NotImplementedError) as error:  # derivatives, or a library is missing
            rule = f"has no state space: {one_line(error)}".rstrip(".")
            raise ScenarioError("system", rule, type(system).__name__, "give one") from None
    if not all(hasattr(space, name) for name in ("A", "B", "C", "D", "dt")):
        remedy = "give control.ss(system), or one of scipy.signal.StateSpace"
        raise ScenarioError("system", "must be a state space", type(system).__name__, remedy)
    return space


def _dynamics(dt: Any, A: FloatArray, gain: FloatArray, noise: FloatArray) -> dict[str, Any]:
    """Return plant, horizon and probe: in continuous time where ``dt`` is None or 0."""
    if dt is None or (dt == 0 and dt is not False):
        fastest = float(np.abs(np.linalg.eigvals(A)).max()) or 1.0
        horizon = decimal_below(TIME_CONSTANTS / fastest)
        plant = {"kind": "diffusion", "A": A, "B": gain @ noise_root(noise)}
        probe = float(EXACT.divide(Decimal(repr(horizon)), SAMPLES))
        return {"plant": plant, "horizon": horizon, "probe": probe}
    table = _slots(1.0 if dt is True else dt)
    table["plant"] |= {"F": A, "Q": gain @ noise @ gain.T}
    return table


def from_filterpy(kf: Any, changes: Changes = None, *, period: float = 1.0) -> Scenario:
    """Return a scenario that runs from a linear Kalman filter of filterpy, with its F, Q, H and R,
    a ``period`` of seconds from one ``predict`` to the next.

    The state begins with the mean ``kf.x`` and the covariance ``kf.P``; each slot is one
    ``kf.predict()`` and one ``kf.update(z)``. Nodes, network, filter and ``changes`` are those of
    ``from_control``; the G of an input is ``kf.B`` by default.

    Raises ScenarioError for a filter without these matrices, such as an extended one, for one with
    fading memory (``alpha``) or correlated noises (``M``), and for what ``netkf.load`` refuses.
    """
    missing = [name for name in "FQHRxP" if getattr(kf, name, None) is None]
    if missing:
        rule = f"must have {', '.join(missing)}"
        remedy = "give a linear filter such as filterpy.kalman.KalmanFilter"
        raise ScenarioError("kf", rule, type(kf).__name__, remedy)
    if getattr(kf, "alpha", 1.0) != 1.0:
        raise ScenarioError("kf.alpha", "must be 1", kf.alpha, "netkf has no fading memory")
    if np.any(getattr(kf, "M", 0.0)):
        remedy = "netkf has no noises that plant and readings share"
        raise ScenarioError("kf.M", "must be 0", np.asarray(kf.M), remedy)
    table: dict[str, Any] = {"name": "filterpy", **_slots(period)}
    table["plant"] |= {
        "F": matrix("kf.F", np.atleast_2d(kf.F)),
        "Q": covariance("kf.Q", np.atleast_2d(kf.Q)),
        "mean": vector("kf.x", np.ravel(kf.x)),
        "cov": covariance("kf.P", np.atleast_2d(kf.P)),
    }
    H = matrix("kf.H", np.atleast_2d(kf.H))
    return _scenario(table, H, kf.R, getattr(kf, "B", None), changes)


def _shaped(key: str, value: FloatArray, rows: int, hint: str = "correct it") -> FloatArray:
    if len(value) != rows:
        raise ScenarioError(key, f"must have {rows} rows", value, hint)
    return value


def _slots(period: Any) -> dict[str, Any]:
    period = positive("period", period)
    horizon = float(EXACT.multiply(SLOTS, Decimal(repr(period))))
    return {"horizon": horizon, "probe": period, "plant": {"kind": "linear", "period": period}}


def _scenario(table: dict[str, Any], H: FloatArray, R: Any, B: Any, changes: Changes) -> Scenario:
    """Return the scenario of a ``table`` with outputs ``H x`` of noise ``R``, inputs ``B u``."""
    R = _shaped("R", definite_covariance("R", np.atleast_2d(R)), len(H))
    alone = np.count_nonzero(R - np.diag(np.diag(R))) == 0
    rows = [[k] for k in range(len(H))] if alone else [list(range(len(H)))]
    table |= {
        "format": 1,
        "sensors": [
            {"nodes": [node], "H": H[own], "R": R[np.ix_(own, own)]}
            for node, own in enumerate(rows)
        ],
        "network": {"graph": {"kind": "complete", "nodes": len(rows)}},
        "filter": {"kind": "central"},
    }
    table = change_table(table, require_changes(changes))
    plant = table["plant"]
    u = plant.get("input") if isinstance(plant, Mapping) else None
    if isinstance(u, Mapping) and B is not None:
        table["plant"] = {**plant, "input": {"G": np.asarray(B), **u}}
    return from_table(table, Path.cwd())
