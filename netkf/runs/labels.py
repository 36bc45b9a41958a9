"""What promises are called, in `netkf theory`, in tables and in pictures alike."""

from __future__ import annotations

from netkf.algorithms.registry import overridden
from netkf.scenario.scenario import Scenario
from netkf.theory.hybrid.coupled import has_balanced_rates


def limit_words(scenario: Scenario) -> str:
    """What the limit of the bound as links tick ever faster is for this scenario."""
    balanced = has_balanced_rates(scenario)
    words = "limit S of H(13)" if balanced else "weighted limit (not S of H(13))"
    return words + without_delay(scenario)


def without_delay(scenario: Scenario) -> str:
    """The limits leave delays out, and say so where there are any."""
    delayed = scenario.filter.algorithm.talks and scenario.network.channel.delay.fixed != 0.0
    return ", if messages took no time" if delayed else ""


def by_design(scenario: Scenario) -> str:
    """Whether the design of the filter makes P "larger" or "smaller" than the covariance of its
    error; empty if neither is known.
    """
    algorithm = scenario.filter.algorithm
    design = scenario.hosted.P_by_design[0 if scenario.slotted else 1]
    if overridden(algorithm) or not scenario.topology.links:
        return ""
    return "" if design == "larger" and not scenario.filters_know_the_truth else design


def nees_words(scenario: Scenario) -> str:
    """What NEES should be where P is not the covariance of the error by design; empty where it
    should be near n.
    """
    n, design = scenario.plant.n, by_design(scenario)
    if design == "smaller":
        return (
            "until others hear of its samples a node counts them as if all nodes had taken them: "
            f"P is too small there, NEES above n = {n} is right, and netkf consistency says what "
            "it should be"
        )
    if design == "larger":
        return (
            "this filter keeps P above the covariance of its error by design: NEES below "
            f"n = {n} is right, and netkf consistency says what it should be"
        )
    return ""


def mismatch_words(scenario: Scenario) -> str:
    """What P and its bound are worth where the filters believe another model; empty where not."""
    if scenario.filters_know_the_truth:
        return ""
    if not scenario.is_random:
        return "whether P fits the errors depends on the model: the state or readings are recorded"
    return "the filters' model differs from the truth: P and its bound need not bound the errors"
