"""Structures of named arrays and numbers that are passed to kernels as one address.

numba passes a named tuple by value: ten machine words for each array in it, in each call, and it
converts each array whenever Python calls. A :class:`Struct` is one block of memory that holds its
numbers and the addresses and shapes of its arrays. Kernels read ``state.xhat`` and write
``state.piece += 1`` as Python does, and see what Python wrote::

    class Walk(Struct):
        position: FloatArray
        steps: int

    walk = Walk(position=np.zeros((2, 3)), steps=0)

A field ``size`` may be :func:`sized`: the length of the tuple is part of the type, so that loops
over ``range(len(size))`` have a constant length. Each size has a class, ``cls.of_size(n)``.

Annotations ``int`` and ``float`` are numbers; all other fields are C-contiguous arrays or other
structs, whose types are the same for all instances of a class. A struct keeps its arrays alive.

Kernels that Python calls very often take ``struct.memory``, whose type numba knows sooner, and
begin with ``struct = struct_at(memory, Walk)``.
"""

from __future__ import annotations

import ctypes
import math
from typing import Any, ClassVar, TypeVar, dataclass_transform
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import NDArray

from netkf.linalg.arrays import array_address
from netkf.linalg.plain import is_plain, with_fields

FloatArray = NDArray[np.float64]
NUMBERS = {"int": np.int64, "float": np.float64}
WORD = 8  # bytes
MAX_UNROLLED = 4
"""Largest n for which kernels are compiled specially, with unrolled loops: 1.5 times as fast."""

Size = tuple[int, ...] | FloatArray


class NumbaType:
    """The numba type of a class of structs until numba asks for it; from then on the type itself,
    which numba finds in a fifth of the time of asking Python.
    """

    find: ClassVar[Any]
    """The function from a class to its numba type, set by ``struct_types``."""

    def __get__(self, _: Any, cls: Any) -> Any:
        # An AttributeError, as long as nothing is compiled, says that there is none.
        cls._numba_type_ = self.find(cls)
        return cls._numba_type_


class StructClass(type):
    """The metaclass of Struct, by which numba recognises its derived classes."""


@dataclass_transform(kw_only_default=True)
class Struct(metaclass=StructClass):
    """Named arrays and numbers at one address; derived classes annotate their fields."""

    struct_fields: ClassVar[tuple[str, ...]] = ()
    struct_offsets: ClassVar[dict[str, int]] = {}
    """First word of each field: a number; a pointer; or a pointer and a shape."""
    struct_kinds: ClassVar[dict[str, Any]] = {}
    """Kind of each field: ``np.int64``, ``np.float64``, a derived class, the (dtype, dimensions) of
    an array, or the length n of a sized tuple. Empty before the first instance.
    """

    _numba_type_: ClassVar[Any]
    memory: np.ndarray
    """The block of memory, as int64 words."""
    address: int
    """Address of the first byte of ``memory``."""

    def __init_subclass__(cls) -> None:
        """Take the fields from the annotations; the first instance determines their layout."""
        cls.struct_fields = tuple(cls.__annotations__)
        cls.struct_offsets, cls.struct_kinds = {}, {}
        # Each class its own, and not that of the class that it derives from.
        cls._numba_type_ = NumbaType()

    @classmethod
    def of_size(cls, n: int) -> Any:
        """Return the class of structs with n numbers in ``size``: its own up to MAX_UNROLLED."""
        # Larger states share one compiled kernel, whatever their n.
        if n > MAX_UNROLLED:
            return cls
        sized_class = _sized_classes.get((cls, n))
        if sized_class is None:
            # The same annotations, but a class of its own: its layout has the size in the type.
            body = {"__annotations__": cls.__annotations__, "__module__": cls.__module__}
            new_class = StructClass(f"{cls.__name__}{n}", (cls,), body)
            # setdefault, because two threads may make the same class at once.
            sized_class = _sized_classes.setdefault((cls, n), new_class)
        return sized_class

    def __init__(self, **values: Any) -> None:
        """Raises TypeError where fields are missing, unknown, or of another type."""
        cls = type(self)
        if values.keys() != set(cls.struct_fields):
            raise TypeError(f"{cls.__name__} has the fields {', '.join(cls.struct_fields)}")
        # The first instance determines the types of the fields.
        if not cls.struct_offsets:
            cls._lay_out(values)
        # All words at once: a run makes some structs of 50 fields.
        words, floats = [0] * cls.struct_size(), []
        for name, value in values.items():
            word, kind = cls.struct_offsets[name], cls.struct_kinds[name]
            if kind is np.int64:
                words[word] = int(value)
            elif kind is np.float64:
                floats.append((word, value))
            else:
                for k, part in enumerate(self._keep_alive(name, value, kind), word):
                    words[k] = part
        memory = np.array(words, dtype=np.int64)
        numbers = memory.view(np.float64)
        for word, value in floats:
            numbers[word] = value
        self.__dict__.update(memory=memory, address=array_address(memory))
        _structs[self.address] = self

    @classmethod
    def from_memory(cls, memory: np.ndarray) -> Any:
        """Return the struct whose block of int64 words is ``memory`` (words,), with views of the
        arrays that it tells the addresses of; they must be kept elsewhere.
        """
        made = object.__new__(cls)
        made.__dict__.update(memory=memory, address=array_address(memory))
        for name, kind in cls.struct_kinds.items():
            words = memory[cls.struct_offsets[name] :]
            if isinstance(kind, int):
                made.__dict__[name] = (0,) * kind
            elif isinstance(kind, tuple):
                dtype, ndim = kind
                made.__dict__[name] = with_fields(_array_at(words[0], dtype, words[1 : 1 + ndim]))
            elif issubclass(kind, Struct):
                inner = _array_at(words[0], np.dtype(np.int64), [kind.struct_size()])
                made.__dict__[name] = struct_at(inner, kind)
        return made

    @classmethod
    def at(cls, struct: Any) -> Any:
        """Return a struct of this class at the memory of another one, which it keeps alive."""
        made = object.__new__(cls)
        made.__dict__.update(memory=struct.memory, address=struct.address, seen=struct)
        return made

    @classmethod
    def struct_size(cls) -> int:
        """Return the number of int64 words of ``memory``: the end of the last field, which is one
        word for a number or the address of a struct, and one word for the address of an array plus
        one for each of its dimensions.
        """
        last = cls.struct_fields[-1]
        return cls.struct_offsets[last] + 1 + _dimensions(cls.struct_kinds[last])

    @classmethod
    def _lay_out(cls, values: dict[str, Any]) -> None:
        """Set ``struct_offsets``, in words, and ``struct_kinds`` from the first values."""
        word, offsets = 0, dict[str, int]()
        kinds = dict[str, Any]()
        for name in cls.struct_fields:
            value, annotation = values[name], cls.__annotations__[name]
            annotation = getattr(annotation, "__name__", annotation)
            offsets[name] = word
            if annotation in NUMBERS:
                kinds[name] = NUMBERS[annotation]
            elif isinstance(value, Struct):
                kinds[name] = type(value)
            elif isinstance(value, tuple):
                kinds[name] = len(value)
            else:
                kinds[name] = (value.dtype, value.ndim)
            # A number or a pointer, and one word for each dimension.
            word += 1 + _dimensions(kinds[name])
        cls.struct_kinds, cls.struct_offsets = kinds, offsets

    def __setattr__(self, name: str, value: Any) -> None:
        """Write a field: a number into ``memory``, or the address and shape of an array, the
        address of a struct. Raises TypeError for another type than the field had at first.
        """
        word, kind = self.struct_offsets[name], self.struct_kinds[name]
        if kind is np.int64 or kind is np.float64:
            # Integers and floats share the words, seen as one or the other type.
            self.memory.view(kind)[word] = value
        else:
            for k, part in enumerate(self._keep_alive(name, value, kind), word):
                self.memory[k] = part

    def _keep_alive(self, name: str, value: Any, kind: Any) -> tuple[int, ...]:
        """Keep an array, a struct or a sized tuple alive, and return its words."""
        if isinstance(kind, tuple):
            # Compiled code assumes the type and computes strides itself: anything else would read
            # wrong memory.
            if (value.dtype, value.ndim) != kind or not value.flags.c_contiguous:
                raise TypeError(f"{type(self).__name__}.{name} is a C-contiguous array {kind}")
            # The dictionary keeps the array alive, since the memory holds its address only.
            self.__dict__[name] = with_fields(value) if is_plain() else value
            return array_address(value), *value.shape
        # Of a tuple, ``size``, only its length matters, which is part of the numba type.
        if not isinstance(kind, int) and type(value) is not kind:
            raise TypeError(f"{type(self).__name__}.{name} is a {kind.__name__}")
        self.__dict__[name] = value
        return (0, kind) if isinstance(kind, int) else (value.address,)

    @property
    def general(self) -> Any:
        """The same memory as a struct of the class for any size, which has the same layout."""
        cls = _general_class(type(self))
        return self if is_plain() or cls is type(self) else cls.at(self)

    def __reduce__(self) -> tuple[Any, ...]:
        cls, size = type(self), getattr(self, "size", None)
        # A class made by of_size() has no importable name: its base and n are pickled.
        base, n = (cls.__base__, len(size)) if isinstance(size, tuple) else (cls, None)
        return _rebuilt, (base, n, {name: getattr(self, name) for name in self.struct_fields})

    def __getattr__(self, name: str) -> Any:
        """Return the present value of a number, which ``memory`` holds, or an attribute."""
        # Numbers are read from the memory, where kernels may have changed them.
        kind = self.struct_kinds.get(name)
        if kind is not np.int64 and kind is not np.float64:
            raise AttributeError(name)
        number = self.memory.view(kind)[self.struct_offsets[name]]
        return number if is_plain() else number.item()


Derived = TypeVar("Derived", bound=Struct)


_sized_classes: dict[tuple[type[Struct], int], Any] = {}
_structs: WeakValueDictionary[int, Struct] = WeakValueDictionary()
"""All structs by address, for ``struct_at`` in plain Python."""


def _dimensions(kind: Any) -> int:
    """Return the number of words of a shape; that of a sized tuple is that of an array."""
    return kind[1] if isinstance(kind, tuple) else int(isinstance(kind, int))


def _general_class(cls: Any) -> Any:
    """Return the class that ``cls`` was made of by ``of_size``, else ``cls``, laid out alike."""
    base = cls.__base__
    if base is Struct:
        return cls
    if not base.struct_kinds:
        kinds = dict(cls.struct_kinds)
        for name, kind in kinds.items():
            if base.__annotations__[name] == "Size":
                kinds[name] = (np.dtype(np.float64), 1)
            elif isinstance(kind, StructClass):
                kinds[name] = _general_class(kind)
        base.struct_kinds, base.struct_offsets = kinds, cls.struct_offsets
    return base


def _array_at(address: int, dtype: np.dtype, shape: Any) -> np.ndarray:
    """Return the C-contiguous array of this ``shape`` that begins at an address."""
    size = dtype.itemsize * math.prod(map(int, shape))
    memory: Any = (ctypes.c_char * size).from_address(int(address))
    return np.frombuffer(memory, dtype=dtype).reshape(tuple(map(int, shape)))


def _rebuilt(cls: type[Derived], n: int | None, values: dict[str, Any]) -> Derived:
    """Return an unpickled struct; ``n`` is the size for a class made by ``of_size``."""
    return (cls if n is None else cls.of_size(n))(**values)


def sized(n: int) -> Size:
    """Return an object of length n, of which only the length matters: a tuple, whose length is part
    of its type, if loops over it are to be unrolled, else an array.
    """
    return (0,) * n if n <= MAX_UNROLLED else np.zeros(n)


def struct_at(memory: np.ndarray, cls: type[Derived]) -> Derived:
    """Return, in kernels, the struct of ``cls`` whose int64 words are ``memory`` (words,)."""
    known: Any = _structs.get(array_address(memory))
    found: Derived = cls.from_memory(memory) if known is None else known
    return found
