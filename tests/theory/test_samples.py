"""The bound with sensors that sample, against many runs of P alone, limits and closed forms."""

import numpy as np
import pytest
import scipy.stats

import netkf
from netkf import theory
from netkf.theory.hybrid.steady import steady_by_node

RUNS = 20_000


def mean_covariances(A, Q, P0, sensors, links, times, seed, readings=False):
    """Mean (T, N, n, n) and standard errors of P over RUNS runs: ``sensors`` (node, H, R, rate),
    ``links`` (receivers of (sender, rate, weight)) tick independently. Time goes in small steps of
    the superposed clock, exactly: gaps are exponential with the total rate, by uniformisation.
    """
    random = np.random.default_rng(seed)
    rates = np.array([s[3] for s in sensors] + [link[1] for link in links])
    total = rates.sum()
    P = np.repeat(P0[None], RUNS, axis=0)
    now, following = np.zeros(RUNS), random.exponential(1.0 / total, RUNS)
    values, vectors = np.linalg.eig(A)
    inverse = np.linalg.inv(vectors)
    rotated = inverse @ Q @ inverse.T  # not conjugated: F Q F' in the eigenbasis
    sums = values[:, None] + values[None, :]

    def predict(P, gaps):
        e = np.exp(gaps[:, None] * values)
        F = ((vectors * e[:, None, :]) @ inverse).real
        small = np.abs(sums) < 1e-12
        grown = np.where(
            small,
            gaps[:, None, None],
            np.expm1(gaps[:, None, None] * sums) / np.where(small, 1, sums),
        )
        noise = (vectors @ (rotated * grown) @ vectors.T).real
        return F[:, None] @ P @ np.swapaxes(F, 1, 2)[:, None] + noise[:, None]

    def use(P, node, H, R):
        M = P[:, node]
        C = M @ H.T
        return M - C @ np.linalg.solve(H @ C + R, np.swapaxes(C, 1, 2))

    means, errors = [], []
    for time in times:
        while (due := np.flatnonzero(following <= time)).size:
            P[due] = predict(P[due], following[due] - now[due])
            now[due] = following[due]
            which = random.choice(len(rates), due.size, p=rates / total)
            for k in np.unique(which):
                rows = due[which == k]
                if k < len(sensors):
                    node, H, R, _ = sensors[k]
                    P[rows, node] = use(P[rows], node, H, R)
                    heard = [link for link in links if link[0] == node] if readings else []
                    before = P[rows, node]
                    for _, _, receivers in heard:
                        _reset(P, rows, before, receivers, random)
                else:
                    sender, _, receivers = links[k - len(sensors)]
                    _reset(P, rows, P[rows, sender], receivers, random)
            following[due] += random.exponential(1.0 / total, due.size)
        P = predict(P, time - now)
        now[:] = time
        means.append(P.mean(axis=0))
        errors.append(P.std(axis=0) / np.sqrt(RUNS))
    return np.array(means), np.array(errors)


def _reset(P, rows, before, receivers, random):
    """All receivers hear values from before."""
    old = P[rows].copy()
    for receiver, weight, delivery in receivers:
        got = rows[random.random(len(rows)) < delivery]
        place = np.searchsorted(rows, got)
        P[got, receiver] = (1 - weight) * old[place, receiver] + weight * before[place]


A = np.array([[0.1, 0.6], [-0.6, -0.2]])
B = np.array([[0.7, 0.0], [0.2, 0.5]])
SENSORS = [
    {"nodes": [0], "H": [[1.0, 0.0]], "R": [[0.3]], "sampling": {"kind": "poisson", "rate": 3.0}},
    {
        "nodes": [0, 2],
        "H": [[0.3, 1.0]],
        "R": [[0.5]],
        "sampling": {"kind": "poisson", "rate": 1.0},
    },
]
TIMES = [0.3, 1.0, 2.5, 5.0]


def three(build, activation, delivery=0.8, sensors=SENSORS, **other):
    network = {
        "graph": {"kind": "path", "nodes": 3},
        "activation": activation,
        "channel": {"loss": {"kind": "bernoulli", "delivery": delivery}, "symmetric": False},
    }
    plant = {
        "kind": "diffusion",
        "A": A.tolist(),
        "B": B.tolist(),
        "cov": [[2.0, 0.0], [0.0, 1.0]],
    }
    tables = {"plant": plant, "sensors": sensors, "network": network, "horizon": 6.0, **other}
    return build(**{"filter": {"kind": "hybrid", "epsilon": 0.4}, **tables})


BROADCASTS = {
    0: [(1, 0.4, 0.8)],
    1: [(0, 0.4, 0.8), (2, 0.4, 0.8)],
    2: [(1, 0.4, 0.8)],
}
ONE_WAY = [(i, r) for i, some in BROADCASTS.items() for r in some]


@pytest.mark.parametrize("at", ["directions", "nodes", "readings"])
@pytest.mark.slow
def test_the_mean_of_many_runs_stays_below(build, at):
    activation = {"kind": "poisson", "rate": 2.0, "at": at}
    links = [(i, 2.0, some) for i, some in BROADCASTS.items()]
    if at == "directions":
        links = [(i, 2.0, [r]) for i, r in ONE_WAY]
    elif at == "readings":
        activation = {"kind": "readings"}
        links = [(i, 0.0, some) for i, some in BROADCASTS.items()]
    scenario = three(build, activation)
    bound = theory.covariance_bound(scenario, TIMES)
    sensors = [
        (0, np.array([[1.0, 0.0]]), np.array([[0.3]]), 3.0),
        (0, np.array([[0.3, 1.0]]), np.array([[0.5]]), 1.0),
        (2, np.array([[0.3, 1.0]]), np.array([[0.5]]), 1.0),
    ]
    start = np.array([np.diag([2.0, 1.0])] * 3)
    mean, error = mean_covariances(
        A, B @ B.T, start, sensors, links, TIMES, 1, readings=at == "readings"
    )
    z = scipy.stats.norm.ppf(1.0 - 0.01 / mean[..., 0, 0].size / 2)
    traces = np.trace(mean, axis1=2, axis2=3)
    spread = z * np.trace(error, axis1=2, axis2=3)
    above = np.trace(bound, axis1=2, axis2=3)
    assert (traces <= above + spread).all()
    # and is not far below: Jensen's gap is a share of the bound
    assert (traces > 0.6 * above).all()
    # before anything was sampled twice, it is nearly exact
    assert (traces[0] > 0.9 * above[0]).all()


def test_many_vague_samples_are_increments(build):
    activation = {"kind": "poisson", "rate": 2.0}
    V, H = [[0.2]], [[1.0, 0.4]]
    continuous = three(build, activation, sensors=[{"nodes": [0], "H": H, "R": V}])
    expected = theory.covariance_bound(continuous, TIMES)
    steady = theory.steady_covariance_bound(continuous)
    apart, steadily = [], []
    for s in (1e3, 1e4, 1e5):
        sensor = {
            "nodes": [0],
            "H": H,
            "R": [[0.2 * s]],
            "sampling": {"kind": "poisson", "rate": s},
        }
        sampled = three(build, activation, sensors=[sensor])
        apart.append(np.abs(theory.covariance_bound(sampled, TIMES) - expected).max())
        steadily.append(np.abs(theory.steady_covariance_bound(sampled) - steady).max())
    for found in (apart, steadily):
        np.testing.assert_allclose(np.log10(np.array(found[:-1]) / found[1:]), 1.0, atol=0.02)
        assert found[-1] < 1e-3


@pytest.mark.slow
def test_the_steady_state_is_where_the_bound_settles(build):
    for activation in (
        {"kind": "poisson", "rate": 2.0, "at": "nodes"},
        {"kind": "readings"},
    ):
        scenario = three(build, activation, horizon=200.0)
        late = theory.covariance_bound(scenario, [150.0])[0]
        np.testing.assert_allclose(theory.steady_covariance_bound(scenario), late, rtol=1e-8)
    delayed = scenario.replace({"network.channel.delay": {"kind": "constant", "seconds": 0.3}})
    late = theory.covariance_bound(delayed, [60.0])[0]
    np.testing.assert_allclose(theory.steady_covariance_bound(delayed), late, rtol=1e-6)


def test_fast_links_come_to_the_limit(build):
    scenario = three(build, {"kind": "poisson", "rate": 2.0})
    S = theory.limit_covariance(scenario)
    apart = []
    for rate in (1e3, 1e4):
        fast = scenario.replace({"network.activation.rate": rate})
        apart.append(np.abs(theory.steady_covariance_bound(fast) - S).max())
    assert apart[0] / apart[1] == pytest.approx(10.0, rel=0.05)
    with pytest.raises(netkf.TheoryError, match="stays random"):
        theory.true_limit_covariance(scenario)
    with pytest.raises(netkf.TheoryError, match="up and down"):
        theory.central_covariance(scenario)


def scalar(build, a, activation, sampling, filter_, graph=None, R=1.0):
    return build(
        plant={"kind": "diffusion", "A": [[a]], "B": [[1.0]], "cov": [[1.0]]},
        sensors=[{"nodes": [0], "H": [[1.0]], "R": [[R]], "sampling": sampling}],
        network={
            "graph": graph or {"kind": "path", "nodes": 2},
            **({"activation": activation} if activation else {}),
        },
        filter=filter_,
        horizon=50.0,
    )


def test_thresholds(build):
    """A blind node that hears at rate r with weight w needs r w > 2 a; a node that samples alone at
    rate s needs s > 2 a.
    """
    a, sampling = 0.5, {"kind": "poisson", "rate": 50.0}
    heard = {"kind": "poisson", "rate": 2.1, "at": "nodes"}
    hybrid = {"kind": "hybrid", "epsilon": 0.5}
    above = scalar(build, a, heard, sampling, hybrid)
    assert np.isfinite(theory.steady_covariance_bound(above)).all()
    below = scalar(build, a, {**heard, "rate": 1.0}, sampling, hybrid)
    with pytest.raises(netkf.TheoryError, match=r"the rate 1 is below the threshold (1\.99|2)"):
        theory.steady_covariance_bound(below)
    full = {"kind": "hybrid", "epsilon": 1.0}
    whole = scalar(build, a, {**heard, "rate": 1.1}, sampling, full)
    steady = theory.steady_covariance_bound(whole)[:, 0, 0]
    assert np.isfinite(steady).all()
    with pytest.raises(netkf.TheoryError, match="threshold"):
        theory.steady_covariance_bound(scalar(build, a, {**heard, "rate": 0.9}, sampling, full))
    for s, exists in ((1.05, True), (0.95, False)):
        alone = scalar(build, a, None, {"kind": "poisson", "rate": s}, {"kind": "local"})
        if exists:
            P = steady_by_node(alone)[0, 0, 0]
            # 0 = 2 a P + 1 - s P^2 / (P + 1)
            assert 2 * a * P + 1.0 == pytest.approx(s * P**2 / (P + 1.0), rel=1e-9)
        else:
            assert np.isnan(steady_by_node(alone)[0]).all()


def test_remote_estimation_over_one_link_in_closed_form(build):
    """E = (B^2 / 2 a) (r / (r - 2 a) - 1) where each message brings x exactly."""
    a, r = 0.5, 3.0
    perfect = {"kind": "poisson", "rate": 1e7}
    heard = {"kind": "poisson", "rate": r, "at": "nodes"}
    scenario = scalar(build, a, heard, perfect, {"kind": "hybrid", "epsilon": 1.0}, R=1e-9)
    # node 0 hears the blind node too, and forgets it at its next sample
    blind = theory.steady_covariance_bound(scenario)[1, 0, 0]
    assert blind == pytest.approx((1.0 / (2 * a)) * (r / (r - 2 * a) - 1.0), rel=1e-5)


def test_samples_at_known_times_are_jumps(build):
    """One node alone: the textbook filter; two nodes: by hand."""
    a, T, R = -0.2, 0.5, 0.4
    periodic = {"kind": "periodic", "period": T}
    alone = scalar(build, a, None, periodic, {"kind": "local"}, R=R)
    times = [0.3, 0.5, 1.0, 1.2]
    f, q = np.exp(2 * a * T), (np.exp(2 * a * T) - 1) / (2 * a)

    def over(P, gap):
        e = np.exp(2 * a * gap)
        return e * P + (e - 1) / (2 * a)

    first = over(1.0, T)
    first = first - first**2 / (first + R)
    second = f * first + q
    second = second - second**2 / (second + R)
    expected = [over(1.0, 0.3), first, second, over(second, 0.2)]
    np.testing.assert_allclose(
        theory.covariance_bound(alone, times)[:, 0, 0, 0], expected, rtol=1e-9
    )
    told = scalar(build, a, {"kind": "readings"}, periodic, {"kind": "hybrid", "epsilon": 0.4}, R=R)
    blind = 0.6 * over(1.0, T) + 0.4 * first
    blind = [blind, 0.6 * over(blind, T) + 0.4 * second]
    found = theory.covariance_bound(told, [0.5, 1.0])[:, 1, 0, 0]
    np.testing.assert_allclose(found, blind, rtol=1e-9)
    late = told.replace({"network.channel.delay": {"kind": "constant", "seconds": 0.2}})
    at = 0.6 * over(1.0, 0.7) + 0.4 * over(first, 0.2)
    np.testing.assert_allclose(
        theory.covariance_bound(late, [0.6, 0.7, 0.9])[:, 1, 0, 0],
        [over(1.0, 0.6), at, over(at, 0.2)],
        rtol=1e-9,
    )
    with pytest.raises(netkf.TheoryError, match="cycle"):
        theory.steady_covariance_bound(alone)
    with pytest.raises(netkf.TheoryError, match="up to the horizon"):
        theory.covariance_bound(alone, [60.0])


def test_what_is_not_promised_is_said(build):
    jittered = {"kind": "periodic", "period": 0.5, "jitter": 0.1}
    for sampling in (jittered, {"kind": "periodic", "period": 0.5, "phase": "random"}):
        scenario = three(
            build,
            {"kind": "poisson", "rate": 1.0},
            sensors=[{"nodes": [1], "H": [[1.0, 0.0]], "R": [[1.0]], "sampling": sampling}],
        )
        with pytest.raises(netkf.TheoryError, match="when node 1 samples is random"):
            theory.covariance_bound(scenario, [1.0])
