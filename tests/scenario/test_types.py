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

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

import netkf
from netkf.parts import (
    Bernoulli, Channel, Cycle, Diffusion, FlowFilter, LinearSensor, LinkClock, Loss, Poisson,
    positive, probability, setting,
)


@dataclass(frozen=True, eq=False)
class Replace(FlowFilter):
    """Takes the last estimate that arrives."""

    def absorb(self, state: Any, messages: Sequence[tuple[float, Any, float]]) -> Any:
        for _, payload, _ in messages:
            state = state._replace(xhat=payload.xhat, P=payload.P)
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

    def chance(self, link: tuple[int, int], message: int, bad: bool, measured: float) -> float:
        return self.delivery ** (1 + message)


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


kinds: dict[str, dict[str, type]] = netkf.parts.kinds()
loss: Loss = Bernoulli(0.5)
rate: float = Poisson(rate=2.0).mean_rate((0, 1))
verdict = netkf.check(scenario(), runs=10)
'''
WRONG = """
netkf.parts.Bernouli(0.5)
netkf.check(5)
"""


def mypy(folder, **files):
    for name, text in files.items():
        (folder / f"{name}.py").write_text(text)
    names = [f"{name}.py" for name in files]
    command = [sys.executable, "-m", "mypy", "--strict", "--follow-imports=silent", *names]
    cache = ["--cache-dir", str(ROOT / ".mypy_cache"), "--config-file", os.devnull]
    result = subprocess.run(
        [*command, *cache],
        cwd=folder,
        env={**os.environ, "MYPYPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    return result.stdout + result.stderr


def test_mypy_accepts_classes_of_ones_own_and_finds_mistakes(tmp_path):
    pytest.importorskip("mypy")
    found = mypy(tmp_path, own=OWN, wrong=OWN + WRONG)
    assert "own.py" not in found
    assert 'Module has no attribute "Bernouli"' in found
    assert 'Argument 1 to "check" has incompatible type "int"' in found
    assert "Found 2 errors in 1 file (checked 2 source files)" in found


def test_every_kind_and_contract_is_imported_by_name():
    source = inspect.getsource(netkf.parts)
    assert "__getattr__" not in source
    classes = {cls for names in KINDS.values() for cls in names.values()}
    for cls in classes | set(FAMILIES.values()):
        assert cls.__name__ in netkf.parts.__all__
        assert getattr(netkf.parts, cls.__name__) is cls
    assert sorted(netkf.parts.__all__) == netkf.parts.__all__
    assert set(dir(netkf.parts)) >= set(netkf.parts.__all__)
