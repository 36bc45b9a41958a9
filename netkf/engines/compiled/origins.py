"""Moves of the origin that states and estimates are relative to, see plants/truth."""

from __future__ import annotations

from netkf.engines.compiled.combination_state import CombinationState
from netkf.engines.compiled.running_totals import Totals, predict_total
from netkf.engines.compiled.state import Simulation
from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario


def move_origin(
    scenario: Scenario,
    state: Simulation,
    totals: Totals | None,
    combination: CombinationState | None,
    k: int,
    offset: FloatArray,
) -> None:
    """Move the origin of all states at the beginning of frame ``k`` (for an unstable plant,
    whose numbers would lose their digits): add ``offset`` (n,) to all estimates, and to
    the estimates in messages under way the offset predicted back to the time of sending. Changes
    ``state.xhat`` and ``state.pool_x``; and what ``totals`` and ``combination``, None
    if the filter has none, hold of estimates.
    """
    now = float(state.frames[k])
    # Covariances stay: only means refer to an origin.
    state.xhat[:] += offset
    if combination is not None:
        combination.prior[:] += offset
    if totals is not None:
        _shift_totals(scenario, state, totals, now, offset)
    # Totals are shifted above.
    if totals is not None:
        return
    for m in state.heap[: state.in_flight]:
        # An estimate under way refers to the time of sending: predict the offset back to it.
        state.pool_x[m] += scenario.move_back(offset, now - state.pool["sent"][m])


def _shift_totals(
    scenario: Scenario, state: Simulation, totals: Totals, now: float, offset: FloatArray
) -> None:
    """Move the running sums of push-sum (weight, U (n, n), parts of u) to a new origin: add ``U
    offset`` to the ``u`` of all that nodes have sent or heard, predicted to ``now`` (seconds), and
    that is under way; ``offset`` (n,) is first predicted back to the time that this was sent.
    """
    # Predicted forward: back to a time long ago an offset would grow with the modes that decay.
    for times, values in ((totals.sent_at, totals.sent), (totals.heard_at, totals.heard)):
        for k, time in enumerate(times.tolist()):
            predict_total(totals, values, k, now - time)
            _shift_total(values[k], offset, totals.projectors)
        times[:] = now
    for m in state.heap[: state.in_flight]:
        moved = scenario.move_back(offset, now - state.pool["sent"][m])
        _shift_total(totals.offered[m], moved, totals.projectors)


def _shift_total(total: FloatArray, offset: FloatArray, projectors: FloatArray) -> None:
    """Add ``U P_g offset`` to each of the G parts of u in place, for the total (1 + n n + G n,) =
    (w, U by rows, parts of u), the ``offset`` (n,) of the state x and the ``projectors`` P_g
    (G, n, n): since u = U x, it moves with x.
    """
    n = len(offset)
    U = total[1 : 1 + n * n].reshape(n, n)
    total[1 + n * n :] += (projectors @ offset @ U.T).reshape(-1)
