"""Truth and readings of a plant with an input, in coordinates that move along with its response.

Filters that commute with a shift run the same wherever states are counted from. Of a driven plant
they are counted from the response m(t) to the input (``response``), as far as filters believe in
it: there the truth, its readings and all that filters do are those of the plant without input.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.linalg.portable import apply
from netkf.plants.readings import read_many, readings_of
from netkf.plants.response import Response, moments_over


class InputResponses(NamedTuple):
    """The responses of a plant whose input filters know, or not.

    believed : m by the matrices that filters believe. Their estimates are counted from it: the
               origin of coordinates moves along, so that a filter that knows u runs as without it.
               None where the origin does not move
    surprise : the true m minus that, which is left in the state in these coordinates; None if it
               is 0, or in the recorded states
    """

    believed: Response | None
    surprise: Response | None


Shift = Callable[[np.ndarray], FloatArray]
"""Returns what is added to states (K, n) at K times in seconds, or in K slots."""


class DrivenTruth:
    """The state of one run with an input, from the ``truth`` without it: ``local`` and ``absolute``
    say what is added to its local and absolute states, None: nothing; ``over`` is the response
    that is added to the moments of a path.
    """

    def __init__(
        self, truth: Any, local: Shift | None, absolute: Shift | None, over: Any = None
    ) -> None:
        self._truth, self._local, self._absolute, self._over = truth, local, absolute, over

    def __getattr__(self, name: str) -> Any:
        """Return what the input leaves as it is, such as frames."""
        return getattr(self.__dict__["_truth"], name)

    def local(self, time: Any) -> FloatArray:
        """Return x (n,) at ``time``, in seconds or a slot, in the coordinates of the filters."""
        return _shifted(self._truth.local(time), self._local, time)

    def absolute(self, time: Any) -> FloatArray:
        """Return x (n,) at ``time``, in seconds or a slot, in the coordinates of the plant."""
        return _shifted(self._truth.absolute(time), self._absolute, time)

    state = absolute

    def moments(self, start: float, end: float) -> FloatArray:
        """Return the two moments (2, n) of local states over [start, end] seconds of a path."""
        moments: FloatArray = self._truth.moments(start, end)
        if self._over is None:
            return moments
        return moments + moments_over(self._over, start, end, self._truth.time_grid)

    def states(self, times: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return local and absolute states (K, n) each at ``times`` (K,), in any order."""
        absolute = self._truth.states(times)[1]
        return self.local_states(times), (
            absolute if self._absolute is None else absolute + self._absolute(times)
        )

    def local_states(self, times: FloatArray) -> FloatArray:
        """Return local states (K, n) at ``times`` (K,), in any order."""
        local: FloatArray = self._truth.states(times)[0]
        return local if self._local is None else local + self._local(times)


def _shifted(x: FloatArray, shift: Shift | None, time: Any) -> FloatArray:
    return x if shift is None else np.asarray(x + shift(np.array([time]))[0])


def driven(
    truth: Any,
    responses: InputResponses,
    recorded: bool,
    forced: bool = False,
    times: tuple[FloatArray | None, FloatArray | None] = (None, None),
) -> DrivenTruth:
    """Return a ``truth`` without input with it. States that are ``recorded`` have it already, and
    paths that are ``forced`` the surprise. The shifts of local states at the first of ``times``
    (K,), and those of absolute ones at the second, are computed at once.
    """
    (believed, surprise), (all_times, shown) = responses, times
    if recorded:
        return DrivenTruth(truth, _shift(all_times, believed, -1.0), None)
    local = None if forced else surprise
    shifts = _shift(all_times, local), _shift(shown, believed, 1.0, local)
    return DrivenTruth(truth, *shifts, local)


def _shift(
    known: FloatArray | None,
    first: Response | None,
    sign: float = 1.0,
    second: Response | None = None,
) -> Shift | None:
    """Return the shift by ``sign`` times the ``first`` response and the ``second``."""
    if first is None and second is None:
        return None

    def compute(times: np.ndarray) -> FloatArray:
        parts = [s * r.states(times) for s, r in ((sign, first), (1.0, second)) if r is not None]
        return np.asarray(sum(parts))

    if known is None:
        return compute
    table = compute(known)

    def look_up(times: np.ndarray) -> FloatArray:
        rows = np.minimum(np.searchsorted(known, times), len(known) - 1)
        return table[rows] if np.array_equal(known[rows], times) else compute(times)

    return look_up


class MovedFunction:
    """Linearises readings for estimates counted from ``m`` (n,), see ``nonlinear.Linearised``."""

    def __init__(self, function: Any, m: FloatArray) -> None:
        self._function, self._m = function, m

    def __getattr__(self, name: str) -> Any:
        """Return what no origin changes, such as the difference of two readings."""
        return getattr(self.__dict__["_function"], name)

    @property
    def parts(self) -> list[MovedFunction]:
        """The functions of single readings."""
        parts = getattr(self._function, "parts", [self._function])
        return [MovedFunction(part, self._m) for part in parts]

    def value(self, x: FloatArray) -> FloatArray:
        """Return the reading (p,) without noise at the state x (n,)."""
        return np.asarray(self._function.value(x + self._m))

    def __call__(self, y: FloatArray, xhat: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the reading ``y`` (p,) linearised at the estimate ``xhat`` (n,), and H (p, n)."""
        z, J = self._function(y, xhat + self._m)
        return z - J @ self._m, J


class MovedReadings:
    """The readings of one sensor on one node where states are counted from m: nonlinear ones, or
    recorded ones, which are of the plant's coordinates. In slots (``Readings``); in continuous time
    with the ``times`` (K,) of its samples (``Samples``).
    """

    def __init__(self, path: Any, believed: Response, times: FloatArray | None = None) -> None:
        self._path, self._believed = path, believed
        self._at_samples = None if times is None else believed.states(times)

    def __getattr__(self, name: str) -> Any:
        """Return what no origin changes, such as covariances of readings."""
        return getattr(self.__dict__["_path"], name)

    def _m(self, numbers: Sequence[int]) -> FloatArray:
        if self._at_samples is None:
            return self._believed.states(np.array(numbers))
        return self._at_samples[list(numbers)]

    def matrix(self, slot: int) -> Any:
        """Return H (p, n) in slot number ``slot``, or a function that linearises."""
        H = self._path.matrix(slot)
        return H if isinstance(H, np.ndarray) else MovedFunction(H, self._m([slot])[0])

    def reading(self, k: int, x: FloatArray) -> Any:
        """Return the reading (p,) in slot number ``k`` whose state is x (n,), or of sample number
        ``k`` with its H (p, n), or the function that linearises.
        """
        m = self._m([k])[0]
        if self._at_samples is None:
            return moved_reading(self._path.reading(k, x + m), self._path.matrix(k), m)[0]
        y, H = self._path.reading(k, x + m)
        return moved_reading(y, H, m)

    def parts(self, slot: int, x: FloatArray, R: FloatArray) -> Iterator[Any]:
        """Yield y, H and covariance of each reading of a slot, see ``readings_of``."""
        m = self._m([slot])[0]
        for y, H, covariance in readings_of(self._path, slot, x + m, R):
            yield *moved_reading(y, H, m), covariance

    def several(self, numbers: Sequence[int], x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return readings (S, p) and H (S, p, n) of increasing ``numbers``, states x (S, n)."""
        m = self._m(numbers)
        y, H = read_many(self._path, numbers, x + m)
        return y - apply(H, m), H

    def whitened(self, slots: list[int], R: FloatArray, p: int) -> tuple[FloatArray, FloatArray]:
        """Return whitened readings (S, p) and H (S, p, n), see ``RecordedReadings``."""
        y, H = self._path.whitened(slots, R, p)
        return y - apply(H, self._m(slots)), H


def moved_reading(y: FloatArray, H: Any, m: FloatArray) -> tuple[FloatArray, Any]:
    """Return a reading y (p,) with H (p, n), or a function, for states counted from ``m`` (n,)."""
    if not isinstance(H, np.ndarray):
        return y, MovedFunction(H, m)
    # A sensor without a reading may give an empty y, whatever H is.
    return y - H @ m if len(H) == len(y) else y, H
