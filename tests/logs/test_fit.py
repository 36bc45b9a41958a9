"""Laws of losses against synthetic logs whose laws are known."""

import itertools
import json
import math
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import scipy.optimize
import scipy.special
import scipy.stats

import netkf
from netkf.cli.main import main
from netkf.core.errors import ScenarioError
from netkf.logs.envelope import FittedLaw
from netkf.logs.fitting import run_tests
from netkf.logs.outcomes import (
    Group,
    LogOutcomes,
    _shrinkage,
    binomial_interval,
    choose_windows,
    correlation_time,
    counts_in,
    fit_chain,
    fit_distance,
    long_run_sum,
    make_outcomes,
    residual_spread,
    shared_fate,
    shared_law,
)
from netkf.logs.outcomes import test_constancy as constancy_test
from netkf.logs.outcomes import test_identical as identity_test
from netkf.logs.outcomes import test_time as time_test
from netkf.scenario.writing import as_table
from tests.conftest import SCENARIOS

LEVEL = 0.05


def drawn(
    random, T=150, share=0.0, chain=None, p=0.8, senders=3, hearers=3, wave=0.0, steps=(0.0,)
):
    """Outcomes of broadcasts by a law: share of one fate, a chain (to_bad, to_good, good, bad), one
    delivery p or one for each link, and a wave of it over time, or steps of it.
    """
    groups, links = [], []
    deliveries = np.broadcast_to(p, (senders, hearers))
    for s in range(senders):
        ids = np.arange(hearers) + len(links)
        links += [(str(s), f"{s}{j}") for j in range(hearers)]
        uniform, one = random.random((T, hearers)), random.random(T) < share
        uniform[one] = random.random((one.sum(), 1))
        q = deliveries[s] + wave * np.sin(6.0 * math.pi * np.arange(T) / T)[:, None]
        q += np.array(steps)[np.arange(T) * len(steps) // T, None]
        if chain is not None:
            to_bad, to_good, good, bad = chain
            state, q = random.random(hearers) < to_bad / (to_bad + to_good), np.empty((T, hearers))
            for t in range(T):
                u = random.random(hearers)
                state = np.where(state, u >= to_good, u < to_bad)
                q[t] = np.where(state, bad, good)
        follows = np.arange(T) > 0
        groups.append(Group((uniform < q).astype(float), np.arange(T) + s / 9, follows, ids))
    return LogOutcomes(tuple(links), tuple(groups), ("",) * senders)


def seeds(count, offset=0):
    return (np.random.default_rng([offset, seed]) for seed in range(count))


def rate(flags):
    return np.mean(list(flags))


def binomial_range(count, p):
    """Four standard deviations around ``p``."""
    width = 4.0 * math.sqrt(p * (1.0 - p) / count)
    return p - width, p + width


def test_true_laws_are_kept_and_parameters_lie_in_their_intervals():
    """200 logs of links of their own that share a fate of 0.4: intervals of 95 % hold them, and
    true assumptions are rejected at the level of the test.
    """
    p = np.array([[0.5, 0.6, 0.7], [0.8, 0.85, 0.9], [0.65, 0.75, 0.95]])
    inside, together, rejected = [], [], {"time": [], "memory": [], "constancy": []}
    for random in seeds(200):
        outcomes = drawn(random, share=0.4, p=p)
        tests, share, *_ = run_tests(outcomes, None)
        inside.append(abs(share.value - 0.4) < 1.96 * share.error)
        count, heard = outcomes.counts.T.astype(float)
        low, high = binomial_interval(heard, count, LEVEL / len(count))
        together.append(((low <= p.ravel()) & (p.ravel() <= high)).all())
        assert tests["fate"].p < 1e-3
        for name, flags in rejected.items():
            flags.append(tests[name].p < LEVEL)
    low, high = binomial_range(200, 0.95)
    assert low < rate(inside) <= 1.0
    assert rate(together) > low
    for flags in rejected.values():
        assert rate(flags) < binomial_range(200, LEVEL)[1]


def test_true_assumptions_are_kept_where_packets_hop_and_links_lose_nothing():
    """At random over three channels few follow each other; perfect links take no parameter."""
    pairs = tuple(itertools.permutations("0123", 2))
    p = np.where([{i, j} < {"0", "1", "2"} for i, j in pairs], 0.7, 1.0).reshape(4, 3)
    rejected = {"memory": [], "channel": [], "directions": []}
    for random in seeds(100, 9):
        groups = []
        for x, t, _, ids in drawn(random, T=250, p=p, senders=4).groups:
            channel = random.integers(3, size=len(t))
            for own in (np.flatnonzero(channel == k) for k in range(3)):
                follows = np.diff(own, prepend=-2) == 1
                groups.append(Group(x[own], t[own], follows, ids))
        tests, *_ = run_tests(LogOutcomes(pairs, tuple(groups), ("a", "b", "c") * 4), None)
        for name, flags in rejected.items():
            flags.append(tests[name].p < LEVEL)
    assert max(map(rate, rejected.values())) < binomial_range(100, LEVEL)[1]


@pytest.mark.parametrize("share", [0.0, 0.7, 1.0])
def test_the_share_of_one_fate_from_none_to_all(share):
    found = [shared_fate(drawn(random, share=share), 0)[0] for random in seeds(100, 1)]
    errors = np.array([f.value - share for f in found])
    assert abs(errors.mean()) < 4.0 * max(errors.std(), 1e-12) / 10.0 + 0.005
    covered = [abs(e) <= 1.96 * f.error + 1e-9 for e, f in zip(errors, found, strict=True)]
    assert rate(covered) > binomial_range(100, 0.95)[0]
    stated = np.mean([f.error for f in found])
    assert stated == pytest.approx(errors.std(), rel=0.3, abs=0.005)  # nor is it too large


def test_statistics_are_what_plain_sums_say():
    random = np.random.default_rng(1)
    units = random.normal(size=40)
    apart = np.abs(np.subtract.outer(np.arange(40), np.arange(40)))
    by_hand = units @ np.maximum(1.0 - apart / 6.0, 0.0) @ units
    assert long_run_sum(units, 5) == pytest.approx(by_hand)
    heard = np.array([0.0, 3.0, 9.0])
    exact = [scipy.stats.binomtest(int(k), 9).proportion_ci(0.95) for k in heard]
    np.testing.assert_allclose(
        np.transpose(binomial_interval(heard, 9.0 + 0.0 * heard, LEVEL)), exact
    )
    outcomes, p, share = drawn(random, T=40, share=0.4, senders=1), 0.7, 0.3
    x = outcomes.groups[0].x
    one = np.where(x.all(axis=1), p, np.where(x.any(axis=1), 0.0, 1.0 - p))
    rows = (1.0 - share) * np.where(x == 1.0, p, 1.0 - p).prod(axis=1) + share * one
    likelihood, variance = shared_law(outcomes, p, share)
    assert likelihood == pytest.approx(np.log(rows).sum())
    assert variance == pytest.approx(((x.sum(axis=1) - 3.0 * p) ** 2).sum() / 120.0**2)


def test_the_share_of_one_fate_does_not_depend_on_the_order_of_senders():
    """Sums of the last packets of one sender were multiplied with those of the first of another."""
    outcomes = drawn(np.random.default_rng(5), T=40, chain=(0.1, 0.3, 0.95, 0.1))
    turned = LogOutcomes(outcomes.links, outcomes.groups[::-1], outcomes.channels)
    np.testing.assert_allclose(shared_fate(turned, 8)[0], shared_fate(outcomes, 8)[0], rtol=1e-12)
    one, other = (shared_fate(each, 8)[1].p for each in (outcomes, turned))
    assert one == pytest.approx(other, rel=1e-12)


def test_the_time_of_a_chain_and_no_windows_without_a_change():
    """Correlations of .6 ** lag add up to (1 + .6) / (1 - .6); noise has no edges."""
    chain = (0.1, 0.3, 1.0, 0.0)
    found = [correlation_time(drawn(random, T=60, chain=chain)) for random in seeds(100, 10)]
    assert np.mean(found) == pytest.approx(4.0, rel=0.1)
    edges = [choose_windows(drawn(random)) for random in seeds(60, 11)]
    assert rate(map(len, edges)) < 0.1


@pytest.mark.slow
def test_departures_of_the_stated_size_are_found_with_the_stated_power():
    """Of bursts (a chain whose outcomes are correlated by r), and of shared fate."""
    unit = time_test(drawn(np.random.default_rng(0))).detectable(LEVEL)
    p = 0.8
    chain = ((1.0 - p) * (1.0 - unit), p * (1.0 - unit), 1.0, 0.0)
    found = [time_test(drawn(random, chain=chain)).p < LEVEL for random in seeds(200, 2)]
    low, high = binomial_range(200, 0.9)
    assert low < rate(found) < high
    share = shared_fate(drawn(np.random.default_rng(0)), 0)[1].detectable(LEVEL)
    found = [shared_fate(drawn(r, share=share), 0)[1].p < LEVEL for r in seeds(200, 3)]
    assert low < rate(found) < high
    spread = [run_tests(drawn(r), None)[0]["links"].p < LEVEL for r in seeds(60, 4)]
    assert rate(spread) < binomial_range(60, LEVEL)[1]
    size = run_tests(drawn(np.random.default_rng(0)), None)[0]["links"].detectable(LEVEL)
    other = [
        run_tests(drawn(r, p=0.8 + size * r.choice([-1, 1], (3, 3))), None)[0]["links"].p < LEVEL
        for r in seeds(100, 5)
    ]
    assert rate(other) > 0.75
    # It is as uncertain as the variance of 48 blocks.
    none = [constancy_test(drawn(r, T=600, p=0.75)).detectable(LEVEL) for r in seeds(30, 15)]
    step = np.mean(none)
    laws = (drawn(r, T=600, p=0.75, steps=(step, -step)) for r in seeds(200, 14))
    assert 0.8 < rate(constancy_test(outcomes).p < LEVEL for outcomes in laws) < high


def test_the_share_that_many_hearers_find_and_bursts_do_not_feign():
    """A shared fate makes sums over pairs vary more, and bursts make those of neighbours alike."""
    plain = {"T": 40, "p": 0.5, "senders": 1, "hearers": 10}
    found = shared_fate(drawn(np.random.default_rng(0), **plain), 0)[1]
    share, low = found.detectable(LEVEL), binomial_range(200, 0.9)[0]
    powers = [
        rate(shared_fate(drawn(r, share=s, **plain), 0)[1].p < LEVEL for r in seeds(200, 12))
        for s in (share, found._replace(rise=0.0).detectable(LEVEL))
    ]
    assert powers[0] > low > powers[1]
    tests = [run_tests(drawn(r, chain=(0.03, 0.05, 1.0, 0.0)), None) for r in seeds(60, 13)]
    assert rate(one["fate"].p < LEVEL for one, *_ in tests) < binomial_range(60, LEVEL)[1]
    assert rate(abs(s.value) < 1.96 * s.error for _, s, *_ in tests) > binomial_range(60, 0.95)[0]


def test_slow_changes_are_found():
    tests, *_ = run_tests(drawn(np.random.default_rng(3), T=600, wave=0.15), None)
    assert tests["constancy"].p < 1e-4
    assert 0.05 < tests["constancy"].estimate < 0.15  # 0.15 / sqrt 2 = 0.106


@pytest.mark.parametrize("steps", [(0.0, -0.6, 0.0), (0.0, -0.85), (0.0, -0.25, 0.0)])
def test_however_large_a_change_is_it_is_no_burst_and_no_shared_fate(steps):
    """The larger it is, the longer outcomes are correlated; its edges are windows' edges."""
    found, other = [], []
    for random in seeds(12, 8):
        tests, *_, edges = run_tests(drawn(random, T=400, p=0.9, steps=steps), None)
        found.append(tests["constancy"].p < LEVEL)
        other += [tests[name].p < LEVEL for name in ("time", "fate")]
        true = 400.0 * np.arange(1, len(steps)) / len(steps)
        assert np.abs(edges[:, None] - true).min(axis=0).max() < 12.0
    assert all(found)
    assert rate(other) < binomial_range(24, LEVEL)[1]


@pytest.mark.slow
def test_slow_changes_are_neither_bursts_nor_shared_fate():
    """Few true assumptions are rejected; without windows most would be."""
    flags, without = [], []
    for random in seeds(25, 6):
        outcomes = drawn(random, T=600, p=0.7, wave=0.15)
        tests, share, _, edges = run_tests(outcomes, None)
        assert len(edges) > 2
        assert abs(share.value) < 0.08
        flags += [tests[name].p < LEVEL for name in ("time", "memory", "fate")]
        without.append(time_test(outcomes).p < LEVEL)
    assert rate(flags) < binomial_range(75, LEVEL)[1] < 0.5 < rate(without)
    counts = counts_in(outcomes, edges)
    assert counts[:, 0].sum() == 5400
    window = np.searchsorted(edges, np.arange(600.0), side="right")
    true = 0.7 + 0.15 * np.sin(6.0 * math.pi * np.arange(600) / 600)
    expected = np.bincount(window, true) / np.bincount(window)
    error = counts[:, 1] / counts[:, 0] - expected
    assert (abs(error) < 4.0 * np.sqrt(0.21 / counts[:, 0])).all()


def test_the_chain_of_two_states():
    """Its parameters lie within their errors, and outcomes that one chain makes are not Markov."""
    true = np.array([0.05, 0.2, 0.95, 0.1])
    off = []
    for random in seeds(6, 6):
        outcomes = drawn(random, T=500, chain=true)
        chain = fit_chain(outcomes)
        logits = np.log(chain.values / (1.0 - chain.values)) - np.log(true / (1.0 - true))
        off += (logits / np.sqrt(np.diag(chain.cov))).tolist()
        assert run_tests(outcomes, None)[0]["memory"].p < LEVEL
    assert np.mean(np.square(off)) < 2.0  # a mean of 24 squares of standard normals, nearly
    assert np.abs(off).max() < 4.0
    # The likelihood, written plainly for one link: the forward algorithm.
    outcomes = drawn(np.random.default_rng(1), T=300, chain=true, senders=1, hearers=1)
    chain = fit_chain(outcomes)

    def likelihood(logits):
        to_bad, to_good, good, bad = scipy.special.expit(logits)
        move = np.array([[1 - to_bad, to_bad], [to_good, 1 - to_good]])
        law, total = np.array([to_good, to_bad]) / (to_bad + to_good), 0.0
        for x in outcomes.groups[0].x[:, 0]:
            law = law @ move * (np.array([good, bad]) if x else 1.0 - np.array([good, bad]))
            total, law = total + math.log(law.sum()), law / law.sum()
        return total

    best, step = scipy.special.logit(chain.values), 0.01 * np.eye(4)
    assert chain.likelihood == pytest.approx(likelihood(best), abs=1e-9)
    # The covariance is that of its curvature and of a prior of deviation 2.
    curvature = [
        [
            sum(s * r * likelihood(best + s * a + r * b) for s in (1, -1) for r in (1, -1)) / -4e-4
            for a in step
        ]
        for b in step
    ]
    np.testing.assert_allclose(np.linalg.inv(chain.cov), curvature + 0.25 * np.eye(4), atol=0.2)


def test_the_spread_of_deliveries_that_is_noise_is_that_of_what_hearers_lose_alone():
    p, n = np.array([0.2, 0.5, 0.8]), 100
    noise = np.mean(p * (1.0 - p) / n)
    fate, alone = np.ones((3, 3)), np.eye(3)
    pair = np.array([[1.0, 1.0, 0.0], [0.0, 0.0, 1.0]])  # two of three hearers have one fate
    for residuals, share in ((fate, 0.0), (alone, 1.0), (pair, 2.0 / 3.0)):
        group = SimpleNamespace(mean=p, x=np.ones((n, 3)), residuals=residuals)
        found = _shrinkage(SimpleNamespace(groups=[group]))
        assert found == pytest.approx(1.0 - share * noise / p.var(ddof=1), abs=1e-12)


def test_the_logistic_function_of_the_distance():
    inside, off = [], []
    for random in seeds(200, 7):
        d, n = random.uniform(5.0, 50.0, 30), np.full(30, 40.0)
        heard = random.binomial(40, 1.0 / (1.0 + np.exp((d - 25.0) / 6.0))).astype(float)
        values, cov = fit_distance(d, n, heard, 1.0)
        off.append((values - [25.0, 6.0]) / np.sqrt(np.diag(cov)))
        inside.append(np.abs(off[-1]) < 1.96)
    assert (np.mean(inside, axis=0) > binomial_range(200, 0.95)[0]).all()
    np.testing.assert_allclose(np.std(off, axis=0), 1.0, atol=0.2)


def test_the_distance_when_nodes_move(tmp_path):
    """One likelihood over all packets, each at the distance at which it was sent: scipy's is the
    same, and what places cause is taken for neither bursts nor slow changes.
    """
    random, rows, places, near = np.random.default_rng(3), [], [], []
    for k in range(120):
        at = np.array([[0.0, 0.0], [30.0 + 0.2 * k, 0.0], [0.0, 40.0 - 0.3 * k]])
        places += [f"{10 * k + 5},{'abc'[i]},{x},{y}" for i, (x, y) in enumerate(at)]
        for i, j in ((i, j) for i in range(3) for j in range(3) if i != j):
            d = np.hypot(*(at[i] - at[j]))
            heard = random.random() < 1.0 / (1.0 + math.exp((d - 30.0) / 6.0))
            rows.append(f"{10 * k + 5 + i},{'abc'[i]},{'abc'[j]},{k},{int(heard)}")
            near.append((d, heard))
    (tmp_path / "packets.csv").write_text("\n".join(["t,from,to,number,heard", *rows]))
    (tmp_path / "positions.csv").write_text("\n".join(["t,node,x,y", *places]))
    netkf.import_log(tmp_path, "csv", tmp_path / "log")
    fit = netkf.fit_log(tmp_path / "log", runs=0)
    d, heard = np.array(near).T

    def miss(values):
        z = (values[0] - d) / values[1]
        return np.logaddexp(0.0, -z)[heard == 1].sum() + np.logaddexp(0.0, z)[heard == 0].sum()

    best = scipy.optimize.minimize(miss, [20.0, 10.0], method="Nelder-Mead", tol=1e-9)
    law = netkf.load(fit.scenarios["distance"]).network.channel.loss.delivery
    assert (law.half, law.width) == pytest.approx(best.x, rel=1e-4)
    row = fit.laws.set_index("law").loc["distance"]
    assert row["log_likelihood"] == pytest.approx(-best.fun, rel=1e-6)
    assert row["rejected_by"] == ""
    assert row["bic"] == fit.laws["bic"].min()
    assert row["bic"] == pytest.approx(2.0 * math.log(len(d)) - 2.0 * row["log_likelihood"])


def test_runs_draw_parameters_from_their_posterior():
    """Beta(heard + 1/2, lost + 1/2): ten packets leave a spread that mean and variance tell."""
    law = FittedLaw("per-link", np.array([0.7]), 0.0, np.array([[10.0, 7.0]]))
    values = np.array([law.draw(random)[0] for random in seeds(2000, 8)])
    a, b = 7.5, 3.5
    assert values.mean() == pytest.approx(a / (a + b), abs=0.01)
    assert values.var() == pytest.approx(a * b / (a + b) ** 2 / (a + b + 1), rel=0.1)


@pytest.mark.parametrize(("packets", "spread"), [(2, 0.0), (10, 0.0), (10, 0.3)])
def test_thousands_of_links_with_few_packets_are_drawn_without_a_bias(packets, spread):
    """A prior of half a packet each moved all to one side: the true law did not make its replay."""
    random, links = np.random.default_rng(packets), 4000
    p = 0.65 + spread * random.uniform(-1.0, 1.0, links)
    counts = np.stack([np.full(links, packets), random.binomial(packets, p)], axis=1).astype(float)
    half = np.stack([counts[:, 0], counts[:, 0] - counts[:, 1]], axis=1)
    for kind, both in (("per-link", counts), ("per-link-bursts", np.concatenate([counts, half]))):
        drawn = np.array([FittedLaw(kind, p, 0.0, both).draw(one) for one in seeds(20, 8)])
        for k, part in enumerate(np.split(drawn, len(both) // links, axis=1)):
            mean, deviation = (p, 1.0 - p)[k].mean(), math.sqrt(0.23 / links / packets)
            assert part.mean() == pytest.approx(mean, abs=4.0 * deviation)
            # They differ as the links do, no more.
            assert part.std(axis=1).mean() == pytest.approx(p.std(), abs=0.1 / math.sqrt(packets))


def log_of(path, random, count=60, share=0.0):
    rows = ["t,src,dst,seq,channel,heard"]
    for k in range(count):
        for i in range(3):
            one, fate = random.random() < share, random.random()
            for j in range(3):
                if i != j:
                    luck, p = fate if one else random.random(), 0.95 if k % 2 else 0.5
                    rows.append(f"{k + 0.2 * i + 1},{i},{j},{k},{11 + k % 2},{int(luck < p)}")
    path.write_text("\n".join(rows) + "\n")
    return path


def test_a_fit_writes_laws_that_run_and_says_what_fails(tmp_path, capsys):
    log = log_of(tmp_path / "log.csv", np.random.default_rng(1))
    (tmp_path / "positions.csv").write_text("node,x,y\n0,0,0\n1,1,0\n2,0,2\n")
    netkf.import_log(log, "csv", tmp_path / "out")
    arguments = ["fit", str(tmp_path / "out"), "--runs", "10", "--workers", "1"]
    assert main([*arguments, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    tests = {row["key"]: row for row in document["tests"]}
    assert tests["channel"]["verdict"] == "rejected"
    assert tests["channel"]["made_by"] == "hopping"
    hopping = pd.read_csv(tmp_path / "out" / "fit_hopping.csv")
    sent = pd.read_csv(tmp_path / "out" / "outcomes.csv").sort_values(["sender", "receiver", "t"])
    hopping = hopping.sort_values(["sender", "receiver", "from"])
    assert (
        (hopping["from"].to_numpy() < sent["t"]) & (sent["t"] < hopping["until"].to_numpy())
    ).all()
    shares = sent.groupby("channel")["delivered"].transform("mean")
    np.testing.assert_allclose(hopping["delivery"], shares)
    links = pd.read_csv(tmp_path / "out" / "fit_links.csv")
    outcomes = pd.read_csv(tmp_path / "out" / "outcomes.csv")
    mean = outcomes.groupby(["sender", "receiver"])["delivered"].mean().to_numpy()
    np.testing.assert_allclose(links["delivery_probability"], mean)
    assert {"per-link", "bernoulli"} <= set(document["scenarios"])
    heard = [row for row in document["envelope"] if row["quantity"] == "messages heard"]
    assert all(row["replay"] == outcomes["delivered"].sum() for row in heard)
    assert all(row["p"] > 0.01 and row["low"] < row["replay"] < row["high"] for row in heard)
    for path in document["scenarios"].values():
        run = netkf.simulate(netkf.load(path), engine="simpy")
        assert (run.events["kind"] == "send").sum() == len(outcomes)
    assert any("p by Student's t" in note for note in document["notes"])


def test_what_nobody_reported_counts_as_lost_and_holes_do_not(tmp_path):
    """Without the packets that nobody heard, hearers would look dependent."""
    random, rows = np.random.default_rng(2), ["t,src,dst,seq"]
    for k in range(300):
        for i in range(3):
            heard = [j for j in range(3) if i != j and random.random() < 0.6]
            rows += [f"{k + 0.2 * i + 1},{i},{j},{k}" for j in heard]
    (tmp_path / "log.csv").write_text("\n".join(rows) + "\n")
    netkf.import_log(tmp_path / "log.csv", "csv", tmp_path / "out")
    fit = netkf.fit_log(tmp_path / "out", runs=0)
    unknown = pd.read_csv(tmp_path / "out" / "unknown.csv")
    assert fit.links["unreported"].sum() == len(unknown) > 100
    assert fit.links["unknown"].sum() == 0
    heard, packets = fit.links["heard"], fit.links["packets"]
    np.testing.assert_allclose(fit.links["at_least"], heard / packets)
    np.testing.assert_allclose(fit.links["at_most"], (heard + fit.links["unreported"]) / packets)
    assert (fit.links["low"] < 0.6).all()
    assert (fit.links["high"] > 0.6).all()
    assert fit.tests.set_index("key").loc["fate", "verdict"] == "not rejected"
    assert fit.envelope.empty
    assert "per-link" in repr(fit)


def test_nodes_that_die_or_come_late_and_channels_in_turn(tmp_path):
    """What is not known at the end of a log is not known, and not lost; packets that nobody heard
    were on the channel whose turn it was, and do not make hearers look dependent.
    """
    random, rows, quality = np.random.default_rng(4), ["t,src,dst,seq,channel"], (0.9, 0.7, 0.4)
    for k in range(500):
        present = [i for i in range(5) if not (i == 1 and k >= 300) and not (i == 4 and k < 150)]
        for i in present:
            heard = [j for j in present if j != i and random.random() < quality[k % 3]]
            rows += [f"{k + 0.1 * i + 1:.1f},{i},{j},{k % 64},CH{k % 3}" for j in heard]
    (tmp_path / "log.csv").write_text("\n".join(rows) + "\n")
    netkf.import_log(tmp_path / "log.csv", "csv", tmp_path / "out")
    fit = netkf.fit_log(tmp_path / "out", runs=10, workers=1)
    accounts = pd.read_csv(tmp_path / "out" / "accounts.csv")
    assert (fit.links["packets"] + fit.links["unknown"]).tolist() == accounts["sent"].tolist()
    assert fit.links["unknown"].sum() > 900
    tests = fit.tests.set_index("key")
    rejected = tests.index[tests["verdict"] == "rejected"].tolist()
    assert rejected == ["channel"]
    # The next packet of a sender on one channel is three numbers later: nothing tells of time.
    assert tests.loc["time", "verdict"] == "not tested"
    hopping = pd.read_csv(tmp_path / "out" / "fit_hopping.csv")["delivery"]
    np.testing.assert_allclose(np.sort(hopping.unique()), sorted(quality), atol=0.04)
    heard = fit.envelope[fit.envelope["quantity"].isin(["messages heard", "mean age (s)"])]
    assert heard["inside"].all()


def test_channels_of_packets_that_nobody_heard_are_not_invented(tmp_path):
    """Those heard are more often on good channels, and at one hearer where not at the other."""
    random, rows, quality = np.random.default_rng(24), ["t,src,dst,seq,channel"], (0.85, 0.3, 0.6)
    for k in range(500):
        for i in range(3):
            c = random.integers(3)
            heard = [j for j in range(3) if j != i and random.random() < quality[c]]
            rows += [f"{k + 0.1 * i + 1:.1f},{i},{j},{k},c{c}" for j in heard]
    (tmp_path / "log.csv").write_text("\n".join(rows) + "\n")
    netkf.import_log(tmp_path / "log.csv", "csv", tmp_path / "out")
    fit = netkf.fit_log(tmp_path / "out", runs=0)
    verdicts = fit.tests.set_index("key")["verdict"]
    assert (verdicts["channel"], verdicts["fate"]) == ("rejected", "not rejected")
    hopping = pd.read_csv(tmp_path / "out" / "fit_hopping.csv")["delivery"]
    np.testing.assert_allclose(np.sort(hopping.unique()), sorted(quality), atol=0.06)
    assert any("whose channel nobody tells: drawn, once" in note for note in fit.notes)
    # All laws are compared by the same outcomes.
    likelihood = fit.laws.set_index("law")["log_likelihood"]
    assert likelihood["per-link-bursts"] == pytest.approx(likelihood["per-link"], rel=0.03)
    assert likelihood["hopping"] > likelihood["bernoulli"]


def test_channels_that_are_alike_stay_so_where_nobody_hears_many_packets(tmp_path):
    """What is lost with its channel makes no channel better than the link."""
    random, rows = np.random.default_rng(25), ["t,src,dst,seq,channel"]
    for k in range(300):
        for i in range(3):
            c = random.integers(3)
            heard = [j for j in range(3) if j != i and random.random() < 0.4]
            rows += [f"{k + 0.1 * i + 1:.1f},{i},{j},{k % 64},{c}" for j in heard]
    (tmp_path / "log.csv").write_text("\n".join(rows) + "\n")
    netkf.import_log(tmp_path / "log.csv", "csv", tmp_path / "out")
    tests = netkf.fit_log(tmp_path / "out", runs=0).tests.set_index("key")
    assert tests.loc["channel", "verdict"] == "not rejected"
    # All tests hold together.
    confidence = 1.0 - 1.5 * tests["p"].min()
    again = netkf.fit_log(tmp_path / "out", runs=0, confidence=confidence).tests
    assert "rejected" not in set(again["verdict"])


@pytest.mark.parametrize("symmetric", ["false", "true"])
def test_links_with_bursts_of_their_own(tmp_path, symmetric):
    """The table of chains holds what follows what in the record, and its runs are like the log,
    whatever a scenario that the log was imported like says of both directions.
    """
    random, rows, bad = np.random.default_rng(5), ["t,src,dst,seq,heard"], {}
    for k in range(400):
        for i in range(3):
            for j in {0, 1, 2} - {i}:
                to_bad, to_good = 0.02 + 0.03 * i, 0.1 + 0.2 * j
                was = bad.get((i, j), False)
                bad[i, j] = random.random() >= to_good if was else random.random() < to_bad
                rows.append(f"{k + 0.2 * i + 1},{i},{j},{k},{int(not bad[i, j])}")
    (tmp_path / "log.csv").write_text("\n".join(rows) + "\n")
    netkf.import_log(tmp_path / "log.csv", "csv", tmp_path / "out")
    scenario = tmp_path / "out" / "scenario.toml"
    scenario.write_text(
        scenario.read_text().replace("symmetric = false", f"symmetric = {symmetric}")
    )
    fit = netkf.fit_log(tmp_path / "out", runs=6, workers=1)
    law = fit.laws.set_index("law").loc["per-link-bursts"]
    assert law["rejected_by"] == ""
    assert law["bic"] < fit.laws.set_index("law").loc["per-link", "bic"]
    file = tmp_path / "out" / "fit_per_link_bursts.csv"
    table = pd.read_csv(file, dtype=str).astype(float)  # exactly, with any pandas
    np.testing.assert_allclose(table["to_good"], fit.links["to_good"], atol=0.02)
    np.testing.assert_allclose(table["to_bad"], 0.02 + 0.03 * table["sender"], atol=0.04)
    own = fit.envelope[fit.envelope["law"] == "per-link-bursts"]
    assert (own["p"] > 0.005).all()
    # Of six runs Student's t, of both sides.
    row = own.set_index("quantity").loc["messages heard"]
    middle, half = 0.5 * (row["low"] + row["high"]), 0.5 * (row["high"] - row["low"])
    reach = scipy.stats.t.isf(0.5 * 0.05 / len(own), 5)
    off = abs(row["replay"] - middle) / half * reach
    assert row["p"] == pytest.approx(2.0 * scipy.stats.t.sf(off, 5))
    loss = netkf.load(fit.scenarios["per-link-bursts"]).network.channel.loss
    assert loss.of((0, 1)).to_bad == table["to_bad"][0]
    # Intervals of all links together, of to_bad and to_good too; bursts widen those of deliveries.
    log = pd.read_csv(tmp_path / "log.csv").query("src == 0 and dst == 1")["heard"].to_numpy()
    row, level = fit.links.iloc[0], 0.05 / len(fit.links)
    next_ones = log[1:][log[:-1] == 1]
    exact = scipy.stats.binomtest(int((next_ones == 0).sum()), len(next_ones))
    assert (row["to_bad_low"], row["to_bad_high"]) == pytest.approx(
        tuple(exact.proportion_ci(1.0 - level / 2.0))
    )
    exact = scipy.stats.binomtest(int(log.sum()), len(log)).proportion_ci(1.0 - level)
    assert row["high"] - row["low"] > 1.3 * (exact.high - exact.low)


def test_directions_without_a_packet_have_the_law_of_the_others(tmp_path):
    """Node 1 never sends, though its link goes both ways."""
    chain, rows, bad = np.random.default_rng(2), ["t,src,dst,seq,heard"], False
    for k in range(300):
        bad = chain.random() < (0.8 if bad else 0.1)
        rows.append(f"{k + 1},0,1,{k},{int(not bad)}")
    (tmp_path / "log.csv").write_text("\n".join(rows) + "\n")
    netkf.import_log(tmp_path / "log.csv", "csv", tmp_path / "out")
    scenario = tmp_path / "out" / "scenario.toml"
    scenario.write_text(scenario.read_text().replace("directed = true", "directed = false"))
    fit = netkf.fit_log(tmp_path / "out", runs=4, workers=1)
    assert {"per-link-bursts", "gilbert-elliott"} <= set(fit.scenarios)
    for path in fit.scenarios.values():
        netkf.simulate(netkf.load(path))
    loss = netkf.load(fit.scenarios["per-link-bursts"]).network.channel.loss
    assert loss.of((1, 0)).transitions == pytest.approx(loss.of((0, 1)).transitions)


def test_channels_and_stretches_are_kept_apart():
    rows = [
        {"sender": "a", "receiver": r, "message": k, "t": k, "transmission": k, "delivered": 1.0}
        | {"channel": 11 + (k // 3) % 2}
        for k in range(9)
        for r in ("b", "c")
        if (k, r) != (4, "b")
    ]
    outcomes = make_outcomes(pd.DataFrame(rows))
    assert outcomes.channels == ("11", "12")
    assert [group.follows.tolist() for group in outcomes.groups] == [
        [False, True, True, False, True, True],
        [False, True, True],
    ]
    assert np.isnan(outcomes.groups[1].x[1]).tolist() == [True, False]
    assert outcomes.counts.tolist() == [[8, 8], [9, 9]]
    assert outcomes.transitions.tolist() == [[4, 0, 0, 0], [6, 0, 0, 0]]


def test_only_a_record_can_be_fitted(tmp_path):
    (tmp_path / "scenario.toml").write_text((SCENARIOS / "poisson_ring.toml").read_text())
    with pytest.raises(ScenarioError, match=r"network.channel.loss.kind: must be recorded"):
        netkf.fit_log(tmp_path)


@pytest.mark.parametrize("shares", [(1.0, 0.0), (0.6, 0.4)])
def test_delays_of_one_length_are_constant_and_those_of_none_are_counted(tmp_path, shares):
    rows = ["t,sender,receiver,number,heard,t_heard"]
    for k in range(10):
        late = 0.3 if k < 10 * shares[0] else 0.0
        rows.append(f"{0.1 * k:.1f},a,b,{k},1,{0.1 * k + late:.1f}")
    (tmp_path / "log.csv").write_text("\n".join(rows))
    netkf.import_log(tmp_path / "log.csv", "csv", tmp_path / "made")
    found = netkf.fit_log(tmp_path / "made", runs=0)
    delay = netkf.load(found.scenarios["bernoulli"]).network.channel.delay
    assert delay.seconds == pytest.approx(0.3, abs=1e-12)
    again = netkf.fit_log(tmp_path / "made" / "scenario.toml", runs=0)  # a file will do
    assert again.scenarios == found.scenarios
    assert any("4 of 10 delays are 0" in note for note in found.notes) == (shares[1] > 0.0)


@pytest.mark.parametrize(
    "law",
    [
        {"kind": "lognormal", "mean": 0.3, "sigma": 0.5},
        {"kind": "exponential", "mean": 0.2},
        {"kind": "uniform", "low": 0.1, "high": 0.3},
    ],
)
def test_delays_have_the_law_they_were_drawn_from(tmp_path, law):
    random = np.random.default_rng(1)
    kind, *values = law.values()
    if kind == "lognormal":
        values[0] = np.log(values[0]) - 0.5 * values[1] ** 2
    found = _fit_of_delays(tmp_path, getattr(random, kind)(*values, size=400))
    delay = as_table(netkf.load(found.scenarios["bernoulli"]))["network"]["channel"]["delay"]
    assert delay.pop("kind") == kind
    assert delay == pytest.approx({key: law[key] for key in delay}, rel=0.1)
    assert found.tests.set_index("key").loc["delay", "verdict"] == "not rejected"


@pytest.mark.parametrize("digits", [9, 2])
def test_delays_of_another_law_are_told(tmp_path, digits):
    """Most of them short, some long, as with a retransmission."""
    random = np.random.default_rng(1)
    again = np.where(random.random(400) < 0.2, 0.3, 0.0)
    delays = np.round(again + random.uniform(0.1, 0.2, 400), digits)
    row = _fit_of_delays(tmp_path, delays).tests.set_index("key").loc["delay"]
    law = scipy.stats.lognorm(np.log(delays).std(), scale=np.exp(np.log(delays).mean()))
    assert row["verdict"] == "rejected"
    if digits == 9:
        distance, p = scipy.stats.kstest(delays, law.cdf)
        assert (row["estimate"], row["p"]) == pytest.approx((distance, p), rel=1e-3)


def _fit_of_delays(folder, delays):
    rows = [f"{k},a,b,{k},1,{k + delay:.9f}" for k, delay in enumerate(delays)]
    text = "\n".join(["t,sender,receiver,number,heard,t_heard", *rows])
    (folder / "log.csv").write_text(text)
    netkf.import_log(folder / "log.csv", "csv", folder / "made")
    return netkf.fit_log(folder / "made", runs=0)


def test_residuals_of_hearers_of_one_sender_correlate_by_its_share():
    outcomes = drawn(np.random.default_rng(4), T=20, senders=2, hearers=4)
    lone = Group(np.ones((20, 1)), np.arange(20.0), np.arange(20) > 0, np.array([8]))
    links = (*outcomes.links, ("2", "20"))
    outcomes = LogOutcomes(links, (*outcomes.groups, lone), ("",) * 3)
    together = np.array([[0.3 * (a == b) for b, _ in links] for a, _ in links])
    expected = 2.5 * np.linalg.eigvalsh(together + 0.7 * np.eye(9))
    np.testing.assert_allclose(np.sort(residual_spread(outcomes, 0.3, 2.5)), expected)


def test_links_that_lose_together_have_fewer_degrees_of_freedom():
    """Against draws of the normal law: a sum of squares of residuals that correlate."""
    random, links, share, p = np.random.default_rng(3), 6, 0.5, np.full(6, 0.7)
    covariance = (1.0 - share) * np.eye(links) + share
    residuals = random.multivariate_normal(np.zeros(links), covariance, size=4000)
    spread, packets = np.linalg.eigvalsh(covariance), np.full(links, 500.0)
    values = [
        identity_test(
            np.column_stack([packets, packets * (p + z * np.sqrt(p * (1.0 - p) / packets))]),
            p, spread, 0,
        ).p
        for z in residuals
    ]  # fmt: skip
    # Five deviations; with a degree of freedom for each link it is 0.1.
    assert abs(np.mean(np.array(values) < 0.05) - 0.05) < 0.0175
