"""Numbers that pass 1.8e308 end a run as diverged, on both engines and in batches, and why."""

from pathlib import Path

import numpy as np
import pytest

import netkf
from netkf.engines.soundness import describe_divergence
from netkf.scenario.reading import from_table
from tests.engines.agreement import assert_agree

GROWTH = 3.0


def scenario(kind, slotted, horizon, model=None):
    plant = (
        {"kind": "linear", "F": [[GROWTH]], "Q": [[1.0]], "period": 1.0}
        if slotted
        else {"kind": "diffusion", "A": [[np.log(GROWTH)]], "B": [[1.0]]}
    )
    sampling = {} if slotted else {"sampling": {"kind": "periodic", "period": 1.0}}
    return from_table(
        {
            "format": 1,
            "name": "overflow",
            "horizon": horizon,
            "probe": 10.0,
            "seed": 3,
            "plant": {**plant, "cov": [[1.0]]},
            "sensors": [{"nodes": [0], "H": [[1.0]], "R": [[0.5]], **sampling}],
            "network": {"graph": {"kind": "path", "nodes": 2}},
            "filter": {"kind": kind} | ({"model": model} if model else {}),
        },
        Path(),
    )


def reason(run):
    return describe_divergence(run.nodes, run.x, run.xhat, run.P, run.error)


def diverged_nodes(run):
    rows = run.events[run.events["kind"] == "diverged"]
    assert (rows["t"] == run.times[-1]).all()
    return rows["node"].tolist()


# The blind node's covariance passes the largest number at half the time at which the truth does.
CASES = {
    "truth": ("central", 760.0, None, [0, 1], "the true state passed 1.8e308"),
    "covariance": ("local", 760.0, None, [1], "the covariance of node 1 passed 1.8e308"),
    "error": ("local", 760.0, 0.5, [0, 1], "the squared error of nodes 0, 1 passed 1.8e308"),
}


@pytest.mark.one_in(3)
@pytest.mark.parametrize("slotted", [False, True])
@pytest.mark.parametrize("case", CASES)
def test_what_passes_the_largest_number_ends_the_run_and_is_named(case, slotted):
    kind, horizon, believed, nodes, text = CASES[case]
    model = None
    if believed is not None:
        model = {"F": [[believed]]} if slotted else {"A": [[np.log(believed)]]}
    one = scenario(kind, slotted, horizon, model)
    run = netkf.simulate(one)
    assert (run.engine, run.status) == ("compiled", "diverged")
    assert diverged_nodes(run) == nodes
    assert reason(run).startswith(text)
    before = (run.x[:-1], run.xhat[:-1], run.P[:-1], run.sq_error[:-1])
    assert all(np.isfinite(values).all() for values in before)
    slow = netkf.simulate(one, engine="simpy")
    assert (slow.status, reason(slow)) == ("diverged", reason(run))
    assert slow.fingerprint == run.fingerprint
    # A batch ends its runs at the same samples.
    ensemble = netkf.monte_carlo(one, runs=3)
    assert ensemble.diverged == 3
    assert ensemble.runs[np.searchsorted(ensemble.times, run.times[-1])] <= 2


@pytest.mark.parametrize("slotted", [False, True])
@pytest.mark.parametrize("engine", ["simpy", "compiled"])
def test_states_that_are_no_numbers_end_the_run_as_well(engine, slotted):
    """Beyond the largest number two states are infinity less infinity: no number at all."""
    F, eye = [[3.0, 1.0], [-1.0, 3.0]], np.eye(2).tolist()
    plant = {"F": F, "Q": eye, "period": 1.0} if slotted else {"A": F, "B": eye}
    kind = "linear" if slotted else "diffusion"
    sensor = {"nodes": [0, 1], "H": eye, "R": eye}
    changes = {"plant": {**plant, "kind": kind, "cov": eye}, "sensors": [sensor], "probe": 100.0}
    run = netkf.simulate(scenario("local", slotted, 900.0).replace(changes), engine=engine)
    assert run.status == "diverged"
    assert np.isnan(run.x[-1]).all()
    assert np.isfinite(run.x[:-1]).all()
    assert np.isfinite(run.error).all()
    assert reason(run) == "the true state passed 1.8e308, the largest number there is,"


def test_runs_that_end_in_time_are_complete():
    for slotted in (False, True):
        run = assert_agree(scenario("central", slotted, 600.0))
        assert run.status == "complete"
        assert np.isfinite(run.xhat).all()
        assert np.isfinite(run.sq_error).all()


def test_reasons_are_told_apart():
    x, xhat, P = np.zeros((2, 2)), np.zeros((2, 3, 2)), np.tile(np.eye(2), (2, 3, 1, 1))

    def say(**changes):
        arrays = {"x": x.copy(), "xhat": xhat.copy(), "P": P.copy(), "error": xhat.copy()}
        for name, (index, value) in changes.items():
            arrays[name][index] = value
        return describe_divergence((5, 6, 7), **arrays)

    assert say(xhat=((1, 1, 0), np.inf)).startswith("the estimate of node 6 passed 1.8e308")
    assert "infinity - infinity, or 0 / 0" in say(xhat=((1, 1), np.nan))
    assert say(P=((1, 0, 0, 0), -1.0)) == (
        "the covariance of node 5 is no longer positive semidefinite"
    )
    assert say(P=((1, 1, 1, 1), np.inf)).startswith("the covariance of node 6 passed")
    assert say(error=((1, slice(0, 2), 0), 1e160)).startswith("the squared error of nodes 5, 6")
    assert say(x=(1, np.inf), error=(1, np.inf), xhat=(1, np.inf)).startswith("the true state")
    large = xhat.copy()
    large[0, 2], large[1, 2] = 1e200, np.nan
    text = describe_divergence((5, 6, 7), x, large, P, x[:, None] - large)
    assert text.startswith("the estimate of node 7 is not a number, after numbers beyond 1e+100")
    # Nobody knows the truth.
    unknown = np.full_like(xhat, np.nan)
    large[1, 2] = np.inf
    text = describe_divergence((5, 6, 7), unknown[:, 0], large, P, unknown)
    assert text.startswith("the estimate of node 7 passed 1.8e308")
