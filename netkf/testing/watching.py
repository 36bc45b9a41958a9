"""Calls of users' methods that check for side effects, and generators that record their calls."""

from __future__ import annotations

import ctypes
import dataclasses
import functools
import inspect
import math
import pickle
import random
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from operator import attrgetter
from typing import Any, NoReturn

import numpy as np

from netkf.core.contracts import ContractError, describe_error
from netkf.core.errors import NetkfError, ScenarioError, quote
from netkf.core.fields import Component, check_values
from netkf.linalg.arrays import FloatArray
from netkf.rng.streams import Streams
from netkf.scenario.plugins import describe_failure

Leaves = dict[str, Any]
"""Copies of the numbers, texts and arrays in a value, by their paths such as ``.P[0]``."""
OWN_GENERATOR = "must use no generator but the one it is given"
OTHER_GENERATOR = "must draw from the generator given"
ROUNDING = 1e-9
"""Difference (:func:`scaled_difference`) up to which arrays count as equal."""
MERSENNE_BYTES = 4 * 625
"""Size of the state of a Mersenne twister: 624 words of 32 bits and the position in them."""


def fail(where: str, rule: str, got: object = None, remedy: str = "") -> NoReturn:
    """Raise AssertionError with the line ``where: rule; got ...; remedy``."""
    message = f"{where}: {rule}"
    if got is not None:
        message += f"; got {got if isinstance(got, str) else quote(got)}"
    if remedy:
        message += f"; {remedy}"
    raise AssertionError(message)


def demand(holds: object, where: str, rule: str, got: object = None, remedy: str = "") -> None:
    """Raise AssertionError with the line ``where: rule; got ...; remedy`` unless ``holds``."""
    if not holds:
        fail(where, rule, got, remedy)


def demand_kind(name: str, value: object, kind: type) -> None:
    """Raise AssertionError unless the argument ``name`` is None or of a kind."""
    of_kind = value is None or isinstance(value, kind)
    demand(of_kind, name, f"must be a {kind.__name__}", quote(value), "leave it out")


def is_number(value: Any) -> bool:
    """Return True for a number of Python or numpy, not for an array or text."""
    return isinstance(value, (int, float, np.floating)) and not isinstance(value, bool)


def make_part(
    part: Any, contracts: tuple[type[Component], ...], settings: Mapping[str, Any]
) -> Any:
    """Return ``part``, or ``part(**settings)`` of a class. Raises AssertionError if it is derived
    from none of the ``contracts``, is abstract, refuses the settings or states a wrong value.
    """
    cls = part if isinstance(part, type) else type(part)
    name = cls.__name__
    listed = " or ".join(contract.__name__ for contract in contracts)
    rule = f"must be derived from {listed} of netkf.parts, or be an object of such a class"
    demand(issubclass(cls, contracts), name, rule)
    missing = [
        attribute
        for attribute in sorted(dir(cls))
        if getattr(_static_attribute(cls, attribute), "__isabstractmethod__", False)
    ]
    demand(not missing, name, f"must define {', '.join(missing)}", remedy="write what is missing")
    if not isinstance(part, type):
        demand(not settings, name, "settings go with a class", sorted(settings), "leave them out")
    else:
        try:
            part = cls(**settings)
        except ContractError as error:
            raise AssertionError(str(error)) from None
        except Exception as error:
            text = f"could not be made with the settings {dict(settings)!r}"
            remedy = "hand over an object, or the class with its settings as keywords"
            fail(name, text, describe_error(error), remedy)
    try:
        check_values(part)
    except ScenarioError as error:
        raise AssertionError(str(error)) from None
    return part


_PLAIN = frozenset((str, bytes, bool, int, float, complex, type(None)))
"""Exact types of most leaves that are not arrays."""


def collect_leaves(value: Any) -> Leaves:
    """Return copies of the numbers, texts and arrays in a value by path, such as ``.P[0]``."""
    leaves: Leaves = {}
    _add_leaves([("", value)], "", set(), leaves)
    return leaves


def _add_leaves(
    members: Iterable[tuple[str, Any]], path: str, ancestors: set[int], leaves: Leaves
) -> None:
    """Add copies of the leaves of ``members``; ``ancestors`` are ids that end cycles."""
    # Most members are leaves: a call for each of them would take a third of a check.
    for name, member in members:
        if type(member) in _PLAIN:
            leaves[path + name] = member
        elif isinstance(member, np.ndarray):
            leaves[path + name] = member.copy()
        elif id(member) in ancestors or isinstance(member, np.random.Generator) or callable(member):
            continue
        elif isinstance(member, (str, bytes, int, float, complex, np.generic)):
            leaves[path + name] = member
        else:
            ancestors.add(id(member))
            _add_leaves(_list_members(member), path + name, ancestors, leaves)
            ancestors.discard(id(member))


def _list_members(value: Any) -> Iterable[tuple[str, Any]]:
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


def differing_path(one: Leaves, other: Leaves) -> str | None:
    """Return the path of the first leaf in which two values differ, None if all are equal."""
    if one.keys() != other.keys():
        return (
            min(one.keys() ^ other.keys(), key=len, default="")
            or "its shape changed from a number to parts"
        )
    for path, value in one.items():
        second = other[path]
        # Arrays were copied, so that only numbers and texts can be the same object.
        if value is not second and not _are_equal(np.asarray(value), np.asarray(second)):
            return path or "value"
    return None


def _are_equal(one: np.ndarray, other: np.ndarray) -> bool:
    same_type = one.dtype == other.dtype and one.shape == other.shape
    # Comparing bytes is cheap, and nearly all are equal to the last bit.
    if same_type and one.dtype != object and one.tobytes() == other.tobytes():
        return True
    numeric = one.dtype.kind in "fc" and other.dtype.kind in "fc"
    return np.array_equal(one, other, equal_nan=numeric)


def global_generator_states() -> tuple[Any, Any]:
    """Return the states of the global generators of Python and numpy, for comparisons."""
    shared = np.random.get_bit_generator()  # type: ignore[attr-defined]
    if not isinstance(shared, np.random.MT19937):
        return random.getstate(), repr(shared.state)
    # Copied from memory: numpy takes 0.1 ms to list the state, and this function runs before and
    # after each call of a user's method.
    words = ctypes.string_at(shared.ctypes.state_address, MERSENNE_BYTES)
    return random.getstate(), (id(shared), words)


@functools.cache
def _static_attribute(cls: type, name: str) -> Any:
    return inspect.getattr_static(cls, name, None)


Calls = list[tuple[str, int]]
"""Calls of a generator: method and number of values drawn."""


class RecordingGenerator(np.random.Generator):
    """A random generator that records each call of its methods in ``calls``."""

    def __init__(self, seed: int, *entity: int) -> None:
        super().__init__(Streams(seed).generator("testing", *entity).bit_generator)
        self.calls: Calls = []

    def __getattribute__(self, name: str) -> Any:
        """Return an attribute; calls of methods that draw are appended to ``calls``."""
        attribute = super().__getattribute__(name)
        if name.startswith("_") or name in ("calls", "take_calls", "bit_generator"):
            return attribute

        def draw(*arguments: Any, **keywords: Any) -> Any:
            values = attribute(*arguments, **keywords)
            self.calls.append((name, int(np.size(values))))
            return values

        return draw

    def take_calls(self) -> Calls:
        """Return the recorded calls and forget them."""
        calls, self.calls = self.calls, []
        return calls


def describe_calls(calls: Calls) -> str:
    """Return calls as text, such as "2 x normal", or "nothing"."""
    return ", ".join(f"{count} x {name}" for name, count in calls) or "nothing"


class WatchedPart:
    """A component of a scenario whose methods are called with checks for side effects.

    A call must change neither its arguments nor the component, nor results of earlier calls; a
    second call must return the same; the global generators of numpy and Python must not be used.
    ``name`` is that of the user's class.
    """

    def __init__(self, part: Any) -> None:
        """Take the component ``part``."""
        self.part, self.name = part, type(part).__name__
        # Of each call: the method, the result, and its leaves at that time.
        self._results: list[tuple[str, Any, Leaves]] = []

    def call(self, method: str, *arguments: Any, repeatable: bool = True) -> Any:
        """Call a method, or a function such as "link_weights.of", check for side effects and return
        the result. If ``repeatable`` it is called twice, with equal results. Raises AssertionError.
        """
        where = f"{self.name}.{method}"
        before = [collect_leaves(argument) for argument in arguments]
        attributes = self.attributes()
        results = [self._call_method(where, method, arguments) for _ in range(1 + repeatable)]
        for k, leaves in enumerate(before):
            path = differing_path(leaves, collect_leaves(arguments[k]))
            if path is not None:
                name = self._parameter_names(method, len(arguments))[k]
                remedy = "return a new one; work on copies"
                rule = f"must not change its arguments, but changed {name}{path}"
                fail(where, rule, remedy=remedy)
        path = differing_path(attributes, self.attributes())
        rule = f"must not change its own object, but changed {path}"
        remedy = "keep what changes in the state that is handed in and returned"
        demand(path is None, where, rule, remedy=remedy)
        result_leaves = [collect_leaves(result) for result in results]
        path = differing_path(result_leaves[0], result_leaves[-1])
        got = f"another {(path or 'value').removeprefix('.')} at the second call"
        remedy = "use no randomness, clock or memory of earlier calls"
        demand(path is None, where, "must return the same for the same arguments", got, remedy)
        self._results.append((where, results[0], result_leaves[0]))
        return results[0]

    def unchecked(self) -> WatchedPart:
        """Return the same component with calls that are made once and not checked."""
        return _UncheckedPart(self.part)

    def attributes(self) -> Leaves:
        """Return copies of what the user's object holds, by path, without cached properties."""
        cls: Any = type(self.part)
        attributes = {
            name: value
            for name, value in vars(self.part).items()
            if not isinstance(_static_attribute(cls, name), functools.cached_property)
        }
        return {path.strip("[]'"): leaf for path, leaf in collect_leaves(attributes).items()}

    def _call_method(self, where: str, method: str, arguments: tuple[Any, ...]) -> Any:
        before = global_generator_states()
        try:
            result = attrgetter(method)(self.part)(*arguments)
        except NetkfError as error:
            fail(where, f"failed: {error}")
        except Exception as error:
            singular = isinstance(error, np.linalg.LinAlgError)
            remedy = "; set inverts in needs where covariances must not be singular"
            text = f"{where}: {describe_failure(error)}{remedy if singular else ''}"
            raise AssertionError(text) from error
        _forbid_global_generators(where, before)
        return result

    def _parameter_names(self, method: str, count: int) -> list[str]:
        names = list(inspect.signature(attrgetter(method)(self.part)).parameters)
        return [*names, *["an argument"] * count][:count]

    def finish(self) -> None:
        """Check that no result of a call was changed by a later one."""
        for where, result, leaves in self._results:
            path = differing_path(leaves, collect_leaves(result))
            rule = f"returned something that a later call changed ({(path or '').lstrip('.')})"
            demand(path is None, where, rule, remedy="return copies, share no buffers")

    @contextmanager
    def guard(self, method: str = "") -> Iterator[None]:
        """Guard what calls the user's ``method``, or several, as :func:`guard_user_code`, and check
        that the object is left as it is.
        """
        before = self.attributes()
        with guard_user_code(f"{self.name}.{method}".rstrip(".")):
            yield
        path = differing_path(before, self.attributes())
        rule = f"must not change its own object, but changed {path}"
        remedy = "keep what changes in the paths and states that its methods return"
        demand(path is None, self.name, rule, remedy=remedy)

    def demand(
        self, method: str, holds: object, rule: str, got: object = None, remedy: str = ""
    ) -> None:
        """Raise AssertionError ``Class.method: rule; got ...; remedy`` unless ``holds``."""
        demand(holds, f"{self.name}.{method}", rule, got, remedy)

    def repeat(self, method: str, draw: Callable[[RecordingGenerator], Any]) -> Any:
        """Return what ``draw`` makes of a generator, which must be the same of an equal one."""
        generators = [RecordingGenerator(5) for _ in range(2)]
        first, second = map(draw, generators)
        path = differing_path(collect_leaves(first), collect_leaves(second))
        self.demand(method, path is None, OWN_GENERATOR, "another result from an equal generator")
        calls = [random.take_calls() for random in generators]
        got = " and then ".join(map(describe_calls, calls))
        remedy = "keep nothing of an earlier run"
        self.demand(method, calls[0] == calls[1], "must draw the same in each run", got, remedy)
        return first

    def pickle_copy(self) -> Any:
        """Return a copy of the user's object made by pickle; check that it is equal."""
        try:
            copy = pickle.loads(pickle.dumps(self.part))
        except Exception as error:
            fail(
                self.name,
                "must be picklable, for worker processes",
                describe_error(error),
                "define the class at the top level of a module and keep no open files or lambdas",
            )
        path = differing_path(collect_leaves(self.part), collect_leaves(copy))
        demand(path is None, self.name, f"must be equal after pickling, but lost {path}")
        return copy


class _UncheckedPart(WatchedPart):
    """A component whose methods are called once and not checked for side effects."""

    def call(self, method: str, *arguments: Any, repeatable: bool = True) -> Any:
        return self._call_method(f"{self.name}.{method}", method, arguments)


def checker(check: Callable[..., None]) -> Callable[..., None]:
    """Return a checker whose every failure is an AssertionError of one line."""

    @functools.wraps(check)
    def checked(part: Any, /, *arguments: Any, **settings: Any) -> None:
        with guard_user_code((part if isinstance(part, type) else type(part)).__name__):
            check(part, *arguments, **settings)

    return checked


@contextmanager
def guard_user_code(where: str) -> Iterator[None]:
    """Turn exceptions into an AssertionError of one line; refuse use of global generators."""
    before = global_generator_states()
    try:
        yield
    except AssertionError:
        raise
    except Exception as error:
        raise AssertionError(f"{where}: {describe_failure(error)}") from error
    _forbid_global_generators(where, before)


def _forbid_global_generators(where: str, before: tuple[Any, Any]) -> None:
    rule = "must not use or seed global generators (numpy.random.*, random.*)"
    remedy = "draw from the generator that is handed in"
    demand(global_generator_states() == before, where, rule, remedy=remedy)


def demand_array(
    where: str, name: str, value: Any, shape: tuple[int, ...], remedy: str = ""
) -> FloatArray:
    """Return ``value`` as an array; AssertionError unless float64, finite and of ``shape``."""
    rule = f"{name} must be an array of numpy"
    demand(isinstance(value, np.ndarray | np.generic), where, rule, value)
    array = np.asarray(value)
    demand(array.shape == shape, where, f"{name} must have the shape {shape}", str(array.shape))
    demand(array.dtype == np.float64, where, f"{name} must be float64", str(array.dtype))
    demand(np.isfinite(array).all(), where, f"{name} must be finite", array, remedy)
    return array


def demand_vector(where: str, value: Any) -> FloatArray:
    """Return ``value`` as a vector of any length; AssertionError unless of float64."""
    array = np.asarray(value)
    is_vector = array.ndim == 1 and array.dtype == np.float64
    demand(is_vector, where, "must be a vector of float64", f"{array.dtype} {array.shape}")
    return array


def component_sizes(*arrays: FloatArray) -> FloatArray:
    """Return the largest absolute values (n,) of each component of ``arrays`` (..., n), above 0."""
    largest = np.max([np.abs(a).reshape(-1, a.shape[-1]).max(0, initial=0.0) for a in arrays], 0)
    # What is 0 but for rounding has no size of its own.
    floor = max(1e-4 * largest.max(initial=0.0), float(np.finfo(float).tiny))
    return np.asarray(np.maximum(largest, floor))


def scaled_difference(one: FloatArray, other: FloatArray) -> float:
    """Return the largest difference of K draws (K, ...) over the size of its component in both."""
    one, other = (a.reshape(len(a), math.prod(a.shape[1:])) for a in (one, other))
    return float((np.abs(one - other) / component_sizes(one, other)).max(initial=0.0))


def demand_close(
    one: FloatArray, other: FloatArray, where: str, rule: str, when: str = "", remedy: str = ""
) -> None:
    """Raise AssertionError unless two arrays of one shape are equal up to ROUNDING."""
    difference = scaled_difference(one, other)
    got = f"a difference of {difference:.3g} of their size {when}".rstrip()
    demand(difference <= ROUNDING, where, rule, got, remedy)
