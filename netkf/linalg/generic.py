"""Functions of kernels that have an implementation for each class of their first argument.

A slot and a gap in continuous time are predicted in different ways, yet a filter is written once:
it calls ``predict_estimate(model, ...)``, and the class of ``model``, a struct, chooses the kernel,
in compiled code when that is compiled::

    @generic
    def predict_estimate(model, x, root, k): ...

    @predict_estimate.register(SlotModel)
    @kernel
    def predict_slot(model, x, root, k): ...
"""

from __future__ import annotations

from collections.abc import Callable
from functools import update_wrapper
from typing import Any, TypeVar

import numpy as np

from netkf.linalg.structs import Struct, struct_at

Derived = TypeVar("Derived", bound=Struct)


class Generic:
    """A function that calls the kernel registered for the class of its first argument."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._kernels: dict[type[Struct], Any] = {}
        update_wrapper(self, function)

    def register(self, cls: type[Struct]) -> Callable[[Any], Any]:
        """Return a decorator that makes a kernel the implementation for ``cls`` and its sizes."""

        def add(kernel: Any) -> Any:
            self._kernels[cls] = kernel
            return kernel

        return add

    def kernel_of(self, cls: type[Struct]) -> Any:
        """Return the kernel for a class; raises TypeError if there is none."""
        for base in cls.__mro__:
            if base in self._kernels:
                return self._kernels[base]
        raise TypeError(f"{self.__name__} has no kernel for {cls.__name__}")  # type: ignore[attr-defined]

    def __call__(self, first: Struct, *others: Any) -> Any:
        """Call the kernel for the class of ``first``."""
        return self.kernel_of(type(first))(first, *others)

    def __reduce__(self) -> str:
        return self.__qualname__  # type: ignore[attr-defined, no-any-return]


def generic(function: Callable[..., Any]) -> Generic:
    """Make a function whose kernels are registered by class; its own body is not used."""
    return Generic(function)


def drop_lane(array: np.ndarray) -> np.ndarray:
    """Return an array of one lane without its last axis, as kernels of single runs take it."""
    return array[..., 0]


def copy_row(struct: Struct, k: int, m: int) -> None:
    """Copy entry ``m`` of each array of a struct to entry ``k``."""
    for name in struct.struct_fields:
        array = getattr(struct, name)
        if isinstance(array, np.ndarray):
            array[k] = array[m]


def copy_part(struct: Struct, k: int, m: int, place: int, origin: int, _width: int) -> None:
    """Copy component ``origin`` of entry ``m`` of each array of a struct, of ``_width`` components,
    to component ``place`` of entry ``k``.
    """
    for name in struct.struct_fields:
        array = getattr(struct, name)
        if isinstance(array, np.ndarray):
            array[k, place] = array[m, origin]


def copy_arrays(target: Derived, source: Derived) -> None:
    """Copy all arrays of a struct into those of another one of its class and shapes."""
    for name in target.struct_fields:
        array, given = getattr(target, name), getattr(source, name)
        if isinstance(array, np.ndarray) and array is not given:
            array[...] = given


def struct_like(struct: Derived, memory: np.ndarray) -> Derived:
    """Return the struct of the class of ``struct`` whose block of int64 words is ``memory``
    (words,). A kernel must pass it on to one that writes into its arrays: numba removes what seems
    to be written to values of a function's own.
    """
    return struct_at(memory, type(struct))
