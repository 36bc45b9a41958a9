"""Runs and ensembles as xarray Datasets, and as netCDF files of these."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from netkf.core.errors import ScenarioError
from netkf.core.extras import require
from netkf.core.printable import NamedNode
from netkf.core.version import __version__
from netkf.ensembles.monte_carlo import Ensemble
from netkf.runs.files import output_file, this_process, write_atomically
from netkf.scenario.scenario import Scenario
from netkf.scenario.writing import resolve_defaults, to_toml
from netkf.trace.run import Run
from netkf.trace.schema import EVENT, KINDS

SAMPLE = ("time", "node")
MATRIX = (*SAMPLE, "state", "other_state")
"""Dimensions of P: entry [state, other_state] is their covariance."""
Variables = dict[str, tuple[Any, ...]]
"""Dimensions, values and attributes of each variable by its name."""


def to_xarray(result: Run | Ensemble) -> Any:
    """Return a run or an ensemble as an xarray Dataset, see ``Run.to_xarray``."""
    xarray = require("xarray", "xarray", "to_xarray")
    scenario = result.scenario
    is_run = isinstance(result, Run)
    n = (result.xhat if isinstance(result, Run) else result.mean_P).shape[-1]
    coordinates: Variables = {
        "time": (("time",), result.times, {"units": "s", "long_name": "simulated time"}),
        "node": (("node",), np.array(result.nodes, dtype=np.int64), {"long_name": "id of a node"}),
        "state": (("state",), np.arange(n)),
        "other_state": (("other_state",), np.arange(n)),
    }
    if any(isinstance(node, NamedNode) for node in result.nodes):
        coordinates["name"] = ("node",), np.array(list(map(str, result.nodes)))
    attributes = {
        "Conventions": "CF-1.11",
        "source": f"netkf {__version__}",
        "seed": result.seed,
        "engine": result.engine,
        "fingerprint": result.fingerprint,
        "truth_known": int(result.truth_known),
    }
    variables = _run_variables(result) if isinstance(result, Run) else _means(result)
    if isinstance(scenario, Scenario):
        attributes |= {"title": scenario.name, "comment": scenario.claim}
        text = to_toml({**resolve_defaults(scenario), "seed": result.seed})
        about = "the scenario, without the files that it names"
        variables["scenario"] = (), text, {"long_name": about}
        labels = {"long_name": "name and unit of the state"}
        coordinates["state_label"] = ("state",), np.array(scenario.state_labels[:n]), labels
        coordinates |= _coordinates_of_nodes(scenario, is_run)
    if isinstance(result, Run):
        attributes |= {
            "replica": result.replica,
            "status": result.status,
            "exact_errors": int(result.exact_errors),
            "sums": json.dumps(result.sums),
            "stats": json.dumps(result.stats),
        }
    else:
        counts = {"diverged": result.diverged, "events": result.events, **result.messages}
        attributes |= {"rounding_from": result.rounding_from, **counts}
    return xarray.Dataset(variables, coordinates, attributes)


def _coordinates_of_nodes(scenario: Scenario, is_run: bool) -> Variables:
    """Return coordinates of nodes that stay at one place and, of a run, the blocks of states."""
    found: Variables = {}
    points = scenario.topology.positions
    if points is not None:
        xy = np.array([points[node] for node in scenario.nodes])
        found |= {f"node_{axis}": (("node",), xy[:, k]) for k, axis in enumerate("xy")}
    if scenario.plants and is_run:
        along = ("state",) if scenario.views is None else ("entry",)
        blocks = [place.key for place in scenario.layout.places for _ in range(place.n)]
        found["block"] = along, np.array([name for name, _ in blocks])
        owners = np.array([int(owner) for _, owner in blocks], dtype=np.int64)
        found["owner"] = along, owners, {"long_name": "node that owns the block, -1 if all do"}
    return found


def _run_variables(run: Run) -> Variables:
    views = None if run.scenario is None else run.scenario.views
    truth = ("time", "state" if views is None else "entry")
    samples: Variables = {
        "x": (truth, run.x, {"long_name": "true state"}),
        "xhat": ((*SAMPLE, "state"), run.xhat, {"long_name": "estimate"}),
        "P": (MATRIX, run.P, {"long_name": "covariance that the filter claims"}),
        "error": ((*SAMPLE, "state"), run.error, {"long_name": "x - xhat"}),
        "sq_error": (SAMPLE, run.sq_error, {"long_name": "squared norm of the error"}),
        "nees": (SAMPLE, run.nees, {"long_name": "normalised estimation error squared"}),
    }
    if views is not None:
        table = np.full((len(views), run.xhat.shape[-1]), -1)
        for row, view in zip(table, views, strict=True):
            row[: len(view)] = view
        about = "entry of x that a state of a node is, -1 if none"
        samples["view"] = ("node", "state"), table, {"long_name": about}
    attributes: dict[str, dict[str, Any]] = {
        "t": {"units": "s", "long_name": "time of the event"},
        "age": {"units": "s", "long_name": "age of the message, nan if there is none"},
        "kind": {
            "flag_values": np.arange(len(KINDS), dtype=np.int8),
            "flag_meanings": " ".join(KINDS),
        },
    }
    for name in EVENT.names or ():
        values = run.log[name].astype(np.int8) if name == "kind" else run.log[name]
        samples[f"event_{name}"] = ("event",), values, attributes.get(name, {})
    return samples


def _means(ensemble: Ensemble) -> Variables:
    variables: Variables = {
        "runs": (("time",), ensemble.runs, {"long_name": "runs that have the sample"})
    }
    for name, dims, about in (
        ("P", MATRIX, "covariance that filters claim"),
        ("error", MATRIX, "products of the entries of x - xhat"),
        ("nees", SAMPLE, "normalised estimation error squared"),
    ):
        mean, se = getattr(ensemble, f"mean_{name}"), getattr(ensemble, f"se_{name}")
        variables[f"mean_{name}"] = dims, mean, {"long_name": f"mean over runs of {about}"}
        variables[f"se_{name}"] = dims, se, {"long_name": f"standard error of mean_{name}"}
    for k, name in enumerate(("square_error", "trace_P", "nees")):
        for kind, values in (("average", ensemble.average), ("se_average", ensemble.se_average)):
            text = {"long_name": f"{kind} of {name} over time and runs"}
            variables[f"{kind}_{name}"] = ("node",), values[:-1, k], text
            variables[f"{kind}_{name}_of_all"] = (), values[-1, k], text
    return variables


def export_netcdf(result: Run | Ensemble, out: str | Path) -> tuple[Path, ...]:
    """Write ``to_xarray()`` of a run or an ensemble as a netCDF file, and return its path: ``out``
    or, if that is a folder, ``out``/run.nc or ensemble.nc. ``xarray.load_dataset`` returns the same
    Dataset, to the bit.

    Raises ScenarioError without the extra ``xarray``, and WriteError.
    """
    if not isinstance(result, Run | Ensemble):
        raise ScenarioError("run", "must be a run or an ensemble", result, "take netkf.open(DIR)")
    require("h5netcdf", "xarray", "export")
    path = output_file(out, "run.nc" if isinstance(result, Run) else "ensemble.nc")
    dataset = to_xarray(result)
    with write_atomically(path, this_process()) as temporary:
        dataset.to_netcdf(temporary, engine="h5netcdf")
    return (path,)
