"""Losses of users whose law is a kernel: the same messages as with the law in Python."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

import netkf
from netkf.core.errors import ScenarioError
from netkf.engines.compiled import outcomes, slot_tables
from netkf.kernels import kernel
from netkf.parts import KernelLoss, Loss, integer, probability, setting
from netkf.testing import check_channel
from tests.benchmarks.cases import Even
from tests.conftest import SCENARIOS
from tests.engines.agreement import assert_agree


@kernel
def hub_law(message: Any, settings: Any, t: float, out: Any) -> None:
    """Weak links are worse, every fifth message is worse than others, and time matters."""
    hub = settings[0]
    out[0] = 0.9 if hub in (message[0], message[1]) else settings[1]
    if message[2] % 5 == 3.0:
        out[0] *= 0.5
    out[0] *= message[4] * (0.75 + 0.25 * np.sin(t))


@dataclass(frozen=True, eq=False)
class Hub(KernelLoss):
    """The law as a kernel."""

    law = hub_law
    independent = False

    hub: int = setting(integer())
    weak: float = setting(probability)


@dataclass(frozen=True, eq=False)
class SlowHub(Loss):
    """The same law, message by message."""

    independent = False

    hub: int = setting(integer())
    weak: float = setting(probability)

    def delivery_probability(self, sent: Any) -> Any:
        p = 0.9 if self.hub in sent.link else self.weak
        p *= 0.5 if sent.number % 5 == 3 else 1.0
        return p * sent.table_probability * (0.75 + 0.25 * np.sin(sent.time))


@kernel
def wrong_law(message: Any, settings: Any, t: float, out: Any) -> None:
    """No probability from the eighth message on."""
    out[0] = settings[0] if message[2] < 7.0 else np.nan


@dataclass(frozen=True, eq=False)
class Wrong(KernelLoss):
    """A mistake that shows late."""

    law = wrong_law

    first: float = setting(probability)


@kernel
def silent_law(message: Any, settings: Any, t: float, out: Any) -> None:
    """Writes nothing for most messages."""
    if message[2] < 2.0:
        out[0] = settings[0]


@kernel
def astray_law(message: Any, settings: Any, t: float, out: Any) -> None:
    """Reads what is no setting."""
    out[0] = 0.5 + 0.0 * min(settings[3], 0.0)


class Silent(Wrong):
    law = silent_law


class Astray(Wrong):
    law = astray_law


@dataclass(frozen=True, eq=False)
class NoKernel(KernelLoss):
    """Its law is plain Python."""

    law = max

    first: float = setting(probability)


def hub(name: str, kind: type, horizon: float) -> Any:
    loss = {"kind": f"{__name__}:{kind.__name__}", "hub": 0, "weak": 0.4}
    changes = {"network.channel.loss": loss, "horizon": horizon}
    return netkf.load(SCENARIOS / f"{name}.toml").replace(changes)


CASES = {"poisson_ring": 4.0, "gossip_ring": 6.0, "push_sum_planar": 0.6}


@pytest.mark.parametrize("name", CASES)
def test_a_law_as_kernel_is_the_law(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    slow = netkf.monte_carlo(hub(name, SlowHub, CASES[name]), 3, seed=2, workers=1)
    # The compiled loops call the kernel: nothing is made in Python.
    monkeypatch.delattr(outcomes, "message_delays")
    monkeypatch.delattr(slot_tables, "message_delays")
    fast = hub(name, Hub, CASES[name])
    assert_agree(fast)
    batch = netkf.monte_carlo(fast, 3, seed=2, workers=1)
    for quantity in ("mean_error", "mean_P"):
        np.testing.assert_array_equal(getattr(batch, quantity), getattr(slow, quantity))


def test_who_may_be_silent_or_down_has_its_messages_numbered_as_in_simpy() -> None:
    """Then Python counts the messages, and the kernel is called for many at once."""
    down = {"nodes": [0, 1], "kind": "crashes", "mean_up": 4.0, "mean_down": 2.0}
    assert_agree(hub("gossip_ring", Hub, 8.0).replace({"network.lives": [down]}))
    clocked = hub("poisson_ring", Hub, 4.0)
    sampled = {
        f"sensors[{k}].sampling": {"kind": "periodic", "period": 0.5}
        for k in range(len(clocked.sensors))
    }
    assert_agree(clocked.replace({"network.lives": [down], **sampled}))


@pytest.mark.parametrize(("kind", "message"), [("Wrong", 7), ("Silent", 2)])
def test_probabilities_that_are_none_are_refused_in_one_line(kind: str, message: int) -> None:
    words = rf"{kind}: .* message {message} on link .* got nan; correct the law"
    for name, engine in (("gossip_ring", "compiled"), ("poisson_ring", "simpy")):
        loss = {"kind": f"{__name__}:{kind}", "first": 0.5}
        scenario = netkf.load(SCENARIOS / f"{name}.toml").replace({"network.channel.loss": loss})
        with pytest.raises(ScenarioError, match=words):
            netkf.simulate(scenario, engine=engine)


def test_what_compiled_code_does_not_notice_is_found() -> None:
    with pytest.raises(AssertionError, match=r"Astray\.law: failed with IndexError"):
        check_channel(Astray(first=0.5))


def test_a_law_is_marked_as_a_kernel() -> None:
    with pytest.raises(AssertionError, match="law must be a kernel"):
        check_channel(NoKernel(first=0.5))
    check_channel(Even(delivery=0.4))
