"""Filters against their equations, in slots and under clocks, and what their papers say of P.

Statements that are exact given the events of a run hold for every filter whose verbs are known;
papers about slots are checked by these under clocks.
"""

from __future__ import annotations

import contextlib
from dataclasses import replace

import numpy as np

from netkf.algorithms.traits import nothing_conserved
from netkf.checks.evidence import Assumption, Finding, Promise, compare_identities, find_unknown
from netkf.checks.exact import (
    check_bias,
    check_error_covariance,
    check_exact_covariance,
    check_expected_nees,
    check_nees_bound,
    check_upper_bound,
    max_replayed,
    summarise_exactly,
    with_promised_filter,
)
from netkf.checks.laws import exact_start
from netkf.checks.paper import PaperChecks
from netkf.checks.samples import (
    ReplicaSummary,
    RunSamples,
    check_replay,
    check_slots,
    checked_samples,
    sampled_indices,
)
from netkf.core.errors import TheoryError
from netkf.network.clocks import LinkClock
from netkf.scenario.records import unjudged_line
from netkf.scenario.scenario import Scenario
from netkf.theory.common.evidence import MEMORY, nonlinear_rows
from netkf.theory.one_bit.covariances import bit_covariances
from netkf.trace.run import Run

MASS_TOLERANCE = 1e-9  # drift of the total, relative: rounding of many exchanges

# What promises need: parts of names or sources in the table of assumptions, see ``Promise.needs``.
REACH, START, KNOWN = "exact errors are within reach", "the filters start", "the filters know"
NO_LOSS = "no message is lost"


def error_promises(
    source: str, needs: tuple[str, ...] = (REACH,), by: str = "the equations give them"
) -> tuple[Promise, Promise]:
    """Return the promises of a ``source`` that errors have the covariance known ``by``, no bias."""
    covariance = f"errors have the covariance that {by}"
    bias = "errors have no bias that the equations do not give them"
    return (
        Promise(covariance, source, needs, check_error_covariance),
        Promise(bias, source, needs, check_bias),
    )


FOLLOWS_EVENTS = Promise(
    "P follows the equations along the events of each run",
    "derived",
    (REACH,),
    check_replay,
    exact=True,
)
ERRORS = (
    *error_promises("derived"),
    Promise("NEES has the mean that exact errors say", "derived", (REACH,), check_expected_nees),
)
UPPER_BOUND = Promise(
    "P is at least the covariance of the error, given the events",
    "derived",
    (KNOWN, START, REACH, MEMORY),
    check_upper_bound,
    exact=True,
)
EXACT = Promise(
    "P is the covariance of the error, given the events",
    "Bar-Shalom and Campo 1986",
    (KNOWN, START, REACH, MEMORY),
    check_exact_covariance,
    exact=True,
)


def left_out(scenario: Scenario) -> tuple[Promise, ...]:
    """Return a row on nodes whose errors have no law, as what they follow is recorded; or none."""
    name, line = "errors of all blocks have a known law", unjudged_line(scenario)
    return (Promise(name, "netkf", (), lambda *_: find_unknown(line)),) if line else ()


def about_equations(*about_P: Promise, slots_only: bool = False) -> PaperChecks:
    """Return the checks of a filter's equations, and of promises about its P."""
    return PaperChecks(
        lambda scenario: (FOLLOWS_EVENTS, *about_P, *ERRORS, *left_out(scenario)),
        slots_only=slots_only,
    )


def design_of(scenario: Scenario) -> str:
    """Return how P of the promised filter compares with the covariance of its error by design."""
    in_slots, under_clocks = with_promised_filter(scenario).node_filter.analysis.P_by_design
    return in_slots if scenario.slotted else under_clocks


def _mass_conserved(samples: RunSamples, level: float) -> Finding:
    drift, scenario = np.abs(samples.runs.drift), samples.scenario
    message = f"drift of the totals in {samples.count} runs"
    # Every addition may add a rounding error. Running totals grow with every broadcast, and their
    # rounding remains in their differences.
    clock, terms = scenario.network.activation, 1.0
    if scenario.slotted:
        terms = float(check_slots(scenario)[-1] * len(scenario.nodes))
    elif isinstance(clock, LinkClock):
        rate = sum(clock.mean_rate(entity) for entity in clock.entities(scenario.topology))
        terms += scenario.horizon * float(np.nan_to_num(rate))
    # The drift is relative already.
    return compare_identities(drift, np.ones_like(drift), terms, MASS_TOLERANCE, message)


def mass_conserved(scenario: Scenario, source: str = "P (67), derived") -> tuple[Promise, ...]:
    """Return the promise of a ``source`` that exchanges conserve sums; none without such sums."""
    analysis = with_promised_filter(scenario).node_filter.analysis
    if analysis.conserved is nothing_conserved:
        return ()
    needs: tuple[str, ...] = (MEMORY,)
    if scenario.slotted and not analysis.conserves_despite_loss:
        needs = (MEMORY, "both directions of a link", "nodes are up")
    return (Promise("mass is conserved", source, needs, _mass_conserved, exact=True),)


def summarise_drift(scenario: Scenario, run: Run) -> ReplicaSummary:
    """Return the summary of a run with ``drift``, the largest relative one of conserved sums."""
    drift = [abs(total - start) / abs(start) for start, total in run.sums.values()]
    summary = summarise_exactly(scenario, run)
    summary.drift = max(drift, default=0.0)
    return summary


def _promises_under_clocks(scenario: Scenario) -> tuple[Promise, ...]:
    analysis, design = with_promised_filter(scenario).node_filter.analysis, design_of(scenario)
    # P of other papers' filters may leave something out (kcf), or is proved of one fusion (ici).
    proved = design in ("larger", "equal") or analysis.paper in ("", "gossip", "intermittent")
    bound = (EXACT if design == "equal" else UPPER_BOUND,) if proved and design != "smaller" else ()
    return (*mass_conserved(scenario), FOLLOWS_EVENTS, *bound, *ERRORS, *left_out(scenario))


UNDER_CLOCKS = PaperChecks(_promises_under_clocks, summarise=summarise_drift)
"""Filters under clocks whose papers are about slots, filters that hear nothing, and plants that
change.
"""


def _summarise_bits(scenario: Scenario, run: Run) -> ReplicaSummary:
    summary = summarise_exactly(scenario, run)
    if run.replica < max_replayed(scenario):
        at, sampled = checked_samples(scenario, run.times), sampled_indices(scenario)
        # If H differs from slot to slot, the row says that nothing was replayed.
        with contextlib.suppress(TheoryError):
            summary.replayed = bit_covariances(scenario, run)[at][:, sampled]
    return summary


BITS = Promise(
    "a bit lowers P by 2/pi of what its reading would, along the bits of each run",
    "Ribeiro et al. 2006",
    ("nodes are up",),
    check_replay,
    exact=True,
)
NEES_BOUND = Promise(
    "P is at least the second moment of the error: the mean NEES is at most n",
    "Battistelli et al. 2018, derived",
    (KNOWN, NO_LOSS, START),
    check_nees_bound,
)


def _follows_data(scenario: Scenario) -> tuple[Promise, ...]:
    rows = nonlinear_rows(scenario)
    promise, needs = "P and errors follow the equations", tuple(name for name, *_ in rows)
    evidence = rows[0][3]
    return (Promise(promise, "all papers", needs, lambda *_: find_unknown(evidence)),)


WITHOUT_PAPER = PaperChecks(
    _follows_data, lambda scenario: [Assumption(*row) for row in nonlinear_rows(scenario)]
)
"""Scenarios whose dynamics or readings are not linear: gains, P and errors follow the data, so that
no paper promises anything; their clocks, channels, noises and records are judged as everywhere.
"""
OF_EQUATIONS = {
    # On trees P is the covariance of the error.
    "belief_propagation": about_equations(
        replace(
            EXACT,
            source="Weiss and Freeman 2001, derived",
            needs=(KNOWN, "the graph has no loops", START, REACH, MEMORY),
        )
    ),
    # Of two nodes P is the covariance of the error.
    "block_cross_covariances": about_equations(
        replace(
            EXACT,
            source="Luft et al. 2018, derived",
            needs=(KNOWN, "no node has two neighbours", START, REACH),
        )
    ),
    "consensus_innovations": about_equations(
        replace(EXACT, source="Das and Moura 2017", needs=(KNOWN, NO_LOSS, START, REACH))
    ),
    # H (10) holds for any gains.
    "constant_gain": about_equations(UPPER_BOUND),
    "diffusion_kalman": about_equations(),
    "event_triggered": PaperChecks(
        lambda _: (NEES_BOUND,), lambda scenario: [exact_start(scenario)], slots_only=True
    ),
    "information_consensus": about_equations(
        replace(
            UPPER_BOUND,
            source="Battistelli and Chisci 2014, derived",
            needs=(KNOWN, "no reading counts more than once", "P_i(0) >=", REACH, MEMORY),
        ),
        slots_only=True,
    ),
    "kalman_consensus": about_equations(),
    # Errors are not Gaussian, and P only approximates their covariance.
    "one_bit": PaperChecks(
        lambda _: (BITS,), lambda _: [], summarise=_summarise_bits, slots_only=True
    ),
}
"""The checks of papers that promise nothing but equations and what P is, by the paper's name."""
