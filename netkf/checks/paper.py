"""The contract of the modules that check the promises of one paper."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar

from netkf.checks.evidence import Assumption, Promise
from netkf.checks.exact import summarise_exactly
from netkf.checks.samples import ReplicaSummary, RunSamples
from netkf.scenario.scenario import Scenario
from netkf.trace.run import Run


class PaperChecks(ABC):
    """The promises of one paper and what their tests need of each run.

    ``slots_only``: the paper is about slots; under clocks only the equations are checked.
    ``summary_type``: class of the summaries of runs.
    """

    slots_only: ClassVar[bool] = False
    summary_type: ClassVar[type[ReplicaSummary]] = ReplicaSummary

    def summarise(self, scenario: Scenario, run: Run) -> ReplicaSummary:
        """Return what the tests need of one ``run``, an instance of ``summary_type``; called once
        for each run, whose samples are at ``probe_times``.
        """
        return summarise_exactly(scenario, run)

    def collect(self, scenario: Scenario, stacked: Any, seed: int) -> RunSamples:
        """Return the object that every test of a promise gets; called once, after the last run.

        ``stacked`` is a ``summary_type`` with the summaries of all R runs: each field has a first
        axis of length R. ``seed`` is that of the runs; tests that simulate reference samples seed
        their random streams with it.
        """
        return RunSamples(scenario, stacked, seed)

    @abstractmethod
    def assumptions(self, scenario: Scenario) -> list[Assumption]:
        """Return the assumptions of the tests beyond those of the paper itself, each with whether
        it holds for the scenario: a promise is tested only if those that it ``needs`` hold.
        """

    @abstractmethod
    def promises(self, scenario: Scenario) -> tuple[Promise, ...]:
        """Return the promises of the paper that are tested for a scenario."""
