"""Messages in slots that kernels do not draw, drawn from all that a network can have: both engines
make one run, and batches hold the single runs.
"""

import math
from dataclasses import dataclass

import numpy as np
import pytest

from netkf.engines.compiled.engine import CompiledEngine
from netkf.parts import Delay, Loss
from tests.algorithms.test_literature import GRAPH, scenario_of
from tests.engines.agreement import assert_agree, assert_blocks_do_not_matter
from tests.engines.test_batches import assert_alone

ARROWS = [[0, 1], [1, 2], [2, 0], [3, 2], [2, 4], [4, 3], [1, 3]]


@dataclass(frozen=True, eq=False)
class Weather(Loss):
    """What a run has drawn, what time it is, and which message it is: each of them matters."""

    def conditions(self, random, horizon):
        return random.random()

    def delivery_probability(self, sent):
        wave = math.sin(1.7 * sent.time + 5.0 * sent.conditions)
        return 0.6 + 0.2 * wave + 0.1 * (sent.number % 2)


@dataclass(frozen=True, eq=False)
class Tired(Loss):
    """A state of a link that a user draws."""

    stateful = True

    def next_state(self, link, bad, random):
        return bool(random.random() < (0.5 if bad else 0.2))

    def delivery_probability(self, sent):
        return 0.2 if sent.bad else 0.9


@dataclass(frozen=True, eq=False)
class Even(Delay):
    """Every other message takes longer, every fifth is lost."""

    def draw(self, random):
        return random.random() * 0.2

    def message_delay(self, sent, drawn):
        return math.nan if sent.number % 5 == 4 else drawn + 0.1 * (sent.number % 2)


SCHEDULE = "from,until,sender,receiver,delivery\n0,3,0,1,0.2\n2,5.5,1,0,0.9\n4,9,2,3,0.0\n"
CHAINS = "sender,receiver,mean_loss,mean_burst\n0,1,0.5,2\n1,0,0.2,4\n2,3,0.6,3\n"
HOPS = "sender,receiver,channel,delivery\n" + "".join(
    f"{i},{j},{channel},{0.9 - 0.3 * (channel == 15) - 0.05 * i}\n"
    for edge in GRAPH["edges"] for i, j in (edge, edge[::-1]) for channel in (11, 15)
)  # fmt: skip
BURSTS = {"kind": "gilbert-elliott", "mean_loss": 0.4, "mean_burst": 3.0}
LOSSES = {
    "bernoulli": {"loss": {"kind": "bernoulli", "delivery": 0.7}},
    "shared": {"loss": {"kind": "shared", "delivery": 0.6, "share": 0.5}},
    "bursts": {"loss": BURSTS},
    "bursts of senders": {"loss": {**BURSTS, "shared": True}},
    "chains": {"loss": {**BURSTS, "path": "chains.csv"}},
    "scheduled": {"loss": {"kind": "scheduled", "path": "s.csv", "otherwise": 0.6}},
    "hopping": {
        "loss": {"kind": "bernoulli", "delivery": 0.9},
        "channels": {"hopping": [11, 15, 11], "path": "hops.csv"},
    },
    "distance": {"loss": {"kind": "distance", "delivery": [[0.0, 1.0], [2.0, 0.3]]}},
    "weather": {"loss": Weather()},
    "tired": {"loss": Tired()},
}
DELAYS = [
    {"kind": "none"},
    {"kind": "constant", "seconds": 0.25},
    {"kind": "uniform", "low": 0.0, "high": 0.5},
    {"kind": "exponential", "mean": 0.4},
    Even(),
]
LIVES = [
    {"kind": "crashes", "mean_up": 2.0, "mean_down": 1.0, "memory": "kept"},
    {"kind": "crashes", "mean_up": 2.5, "mean_down": 1.5, "memory": "lost"},
    {"kind": "duty", "period": 2.3, "up": 1.4, "phase": 0.7, "memory": "kept"},
]
RADIOS = [
    {"bits_per_second": 1600, "queue": "wait"},
    {"bits_per_second": 1100, "queue": "drop", "frame_bytes": 20},
    {"frame_bytes": 24},
]
STOCHASTIC = {"kind": "event-triggered", "trigger": "stochastic", "Y": 1.0}
FILTERS = {
    "kcf": {"kind": "kcf", "epsilon": 0.2},
    "diffusion-kalman": {"kind": "diffusion-kalman"},
    "consensus": {"kind": "hcmci", "steps": 3},
    "gossip": {"kind": "gossip"},
    "triggered": {**STOCHASTIC, "inner": {"kind": "diffusion-kalman"}},
}
EXCHANGES = "slot,node,peer\n" + "0,0,1\n0,2,3\n1,1,2\n2,4,3\n2,0,2\n4,0,1\n5,2,1\n6,3,4\n"
ROUNDS = {"kcf": (1, 1), "diffusion-kalman": (2, 1), "consensus": (1, 3), "triggered": (2, 1)}
"""Phases of a slot of a filter, and their steps."""
MOVING = "t,node,x,y\n" + "".join(
    f"{t},{i},{i % 3 + 0.7 * math.sin(t + i):.3f},{i // 3 + 0.2 * t:.3f}\n"
    for t in range(9) for i in range(5)
)  # fmt: skip
STANDING = "node,x,y\n0,0,0\n1,1,0\n2,1,1\n3,0,1\n4,2,1\n"


def drawn(seed, folder):
    """A scenario with so many of these as fit each other."""
    random = np.random.default_rng([20261127, seed])

    def one(*choices):
        return choices[random.integers(len(choices))]

    for name, text in (
        *(("s.csv", SCHEDULE), ("chains.csv", CHAINS), ("hops.csv", HOPS), ("e.csv", EXCHANGES)),
        *(("moving.csv", MOVING), ("standing.csv", STANDING)),
    ):
        (folder / name).write_text(text)
    name = list(FILTERS)[seed % len(FILTERS)]
    loss = list(LOSSES)[seed // len(FILTERS) % len(LOSSES)]
    pairwise = name == "gossip"
    network = {"graph": GRAPH, "channel": {**LOSSES[loss], "symmetric": bool(one(0, 1))}}
    activation = {"kind": "broadcast", "phase": one(0.2, 0.25, 0.3)}
    if pairwise:
        activation = {"kind": "matching", "protocol": one("maximal", "node-wakeup"), "phase": 0.3}
    moves = one(0, 0, 1) and loss not in ("chains", "hopping", "scheduled")
    if moves:
        network |= {"graph": {"kind": "range", "radius": 1.6, "nodes": 5}}
    elif one(0, 0, 1):
        path = "e.csv" if pairwise else _rounds(folder, *ROUNDS[name])
        activation = {"kind": "recorded", "path": path, "phase": 0.3}
    elif not pairwise and loss not in ("chains", "hopping", "scheduled") and one(0, 1):
        network |= {"graph": {"kind": "edges", "edges": ARROWS, "directed": True}}
        network["channel"] |= {"symmetric": True}
    if moves or loss == "distance":
        network |= {"positions": "moving.csv" if moves else "standing.csv"}
    if loss == "chains":
        network["channel"]["symmetric"] = False
    network["channel"]["delay"] = one(*DELAYS)
    if one(0, 1):
        network["lives"] = [{**one(*LIVES), "nodes": [1, 3]}]
    if one(0, 0, 1):
        network["radio"] = one(*RADIOS)
    return scenario_of(FILTERS[name], folder, seed, network={**network, "activation": activation})


def _rounds(folder, phases, steps):
    rows = [
        f"{slot},{phase},{step},{i},{j}\n"
        for slot in range(8) for phase in range(phases) for step in range(steps)
        for k, (i, j) in enumerate(GRAPH["edges"]) if (slot + phase + 2 * step + k) % 3
    ]  # fmt: skip
    (folder / "rounds.csv").write_text("slot,phase,step,node,peer\n" + "".join(rows))
    return "rounds.csv"


@pytest.mark.one_in(14)
@pytest.mark.parametrize("seed", range(200))
def test_both_engines_and_batches_make_the_same_runs(seed, tmp_path):
    scenario = drawn(seed, tmp_path)
    run = assert_agree(scenario, replica=seed)
    assert run.count("send")
    assert_alone(scenario, CompiledEngine(), 5, range(2, 12 if seed % 4 == 0 else 4), True)


@pytest.mark.one_in(4)
@pytest.mark.parametrize("seed", range(0, 200, 10))
def test_blocks_of_slots_do_not_matter(seed, tmp_path, monkeypatch):
    """Messages on the way, links that hold their draws and lives go on in the next block."""
    scenario = drawn(seed, tmp_path)
    assert_blocks_do_not_matter(scenario, monkeypatch)
