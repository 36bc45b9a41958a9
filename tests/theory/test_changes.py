"""What theory says of plants that change: piece by piece, or of the last piece, or not at all."""

import dataclasses
import itertools

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm, solve_discrete_are

import netkf
from netkf.checks.check import find_checks
from netkf.core.errors import TheoryError
from netkf.theory.one_bit.covariances import bit_covariances
from netkf.theory.promises import compute_promises, promises_text
from netkf.theory.stochastic_trigger.errors import expected_sends
from netkf.theory.traces import limit_label, theory_traces
from tests.engines.test_changes import (
    INCREMENTS,
    TIMES,
    A,
    B,
    F,
    H,
    Q,
    R,
    clocks,
    piece,
    slots,
)

UNAWARE = {"model": {"schedule": False}}
INFORMATION = {"kind": "hcmci", "consensus": "information", "steps": 1}
TRIGGER = {"kind": "event-triggered", "inner": {"kind": "intermittent"}, "trigger": "stochastic"}
SAID_OF_P = [
    {"kind": "belief-propagation"},
    {"kind": "consensus-innovations"},
    TRIGGER | {"trigger": "consensus", "inner": INFORMATION, "thresholds": [0.5, 0.5]},
    TRIGGER | {"Y": [[1.0]]},
    INFORMATION,
    {"kind": "one-bit"},
    {"kind": "track-fusion", "rule": "cross-covariance"},
]
"""Filters of whose P papers say something that no change of the plant makes false."""


def gain(P):
    return P @ H.T @ np.linalg.inv(H @ P @ H.T + R)


@pytest.mark.parametrize("aware", [True, False])
def test_exact_errors_in_slots_follow_the_changes(aware):
    s = slots("local", filter={} if aware else UNAWARE)
    run = netkf.simulate(s)
    exact = netkf.theory.error_covariance(s, run)
    # The state and the error together, driven by one noise; filters believe the first piece.
    P, joint = np.eye(2), np.kron(np.ones((2, 2)), np.eye(2))
    for k in range(1, 20):
        Fk, Qk = piece(k - 1)
        Fb, Qb = (Fk, Qk) if aware else (F[0], Q[0])
        M = np.block([[Fk, np.zeros((2, 2))], [Fk - Fb, Fb]])
        joint = M @ joint @ M.T + np.kron(np.ones((2, 2)), Qk)
        P = Fb @ P @ Fb.T + Qb
        K = gain(P)
        keep = np.block([[np.eye(2), np.zeros((2, 2))], [np.zeros((2, 2)), np.eye(2) - K @ H]])
        joint = keep @ joint @ keep.T
        joint[2:, 2:] += K @ R @ K.T
        P = (np.eye(2) - K @ H) @ P
        for node in range(3):
            np.testing.assert_allclose(exact[k, node], joint[2:, 2:], rtol=1e-9, atol=1e-12)
            np.testing.assert_allclose(run.P[k, node], P, rtol=1e-9)


@pytest.mark.parametrize("aware", [True, False])
def test_exact_errors_under_clocks_follow_the_changes(aware):
    s = clocks("local", filter={} if aware else UNAWARE)
    run = netkf.simulate(s)
    exact = netkf.theory.error_covariance(s, run)
    log = [(e.t, e.node) for e in run.events.itertuples() if e.kind == "sense"]
    for node in range(3):
        P, joint, now = np.eye(2), np.kron(np.ones((2, 2)), np.eye(2)), 0.0
        senses = [(t, True) for t, i in log if i == node]
        steps = sorted(
            senses + [(t, False) for t in run.times.tolist()], key=lambda e: (e[0], not e[1])
        )
        k = 0
        for t, reads in steps:
            for a, b in itertools.pairwise([now, *(c for c in TIMES if now < c < t), t]):
                true = int(np.searchsorted(TIMES, a, side="right"))
                joint, P = flow_errors(joint, P, true, true if aware else 0, b - a)
            now = t
            if reads:
                K = gain(P)
                keep = np.block(
                    [[np.eye(2), np.zeros((2, 2))], [np.zeros((2, 2)), np.eye(2) - K @ H]]
                )
                joint = keep @ joint @ keep.T
                joint[2:, 2:] += K @ R @ K.T
                P = (np.eye(2) - K @ H) @ P
            else:
                np.testing.assert_allclose(exact[k, node], joint[2:, 2:], rtol=1e-8, atol=1e-10)
                np.testing.assert_allclose(run.P[k, node], P, rtol=1e-8, atol=1e-10)
                k += 1


def flow_errors(joint, P, true, believed, gap):
    """Moments of (x, e) and P over a gap, with a piece of the plant and one of the filters."""
    M = np.block([[A[true], np.zeros((2, 2))], [A[true] - A[believed], A[believed]]])
    N = np.kron(np.ones((2, 2)), B[true] @ B[true].T)
    return van_loan(M, N, gap, joint), van_loan(A[believed], B[believed] @ B[believed].T, gap, P)


def van_loan(M, N, gap, P):
    n = len(M)
    block = expm(np.block([[-M, N], [np.zeros((n, n)), M.T]]) * gap)
    Phi = block[n:, n:].T
    return Phi @ P @ Phi.T + Phi @ block[:n, n:]


@pytest.mark.parametrize("kind", ["local", "hybrid", "gossip"])
@pytest.mark.parametrize("delay", ["none", "exponential"])
@pytest.mark.parametrize("sensor", ["samples", "increments"])
def test_filters_that_know_the_changes_are_not_overconfident(kind, delay, sensor):
    # P of a local filter is the covariance of its error, that of others is at least that.
    at = "links" if kind == "gossip" else "nodes"
    channel = {"delay": {"kind": delay, "mean": 0.4}} if delay != "none" else {}
    network = {"activation": {"kind": "poisson", "at": at, "rate": 2.0}, "channel": channel}
    options = {"epsilon": 0.3} if kind == "hybrid" else {}
    own = {"sensor": INCREMENTS} if sensor == "increments" else {}
    s = clocks(kind, filter=options, network=network, **own)
    run = netkf.simulate(s)
    exact = netkf.theory.error_covariance(s, run)
    if kind == "local":
        np.testing.assert_allclose(exact, run.P, rtol=2e-4 if own else 1e-9)
    excess = np.linalg.eigvalsh(run.P - exact) / np.trace(run.P, axis1=2, axis2=3)[..., None]
    assert excess.min() > (-2e-4 if own else -1e-9)
    if kind == "hybrid":
        assert excess.max() > 1e-3


def test_the_bound_goes_on_from_piece_to_piece():
    network = {"activation": {"kind": "poisson", "at": "links", "rate": 1.5}}
    s = clocks("hybrid", filter={"epsilon": 0.3}, network=network, sensor=INCREMENTS)
    times = np.array([0.0, 1.0, 2.3, 3.0, 4.1, 5.0, 6.0])
    bound = netkf.theory.covariance_bound(s, times)
    G = H.T @ np.linalg.inv(R) @ H

    def slope(t, y):
        P, k = y.reshape(3, 2, 2), int(np.searchsorted(TIMES, t, side="right"))
        out = np.array([A[k] @ p + p @ A[k].T + B[k] @ B[k].T - p @ G @ p for p in P])
        for i, j in ((0, 1), (1, 0), (1, 2), (2, 1)):
            out[i] += 1.5 * 0.3 * (P[j] - P[i])
        return out.reshape(-1)

    y, now = np.tile(np.eye(2), (3, 1, 1)).reshape(-1), 0.0
    for k, t in enumerate(times):
        if t > now:
            y = solve_ivp(slope, (now, t - 1e-13), y, rtol=1e-11, atol=1e-13).y[:, -1]
            now = t
        np.testing.assert_allclose(bound[k].reshape(-1), y, rtol=1e-7)
    delayed = clocks(
        "hybrid",
        filter={"epsilon": 0.3},
        network={**network, "channel": {"delay": {"kind": "constant", "seconds": 0.1}}},
        sensor=INCREMENTS,
    )
    with pytest.raises(TheoryError, match="delays is not known across changes"):
        netkf.theory.covariance_bound(delayed, times)


def test_steady_states_are_those_of_the_last_piece():
    network = {"activation": {"kind": "poisson", "at": "links", "rate": 1.5}}
    s = clocks("hybrid", filter={"epsilon": 0.3}, network=network, sensor=INCREMENTS)
    plant = {"schedule": [], "A": A[2].tolist(), "B": B[2].tolist()}
    last = clocks(
        "hybrid", filter={"epsilon": 0.3}, network=network, sensor=INCREMENTS, plant=plant
    )
    for name in ("steady_covariance_bound", "central_covariance", "limit_covariance"):
        of_last = getattr(netkf.theory, name)(last)
        np.testing.assert_allclose(getattr(netkf.theory, name)(s), of_last, rtol=1e-9)
    text = promises_text(s, compute_promises(s))
    assert "steady states and limits: of the plant from 4.1 s on" in text
    assert "the plant does not change" in text
    # Beside a run a note says it, of filters that the hybrid paper is not about too.
    for one in (s, s.replace({"filter": {"kind": "central"}})):
        promised = theory_traces(one, one.times)
        assert "limits and centralised filter are of the plant after all changes" in promised.notes
        assert promised.limit_label == limit_label(one)


def test_the_central_filter_in_slots_is_that_of_the_last_piece():
    s = slots("intermittent")
    all_H, all_R = np.tile(H, (3, 1)), np.kron(np.eye(3), R)
    expected = solve_discrete_are(F[2].T, all_H.T, Q[2], all_R)
    found = compute_promises(s)["slot_central_covariance"]["value"]
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_what_is_about_one_piece_refuses_a_plant_that_changes():
    for s in (slots("local"), clocks("local")):
        for name in ("slot_belief", "slot_models") if s.slotted else ("belief", "models"):
            with pytest.raises(TheoryError, match=r"plant.schedule"):
                getattr(s, name)


@pytest.mark.slow
def test_filters_that_do_not_know_are_said_to_be_wrong():
    rows = netkf.theory.assumptions(slots("diffusion", filter=UNAWARE)).set_index("assumption")
    known = netkf.theory.assumptions(clocks("local", filter=UNAWARE)).set_index("assumption")
    name = "the filters know the plant and the sensors"
    for table in (rows, known):
        assert not table.loc[name, "holds"]
        assert "do not know that the plant changes" in table.loc[name, "evidence"]
    assert netkf.theory.assumptions(clocks("local")).set_index("assumption").loc[name, "holds"]
    assert not rows.loc["the plant does not change", "holds"]
    unaware = netkf.consistency(slots("local", filter=UNAWARE), runs=40)
    aware = netkf.consistency(slots("local"), runs=40)
    assert (unaware.table["expected"] > 4.0).all()
    assert (unaware.table["nees"] > 4.0).all()
    np.testing.assert_allclose(aware.table["expected"], 2.0, rtol=1e-6)


@pytest.mark.parametrize("kind", ["kcf", "diffusion-kalman"])
def test_check_promises_no_bound_that_no_paper_proves(kind):
    s = slots(kind)
    run = netkf.simulate(s, engine="simpy")
    lacking = run.P - netkf.theory.error_covariance(s, run)
    assert np.linalg.eigvalsh(lacking).min() < -1e-3
    promises = [one.statement for one in find_checks(s).promises(s)]
    assert "P follows the equations along the events of each run" in promises
    assert "P is at least the covariance of the error, given the events" not in promises


@pytest.mark.parametrize("kind", SAID_OF_P, ids=lambda kind: f"{len(kind)} {kind['kind']}")
def test_check_promises_of_p_what_it_does_without_changes(kind):
    s = slots(kind["kind"], filter=kind)
    now, before = (
        {
            one.statement
            for one in find_checks(of).promises(of)
            if one.statement.startswith(("P is", "a bit", "nodes send"))
        }
        for of in (s, s.last_piece)
    )
    assert now == before != set()


def test_check_promises_nothing_of_triggers_that_no_paper_knows():
    s = slots("event-triggered", filter=TRIGGER | {"Y": [[1.0]], "inner": INFORMATION})
    for of in (s, s.last_piece):
        with pytest.raises(TheoryError, match="nothing is promised"):
            find_checks(of)


@pytest.mark.one_in(2)
@pytest.mark.parametrize("sums", [True, False])
def test_mass_is_lost_with_messages_whatever_the_plant_does(sums):
    lossy = {"loss": {"kind": "bernoulli", "delivery": 0.6}, "symmetric": False}
    kind = {"gamma": 2, "delta": 4.0, "running_sums": sums}
    s = slots("push-sum", filter=kind).replace({"network.channel": lossy})
    rows = netkf.check(s, runs=10).table.set_index("promise")
    assert rows.loc["mass is conserved", "verdict"] == ("holds" if sums else "not promised")


def test_nodes_send_as_often_as_the_matrices_of_their_slots_say():
    network = {"graph": {"kind": "complete", "nodes": 3}, "activation": {"kind": "broadcast"}}
    s = slots("event-triggered", filter=TRIGGER | {"Y": [[1.0]]}, network=network)
    sent, expected = np.transpose(
        [expected_sends(s, netkf.simulate(s, replica=k, engine="simpy")) for k in range(60)]
    )
    difference = sent - expected  # a martingale
    assert abs(difference.mean()) < 4.0 * difference.std() / np.sqrt(60)
    # Readings that weigh so much are sent for certain.
    certain = s.replace({"filter.Y": [[1e12]]})
    sent, expected = expected_sends(certain, netkf.simulate(certain, engine="simpy"))
    assert expected == pytest.approx(sent, rel=1e-3)
    run = netkf.simulate(s, engine="simpy")
    np.testing.assert_allclose(netkf.theory.error_covariance(s, run), run.P, rtol=1e-9)


def test_bits_lower_p_by_the_matrices_of_their_slots():
    s = slots("one-bit")
    run = netkf.simulate(s, engine="simpy")
    # The last sample has bits of its own slot, which is not recorded.
    np.testing.assert_allclose(bit_covariances(s, run)[:-1], run.P[:-1], rtol=1e-9)


@pytest.mark.one_in(2)
@pytest.mark.parametrize("aware", [True, False])
def test_check_follows_the_changes(aware):
    verdict = netkf.check(slots("diffusion", filter={} if aware else UNAWARE), runs=20, seed=2)
    rows = verdict.table.set_index("promise")
    assert verdict, rows
    bound = rows.loc["P is at least the covariance of the error, given the events", "verdict"]
    assert bound == ("holds" if aware else "not promised")
    for name in (
        "P follows the equations along the events of each run",
        "states are those that the plant draws, errors are x - xhat",
        "both engines make the same events and states",
    ):
        assert rows.loc[name, "verdict"] == "holds"


def test_a_size_is_found_where_the_plant_changes():
    from netkf.studies.metrics import bound_traces, central_traces

    s = slots("local")
    run = netkf.simulate(s)
    traces = np.trace(run.P[1:], axis1=2, axis2=3).mean(axis=0)
    np.testing.assert_allclose(bound_traces(s), traces, rtol=1e-9)
    central = netkf.simulate(slots("central"))
    mean = np.trace(central.P[1:, 0], axis1=1, axis2=2).mean()
    np.testing.assert_allclose(central_traces(s), mean, rtol=1e-9)


def test_pieces_are_scenarios_of_their_own():
    s = slots("diffusion", filter=UNAWARE)
    middle = s.piece(1)
    np.testing.assert_array_equal(middle.plant.F, F[1])
    np.testing.assert_array_equal(middle.slot_belief[0], F[0])
    assert not middle.filters_know_the_truth
    aware = dataclasses.replace(s, filter=slots("diffusion").filter)
    assert aware.last_piece.filters_know_the_truth
