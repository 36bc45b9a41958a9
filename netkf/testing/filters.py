"""Whether a filter keeps its contract: the part that both kinds of time share."""

from __future__ import annotations

import pickle
from typing import Any, NamedTuple

import numpy as np

from netkf.algorithms.flow import FlowFilter
from netkf.algorithms.slot import SlotFilter
from netkf.core.arrays import FloatArray
from netkf.core.streams import Streams
from netkf.testing.watching import Watched, demand, difference, leaves, made

SYMMETRY, SEMIDEFINITE = 1e-9, 1e-9
MOST_LINKS = 8


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
    systems of one to three states.

    For every method: what it is given, states, payloads and the filter itself, stays as it was,
    also later; the same arguments give the same result; no global generator is used. Estimates are
    (n,), covariances (n, n), symmetric and positive semidefinite after every step. Weights are not
    negative and sum to at most 1. Filter and states survive pickle. In continuous time ``flow``
    composes over gaps; in slots the programme is sound, an empty inbox is absorbed and what
    ``conserved`` names is conserved by an exchange without losses.

    Raises AssertionError with one line: the method, the rule, the value got, what to do.
    """
    from netkf.testing.flow import check_flow_filter
    from netkf.testing.slots import check_slot_filter

    part = made(filter, (FlowFilter, SlotFilter), settings)
    watched = Watched(part)
    watched.pickled()
    if part.talks:
        _weights(watched)
    if isinstance(part, FlowFilter):
        check_flow_filter(watched)
    else:
        check_slot_filter(watched)
    watched.finish()


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
    where = f"{watched.name}.estimate after {after}"
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
    demand(np.isfinite(array).all(), where, f"{name} must be finite", array)


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


def _weights(watched: Watched) -> None:
    part, where = watched.part, f"{watched.name}.weight"
    most = watched.call("largest_degree")
    demand(most >= 1.0, f"{watched.name}.largest_degree", "must be at least 1", most)
    given = getattr(part, "pair_weights", None)
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
