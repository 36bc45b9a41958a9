"""Check that a filter keeps its contract in both models of time."""

from __future__ import annotations

from typing import Any

import numpy as np

from netkf.algorithms.adapters import FlowAdapter, SlotAdapter, adapt
from netkf.algorithms.filter import CLOCKS, Filter, commutes
from netkf.algorithms.flow import FlowFilter
from netkf.algorithms.slot import SlotFilter
from netkf.linalg.arrays import FloatArray
from netkf.testing.parents import check_parent
from netkf.testing.shifts import all_trials, check_shift
from netkf.testing.watching import Watched, demand, make_part

MAX_DEGREE = 8  # weights are checked for all pairs of degrees up to this
PHASES = ("predict", "sense", "exchange")
FLAGS = (
    *("predicts", "pairwise", "one_way", "inverts", "talks", "pooled"),
    *("needs_samples", "newest_only"),
)


def check_filter(filter: Any, /, same_as_parent: bool | None = None, **settings: Any) -> None:
    """Check a filter, or a class with its ``settings``, against its contract on small random
    systems of one to three states, in slots and under each clock that the class says it knows.

    For every method: what it is given, states, payloads and the filter itself, stays as it was,
    also later; the same arguments give the same result; no global generator is used. Estimates are
    (n,); covariances are None, or (n, n), symmetric and positive semidefinite after every step.
    Weights are not negative and sum to at most 1. Filter and states survive pickle. ``predict``
    composes over gaps in continuous time. In slots the schedule is sound and an empty inbox is
    absorbed. What ``conserved`` names is conserved by an exchange without losses. A class that
    defines ``shift`` does the same with shifted data, shifted. FlowFilter and SlotFilter classes
    are checked through their adapters.

    A class that derives from a built-in filter and overrides anything (methods, class variables,
    weights, the first slot, private helpers) runs beside that filter, with the same settings, on
    the same readings and messages, in slots and under the clocks that both know. Estimates and
    covariances that differ by more than 1e-6 of their size are told, with the attributes that are
    its own: as AssertionError where the class only adjusts its parent, and as UserWarning where it
    defines one of ``init``, ``predict``, ``update``, ``emit``, ``absorb``, ``estimate`` itself,
    which may be by design. ``same_as_parent=False`` says that it is by design, and nothing is
    compared; ``same_as_parent=True`` makes every difference an AssertionError.

    Raises AssertionError with one line: the method, the rule, the value got, what to do.
    """
    part = make_part(filter, (Filter, FlowFilter, SlotFilter), settings)
    node_filter = adapt(part)
    watched = Watched(node_filter, part, former_names(node_filter))
    watched.pickle_copy()
    _class_variables(watched)
    if node_filter.talks:
        _check_weights(watched)
    if node_filter.schedule is not None:
        _check_schedule(watched)
    plain = list(all_trials(watched))
    for trial in plain:
        trial.run()
    if commutes(node_filter):
        check_shift(watched, plain)
    watched.finish()
    if isinstance(part, Filter):
        check_parent(watched, same_as_parent)


def former_names(node_filter: Filter) -> dict[str, str]:
    """Return the names that a former contract has for methods of the present one."""
    if isinstance(node_filter, FlowAdapter):
        return {"predict": "flow", "update": "measure", "max_measurement_interval": "stretch"}
    if isinstance(node_filter, SlotAdapter):
        return {"update": "sense", "schedule": "programme", "redraws_links": "redraws"}
    return {}


def _class_variables(watched: Watched) -> None:
    """Check the class variables that say where the filter runs."""
    part, name = watched.part, watched.name
    for flag in FLAGS:
        value = getattr(part, flag)
        demand(isinstance(value, bool), f"{name}.{flag}", "must be True or False", value)
    clocks = part.clocks
    known = isinstance(clocks, tuple) and set(clocks) <= set(CLOCKS)
    text = ", ".join(f'"{clock}"' for clock in CLOCKS)
    demand(known, f"{name}.clocks", f"must be a tuple of {text}", clocks)
    somewhere = bool(clocks) or part.schedule is not None or not part.talks
    rule = "must name a clock where schedule is None: the filter could not run at all"
    demand(somewhere, f"{name}.clocks", rule, clocks)
    first = part.first_slot
    whole = isinstance(first, int) and first >= 0
    demand(whole, f"{name}.first_slot", "must be a whole number of at least 0", first)


def _check_schedule(watched: Watched) -> None:
    """Check the phases of a slot and the numbers of their steps."""
    part, where = watched.part, f"{watched.name}.{watched.defined_name('schedule')}"
    schedule = part.schedule
    if isinstance(part, SlotAdapter):
        sound = set(schedule) <= {"exchange", "sense"} and schedule.count("sense") == 1
        demand(sound, where, 'must be a tuple of "exchange" and "sense" with one "sense"', schedule)
    else:
        known = isinstance(schedule, tuple) and set(schedule) <= set(PHASES)
        text = ", ".join(f'"{phase}"' for phase in PHASES)
        demand(known, where, f"must be None or a tuple of {text}", schedule)
        once = max(schedule.count("predict"), schedule.count("sense")) <= 1
        demand(once, where, 'must have one "predict" and one "sense" at most', schedule)
        _check_predicts(watched, schedule)
    for phase in range(schedule.count("exchange")):
        steps = watched.call("exchange_steps", phase)
        whole = isinstance(steps, int) and steps >= 1
        demand(whole, f"{watched.name}.steps", "must be a whole number of at least 1", steps)
        fresh = watched.call("redraws_links", phase, 0)
        redraws = f"{watched.name}.{watched.defined_name('redraws_links')}"
        demand(fresh is True, redraws, "must be True in step 0", fresh, "links have no outcome yet")


def _check_predicts(watched: Watched, schedule: tuple[str, ...]) -> None:
    """Check that ``predicts`` fits the order of "sense" and "predict"."""
    if not {"predict", "sense"} <= set(schedule):
        return
    ahead = schedule.index("sense") < schedule.index("predict")
    demand(
        watched.part.predicts is ahead,
        f"{watched.name}.predicts",
        'must be True where the schedule has "predict" after "sense", and False where before',
        watched.part.predicts,
        "else estimates are compared with the state of another slot",
    )


def _check_weights(watched: Watched) -> None:
    """Check the weights of a filter for all pairs of degrees."""
    part, where = watched.part, f"{watched.name}.weight"
    most = watched.call("largest_degree")
    demand(most >= 1.0, f"{watched.name}.largest_degree", "must be at least 1", most)
    given = part.pair_weights
    if given is not None:
        return _check_given_weights(watched, np.asarray(given))
    degrees = range(1, int(min(most, MAX_DEGREE)) + 1)
    for degree in degrees:
        found = [watched.call("weight", degree, peer) for peer in degrees]
        for peer, weight in zip(degrees, found, strict=True):
            number = isinstance(weight, (int, float, np.floating)) and 0.0 <= weight <= 1.0
            demand(
                number, where, f"must be a number from 0 to 1 for {degree} and {peer} links", weight
            )
        demand(
            degree * max(found) <= 1.0 + 1e-9,
            where,
            "the weights of all messages that may arrive together must sum to at most 1",
            f"{degree * max(found):.4g} at a node of {degree} links",
            "give smaller weights, or let largest_degree say how many links are allowed",
        )
    return None


def _check_given_weights(watched: Watched, weights: FloatArray) -> None:
    """Check a matrix of weights."""
    where = f"{watched.name}.pair_weights"
    square = weights.ndim == 2 and weights.shape[0] == weights.shape[1]
    demand(square, where, "must be a square matrix", str(weights.shape))
    demand((weights >= 0.0).all(), where, "must not be negative", float(weights.min()))
    sums = weights.sum(axis=0)
    demand(
        (sums <= 1.0 + 1e-9).all(),
        where,
        "columns, what a node gives, must sum to at most 1",
        sums,
        "entry [l, i] is the weight node i gives to what node l sends",
    )
