"""Losses and delays against their stated laws."""

import numpy as np
import pytest
import scipy.stats

from netkf.network import channels, delays, losses
from netkf.rng.streams import Streams
from netkf.trace.schema import CODES

import netkf  # isort: skip


def sampled_outcomes(count, **settings):
    channel = channels.Channel(**settings)
    sampler = channels.ChannelSampler(
        channel, (0, 1), lambda purpose: Streams(1).generator(purpose, 0, 1)
    )
    draws = [sampler.draw() for _ in range(count)]
    arrived = [
        u < channel.loss.delivery_probability(losses.Transmission((0, 1), k, bad=bad))
        for k, (u, bad, _) in enumerate(draws)
    ]
    return np.array(arrived), np.array([delay for _, _, delay in draws])


def test_bernoulli():
    arrived, _ = sampled_outcomes(20000, loss=losses.Bernoulli(0.7))
    assert scipy.stats.binomtest(int(arrived.sum()), arrived.size, 0.7).pvalue > 1e-4
    assert sampled_outcomes(50)[0].all()
    assert not sampled_outcomes(50, loss=losses.Bernoulli(0.0))[0].any()


@pytest.mark.one_in(2)
@pytest.mark.parametrize(
    "loss",
    [
        losses.GilbertElliott(mean_loss=0.3, mean_burst=5.0),
        losses.GilbertElliott(to_bad=0.2 * 0.3 / 0.7, to_good=0.2),
    ],
)
def test_gilbert_elliott_has_its_mean_loss_and_burst(loss):
    arrived, _ = sampled_outcomes(100_000, loss=loss)
    lost = ~arrived
    starts = lost & np.concatenate([[True], arrived[:-1]])
    assert lost.sum() / starts.sum() == pytest.approx(5.0, rel=0.05)
    assert lost.mean() == pytest.approx(0.3, abs=0.02)
    assert loss.mean_delivery(losses.Transmission((0, 1))) == pytest.approx(0.7)
    assert not loss.independent


def test_gilbert_elliott_with_two_kinds_of_luck():
    loss = losses.GilbertElliott(to_bad=0.1, to_good=0.3, deliver_good=0.9, deliver_bad=0.4)
    arrived, _ = sampled_outcomes(100_000, loss=loss)
    expected = 0.75 * 0.9 + 0.25 * 0.4
    assert loss.mean_delivery(losses.Transmission((0, 1))) == pytest.approx(expected)
    assert arrived.mean() == pytest.approx(expected, abs=0.01)


@pytest.mark.parametrize(
    ("delay", "law"),
    [
        (delays.ExponentialDelay(0.4), scipy.stats.expon(scale=0.4)),
        (delays.UniformDelay(0.1, 0.5), scipy.stats.uniform(0.1, 0.4)),
        (delays.LognormalDelay(0.3, 0.8), scipy.stats.lognorm(0.8, scale=0.3 * np.exp(-0.32))),
    ],
)
def test_delays_have_their_law(delay, law):
    _, seconds = sampled_outcomes(4000, delay=delay)
    assert scipy.stats.kstest(seconds, law.cdf).pvalue > 1e-4
    assert scipy.stats.kstest(1.2 * seconds, law.cdf).pvalue < 1e-4
    assert delay.fixed is None
    assert delay.longest == pytest.approx(law.support()[1])
    one, other = np.random.default_rng(3), np.random.default_rng(3)
    together = delays.draw_delays(delay, one, 9)
    assert together.tolist() == [delay.draw(other) for _ in range(9)]


def test_what_never_arrives_does_not_by_any_number():
    never, always = (channels.Channel(loss=losses.Bernoulli(p)) for p in (0.0, 1.0))
    sent = losses.Transmission((0, 1))
    for uniform in (0.0, 0.5, 1.0 - 2.0**-53):
        draw = channels.ChannelDraw(uniform, False, 0.25)
        assert np.isnan(channels.transit_time(never, sent, draw))
        assert channels.transit_time(always, sent, draw) == 0.25


def directions(run):
    """Whether the two messages of each tick arrived, (ticks, 2)."""
    log = run.log
    sent = log[log["kind"] == CODES["send"]]
    lost = {
        (int(r["node"]), int(r["peer"]), int(r["message"]))
        for r in log[log["kind"] == CODES["lost"]]
    }
    fate = [(int(r["node"]), int(r["peer"]), int(r["message"])) not in lost for r in sent]
    return np.array(fate).reshape(-1, 2)


def test_symmetric_directions_share_one_fate_and_others_do_not(ring):
    shared = directions(netkf.simulate(ring))
    assert (shared[:, 0] == shared[:, 1]).all()
    apart = directions(
        netkf.simulate(ring.replace({"network.channel.symmetric": False, "horizon": 100.0}))
    )
    both = apart.all(axis=1).mean()
    assert both == pytest.approx(0.49, abs=0.05)


def test_symmetric_directions_share_one_delay(ring):
    delayed = {
        "network.channel.delay": {"kind": "exponential", "mean": 0.3},
        "network.channel.loss": {"kind": "none"},
        "horizon": 200.0,
    }
    log = netkf.simulate(ring.replace(delayed)).events
    got = log[log.kind == "deliver"]
    pairs = got.assign(
        low=got[["node", "peer"]].min(axis=1), high=got[["node", "peer"]].max(axis=1)
    )
    ages = pairs.groupby(["low", "high", "message"]).age
    assert (ages.count() == 2).mean() > 0.98  # all but those still on their way at the end
    assert ages.max().sub(ages.min()).max() == 0.0


def test_a_direction_keeps_its_own_probability_when_the_draw_is_shared(tmp_path, build):
    (tmp_path / "g.csv").write_text("sender,receiver,delivery_probability\n0,1,0.9\n1,0,0.3\n")
    scenario = build(
        horizon=1000.0,
        probe=100.0,
        network={
            "graph": {"kind": "csv", "path": "g.csv"},
            "activation": {"kind": "poisson", "rate": 2.0},
            "channel": {"loss": {"kind": "per-link"}},
        },
    )
    fate = directions(netkf.simulate(scenario))
    assert fate.mean(axis=0) == pytest.approx([0.9, 0.3], abs=0.05)
    assert (fate[:, 0] | ~fate[:, 1]).all()  # one draw: what reaches 0 from 1 also does back
