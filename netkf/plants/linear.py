"""The linear plant in slots, x[k+1] = F x[k] + w[k], and its readings.

Slot k is the time k times a period. The path and the noise of each sensor are drawn slot by slot
from separate random streams, so that they do not depend on the network.

On an unstable plant states may be *local*: relative to an origin that is moved to the state every
so many slots, the *rebase*. The interval between two rebases is a *frame* (``truth`` says why).
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import Protocol

import numpy as np

from netkf.core.fields import covariance, field, seconds, square
from netkf.linalg.arrays import FloatArray, IntArray
from netkf.linalg.portable import apply, cholesky, noise_root
from netkf.plants.changes import LinearChange, matrices_of_pieces, schedule_of
from netkf.plants.plant import Plant
from netkf.plants.transitions import frame_slots

BLOCK = 64  # slots drawn at once


class SlotPlant(Plant):
    """The contract of plants in slots, which last a ``period`` (seconds) each, with noise of the
    covariance ``Q`` (n, n): slot k is at time ``k * period``.
    """

    Q: FloatArray
    period: float

    @property
    def change_slots(self) -> tuple[int, ...]:
        """The slots (C,) from which on the matrices are those of the next piece."""
        return tuple(round(change / self.period) for change in self.changes.tolist())

    def slot_time(self, k: int) -> float:
        """Return the start of slot k in seconds, on the grid of the scenario."""
        return self.time_grid.instant(k * self.period)

    def slot_times(self, slots: IntArray) -> FloatArray:
        """Return the starts (K,) of ``slots`` (K,) in seconds, each as :meth:`slot_time` does."""
        return self.time_grid.snap(slots * self.period)

    def slots_of(self, times: FloatArray) -> np.ndarray:
        """Return the slots (K,) that contain each of K ``times`` (K,), in seconds."""
        snap, period = self.time_grid.snap, self.period
        # The nearest slot, or the one before if that one begins later.
        nearest = np.rint(np.asarray(times) / period)
        return np.asarray((nearest - (snap(nearest * period) > snap(times))).astype(int))

    def over(self, slot: int, horizon: float) -> bool:
        """Return True if ``slot`` begins at or after the horizon (seconds)."""
        return self.slot_time(slot) >= self.time_grid.instant(horizon)

    @abstractmethod
    def truth(self, random: np.random.Generator, frames: bool = False) -> Truth:
        """Return the true states of one run, drawn from ``random``, with ``frames`` or without."""

    @cached_property
    def noise_root(self) -> FloatArray:
        """A root S (n, n) of ``Q = S S'``, by which standard normals are multiplied."""
        return noise_root(self.Q)


@dataclass(frozen=True, eq=False)
class LinearPlant(SlotPlant):
    """``x[k+1] = F x[k] + w[k]``, cov(w) = Q; slot k is at time ``k * period`` seconds.

    ``F`` (n, n), ``Q`` (n, n); ``schedule`` has others from some times on, ``plants.changes``.
    """

    F: FloatArray = field(square)
    Q: FloatArray = field(covariance)
    period: float = field(seconds)
    schedule: tuple[LinearChange, ...] = field(schedule_of(LinearChange), default=())

    @cached_property
    def pieces(self) -> tuple[LinearPlant, ...]:
        """The plants before the first change and after each, without changes of their own."""
        all_matrices = matrices_of_pieces({"F": self.F, "Q": self.Q}, self.schedule)
        return tuple(LinearPlant(F=m["F"], Q=m["Q"], period=self.period) for m in all_matrices)

    @property
    def n(self) -> int:
        """Dimension of the state."""
        return len(self.F)

    def truth(self, random: np.random.Generator, frames: bool = False) -> Truth:
        """Return the true states of one run, drawn from ``random``, with ``frames`` or without."""
        start = self.start_mean + apply(self.start_root, random.standard_normal(self.n))
        slots = frame_slots(self.F) if frames else None
        later = zip(self.change_slots, self.pieces[1:], strict=True)
        changes = {slot: (piece.F, piece.noise_root) for slot, piece in later}
        return LinearPath(self.F, self.noise_root, start, random, slots, changes)


class Truth(Protocol):
    """The state of one run in slots; slots must be asked for in increasing order.

    After ``rebase`` of a slot, which begins a frame, its local state is zero.
    """

    @property
    def frame_slots(self) -> int | None:
        """Slots from one frame to the next, the first begins at slot 0; None without frames."""

    def local(self, slot: int) -> FloatArray:
        """Return x (n,) in slot number ``slot``, relative to the origin of the present frame."""

    def absolute(self, slot: int) -> FloatArray:
        """Return x (n,) in slot number ``slot``, in the plant's coordinates."""

    def state(self, slot: int) -> FloatArray:
        """Return x (n,) in slot number ``slot``, as ``absolute`` does."""

    def rebase(self, slot: int) -> FloatArray:
        """Return the local state (n,) of a slot that begins a frame, and make it zero from now on;
        called once for each such slot, when its state has been recorded.
        """


class Readings(Protocol):
    """The readings of one sensor on one node in slots, which must be asked for in increasing order.

    For a nonlinear sensor ``matrix`` returns a function that linearises a reading.
    """

    def matrix(self, slot: int) -> FloatArray:
        """Return H (p, n) in slot number ``slot``, not before the last one asked for."""

    def reading(self, slot: int, x: FloatArray) -> FloatArray:
        """Return the reading (p,) in slot number ``slot``, whose state is x (n,)."""

    def several(self, slots: Sequence[int], x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return readings (S, p) and H (S, p, n) of increasing ``slots`` with x (S, n)."""


class LinearPath:
    """The path ``x[k+1] = F x[k] + root z[k]`` of one run from x[0] = ``start`` (n,) on.

    ``F`` is (n, n), ``root`` (n, q), and z[k] are standard normals of ``random``. With
    ``frame_slots``, a frame begins every ``frame_slots`` slots. ``changes`` are other F and roots,
    by the slot from which on they hold. Slots must be asked for in order.
    """

    def __init__(
        self,
        F: FloatArray,
        root: FloatArray,
        start: FloatArray,
        random: np.random.Generator,
        frame_slots: int | None = None,
        changes: Mapping[int, tuple[FloatArray, FloatArray]] = MappingProxyType({}),
    ) -> None:
        self._F, self._root, self._random = F, root, random
        self._changes = changes
        # Normals drawn at once, the noises that they give, and how many slots have had theirs.
        self._normals, self._noises, self._used = np.zeros((0, root.shape[1])), root[:0], 0
        self.frame_slots = frame_slots
        # The present slot, its local state and the origin of that, both before a rebase.
        self._slot, self._x, self._origin = 0, start, np.zeros(len(start))
        self._rebased = 0  # slot of the last rebase

    def _move_to(self, slot: int) -> None:
        # States beyond the horizon may overflow.
        with np.errstate(over="ignore", invalid="ignore"):
            for k in range(self._slot, slot):
                if k in self._changes:
                    self._F, self._root = self._changes[k]
                    self._noises = apply(self._root, self._normals)
                # The origin moves to the state where a frame begins.
                if self.frame_slots and k and k % self.frame_slots == 0:
                    self._origin, self._x = self._origin + self._x, np.zeros(len(self._x))
                if self._used == len(self._noises):
                    self._normals = self._random.standard_normal((BLOCK, self._root.shape[1]))
                    self._noises, self._used = apply(self._root, self._normals), 0
                self._x = apply(self._F, self._x) + self._noises[self._used]
                self._used += 1
                # An origin at 0 stays there.
                if self.frame_slots and self._origin.any():
                    self._origin = apply(self._F, self._origin)
        self._slot = slot

    def local(self, slot: int) -> FloatArray:
        """Return x (n,) of slot number ``slot``, relative to the origin of the present frame."""
        self._move_to(slot)
        return np.zeros(len(self._x)) if slot == self._rebased > 0 else self._x

    def rebase(self, slot: int) -> FloatArray:
        """Return the local state (n,) of ``slot``, which begins a frame; it is zero from now on."""
        self._move_to(slot)
        self._rebased = slot
        return self._x

    def absolute(self, slot: int) -> FloatArray:
        """Return x (n,) of slot number ``slot`` in the plant's coordinates."""
        self._move_to(slot)
        return self._x if self.frame_slots is None else self._origin + self._x

    state = absolute


class SlotReadings:
    """The readings of one sensor on one node, ``y = H x + v``, one a slot: H (p, n), and v with
    covariance R (p, p) drawn from ``random``.
    """

    def __init__(self, H: FloatArray, R: FloatArray, random: np.random.Generator) -> None:
        self._H, self._root = H, cholesky(R)
        self._noise = Blocks(random, len(R))
        # The last slot whose noise has been drawn, and that noise.
        self._slot, self._v = -1, np.zeros(len(R))

    def matrix(self, slot: int) -> FloatArray:
        """Return H (p, n) of slot number ``slot``: the same in all slots."""
        return self._H

    def reading(self, slot: int, x: FloatArray) -> FloatArray:
        """Return ``H x + v`` (p,) in slot number ``slot``, see Readings."""
        return apply(self.matrix(slot), x) + self.noise(slot)

    def noise(self, slot: int) -> FloatArray:
        """Return the noise v (p,) of slot number ``slot``, not before the last one asked for."""
        while self._slot < slot:
            self._v = apply(self._root, self._noise.draw())
            self._slot += 1
        return self._v

    def matrices(self, slots: Sequence[int]) -> FloatArray:
        """Return H (S, p, n) of S increasing ``slots``."""
        return np.broadcast_to(self._H, (len(slots), *self._H.shape))

    def several(self, slots: Sequence[int], x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return readings (S, p) and H (S, p, n) of S increasing ``slots``, see Readings."""
        H = self.matrices(slots)
        offsets = np.array(slots) - self._slot - 1
        # ``apply`` handles the vectors one by one: readings have the same bits however many slots
        # are asked for together.
        noise = apply(self._root, self._noise.draws(int(offsets[-1]) + 1)[offsets])
        self._slot, self._v = slots[-1], noise[-1]
        return apply(H, x) + noise, H


class Blocks:
    """Standard normal vectors (size,) from ``random``, drawn many at a time: one call of the
    generator for each would take longer than the draw.
    """

    def __init__(self, random: np.random.Generator, size: int) -> None:
        self._random, self._size, self._used = random, size, 0
        self._drawn = np.empty((0, size))

    def draw(self) -> FloatArray:
        """Return the next vector (size,)."""
        return np.asarray(self.draws(1)[0])

    def draws(self, count: int) -> FloatArray:
        """Return the next vectors (count, size)."""
        shortfall = self._used + count - len(self._drawn)
        if shortfall > 0:
            block = self._random.standard_normal((max(shortfall, BLOCK), self._size))
            self._drawn, self._used = np.concatenate([self._drawn[self._used :], block]), 0
        self._used += count
        return np.asarray(self._drawn[self._used - count : self._used])
