"""netkf: a discrete-event, asynchronous network simulator for distributed Kalman filters."""

from __future__ import annotations

import importlib

from netkf.core.errors import EngineError as EngineError
from netkf.core.errors import NetkfError as NetkfError
from netkf.core.errors import ScenarioError as ScenarioError
from netkf.core.errors import TheoryError as TheoryError
from netkf.core.version import __version__ as __version__
from netkf.core.wings import WINGS

TYPE_CHECKING = False
"""Type checkers take it as True. It is not imported from ``typing``, because that import takes half
of the time in which a command of netkf does not handle signals yet.
"""
if TYPE_CHECKING:
    from typing import Any

    from netkf import parts as parts
    from netkf import testing as testing
    from netkf import theory as theory
    from netkf.checks.check import check as check
    from netkf.ensembles.monte_carlo import Ensemble as Ensemble
    from netkf.ensembles.monte_carlo import monte_carlo as monte_carlo
    from netkf.figures.catalogue import plot as plot
    from netkf.logs.exporting import export_log as export_log
    from netkf.logs.exporting import export_recorded as export_recorded
    from netkf.logs.fitting import fit_log as fit_log
    from netkf.logs.importing import import_log as import_log
    from netkf.neighbours.datasets import export_netcdf as export_netcdf
    from netkf.neighbours.graphml import export_graphml as export_graphml
    from netkf.neighbours.models import from_control as from_control
    from netkf.neighbours.models import from_filterpy as from_filterpy
    from netkf.neighbours.perfetto import export_perfetto as export_perfetto
    from netkf.report.embedded import page as page
    from netkf.runs.readings import held_out_errors as held_out_errors
    from netkf.runs.run import save as save
    from netkf.runs.simulate import simulate as simulate
    from netkf.scenario.model import Belief as Belief
    from netkf.scenario.model import Filtering as Filtering
    from netkf.scenario.model import Network as Network
    from netkf.scenario.reading import load as load
    from netkf.scenario.scenario import Scenario as Scenario
    from netkf.scenario.time_grid import Time as Time
    from netkf.studies.compare import compare as compare
    from netkf.studies.compare_filters import compare_filters as compare_filters
    from netkf.studies.consistency import consistency as consistency
    from netkf.studies.innovation_tests import innovations as innovations
    from netkf.studies.likelihood import fit_noise as fit_noise
    from netkf.studies.likelihood import log_likelihood as log_likelihood
    from netkf.studies.opening import open as open
    from netkf.studies.search import size as size
    from netkf.studies.sweep import sweep as sweep
    from netkf.studies.why import why as why
    from netkf.trace.run import Run as Run
    from netkf.trace.run import first_difference as first_difference

_MODULE_OF = {
    "Belief": "netkf.scenario.model",
    "Ensemble": "netkf.ensembles.monte_carlo",
    "Filtering": "netkf.scenario.model",
    "Network": "netkf.scenario.model",
    "Run": "netkf.trace.run",
    "Scenario": "netkf.scenario.scenario",
    "Time": "netkf.scenario.time_grid",
    "compare": "netkf.studies.compare",
    "compare_filters": "netkf.studies.compare_filters",
    "consistency": "netkf.studies.consistency",
    "export_graphml": "netkf.neighbours.graphml",
    "export_log": "netkf.logs.exporting",
    "export_netcdf": "netkf.neighbours.datasets",
    "export_perfetto": "netkf.neighbours.perfetto",
    "export_recorded": "netkf.logs.exporting",
    "first_difference": "netkf.trace.run",
    "fit_log": "netkf.logs.fitting",
    "fit_noise": "netkf.studies.likelihood",
    "from_control": "netkf.neighbours.models",
    "from_filterpy": "netkf.neighbours.models",
    "held_out_errors": "netkf.runs.readings",
    "import_log": "netkf.logs.importing",
    "innovations": "netkf.studies.innovation_tests",
    "load": "netkf.scenario.reading",
    "log_likelihood": "netkf.studies.likelihood",
    "check": "netkf.checks.check",
    "monte_carlo": "netkf.ensembles.monte_carlo",
    "open": "netkf.studies.opening",
    "page": "netkf.report.embedded",
    "parts": "netkf.parts",
    "plot": "netkf.figures.catalogue",
    "save": "netkf.runs.run",
    "simulate": "netkf.runs.simulate",
    "size": "netkf.studies.search",
    "sweep": "netkf.studies.sweep",
    "testing": "netkf.testing",
    "theory": "netkf.theory",
    "why": "netkf.studies.why",
}
"""The module of each public name that is imported at first use."""
_MODULES = ("parts", "testing", "theory")
"""The public names that are modules themselves."""

_ERRORS = ("EngineError", "NetkfError", "ScenarioError", "TheoryError")
# Without ``open``: ``from netkf import *`` must leave Python's own ``open`` alone.
__all__ = [name for name in sorted([*_ERRORS, *_MODULE_OF]) if name != "open"]


def _late(module: str, name: str) -> Any:
    """Return a function of a wing for the core, which is imported when it is called."""

    def call(*arguments: Any) -> Any:
        return getattr(importlib.import_module(module), name)(*arguments)

    return call


WINGS.promise_traces = _late("netkf.theory.traces", "theory_traces")
WINGS.draw = _late("netkf.figures.catalogue", "plot")
WINGS.to_xarray = _late("netkf.neighbours.datasets", "to_xarray")
WINGS.to_stonesoup = _late("netkf.neighbours.stone_soup", "to_stonesoup")


def __getattr__(name: str) -> Any:
    """Return a public name, which is imported at first use so that `import netkf` stays quick."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'netkf' has no attribute {name!r}")
    module = importlib.import_module(_MODULE_OF[name])
    return module if name in _MODULES else getattr(module, name)


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__", "open"])
