"""The push-sum filter's exact errors given the links, against many noises on one set of links."""

import numpy as np
import pytest

import netkf
from netkf import theory
from netkf.scenario.reading import from_table
from tests.engines.linearity import engine_covariance

TABLE = {
    "format": 1,
    "name": "four",
    "horizon": 8.0,
    "probe": [2.0, 7.0],
    "plant": {
        "kind": "linear",
        "F": [[1.0, 0.2], [-0.1, 1.0]],
        "Q": [[0.3, 0.0], [0.0, 0.2]],
        "period": 1.0,
        "cov": [[1.0, 0.0], [0.0, 1.0]],
    },
    "sensors": [
        {"nodes": [0], "H": [[1.0, 0.0]], "R": [[0.5]]},
        {"nodes": [2], "H": [[0.0, 1.0]], "R": [[0.5]]},
    ],
    "network": {
        "graph": {"kind": "path", "nodes": 3},
        "activation": {"kind": "broadcast"},
        "channel": {"loss": {"kind": "bernoulli", "delivery": 0.7}},
    },
    "filter": {"kind": "push-sum", "gamma": 2, "delta": 3.2},
}


def test_errors_on_recorded_links_have_the_exact_covariance(tmp_path):
    scenario = from_table(TABLE, tmp_path)
    first = netkf.simulate(scenario)
    sent = first.events[first.events.kind == "lost"]
    rows = "".join(f"{a},{b},{m},0\n" for a, b, m in zip(sent.node, sent.peer, sent.message))  # noqa: B905
    (tmp_path / "lost.csv").write_text("sender,receiver,message,delivered\n" + rows)
    fixed = scenario.replace({"network.channel.loss": {"kind": "recorded", "path": "lost.csv"}})
    stacked = theory.error_covariance(fixed, netkf.simulate(fixed), stacked=True)
    np.testing.assert_allclose(
        stacked, theory.error_covariance(scenario, first, stacked=True), rtol=1e-12
    )
    runs = [netkf.simulate(fixed, replica=r) for r in range(120)]
    e = np.array([(run.x[:, None] - run.xhat).reshape(2, -1) for run in runs])
    for k in range(2):
        kept = np.linalg.eigvalsh(stacked[k])[0] > 1e-8
        assert kept
        whitened = np.einsum("ra,ab,rb->r", e[:, k], np.linalg.inv(stacked[k]), e[:, k]) / 6.0
        # 720 degrees of freedom: one standard error is 5.3 %
        assert whitened.mean() == pytest.approx(1.0, abs=0.24)


@pytest.mark.one_in(6)
@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"filter.stop": "safe"},
        {"filter.stop": "paper"},
        {"filter.asymptotic": True},
        {"filter.running_sums": True},
        {"filter.model": {"F": [[1.0, 0.1], [0.0, 0.9]]}},
    ],
    ids=["for ever", "safe", "paper", "asymptotic", "running sums", "another F"],
)
def test_errors_are_the_linear_map_of_the_engine(changes, tmp_path):
    """Also at the horizon, where a slot begins whose exchanges the run does not have."""
    scenario = from_table({**TABLE, "probe": [2.0, 7.0, 8.0]}, tmp_path).replace(changes)
    expected, run = engine_covariance(scenario, "simpy")
    found = theory.error_covariance(scenario, run)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-11 * np.abs(expected).max())
