"""Users' own classes are typed: mypy --strict accepts them, and notices mistakes."""

import inspect
import os
import subprocess
import sys

import pytest

import netkf
from netkf.scenario.registry import FAMILIES, KINDS
from tests.conftest import ROOT

OWN = '''
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import netkf
from netkf.parts import (
    Analysis, Bernoulli, Channel, Cycle, Diffusion, Estimate, Exchange, Filter, Increments,
    LinearSensor, LinkClock, Loss, Message, Needs, NodeInfo, Poisson, Reading, State, Timing,
    Transmission, Weights, positive, probability, setting,
)

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Listen(Filter):
    """Takes the last estimate that arrives; the rest as in the base class."""

    timing = Timing(clocks=("nodes", "links"))
    needs = Needs(one_way=True)

    def absorb(self, state: State, messages: Sequence[Message], exchange: Exchange) -> State:
        for message in messages:
            payload: Estimate = message.payload
            state = state._replace(xhat=payload.xhat, root=payload.root)
        return state


class Own(NamedTuple):
    xhat: Array
    root: Array
    model: Any
    sent: int
    mass: float


@dataclass(frozen=True, eq=False)
class Everything(Filter):
    """Defines every method."""

    gain: float = setting(positive, default=0.1)

    @property
    def timing(self) -> Timing:
        return Timing(
            schedule=None, first_slot=1, max_age=1.0, steps=self.steps, redraws=self.redraws,
            interval=self.interval,
        )

    @property
    def needs(self) -> Needs:
        return Needs(samples=True, check=self.check, notes=self.notes)

    def init(self, model: Any, mean: Array, cov: Array, node: NodeInfo) -> Own:
        first: State = super().init(model, mean, cov, node)
        return Own(first.xhat, first.root, model, 0, 1.0 / node.nodes)

    def predict(self, state: Own, gap: float) -> Own:
        xhat, root = state.model.predict(state.xhat, state.root, gap)
        return state._replace(xhat=xhat, root=root)

    def update(self, state: Own, reading: Reading | Increments) -> Own:
        if isinstance(reading, Increments):
            return state
        return state._replace(xhat=state.xhat + self.gain * reading.H.T @ reading.y)

    def emit(self, state: Own, exchange: Exchange) -> tuple[Own, tuple[float, Array] | None]:
        if not exchange.receivers:
            return state, None
        share = state.mass / (1 + len(exchange.receivers))
        return state._replace(mass=share, sent=state.sent + 1), (share, state.xhat)

    def absorb(self, state: Own, messages: Sequence[Message], exchange: Exchange) -> Own:
        heard = [m.weight * m.age * m.payload[0] for m in messages if m.sender != exchange.slot]
        return state._replace(mass=state.mass + sum(heard))

    def estimate(self, state: Own) -> tuple[Array, Array | None]:
        return state.xhat, None

    def shift(self, state: Own | tuple[float, Array], offset: Array) -> Own | tuple[float, Array]:
        if isinstance(state, Own):
            return state._replace(xhat=state.xhat + offset)
        return state[0], state[1] + offset

    def interval(self, state: Own) -> float:
        return 0.1

    def payload_numbers(self, n: int, rows: int, phase: int) -> float:
        return 2.0 * n

    def steps(self, phase: int) -> int:
        return 1 + phase

    def redraws(self, phase: int, step: int) -> bool:
        return step == 0

    @property
    def analysis(self) -> Analysis:
        return Analysis(
            payload_numbers=self.payload_numbers, conserved=self.conserved, stopped=self.stopped
        )

    def stopped(self, state: Own) -> bool:
        return state.mass > 0.5

    def conserved(self, state: Own) -> Mapping[str, float | Sequence[float]]:
        return {"mass": state.mass, "sent": [float(state.sent)]}

    def weight(self, degree: int, peer_degree: int) -> float:
        return 1.0 / (1 + degree)

    @property
    def link_weights(self) -> Weights:
        return Weights(of=self.weight, largest_degree=5.0)

    def check(self, scenario: netkf.Scenario) -> None:
        assert scenario.nodes

    def notes(self, scenario: netkf.Scenario) -> tuple[str, ...]:
        return (f"{len(scenario.nodes)} nodes",)


@dataclass(frozen=True, eq=False)
class Replace(Filter):
    """Takes the last estimate that arrives."""

    def absorb(self, state: State, messages: Sequence[Message], exchange: Exchange) -> State:
        for message in messages:
            state = state._replace(xhat=message.payload.xhat, root=message.payload.root)
        return state


@dataclass(frozen=True, eq=False)
class Regular(LinkClock):
    period: float = setting(positive)

    def ticks(
        self, link: tuple[int, ...], origin: float, index: int, now: float,
        random: np.random.Generator, count: int,
    ) -> NDArray[np.float64]:
        return self.period * np.arange(index + 1.0, index + 1.0 + count)


@dataclass(frozen=True, eq=False)
class Fading(Loss):
    delivery: float = setting(probability)

    def delivery_probability(self, sent: Transmission) -> float:
        return float(self.delivery ** (1 + sent.number))


def scenario() -> netkf.Scenario:
    return netkf.Scenario(
        name="own",
        horizon=5.0,
        probe=1.0,
        plant=Diffusion(A=np.zeros((1, 1)), B=np.ones((1, 1))),
        sensors=(LinearSensor(nodes=(0,), H=np.ones((1, 1)), R=np.ones((1, 1))),),
        network=netkf.Network(
            graph=Cycle(3), activation=Regular(period=0.5), channel=Channel(loss=Fading(0.9))
        ),
        filter=netkf.Filtering(algorithm=Replace()),
    )


algorithms: list[Filter] = [Listen(), Everything(gain=0.2)]
kinds: dict[str, dict[str, type]] = netkf.parts.kinds()
loss: Loss = Bernoulli(0.5)
rate: float = Poisson(rate=2.0).mean_rate((0, 1))
verdict = netkf.check(scenario(), runs=10)
'''
WRONG = """
class Wrong(Filter):
    def absorb(self, state: State, messages: Sequence[Message], exchange: int) -> State:
        return state


netkf.parts.Bernouli(0.5)
netkf.check(5)
"""


# The types of these packages do not matter to the classes, and take two thirds of the time.
CONFIG = """
[mypy]
[mypy-pandas.*,scipy.*,networkx.*,pyarrow.*,matplotlib.*,simpy.*,distributed.*,numba.*,llvmlite.*]
follow_imports = skip
follow_imports_for_stubs = True
"""


def mypy(folder, **files):
    for name, text in files.items():
        (folder / f"{name}.py").write_text(text)
    (folder / "mypy.ini").write_text(CONFIG)
    names = [f"{name}.py" for name in files]
    command = [sys.executable, "-m", "mypy", "--strict", "--follow-imports=silent", *names]
    # A cache of its own: with other options than those of the package's own check each would undo
    # the other's.
    cache = ["--cache-dir", str(ROOT / ".mypy_cache" / "own"), "--config-file", "mypy.ini"]
    result = subprocess.run(
        [*command, *cache],
        cwd=folder,
        env={**os.environ, "MYPYPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    return result.stdout + result.stderr


@pytest.mark.slow
def test_mypy_accepts_classes_of_ones_own_and_finds_mistakes(tmp_path):
    pytest.importorskip("mypy")
    found = mypy(tmp_path, own=OWN, wrong=OWN + WRONG)
    assert "own.py" not in found
    assert 'Module has no attribute "Bernouli"' in found
    assert 'Argument 1 to "check" has incompatible type "int"' in found
    assert 'Argument 3 of "absorb" is incompatible with supertype' in found
    assert "Found 3 errors in 1 file (checked 2 source files)" in found


def test_a_class_with_every_member_has_every_member():
    """Of the contract, so that none is forgotten above."""
    own = OWN[OWN.index("class Everything") : OWN.index("class Regular")]
    members = {name for name in dir(netkf.parts.Filter) if not name.startswith("_")}
    assert len(members) <= 12
    for name in members - {"kernels"}:
        assert f"def {name}(" in own


def test_every_kind_and_contract_is_imported_by_name():
    source = inspect.getsource(netkf.parts)
    assert "__getattr__" not in source
    classes = {cls for names in KINDS.values() for cls in names.values()}
    for cls in classes | set(FAMILIES.values()):
        assert cls.__name__ in netkf.parts.__all__
        assert getattr(netkf.parts, cls.__name__) is cls
    assert sorted(netkf.parts.__all__) == netkf.parts.__all__
    assert set(dir(netkf.parts)) >= set(netkf.parts.__all__)
