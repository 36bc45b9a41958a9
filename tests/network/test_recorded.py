"""Recorded losses and delays, message by message."""

import math

import numpy as np
import pytest

from netkf.core.errors import ScenarioError
from netkf.core.fields import SourceFile
from netkf.network.channels import Channel, ChannelDraw, ChannelSampler, transit_time
from netkf.network.delays import (
    ExponentialDelay,
    NoDelay,
    UniformDelay,
    checked_delays,
    delay_depends_on_message,
)
from netkf.network.losses import Transmission, delivery_probabilities
from netkf.network.recorded import RecordedDelay, RecordedLoss

WAY, BACK = (0, 1), (1, 0)
FINE = ChannelDraw(0.0, False, 0.0)


@pytest.fixture
def record(tmp_path):
    def make(cls, rows, **settings):
        column = "delivered" if cls is RecordedLoss else "seconds"
        lines = [f"sender,receiver,message,{column}", *rows]
        (tmp_path / "record.csv").write_text("\n".join(lines) + "\n")
        return cls(SourceFile("record.csv", tmp_path), **settings)

    return make


def chances(loss, count, link=WAY):
    return [loss.delivery_probability(Transmission(link, k)) for k in range(count)]


def seconds(delay, count, link=WAY):
    return [delay.message_delay(Transmission(link, k), 0.0) for k in range(count)]


@pytest.mark.parametrize(
    ("after", "expected"),
    [
        ("deliver", [1.0, 0.0, 1.0, 1.0, 1.0]),
        ("lose", [1.0, 0.0, 0.0, 0.0, 0.0]),
        ("repeat", [1.0, 0.0, 1.0, 0.0, 1.0]),
    ],
)
def test_losses_after_the_record(record, after, expected):
    assert chances(record(RecordedLoss, ["0,1,0,1", "0,1,1,0"], after=after), 5) == expected


def test_delays_after_the_record(record):
    rows = ["0,1,0,0.5", "0,1,2,0.25"]
    assert seconds(record(RecordedDelay, rows), 4) == [0.5, 0.0, 0.25, 0.0]
    # Message 1 is a hole: the table that starts again does not list it either.
    again = record(RecordedDelay, rows, after="repeat")
    assert seconds(again, 6) == [0.5, 0.0, 0.25, 0.5, 0.0, 0.25]
    assert seconds(again, 3, BACK) == [0.0, 0.0, 0.0]
    lost = seconds(record(RecordedDelay, rows, after="lose"), 4)
    assert [math.isnan(value) for value in lost] == [False, True, False, True]


@pytest.mark.parametrize(("cls", "key"), [(RecordedLoss, "loss"), (RecordedDelay, "delay")])
def test_a_message_beyond_the_record_may_be_refused(record, cls, key):
    part = record(cls, ["0,1,0,1"], after="refuse")
    channel = Channel(**{key: part})
    assert transit_time(channel, Transmission(WAY, 0), FINE) == (1.0 if key == "delay" else 0.0)
    with pytest.raises(ScenarioError) as caught:
        transit_time(channel, Transmission(WAY, 1), FINE)
    line = str(caught.value)
    assert line.startswith(f"network.channel.{key}.path: record.csv must list every message")
    assert "message 1 from node 0 to node 1" in line
    assert len(line.splitlines()) == 1


@pytest.mark.parametrize("cls", [RecordedLoss, RecordedDelay])
def test_what_is_used_of_a_record(record, cls):
    table = record(cls, ["0,1,0,1", "0,1,3,1", "0,1,9,1", "1,0,0,1", "0,1,3,1", "0,1,9,1"]).table
    use, beyond = table.use({WAY: 5, (2, 0): 2})
    assert (use, use.unused, beyond) == (("record.csv", 6, 2, 1), 3, 5)
    use, beyond = table.use({})
    assert (use, use.unused, beyond) == (("record.csv", 6, 0, 0), 6, 0)


def test_nothing_is_drawn_for_recorded_delays(record):
    asked = []
    channel = Channel(delay=record(RecordedDelay, ["0,1,0,0.5"]))
    sampler = ChannelSampler(channel, (0, 1), asked.append)
    assert sampler.draw() == FINE
    assert [column.tolist() for column in sampler.draws(2)] == [
        [0.0, 0.0],
        [False, False],
        [0.0] * 2,
    ]
    assert asked == []
    assert channel.delay.fixed is None
    assert not channel.delay.is_random
    assert delay_depends_on_message(channel.delay)
    assert not delay_depends_on_message(NoDelay())
    assert channel.delay.longest == 0.5
    assert UniformDelay(0.1, 0.4).longest == 0.4
    assert ExponentialDelay(1.0).longest == math.inf
    assert NoDelay().longest == 0.0
    assert ExponentialDelay(1.0).is_random


def test_negative_delays_are_refused(record):
    class Early(NoDelay):
        def message_delay(self, sent, drawn):
            return -1.0

    with pytest.raises(ScenarioError, match=r"Early: the delay of message 3 .* and not negative"):
        transit_time(Channel(delay=Early()), Transmission(WAY, 3), FINE)


@pytest.mark.parametrize("after", ["deliver", "lose", "repeat"])
def test_many_messages_of_a_link_have_the_fates_of_each(record, after):
    """Also of a class that is derived and takes them one by one."""

    class Slower(RecordedDelay):
        def message_delay(self, sent, drawn):
            return 2.0 * super().message_delay(sent, drawn) if sent.number < 3 else drawn

    loss = record(RecordedLoss, ["0,1,2,0", "0,1,0,1"], after=after)
    delays = [record(cls, ["0,1,3,.5", "0,1,1,.2"], after=after) for cls in (RecordedDelay, Slower)]
    numbers, zeros = np.arange(7), np.zeros(7)
    for link in (WAY, BACK):
        many = Transmission(link)._replace(number=numbers, time=zeros, bad=zeros > 0.0)
        np.testing.assert_array_equal(delivery_probabilities(loss, many), chances(loss, 7, link))
        for delay in delays:
            found = checked_delays(delay, many, zeros)
            np.testing.assert_array_equal(found, seconds(delay, 7, link))
