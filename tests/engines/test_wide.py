"""Wide first covariances with precise sensors: P of a whole run against closed forms."""

from pathlib import Path

import numpy as np
import pytest

import netkf
from netkf.scenario.reading import from_table


def still(H, R, cov, sampling=None, kind="local", horizon=5.0):
    """States that never move, watched by node 0."""
    n = len(H)
    sensor = {"nodes": [0], "H": [H], "R": [[R]]}
    if sampling is not None:
        sensor["sampling"] = sampling
    network = {"graph": {"kind": "path", "nodes": 3}}
    filter_ = {"kind": kind}
    if kind == "hybrid":
        filter_["epsilon"] = 0.3
        network["activation"] = {"kind": "poisson", "rate": 2.0}
    table = {
        "format": 1,
        "name": "wide",
        "horizon": horizon,
        "probe": 0.5,
        "plant": {
            "kind": "diffusion",
            "A": np.zeros((n, n)).tolist(),
            "B": np.zeros((n, 1)).tolist(),
            "cov": (cov * np.eye(n)).tolist(),
        },
        "sensors": [sensor],
        "network": network,
        "filter": filter_,
    }
    return from_table(table, Path())


def exact(H, information, cov):
    """(cov^-1 I + i H H')^-1, without a difference of large numbers along H."""
    H = np.array(H)
    along = np.outer(H, H) / (H @ H)
    return cov * (np.eye(len(H)) - along) + along / (1.0 / cov + information * (H @ H))


@pytest.mark.one_in(3)
@pytest.mark.parametrize("engine", ["simpy", "auto"])
@pytest.mark.parametrize("cov", [1e-6, 1.0, 1e4, 1e8, 1e10, 1e12])
@pytest.mark.parametrize("H", [[1.0, 0.5, 0.3], [1.0, 0.5, 0.3, -0.2]], ids=["n = 3", "n = 4"])
def test_increments(H, cov, engine):
    run = netkf.simulate(still(H, 1e-3, cov), engine=engine)
    assert run.status == "complete"
    for t, P in zip(run.times, run.P[:, 0], strict=True):
        wanted = exact(H, t / 1e-3, cov)
        assert np.linalg.norm(P - wanted) < 1e-9 * np.linalg.norm(wanted)
        assert np.linalg.eigvalsh(P)[0] >= -1e-12 * cov


@pytest.mark.parametrize("engine", ["simpy", "auto"])
@pytest.mark.parametrize("R", [1e-9, 1e-3, 1e6])
@pytest.mark.parametrize("cov", [1e-6, 1e8, 1e12])
def test_samples(cov, R, engine):
    H = [1.0, 0.5, 0.3, -0.2]
    sampling = {"kind": "periodic", "period": 0.2}
    run = netkf.simulate(still(H, R, cov, sampling), engine=engine)
    for t, P in zip(run.times[:-1], run.P[:-1, 0], strict=True):
        wanted = exact(H, np.floor(t / 0.2 + 1e-9) / R, cov)
        limit = 1e-9 if cov <= 1e10 else 1e-6
        assert np.linalg.norm(P - wanted) < limit * np.linalg.norm(wanted)


@pytest.mark.slow
@pytest.mark.parametrize("cov", [1e8, 1e10])
def test_nees_of_a_wide_start_is_what_it_should_be(cov):
    """It was -7393 where P had become indefinite."""
    # Five states: the loop that is compiled for any number of them serves other tests too.
    run = netkf.simulate(still([1.0, 0.5, 0.3, -0.2, 0.4], 1e-3, cov, kind="hybrid"))
    assert run.status == "complete"
    nees = run.states.nees.to_numpy()
    assert (nees[np.isfinite(nees)] >= 0.0).all()
