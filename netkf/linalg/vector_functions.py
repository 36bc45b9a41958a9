"""Functions with an address, at which compiled code calls them (``functions``)."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from netkf.linalg.arrays import FloatArray, real_numbers
from netkf.linalg.compiling import compile_c_function, require_numba, require_quiet
from netkf.linalg.functions import plain_address
from netkf.linalg.plain import is_plain

Shape = tuple[int, ...]
_CALL = ctypes.CFUNCTYPE(
    None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_double, ctypes.c_double, ctypes.c_void_p
)


class VectorFunction:
    """A function with an ``address``: where ``is_kernel`` a kernel ``function(x, u, t, out)`` that
    writes its result into ``out``, or ``function(x, u, t, period, out)`` if it ``takes_period``,
    else a function in Python of the same arguments but ``out``, that returns it. ``shapes`` are
    those of x, u and out. It must be kept as long as kernels may call it.
    """

    def __init__(
        self,
        function: Callable[..., Any],
        shapes: tuple[Shape, Shape, Shape],
        is_kernel: bool,
        takes_period: bool = False,
    ) -> None:
        self._arguments = function, shapes, is_kernel, takes_period
        self._function, self._shapes = function, shapes
        self._is_kernel, self._takes_period = is_kernel, takes_period
        self._error: BaseException | None = None
        self._arrays: dict[tuple[int, Shape], FloatArray] = {}

    @cached_property
    def address(self) -> int:
        """The address, at which a kernel is compiled when it is first asked for."""
        if is_plain():
            return plain_address(self._call_with_arrays)
        self._code: Any
        if not self._is_kernel:
            self._code = _CALL(self._call_with_addresses)
            return int(ctypes.cast(self._code, ctypes.c_void_p).value or 0)
        require_numba()
        require_quiet(getattr(self._function, "loops", self._function), set())
        self._code = _compile(self._function, self._shapes, self._takes_period)
        return int(self._code.address)

    def __reduce__(self) -> tuple[Any, ...]:
        """Return what pickle needs: addresses are those of one process."""
        return VectorFunction, self._arguments

    def __call__(self, x: FloatArray, u: FloatArray, t: float, period: float) -> FloatArray:
        """Return the value (shape of out) at ``x``, ``u``, ``t`` and ``period``, for Python."""
        out = np.empty(self._shapes[2])
        self._call_with_arrays(x, u, t, period, out)
        self.raise_error()
        return out

    def raise_error(self) -> None:
        """Raise the error of the first call that failed, of a function in Python: kernels go on
        after it, with nan as its result.
        """
        error, self._error = self._error, None
        if error is not None:
            raise error

    def _call_with_addresses(self, x: int, u: int, t: float, period: float, out: int) -> None:
        arrays = [self._array(a, shape) for a, shape in zip((x, u, out), self._shapes, strict=True)]
        self._write(arrays[0].copy(), arrays[1].copy(), t, period, arrays[2])

    def _call_with_arrays(self, x: Any, u: Any, t: float, period: float, out: Any) -> None:
        # As at an address, what follows the numbers of an array is not looked at.
        x, u, out = (
            a.reshape(-1)[: math.prod(shape)].reshape(shape)
            for a, shape in zip((x, u, out), self._shapes, strict=True)
        )
        if self._is_kernel:
            self._function(x, u, t, *([period] if self._takes_period else []), out)
        else:
            self._write(x.copy(), u.copy(), t, period, out)

    def _write(self, x: FloatArray, u: FloatArray, t: float, period: float, out: Any) -> None:
        try:
            others = [float(period)] if self._takes_period else []
            value = real_numbers(self._function(x, u, float(t), *others))
            if value.shape != out.shape:
                raise ValueError(f"returned shape {value.shape} instead of {out.shape}")
            out[...] = value
        # Nothing may pass through compiled code.
        except BaseException as error:
            out[...] = math.nan
            self._error = self._error or error

    def _array(self, address: int, shape: Shape) -> FloatArray:
        """Return the array at an address; the same few addresses come again and again."""
        if not math.prod(shape):
            return np.zeros(shape)
        key = address, shape
        if key not in self._arrays:
            memory: Any = (ctypes.c_double * math.prod(shape)).from_address(address)
            self._arrays[key] = np.frombuffer(memory).reshape(shape)
        return self._arrays[key]


@lru_cache
def _compile(function: Any, shapes: tuple[Any, Any, Any], takes_period: bool) -> Any:
    """Return the C function of a kernel, with numba loaded."""
    from netkf.linalg.function_types import SIGNATURE, taking_addresses

    made = taking_addresses(function, shapes, takes_period)
    return compile_c_function(made, SIGNATURE, {"error_model": "numpy"})
