"""Structs: what Python writes kernels read, and the other way round."""

import pickle

import numpy as np
import pytest

from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.structs import Struct, struct_at

POINT = np.dtype([("mark", np.int64), ("value", np.float64)])


class Clock(Struct):
    times: FloatArray
    next: int


class Walk(Struct):
    position: FloatArray
    points: np.ndarray
    steps: int
    length: float
    clock: Clock


@kernel
def walk_on(walk: Walk, k: int, j: int) -> float:
    walk.steps += 1
    walk.position[k, j] += walk.length
    walk.points[k].mark = walk.steps
    clock = walk.clock
    clock.next = clock.next + 1
    return clock.times[clock.next]


@kernel
def walk_on_at(memory: np.ndarray, k: int, j: int) -> float:
    return walk_on(struct_at(memory, Walk), k, j)


def make():
    return Walk(
        position=np.zeros((2, 3)),
        points=np.zeros(4, dtype=POINT),
        steps=0,
        length=0.5,
        clock=Clock(times=np.arange(10.0), next=1),
    )


@pytest.mark.parametrize("call", [walk_on, lambda walk, *at: walk_on_at(walk.memory, *at)])
def test_kernels_read_and_write_fields(call):
    walk = make()
    assert call(walk, 1, 2) == 2.0
    walk.length, walk.position = 2.0, np.ones((4, 5))
    assert call(walk, 3, 4) == 3.0
    assert (walk.steps, walk.clock.next) == (2, 3)
    assert walk.position[3, 4] == 3.0
    assert walk.position.sum() == 22.0
    assert walk.points["mark"].tolist() == [0, 1, 0, 2]
    walk.clock = Clock(times=np.full(3, 7.0), next=-1)
    assert call(walk, 0, 0) == 7.0


def test_fields_are_of_one_type():
    walk = make()
    for wrong in (np.zeros(3), np.zeros((2, 3), dtype=np.int64), np.zeros((3, 2)).T):
        with pytest.raises(TypeError, match="position"):
            walk.position = wrong
    # Kernels would read it as what it is not.
    with pytest.raises(TypeError, match="clock is a Clock"):
        walk.clock = walk
    with pytest.raises(TypeError, match="fields times, next"):
        Clock(times=np.zeros(3))
    with pytest.raises(AttributeError):
        walk.nothing  # noqa: B018


def test_pickled_structs_are_structs_of_their_own():
    walk = make()
    other = pickle.loads(pickle.dumps(walk))
    walk_on(other, 0, 0)
    assert (walk.steps, other.steps, other.clock.next) == (0, 1, 2)
