"""Promises about the sign-of-innovations filter: what a bit is worth."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

from netkf.checks.evidence import Assumption, Promise
from netkf.checks.exact import max_replayed, summarise_exactly
from netkf.checks.paper import PaperChecks
from netkf.checks.points import checked_samples, sampled_indices
from netkf.checks.samples import ReplicaSummary, check_replay
from netkf.core.errors import TheoryError
from netkf.scenario.scenario import Scenario
from netkf.theory.one_bit.covariances import bit_covariances
from netkf.trace.run import Run

WORTH = Promise(
    "a bit lowers P by 2/pi of what its reading would, along the bits of each run",
    "Ribeiro et al. 2006",
    (),
    check_replay,
    exact=True,
)


class BitChecks(PaperChecks):
    """The promise about covariances; there is none about errors, which are not Gaussian and whose
    covariance P only approximates.
    """

    slots_only: ClassVar[bool] = True

    def summarise(self, scenario: Scenario, run: Run) -> ReplicaSummary:
        """Return what the test needs of one ``run``."""
        summary = summarise_exactly(scenario, run)
        if run.replica >= max_replayed(scenario):
            return summary
        at, sampled = checked_samples(scenario, run.times), sampled_indices(scenario)
        try:
            P = bit_covariances(scenario, run)[at][:, sampled]
        except TheoryError:  # H differs from slot to slot: the row says that nothing was replayed
            return summary
        return dataclasses.replace(summary, replayed=P)

    def assumptions(self, scenario: Scenario) -> list[Assumption]:
        """Return no assumptions: P depends on nothing but the bits that arrived."""
        return []

    def promises(self, scenario: Scenario) -> tuple[Promise, ...]:
        """Return the promises about a scenario."""
        return (WORTH,)


CHECKS = BitChecks()
