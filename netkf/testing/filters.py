"""Whether a filter keeps its contract: what both kinds of time share."""

from __future__ import annotations

import pickle
from typing import Any, NamedTuple

import numpy as np

from netkf.algorithms.adapters import FlowAdapter, SlotAdapter, adapt
from netkf.algorithms.filter import CLOCKS, Filter, commutes
from netkf.algorithms.flow import FlowFilter
from netkf.algorithms.slot import SlotFilter
from netkf.linalg.arrays import FloatArray
from netkf.rng.streams import Streams
from netkf.testing.watching import Watched, demand, difference, leaves, made

SYMMETRY, SEMIDEFINITE = 1e-9, 1e-9
MOST_LINKS = 8
PHASES = ("predict", "sense", "exchange")
FLAGS = (
    *("predicts", "pairwise", "one_way", "inverts", "talks", "pooled"),
    *("needs_samples", "newest_only"),
)


class System(NamedTuple):
    """A small random system: dynamics M and noise Q (n, n), a sensor H (p, n), R (p, p), and the
    law of x(0), mean (n,) and cov (n, n).
    """

    M: FloatArray
    Q: FloatArray
    H: FloatArray
    R: FloatArray
    mean: FloatArray
    cov: FloatArray


def check_filter(filter: Any, /, **settings: Any) -> None:
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

    Raises AssertionError with one line: the method, the rule, the value got, what to do.
    """
    from netkf.testing.shifts import check_shift
    from netkf.testing.trials import trials

    part = made(filter, (Filter, FlowFilter, SlotFilter), settings)
    hosted = adapt(part)
    watched = Watched(hosted, part, former_names(hosted))
    watched.pickled()
    _class_variables(watched)
    if hosted.talks:
        _weights(watched)
    if hosted.schedule is not None:
        _schedule(watched)
    plain = list(trials(watched))
    for trial in plain:
        trial.run()
    if commutes(hosted):
        check_shift(watched, plain)
    watched.finish()


def former_names(hosted: Filter) -> dict[str, str]:
    """How a class of a former contract calls the methods of the present one."""
    if isinstance(hosted, FlowAdapter):
        return {"predict": "flow", "update": "measure", "max_measurement_interval": "stretch"}
    if isinstance(hosted, SlotAdapter):
        return {"update": "sense", "schedule": "programme", "redraws_links": "redraws"}
    return {}


def systems(inverts: bool) -> list[System]:
    """Of 1, 2 and 3 states with 0, 1 and 2 readings, from a certain start and from an uncertain one
    where filters allow that.
    """
    random = Streams(0).generator("testing")
    found = []
    for n, p, certain in ((1, 1, False), (2, 1, True), (3, 0, False), (3, 2, False)):
        noise, spread = random.normal(size=(2, n, n))
        eye = np.eye(n)
        found.append(
            System(
                M=0.8 * eye + 0.3 * random.normal(size=(n, n)) / np.sqrt(n),
                Q=noise @ noise.T / n + 0.1 * eye,
                H=random.normal(size=(p, n)),
                R=np.diag(random.uniform(0.5, 1.5, p)),
                mean=random.normal(size=n),
                cov=np.zeros((n, n)) if certain and not inverts else spread @ spread.T + eye,
            )
        )
    return found


def check_estimate(
    watched: Watched, state: Any, n: int, after: str
) -> tuple[FloatArray, FloatArray | None]:
    """``estimate`` after a method: shapes, finite; P None, or symmetric, positive semidefinite."""
    where = f"{watched.name}.estimate after {watched.spoken(after)}"
    pair = watched.call("estimate", state)
    demand(isinstance(pair, tuple) and len(pair) == 2, where, "must be (xhat, P)", pair)
    xhat = np.asarray(pair[0])
    _check_array(where, "xhat", xhat, (n,))
    if pair[1] is None:
        return xhat, None
    P = np.asarray(pair[1])
    _check_array(where, "P", P, (n, n))
    _check_covariance(where, P)
    return xhat, P


def _check_array(where: str, name: str, array: Any, shape: tuple[int, ...]) -> None:
    demand(array.shape == shape, where, f"{name} must have the shape {shape}", str(array.shape))
    demand(array.dtype == np.float64, where, f"{name} must be float64", str(array.dtype))
    remedy = "return None where the filter has no P" if name == "P" else ""
    demand(np.isfinite(array).all(), where, f"{name} must be finite", array, remedy)


def _check_covariance(where: str, P: FloatArray) -> None:
    size = max(float(np.abs(P).max()), np.finfo(float).tiny)
    skew = float(np.abs(P - P.T).max())
    demand(
        skew <= SYMMETRY * size,
        where,
        "P must be symmetric",
        f"P - P' of up to {skew:.3g}",
        "return 0.5 * (P + P.T)",
    )
    least = float(np.linalg.eigvalsh(P)[0])
    demand(
        least >= -SEMIDEFINITE * size,
        where,
        "P must be positive semidefinite",
        f"least eigenvalue {least:.4g}",
        "look for a sign, or for weights that sum to more than 1",
    )


def check_state_pickles(watched: Watched, state: Any) -> None:
    """A state that went through pickle shows the same estimate."""
    where = f"{watched.name}.init"
    try:
        copy = pickle.loads(pickle.dumps(state))
    except Exception as error:
        raise AssertionError(
            f"{where}: states must be picklable; got {type(error).__name__}: {error}; make the "
            "state a NamedTuple of arrays at the top level of a module"
        ) from error
    one, other = (dict(leaves(watched.part.estimate(s))) for s in (state, copy))
    demand(difference(one, other) is None, where, "states must be themselves after pickling")


def _class_variables(watched: Watched) -> None:
    """Where the class says it runs."""
    part, name = watched.part, watched.name
    for flag in FLAGS:
        value = getattr(part, flag)
        demand(isinstance(value, bool), f"{name}.{flag}", "must be True or False", value)
    clocks = part.clocks
    known = isinstance(clocks, tuple) and set(clocks) <= set(CLOCKS)
    words = ", ".join(f'"{clock}"' for clock in CLOCKS)
    demand(known, f"{name}.clocks", f"must be a tuple of {words}", clocks)
    somewhere = bool(clocks) or part.schedule is not None or not part.talks
    rule = "must name a clock where schedule is None: the filter could not run at all"
    demand(somewhere, f"{name}.clocks", rule, clocks)
    first = part.first_slot
    whole = isinstance(first, int) and first >= 0
    demand(whole, f"{name}.first_slot", "must be a whole number of at least 0", first)


def _schedule(watched: Watched) -> None:
    part, where = watched.part, f"{watched.name}.{watched.spoken('schedule')}"
    schedule = part.schedule
    if isinstance(part, SlotAdapter):
        sound = set(schedule) <= {"exchange", "sense"} and schedule.count("sense") == 1
        demand(sound, where, 'must be a tuple of "exchange" and "sense" with one "sense"', schedule)
    else:
        known = isinstance(schedule, tuple) and set(schedule) <= set(PHASES)
        words = ", ".join(f'"{phase}"' for phase in PHASES)
        demand(known, where, f"must be None or a tuple of {words}", schedule)
        once = max(schedule.count("predict"), schedule.count("sense")) <= 1
        demand(once, where, 'must have one "predict" and one "sense" at most', schedule)
        _check_predicts(watched, schedule)
    for phase in range(schedule.count("exchange")):
        steps = watched.call("steps", phase)
        whole = isinstance(steps, int) and steps >= 1
        demand(whole, f"{watched.name}.steps", "must be a whole number of at least 1", steps)
        fresh = watched.call("redraws_links", phase, 0)
        redraws = f"{watched.name}.{watched.spoken('redraws_links')}"
        demand(fresh is True, redraws, "must be True in step 0", fresh, "links have no outcome yet")


def _check_predicts(watched: Watched, schedule: tuple[str, ...]) -> None:
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


def _weights(watched: Watched) -> None:
    part, where = watched.part, f"{watched.name}.weight"
    most = watched.call("largest_degree")
    demand(most >= 1.0, f"{watched.name}.largest_degree", "must be at least 1", most)
    given = part.pair_weights
    if given is not None:
        return _given_weights(watched, np.asarray(given))
    degrees = range(1, int(min(most, MOST_LINKS)) + 1)
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


def _given_weights(watched: Watched, weights: FloatArray) -> None:
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
