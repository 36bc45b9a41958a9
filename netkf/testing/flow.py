"""Whether a filter in continuous time keeps its contract."""

from __future__ import annotations

from typing import Any

import numpy as np

from netkf.algorithms.flow import FlowModel, Reading
from netkf.algorithms.gains import longest_interval
from netkf.core.streams import Streams
from netkf.testing.filters import System, check_estimate, check_state_pickles, systems
from netkf.testing.watching import Watched, demand

HORIZON = 4.0
GAPS = ((1e-3, 0.02), (0.3, 0.5), (1.0, 2.0))
COMPOSES = 1e-6
ROUNDS = 3


def check_flow_filter(watched: Watched) -> None:
    """Flow, readings and messages on every system; see check_filter."""
    for system in systems(watched.part.inverts):
        nodes = [_model(system, sees) for sees in (True, False, True)]
        states = [watched.call("init", model, system.mean, system.cov) for model in nodes]
        n = len(system.M)
        for model, state in zip(nodes, states, strict=True):
            check_estimate(watched, state, n, "init")
            _composes(watched, state, n)
            _stretches(watched, model, state)
        check_state_pickles(watched, states[0])
        _rounds(watched, nodes, states, n)


def _model(system: System, sees: bool) -> FlowModel:
    H, R = (system.H, system.R) if sees else (system.H[:0], system.R[:0, :0])
    A = system.M - np.eye(len(system.M))
    interval = min(0.1, longest_interval(A, system.Q, H, R))
    return FlowModel(A, system.Q, H, R, HORIZON, interval)


def _composes(watched: Watched, state: Any, n: int) -> None:
    for first, second in GAPS:
        whole = watched.call("flow", state, first + second)
        parts = watched.call("flow", watched.call("flow", state, first), second)
        pairs = [check_estimate(watched, s, n, "flow") for s in (whole, parts)]
        for name, one, other in zip(("xhat", "P"), *pairs, strict=True):
            if one is None or other is None:
                continue
            apart = float(np.abs(one - other).max())
            size = max(float(np.abs(one).max()), float(np.abs(other).max()), 1e-300)
            demand(
                apart <= COMPOSES * size,
                f"{watched.name}.flow",
                "must compose over gaps, flow(a + b) = flow(b) after flow(a)",
                f"{name} that differs by {apart / size:.2g} of its size at a = {first:g} and "
                f"b = {second:g} s",
                "solve over the gap exactly, as FlowFilter.flow does, and keep no count of calls",
            )


def _stretches(watched: Watched, model: FlowModel, state: Any) -> None:
    if len(model.H):
        seconds = watched.call("stretch", state)
        demand(seconds > 0.0, f"{watched.name}.stretch", "must be above 0 seconds", seconds)


def _rounds(watched: Watched, nodes: list[FlowModel], states: list[Any], n: int) -> None:
    random = Streams(0).generator("testing")
    for k in range(ROUNDS):
        gap = min(0.05, *(model.interval for model in nodes))
        for i, model in enumerate(nodes):
            states[i] = watched.call("flow", states[i], gap)
            check_estimate(watched, states[i], n, "flow")
            if len(model.H):
                moments = random.normal(size=2 * len(model.H)) * np.sqrt(gap)
                states[i] = watched.call("measure", states[i], Reading(moments, gap))
                check_estimate(watched, states[i], n, "measure")
        if watched.part.talks:
            states = _exchange(watched, states, age=0.1 * k)
            for state in states:
                check_estimate(watched, state, n, "absorb")


def _exchange(watched: Watched, states: list[Any], age: float) -> list[Any]:
    """Node 1 hears both others where it may have two links, node 0 and 2 hear node 1."""
    payloads = [watched.call("emit", state) for state in states]
    middle = 2 if watched.part.largest_degree() >= 2.0 else 1
    edge = watched.part.weight(1, middle)
    inner = watched.part.weight(middle, 1)
    inboxes = [
        [(edge, payloads[1], age)],
        [(inner, payloads[0], age), (inner, payloads[2], 0.0)][:middle],
        [(edge, payloads[1], 0.0)] if middle == 2 else [],
    ]
    return [
        watched.call("absorb", state, inbox) if inbox else state
        for state, inbox in zip(states, inboxes, strict=True)
    ]
