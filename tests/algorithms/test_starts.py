"""Wide first covariances beside precise readings, in filters that add up information matrices."""

from pathlib import Path

import numpy as np
import pytest

import netkf
from netkf.scenario.reading import from_table

FILTERS = {
    "push-sum": {"gamma": 1, "delta": 2.0},
    "hcmci": {"steps": 1},
    "icf": {"steps": 1},
    "diffusion-kalman": {},
}


def scenario(kind, ratio, H=((1.0, 0.3, -0.2), (0.2, 1.0, 0.4))):
    return from_table(
        {
            "format": 1,
            "name": "wide",
            "horizon": 5.0,
            "probe": 1.0,
            "plant": {
                "kind": "linear",
                "F": np.eye(len(H[0])).tolist(),
                "Q": np.zeros((len(H[0]),) * 2).tolist(),
                "period": 1.0,
                "cov": np.eye(len(H[0])).tolist(),
            },
            "sensors": [
                {"nodes": [k], "H": [list(row)], "R": [[1.0 / ratio]]} for k, row in enumerate(H)
            ],
            "network": {
                "graph": {"kind": "path", "nodes": 2},
                "activation": {"kind": "broadcast"},
            },
            "filter": {"kind": kind, **FILTERS[kind]},
        },
        Path(),
    )


@pytest.mark.parametrize("kind", ["push-sum", "hcmci", "icf"])
def test_what_rounding_of_information_does_is_noted_and_then_refused(kind):
    assert not [note for note in scenario(kind, 1e6).notes if "filter.cov" in note]
    (note,) = [note for note in scenario(kind, 1e11).notes if "filter.cov" in note]
    assert "information matrices" in note
    with pytest.raises(netkf.ScenarioError, match=r"filter\.cov: must be at most 1e\+14 times"):
        scenario(kind, 1e17)
    # Of one state, nothing is lost.
    assert (
        scenario(kind, 1e20, ((1.0,), (0.5,))).notes == scenario(kind, 1e3, ((1.0,), (0.5,))).notes
    )
    # Roots keep it: the way out that the message names.
    scenario("diffusion-kalman", 1e20)


@pytest.mark.parametrize("kind", ["push-sum", "diffusion-kalman"])
def test_two_nodes_that_hear_each_other_know_what_all_readings_say(kind):
    # Wide by as much as is not noted: both have the central filter's P.
    run = netkf.simulate(scenario(kind, 1e8), engine="simpy")
    F, R, P = np.eye(3), 1e-8, np.eye(3)
    H = np.array([[1.0, 0.3, -0.2], [0.2, 1.0, 0.4]])
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R * np.eye(2))
    P = (F - K @ H) @ P @ (F - K @ H).T + R * K @ K.T
    assert np.linalg.norm(run.P[1, 0] - P) < 1e-9 * np.linalg.norm(P)
    assert (run.status, len(run.times)) == ("complete", 6 if run.times[-1] == 5.0 else 5)
