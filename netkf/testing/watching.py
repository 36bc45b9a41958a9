"""Calls of a user's methods that check their side effects."""

from __future__ import annotations

import ctypes
import dataclasses
import inspect
import pickle
import random
import struct
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache, cached_property
from typing import Any, NoReturn, cast

import numpy as np

from netkf.core.errors import NetkfError, quote
from netkf.core.fields import Component
from netkf.linalg.arrays import FloatArray
from netkf.scenario.plugins import describe_error

Leaves = dict[str, Any]
MERSENNE_BYTES = 4 * 625
"""Size of the state of a Mersenne twister: 624 words and the position in them."""


def fail(where: str, rule: str, got: object = None, remedy: str = "") -> NoReturn:
    """Raise AssertionError with one line."""
    found = "" if got is None else f"; got {got if isinstance(got, str) else quote(got)}"
    raise AssertionError(f"{where}: {rule}{found}{f'; {remedy}' if remedy else ''}")


def demand(holds: object, where: str, rule: str, got: object = None, remedy: str = "") -> None:
    """Raise the error of :func:`fail` unless ``holds``."""
    if not holds:
        fail(where, rule, got, remedy)


def make_part(
    part: Any, contracts: tuple[type[Component], ...], settings: Mapping[str, Any]
) -> Any:
    """Return an object of a user's class: ``part`` itself, or the class make_part with
    ``settings``.
    """
    cls = part if isinstance(part, type) else type(part)
    name = cls.__name__
    listed = " or ".join(contract.__name__ for contract in contracts)
    demand(
        issubclass(cls, contracts),
        name,
        f"must be derived from {listed} of netkf.parts, or be an object of such a class",
    )
    missing = [
        attribute
        for attribute in sorted(dir(cls))
        if getattr(_static_attribute(cls, attribute), "__isabstractmethod__", False)
    ]
    demand(not missing, name, f"must define {', '.join(missing)}", None, "write what is missing")
    if not isinstance(part, type):
        demand(not settings, name, "settings go with a class", sorted(settings), "leave them out")
        return part
    try:
        return cls(**settings)
    except Exception as error:
        text = f"could not be made with the settings {dict(settings)!r}"
        remedy = "hand over an object, or the class with its settings as keywords"
        fail(name, text, describe_error(error), remedy)


_PLAIN = frozenset((str, bytes, bool, int, float, complex, type(None)))
"""Types of most leaves but arrays."""


def leaves(value: Any) -> Leaves:
    """Return copies of every number, text and array that a value is made of, by their paths."""
    found: Leaves = {}
    _add_leaves([("", value)], "", set(), found)
    return found


def _add_leaves(
    parts: Iterable[tuple[str, Any]], path: str, whole: set[int], found: Leaves
) -> None:
    """Add the leaves of the parts of what is at a path; ``whole``: what they are parts of, by
    identity.
    """
    # Most parts are leaves: calls for each of them would take a third of a check.
    for name, part in parts:
        if type(part) in _PLAIN:
            found[path + name] = part
        elif isinstance(part, np.ndarray):
            found[path + name] = part.copy()
        elif id(part) in whole or isinstance(part, np.random.Generator) or callable(part):
            continue
        elif isinstance(part, (str, bytes, int, float, complex, np.generic)):
            found[path + name] = part
        else:
            whole.add(id(part))
            _add_leaves(_iterate_parts(part), path + name, whole, found)
            whole.discard(id(part))


def _iterate_parts(value: Any) -> Iterable[tuple[str, Any]]:
    """Return the parts of a value, with the text that names each."""
    fields = getattr(value, "_fields", None)
    if fields is not None:
        return [(f".{name}", getattr(value, name)) for name in fields]
    if isinstance(value, (list, tuple)):
        return [(f"[{k}]", item) for k, item in enumerate(value)]
    if isinstance(value, Mapping):
        return [(f"[{key!r}]", item) for key, item in value.items()]
    if isinstance(value, (set, frozenset)):
        return [(f"[{k}]", item) for k, item in enumerate(sorted(value, key=repr))]
    if dataclasses.is_dataclass(value):
        return [(f".{f.name}", getattr(value, f.name)) for f in dataclasses.fields(value)]
    return [(f".{name}", item) for name, item in getattr(value, "__dict__", {}).items()]


def difference(one: Leaves, other: Leaves) -> str | None:
    """Return the path of the first leaf in which two values differ, None if all are equal."""
    if one.keys() != other.keys():
        return (
            min(one.keys() ^ other.keys(), key=len, default="")
            or "its shape changed from a number to parts"
        )
    for path, value in one.items():
        second = other[path]
        # Arrays are copies: what is the same object is a number or a text.
        if value is not second and not _are_equal(np.asarray(value), np.asarray(second)):
            return path or "it"
    return None


def _are_equal(one: np.ndarray, other: np.ndarray) -> bool:
    """Return True if two arrays are equal in type, shape and every entry."""
    same_type = one.dtype == other.dtype and one.shape == other.shape
    # Nearly all are equal to the last bit, which is cheap to see.
    if same_type and one.dtype != object and one.tobytes() == other.tobytes():
        return True
    numeric = one.dtype.kind in "fc" and other.dtype.kind in "fc"
    return np.array_equal(one, other, equal_nan=numeric)


def global_randomness() -> tuple[Any, Any]:
    """Return the states of the generators that all of a process shares."""
    shared = np.random.get_bit_generator()  # type: ignore[attr-defined]
    if not isinstance(shared, np.random.MT19937):
        return _python_randomness(), repr(shared.state)
    # Its memory: numpy takes 0.1 ms to list the state, and this is asked before and after each
    # call of a user's method.
    words = ctypes.string_at(shared.ctypes.state_address, MERSENNE_BYTES)
    return _python_randomness(), (id(shared), words)


def _python_randomness() -> Any:
    """Return the state of Python's shared generator."""
    address = _python_state_address()
    if address is None:
        return random.getstate()
    # To list and compare 625 numbers takes most of the time of a check.
    return ctypes.string_at(address, MERSENNE_BYTES), _shared_random().gauss_next


def _shared_random() -> Any:
    """Return the generator behind Python's functions of ``random``."""
    return cast(Any, random.getstate).__self__


@cache
def _python_state_address() -> int | None:
    """Return where the position and the 624 words of Python's shared generator are in memory; None
    where an object's memory does not hold what ``getstate`` says.
    """
    head, size = object.__basicsize__, random.Random.__basicsize__
    if sys.implementation.name != "cpython" or size < head + MERSENNE_BYTES:
        return None
    address = id(_shared_random()) + head
    position, *words = struct.unpack("=625I", ctypes.string_at(address, MERSENNE_BYTES))
    return address if random.getstate()[1] == (*words, position) else None


@cache
def _static_attribute(cls: type, name: str) -> Any:
    """Return an attribute of a class without calling descriptors."""
    return inspect.getattr_static(cls, name, None)


class Watched:
    """A part whose methods are called with everything around them watched.

    What a method was given must be as before, also later; the part itself too; a second call must
    give the same; numpy's and Python's global generators must not be used. Where the part is an
    adapter, its ``owner`` is the object of the user's class, and ``former`` says how that one calls
    the methods.
    """

    def __init__(
        self, part: Any, owner: Any = None, former: Mapping[str, str] | None = None
    ) -> None:
        self.part, self._owner = part, part if owner is None else owner
        self.name = type(self._owner).__name__
        self._former = former or {}
        self._kept: list[tuple[str, Any, Leaves]] = []

    def defined_name(self, method: str) -> str:
        """Return the name by which the user's class defines a method or property."""
        if method in self._former:
            return self._former[method]
        cls: Any = type(self._owner)
        found = _static_attribute(cls, method)
        defined = getattr(getattr(found, "fget", found), "__name__", method)
        # Under a former name of the contract, see Component.former_names.
        former = getattr(self._owner, "former_names", {}).get(method)
        return former if defined == former else method

    def call(self, method: str, *arguments: Any, repeatable: bool = True) -> Any:
        """Return the result of a method; called twice and compared if it is ``repeatable``, drawing
        nothing.
        """
        where = f"{self.name}.{self.defined_name(method)}"
        before = [leaves(argument) for argument in arguments]
        itself = self.attributes()
        results = [self._call_method(where, method, arguments) for _ in range(1 + repeatable)]
        for k, old in enumerate(before):
            path = difference(old, leaves(arguments[k]))
            if path is not None:
                name = self._parameter_names(method, len(arguments))[k]
                remedy = "return a new one; work on copies"
                fail(
                    where,
                    f"must leave what it is given as it is, and changed {name}{path}",
                    None,
                    remedy,
                )
        path = difference(itself, self.attributes())
        demand(
            path is None,
            where,
            f"must not change its own object, and changed {path}",
            None,
            "keep what changes in the state that is handed in and returned",
        )
        found = [leaves(result) for result in results]
        path = difference(found[0], found[-1])
        demand(
            path is None,
            where,
            "must give the same for the same arguments",
            f"another {(path or '').lstrip('.') or 'value'} at the second call",
            "use no randomness, clock or memory of earlier calls",
        )
        self._kept.append((where, results[0], found[0]))
        return results[0]

    def once(self) -> Watched:
        """Return the same component with unchecked calls, to compare with checked ones."""
        return _Once(self.part, self._owner, self._former)

    def attributes(self) -> Leaves:
        """Return the attributes of the component, except for cached properties."""
        cls: Any = type(self._owner)
        own = vars(self._owner)
        kept = {
            k: v
            for k, v in own.items()
            if not isinstance(_static_attribute(cls, k), cached_property)
        }
        return {path.strip("[]'"): leaf for path, leaf in leaves(kept).items()}

    def _call_method(self, where: str, method: str, arguments: tuple[Any, ...]) -> Any:
        """Return the result of a method; failures and uses of global generators are
        AssertionErrors.
        """
        before = global_randomness()
        try:
            result = getattr(self.part, method)(*arguments)
        except NetkfError as error:
            fail(where, f"failed: {error}")
        except Exception as error:
            singular = isinstance(error, np.linalg.LinAlgError)
            remedy = "; set inverts = True where covariances must not be singular"
            text = f"{where}: failed with {describe_error(error)}{remedy if singular else ''}"
            raise AssertionError(text) from error
        demand(
            global_randomness() == before,
            where,
            "must not use or seed global generators (numpy.random.*, random.*)",
            None,
            "draw from the generator that is handed in",
        )
        return result

    def _parameter_names(self, method: str, count: int) -> list[str]:
        """Return the names of the first ``count`` parameters of a method."""
        names = list(inspect.signature(getattr(self.part, method)).parameters)
        return [*names, *["an argument"] * count][:count]

    def finish(self) -> None:
        """Check that no result of an earlier call has changed since."""
        for where, result, old in self._kept:
            path = difference(old, leaves(result))
            demand(
                path is None,
                where,
                f"returned something that a later call changed ({(path or '').lstrip('.')})",
                None,
                "return copies, share no buffers",
            )

    def demand_unchanged(self, before: Leaves) -> None:
        """Check that the attributes of the component are still those from ``before``."""
        path = difference(before, self.attributes())
        demand(
            path is None,
            self.name,
            f"must not change its own object, and changed {path}",
            None,
            "keep what changes in the paths and states that its methods return",
        )

    def pickle_copy(self) -> Any:
        """Return a copy of the part that went through pickle, as for worker processes."""
        try:
            copy = pickle.loads(pickle.dumps(self._owner))
        except Exception as error:
            fail(
                self.name,
                "must be picklable, for worker processes",
                describe_error(error),
                "define the class at the top level of a module and keep no open files or lambdas",
            )
        path = difference(leaves(self._owner), leaves(copy))
        demand(path is None, self.name, f"must be itself after pickling, and lost {path}")
        return copy


class _Once(Watched):
    """See ``Watched.once``."""

    def call(self, method: str, *arguments: Any, repeatable: bool = True) -> Any:
        """Return the result of a method."""
        return self._call_method(f"{self.name}.{self.defined_name(method)}", method, arguments)


@contextmanager
def user_code(where: str) -> Iterator[None]:
    """Turn errors of a user's class into one line, and check that no global generator is used."""
    before = global_randomness()
    try:
        yield
    except AssertionError:
        raise
    except Exception as error:
        raise AssertionError(f"{where}: failed with {describe_error(error)}") from error
    demand(
        global_randomness() == before,
        where,
        "must not use or seed global generators (numpy.random.*, random.*)",
        None,
        "draw from the generator that is handed in",
    )


def attempt(where: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """Return the result of a function of a user's class, see ``user_code``."""
    with user_code(where):
        return function(*arguments)


def demand_array(where: str, name: str, value: Any, shape: tuple[int, ...]) -> FloatArray:
    """Return a float64 array of that shape with finite numbers; fail otherwise."""
    array = np.asarray(value)
    demand(array.shape == shape, where, f"{name} must have the shape {shape}", str(array.shape))
    demand(array.dtype == np.float64, where, f"{name} must be float64", str(array.dtype))
    demand(np.isfinite(array).all(), where, f"{name} must be finite", "nan or inf")
    return array


def distance(one: FloatArray, other: FloatArray) -> float:
    """Return the largest difference of two arrays of one shape, in units of 1 + their largest
    entry.
    """
    size = 1.0 + max(np.abs(a).max(initial=0.0) for a in (one, other))
    return float(np.abs(one - other).max(initial=0.0) / size)
