"""Scenarios of python-control, scipy.signal and filterpy, against their own filters."""

from types import SimpleNamespace

import networkx
import numpy as np
import pytest
import scipy.linalg
from scipy import signal

import netkf

A, B = np.array([[0.0, 1.0], [-1.0, -0.4]]), np.array([[0.0], [1.0]])
C = np.array([[1.0, 0.0], [0.0, 1.0]])
R = np.diag([0.2, 0.5])


def test_a_continuous_system_ends_at_the_covariance_of_lqe():
    control = pytest.importorskip("control")
    system = control.ss(A, B, C, np.zeros((2, 1)), name="pendulum", states=["angle", "rate"])
    _, P, _ = control.lqe(system, [[0.3]], R)
    scenario = netkf.from_control(system, 0.3, R, {"horizon": 40.0}, G=system.B)
    assert (scenario.name, scenario.plant.states) == ("pendulum", ("angle", "rate"))
    run = netkf.simulate(scenario, engine="simpy")
    for node in range(2):
        np.testing.assert_allclose(run.P[-1, node], P, rtol=2e-3)


def test_a_discrete_system_ends_at_the_covariance_of_dlqe():
    control = pytest.importorskip("control")
    system = control.sample_system(control.ss(A, B, C, np.zeros((2, 1))), 0.25)
    _, prior, _ = control.dlqe(system.A, np.eye(2), system.C, 0.1 * np.eye(2), R)
    posterior = np.linalg.inv(np.linalg.inv(prior) + C.T @ np.linalg.inv(R) @ C)
    run = netkf.simulate(netkf.from_control(system, 0.1 * np.eye(2), R), engine="simpy")
    assert run.times[1] == 0.25
    np.testing.assert_allclose(run.P[-1, 0], posterior, rtol=1e-9)


def test_scipy_systems_and_a_network():
    system = signal.StateSpace(A, B, C, np.zeros((2, 1))).to_discrete(0.5)
    graph = networkx.path_graph(["left", "middle", "right"])
    changes = {
        "network.graph": graph,
        "sensors.0.nodes": ["left"],
        "sensors.1.nodes": ["right"],
        "plant.input": {"kind": "constant", "value": [2.0]},
        "horizon": 20.0,
    }
    scenario = netkf.from_control(system, np.zeros((2, 2)), R, changes)
    assert [str(node) for node in scenario.nodes] == ["left", "middle", "right"]
    run = netkf.simulate(scenario, engine="simpy")
    steps = len(run.times)
    _, _, x = signal.dlsim(system, np.full((steps, 1), 2.0), t=run.times)
    np.testing.assert_allclose(run.x, x, atol=1e-12)  # without noise, the response to the input
    transfer = signal.dlti([1.0], [1.0, -0.5], dt=0.1)
    assert netkf.from_control(transfer, 1.0, 1.0).plant.F.tolist() == [[0.5]]
    by_default = netkf.from_control(system)
    assert by_default.plant.Q.tolist() == np.eye(2).tolist()
    assert [sensor.R.tolist() for sensor in by_default.sensors] == [[[1.0]], [[1.0]]]
    alone = signal.StateSpace(A, np.zeros((2, 0)), C, np.zeros((2, 0)))
    assert netkf.from_control(alone, np.eye(2), R).plant.A.tolist() == A.tolist()  # no inputs
    correlated = netkf.from_control(system, np.eye(2), [[1.0, 0.3], [0.3, 1.0]])
    assert [len(sensor.R) for sensor in correlated.sensors] == [2]


def test_a_continuous_lti_has_the_covariance_of_its_lyapunov_equation():
    system = signal.lti(A, B, C, np.zeros((2, 1)))
    scenario = netkf.from_control(system, 0.3, 1e9 * np.eye(2), {"horizon": 40.0}, G=B)
    run = netkf.simulate(scenario, engine="simpy")
    stationary = scipy.linalg.solve_continuous_lyapunov(A, -0.3 * B @ B.T)
    np.testing.assert_allclose(run.P[-1, 0], stationary, rtol=1e-6, atol=1e-7)


def kalman():
    filterpy = pytest.importorskip("filterpy.kalman")
    kf = filterpy.KalmanFilter(dim_x=2, dim_z=1)
    kf.F, kf.Q = np.array([[1.0, 0.5], [0.0, 1.0]]), np.diag([0.01, 0.04])
    kf.H, kf.R = np.array([[1.0, 0.0]]), np.array([[0.3]])
    kf.x, kf.P = np.array([[2.0], [-1.0]]), np.diag([4.0, 2.0])
    return kf


def test_a_run_of_a_filterpy_filter_is_that_filter():
    kf = kalman()
    run = netkf.simulate(netkf.from_filterpy(kf, period=0.5), engine="simpy")
    pytest.importorskip("stonesoup")
    detections = sorted(run.to_stonesoup().detections, key=lambda one: one.timestamp)
    assert len(detections) == len(run.times) - 2  # the last sample is at the horizon
    for k, one in enumerate(detections, 1):
        kf.predict()
        kf.update(np.asarray(one.state_vector, dtype=float))
        np.testing.assert_allclose(run.xhat[k, 0], kf.x[:, 0], rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(run.P[k, 0], kf.P, rtol=1e-9)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: netkf.from_control(3, 1, 1), "system: must be a state space; got 'int'"),
        (lambda: netkf.from_control(frequencies(), 1, 1), "system: must be a state space; got 'F"),
        (
            lambda: netkf.from_control(signal.TransferFunction([1.0, 0.0, 0.0], [1.0, 1.0])),
            "system: has no state space: Improper",
        ),
        (lambda: netkf.from_control(rotating(), np.eye(2), R), "A: must be a matrix"),
        (lambda: netkf.from_control(SYSTEM, np.eye(3), R), "Q: must have 2 rows"),
        (lambda: netkf.from_control(SYSTEM, np.eye(2), 1.0), "R: must have 2 rows"),
        (lambda: netkf.from_control(SYSTEM, -np.eye(2), R), "Q: must be"),
        (lambda: netkf.from_control(SYSTEM, np.eye(2), R, {"horizn": 1}), "horizn: is not a key"),
        (
            lambda: netkf.from_control(
                through(), np.eye(2), R, {"plant.input.kind": "constant", "plant.input.value": [1]}
            ),
            "system.D: feeds the input through",
        ),
        (
            lambda: netkf.from_control(
                through(), np.eye(2), R, {"plant": netkf.parts.Diffusion(A, B, input=INPUT)}
            ),
            "system.D: feeds the input through",
        ),
        (lambda: netkf.from_filterpy(SYSTEM), "kf: must have F, Q, H, R, x, P"),
        (lambda: netkf.from_filterpy(faded()), "kf.alpha: must be 1"),
        (lambda: netkf.from_filterpy(kalman(), period=0.0), "period: must be"),
        (lambda: netkf.from_filterpy(kalman(), ["horizon"]), "changes: must be a table"),
        (lambda: netkf.from_filterpy(kalman(), period="x"), "period: must be"),
    ],
)
def test_what_is_no_model_is_refused_in_one_line(call, message):
    with pytest.raises(netkf.ScenarioError, match=message) as caught:
        call()
    assert "\n" not in str(caught.value)


SYSTEM = signal.StateSpace(A, B, C, np.zeros((2, 1)))
INPUT = netkf.parts.ConstantInput(G=B, value=[1.0])


def through():
    return signal.StateSpace(A, B, C, np.ones((2, 1)))


def test_inputs_have_the_matrix_of_the_model_however_changes_state_them():
    for kind in (
        {"plant.input.kind": "constant", "plant.input.value": [1.0]},
        {"plant.input": {"kind": "constant", "value": [1.0]}},
        {"plant.input": INPUT},
    ):
        scenario = netkf.from_control(SYSTEM, np.eye(2), R, kind)
        assert scenario.plant.input.G.tolist() == B.tolist()
    assert netkf.from_control(through(), np.eye(2), R, {"plant.input": None}).plant.input is None
    kf = SimpleNamespace(F=A, Q=np.eye(2), H=C, R=R, x=np.zeros(2), P=np.eye(2))  # no B
    assert netkf.from_filterpy(kf).plant.input is None


def frequencies():
    return pytest.importorskip("control").frd([1.0, 2.0], [1.0, 2.0])


def rotating():
    return signal.StateSpace(1j * np.array(A), B, C, np.zeros((2, 1)))


def faded():
    kf = kalman()
    kf.alpha = 1.02
    return kf


def test_noise_at_the_inputs_is_asked_for_where_Q_has_their_size():
    system = signal.StateSpace([[0.0, 1.0], [-1.0, 0.0]], [[0.0], [1.0]], [[1.0, 0.0]], [[0.0]])
    with pytest.raises(netkf.ScenarioError, match=r"Q: must have 2 rows.*give G = system.B"):
        netkf.from_control(system, [[0.3]], [[0.1]])
