"""What is checked of the filters of one paper."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from netkf.checks.evidence import Assumption, Promise
from netkf.checks.exact import few_errors, summarise_exactly
from netkf.checks.laws import exact_start
from netkf.checks.samples import ReplicaSummary, RunSamples
from netkf.scenario.scenario import Scenario
from netkf.trace.run import Run


def usual_assumptions(scenario: Scenario) -> list[Assumption]:
    """Return the assumptions of tests of exact errors: where filters start, how many errors."""
    return [exact_start(scenario), few_errors(scenario)]


@dataclass(frozen=True)
class PaperChecks:
    """The promises of one paper and what their tests need of each run.

    promises : ``promises(scenario)``, those that are tested for a scenario
    assumptions : ``assumptions(scenario)``, those of the tests beyond those of the paper itself,
                  each with whether it holds: a promise is tested only if those it ``needs`` hold
    summarise : ``summarise(scenario, run)``, what the tests need of one run with samples at
                ``probe_times``
    collect : ``collect(scenario, stacked, seed)`` returns what every test of a promise gets, of
              summaries whose fields have a first axis over the runs of ``seed``
    slots_only : the paper is about slots; under clocks only the equations are checked
    """

    promises: Callable[[Scenario], tuple[Promise, ...]]
    assumptions: Callable[[Scenario], list[Assumption]] = usual_assumptions
    summarise: Callable[[Scenario, Run], ReplicaSummary] = summarise_exactly
    collect: Callable[[Scenario, ReplicaSummary, int], RunSamples] = RunSamples
    slots_only: bool = False
