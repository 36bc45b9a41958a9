"""netkf: a discrete-event, asynchronous network simulator for distributed Kalman filters."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from netkf.core.errors import EngineError, NetkfError, ScenarioError, TheoryError

if TYPE_CHECKING:
    from netkf import parts, testing, theory
    from netkf.experiments.checking.check import check
    from netkf.experiments.ensembles.monte_carlo import Ensemble, monte_carlo
    from netkf.experiments.run import save
    from netkf.experiments.simulate import simulate
    from netkf.experiments.studies.compare import compare
    from netkf.experiments.studies.consistency import consistency
    from netkf.experiments.studies.size import size
    from netkf.experiments.studies.sweep import sweep
    from netkf.scenario.reading import load
    from netkf.scenario.scenario import Belief, Filtering, Network, Scenario
    from netkf.trace.run import Run, first_difference

__version__ = "0.1.0"

_WHERE = {
    "Belief": "netkf.scenario.scenario",
    "Ensemble": "netkf.experiments.ensembles.monte_carlo",
    "Filtering": "netkf.scenario.scenario",
    "Network": "netkf.scenario.scenario",
    "Run": "netkf.trace.run",
    "Scenario": "netkf.scenario.scenario",
    "compare": "netkf.experiments.studies.compare",
    "consistency": "netkf.experiments.studies.consistency",
    "first_difference": "netkf.trace.run",
    "load": "netkf.scenario.reading",
    "check": "netkf.experiments.checking.check",
    "monte_carlo": "netkf.experiments.ensembles.monte_carlo",
    "parts": "netkf.parts",
    "save": "netkf.experiments.run",
    "simulate": "netkf.experiments.simulate",
    "size": "netkf.experiments.studies.size",
    "sweep": "netkf.experiments.studies.sweep",
    "testing": "netkf.testing",
    "theory": "netkf.theory",
}

_MODULES = ("parts", "testing", "theory")

__all__ = [
    "Belief",
    "EngineError",
    "Ensemble",
    "Filtering",
    "NetkfError",
    "Network",
    "Run",
    "Scenario",
    "ScenarioError",
    "TheoryError",
    "check",
    "compare",
    "consistency",
    "first_difference",
    "load",
    "monte_carlo",
    "parts",
    "save",
    "simulate",
    "size",
    "sweep",
    "testing",
    "theory",
]


def __getattr__(name: str) -> Any:
    # Imported at first use, so that `import netkf` stays quick.
    if name not in _WHERE:
        raise AttributeError(f"module 'netkf' has no attribute {name!r}")
    module = importlib.import_module(_WHERE[name])
    return module if name in _MODULES else getattr(module, name)


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
