"""Moves of the origin that states and estimates are relative to, see plants/truth."""

from __future__ import annotations

from netkf.engines.compiled.combination_state import CombinationState
from netkf.engines.compiled.state import Simulation
from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario


def move_origin(
    scenario: Scenario,
    state: Simulation,
    combination: CombinationState | None,
    k: int,
    offset: FloatArray,
) -> None:
    """Move the origin of all states at the beginning of frame ``k`` (for an unstable plant,
    whose numbers would lose their digits): add ``offset`` (n,) to all estimates, and to
    the estimates in messages under way the offset predicted back to the time of sending. Changes
    ``state.xhat`` and ``state.pool_x``; and what ``combination``, None if the filter has
    none, holds of estimates.
    """
    now = float(state.frames[k])
    # Covariances stay: only means refer to an origin.
    state.xhat[:] += offset
    if combination is not None:
        combination.prior[:] += offset
    for m in state.heap[: state.in_flight]:
        # An estimate under way refers to the time of sending: predict the offset back to it.
        state.pool_x[m] += scenario.move_back(offset, now - state.pool["sent"][m])
