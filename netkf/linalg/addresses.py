"""Kernels that are called by their address, compiled once for all who call them.

A kernel becomes part of each kernel that calls it, and is compiled with each of them. The verbs of
a filter are called by the loops of several engines, by Python and by theory: they have an address
instead, so that each loop is compiled once for all filters, and each verb once for all loops.

Such a kernel takes a struct, one or two integers and a struct.
"""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np

from netkf.linalg.functions import plain_address, plain_functions
from netkf.linalg.plain import is_plain
from netkf.linalg.structs import Struct

NOTHING = 0
"""The address of a verb that is not called."""
_POINTER, _INTEGER = ctypes.c_void_p, ctypes.c_int64
_CALLS: dict[tuple[bool, int], Any] = {
    (is_number, count): ctypes.CFUNCTYPE(
        ctypes.c_double if is_number else None, _POINTER, *[_INTEGER] * count, _POINTER
    )
    for is_number in (False, True)
    for count in (1, 2)
}
_addresses: dict[tuple[Any, ...], int] = {}
_entries: dict[tuple[Any, ...], Any] = {}
_classes_read: dict[Any, type[Struct]] = {}


class AnyStruct(Struct):
    """A struct of unknown fields, which kernels pass on to what has an address."""

    unknown: int


AnyStruct.struct_kinds, AnyStruct.struct_offsets = {"unknown": np.int64}, {"unknown": 0}


def any_struct(struct: Struct) -> Any:
    """Return a struct as an AnyStruct."""
    return struct if is_plain() else AnyStruct.at(struct)


def viewed_as(cls: type[Struct], struct: Struct, **kinds: Any) -> Any:
    """Return a struct as one of ``cls``, whose fields it has at the same places."""
    if is_plain():
        return struct
    if not cls.struct_kinds:
        own = {name: struct.struct_kinds[name] for name in cls.struct_fields}
        cls.struct_offsets = {name: struct.struct_offsets[name] for name in cls.struct_fields}
        cls.struct_kinds = own | kinds
    return cls.at(struct)


def reads_only(cls: type[Struct], *kernels: Any) -> None:
    """Declare that ``kernels`` read the fields of ``cls``, if these are the first of their record:
    they are compiled once for all such records.
    """
    _classes_read.update(dict.fromkeys(kernels, cls))


def _first_fields(kernel: Any, record: Struct) -> Any:
    cls = _classes_read.get(kernel)
    if cls is None or is_plain():
        return record
    seen, offsets = viewed_as(cls, record), record.struct_offsets
    alike = all(offsets.get(name) == word for name, word in cls.struct_offsets.items())
    return seen if alike else record


def address_of(
    kernel: Any, record: Struct, run: Struct, count: int = 1, number: bool = False
) -> int:
    """Return the address of ``kernel(record, *integers, run)`` with ``count`` integers, compiled
    for structs of these classes; it returns a float if it is of a ``number``, else nothing.
    """
    known = _first_fields(kernel, record)
    key = kernel, type(known), type(run)
    if key not in _addresses:
        arguments = known, *[0] * count, run
        entry = plain_address(kernel) if is_plain() else kernel.compile_entry(arguments, number)
        _addresses[key] = entry
    return _addresses[key]


def call_kernel(
    kernel: Any, record: Struct, *integers: int, run: Struct, number: bool = False
) -> Any:
    """Call ``kernel(record, *integers, run)`` from Python."""
    if is_plain():
        return kernel(record, *integers, run)
    key = kernel, type(record), type(run)
    entry = _entries.get(key)
    if entry is None:
        address = address_of(kernel, record, run, len(integers), number)
        entry = _entries[key] = _CALLS[number, len(integers)](address)
    return entry(record.address, *integers, run.address)


def call_at(address: int, record: Any, h: int, run: Any) -> None:
    """Call, in kernels, what has an ``address`` with a struct, an integer and a struct."""
    plain_functions[int(address)](record, h, run)


def call_at_two(address: int, record: Any, h: int, m: int, run: Any) -> None:
    """Call what has an ``address`` with two integers."""
    plain_functions[int(address)](record, h, m, run)


def number_at(address: int, record: Any, h: int, run: Any) -> float:
    """Return, in kernels, the number that is returned by what has an ``address``."""
    number: Any = plain_functions[int(address)]
    return float(number(record, h, run))
