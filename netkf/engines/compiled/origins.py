"""Everything in the coordinates of a new origin, see plants/truth."""

from __future__ import annotations

from netkf.engines.compiled.combination_state import CombinationState
from netkf.engines.compiled.late_readings import History, remember
from netkf.engines.compiled.running_totals import Totals
from netkf.engines.compiled.state import READINGS, Simulation
from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario


def move_origin(
    scenario: Scenario,
    state: Simulation,
    totals: Totals | None,
    history: History | None,
    combination: CombinationState | None,
    k: int,
    offset: FloatArray,
) -> None:
    """Shift all estimates by ``offset`` (n,) at the time of frame ``k``, and messages under way by
    the offset taken back to when they were sent.
    """
    now = float(state.frames[k])
    # Covariances stay: only means refer to an origin.
    state.xhat[:] += offset
    if combination is not None:
        combination.prior[:] += offset
    if totals is not None:
        _move_totals(scenario, state, totals, now, offset)
    # A late reading that goes back over this time must move the origin again on its way forward.
    if history is not None and history.lag > 0.0:
        history.offsets[k] = offset
        for h in range(len(state.nodes)):
            remember(state, history, h, now, -1, k)
    # Totals were moved above, and readings stay in the coordinates of their own time.
    if totals is not None or state.combination_kind == READINGS:
        return
    for m in state.heap[: state.in_flight]:
        # An estimate under way is of the time it was sent: the offset is moved back to then.
        state.pool_x[m] += scenario.move_back(offset, now - state.pool["sent"][m])


def _move_totals(
    scenario: Scenario, state: Simulation, totals: Totals, now: float, offset: FloatArray
) -> None:
    """Move every ``u`` by ``U offset``, in coordinates of the time that it refers to."""
    for times, values in ((totals.sent_at, totals.sent), (totals.heard_at, totals.heard)):
        for k, time in enumerate(times.tolist()):
            _shift_total(values[k], scenario.move_back(offset, now - time))
    for m in state.heap[: state.in_flight]:
        _shift_total(totals.offered[m], scenario.move_back(offset, now - state.pool["sent"][m]))


def _shift_total(total: FloatArray, offset: FloatArray) -> None:
    """Shift a total (w, U, u) in place by ``offset`` (n,) of the state."""
    n = len(offset)
    # u = U x: it moves by U times the move of x.
    total[1 + n * n :] += total[1 : 1 + n * n].reshape(n, n) @ offset
