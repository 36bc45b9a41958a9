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
        """Return the summary of a run whose samples are at ``check_times``."""
        return summarise_exactly(scenario, run)

    def collect(self, scenario: Scenario, stacked: Any, seed: int) -> RunSamples:
        """Return the samples that the tests take, from stacked summaries.

        ``seed`` is that of the runs; tests that draw reference samples derive theirs from it.
        """
        return RunSamples(scenario, stacked, seed)

    @abstractmethod
    def assumptions(self, scenario: Scenario) -> list[Assumption]:
        """Return the assumptions of the tests beyond those of the paper itself."""

    @abstractmethod
    def promises(self, scenario: Scenario) -> tuple[Promise, ...]:
        """Return the promises about a scenario."""
