"""Methods of users' classes are held to the contract that they override.

A class is refused when it is defined if a method takes other arguments than the contract, or if a
member that nothing uses looks like one of the contract misspelled. A method that returns nothing
where a result is due says so at once, with its file and line; what any method returned last is
kept, so that an error that a wrong result causes later can name its origin.
"""

from __future__ import annotations

import dataclasses
import difflib
import dis
import functools
import inspect
import os
import re
import sys
import traceback
from collections.abc import Iterator, Mapping, Sequence
from operator import attrgetter
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any, NamedTuple
from weakref import WeakSet

from netkf.core.errors import quote
from netkf.linalg.compiling import Kernel
from netkf.linalg.plain import is_plain

_PLACE = re.compile(r'File "([^"]+)", line (\d+)|(?:at|from) (\S+) \((\d+)\)')
"""Where an error of numba says that it was, from the inside to the outside."""
_FRAME = re.compile(r"Failed in|During:|File |- Resolution|Use of unsupported opcode")
"""How lines of an error of numba begin that do not say what is wrong."""


class ContractError(TypeError):
    """A method of a user's class does not fit its contract: its place, and what it must do."""


class Call(NamedTuple):
    """A call of the method ``function`` of the user's class ``cls``, which returned ``result``."""

    cls: type
    function: FunctionType
    result: Any


class _Last:
    """The last call of any method of a user's class that has returned, or the first whose result
    has an xhat of another shape than its state: what fails later fails because of it.
    """

    call: Call | None = None
    reshaped = False


def last_call() -> Call | None:
    """Return the call after which something failed, None before the first."""
    _Last.reshaped = False
    return _Last.call


def is_netkf_class(cls: type) -> bool:
    """Return True if a class is netkf's own."""
    return cls.__module__.partition(".")[0] == "netkf"


def source_line(code: CodeType, line: int | None = None) -> str:
    """Return "file, line n" of ``code``, or of ``line`` in it; relative paths below this folder."""
    return file_line(code.co_filename, code.co_firstlineno if line is None else line)


def file_line(file: str, line: int) -> str:
    """Return "file, line n", with a relative path where the file is below the current folder."""
    try:
        relative = os.path.relpath(file)
    except (OSError, ValueError):
        relative = ".."
    return f"{file if relative.startswith('..') else relative}, line {line}"


def error_line(error: BaseException, package: str = "") -> str:
    """Return "file, line n" of the deepest call in a user's file that led to an error, "" if there
    is none: neither netkf's files count, nor those of Python and of installed packages, except the
    ``package`` of the user's class.
    """
    packages = {package} - {"", "netkf"}
    places = [
        source_line(frame.f_code, line)
        for frame, line in traceback.walk_tb(error.__traceback__)
        if str(frame.f_globals.get("__name__")).partition(".")[0] in packages
        or is_users_file(frame.f_code.co_filename)
    ]
    return places[-1] if places else ""


def is_users_file(file: str) -> bool:
    """Return True for a file that is neither netkf's, Python's nor an installed package's."""
    ours, python = str(Path(__file__).parents[1]), os.path.dirname(os.__file__)
    path = file if file.startswith("<") else os.path.abspath(file)  # numba writes relative ones
    return not path.startswith(("<", ours, python)) and "site-packages" not in path


def describe_error(error: BaseException) -> str:
    """Return the type and text of an exception on one line of at most 300 characters."""
    if is_of_compiler(error):
        return _describe_compilation(error)
    return " ".join(f"{type(error).__name__}: {error}".split())[:300].rstrip(": ")


def is_of_compiler(error: BaseException) -> bool:
    """Return True for an error of numba, which cannot compile a kernel."""
    return type(error).__module__.startswith("numba.")


def _describe_compilation(error: Any) -> str:
    """Return what of a user's kernel numba cannot compile, with file and line, on one line."""
    lines = [line for line in map(str.strip, str(error).splitlines()) if line]
    said = [line for line in lines if not _FRAME.match(line)] or lines
    text = f"{said[0]} {said[1].lstrip('> ')}" if said[0].endswith(":") else said[0]
    text = re.sub(r"\.[0-9a-f]{16}\b", "", text.partition(" Raised from")[0])  # digests of types
    places = [(a or b, int(m or n)) for a, m, b, n in _PLACE.findall(str(error))]
    if (loc := getattr(error, "loc", None)) is not None:
        places.append((loc.filename, loc.line))
    where = next((f" ({file_line(*place)})" for place in places if is_users_file(place[0])), "")
    called = re.search(r"<function (\w+) at", str(error))
    which = f"the kernel {called[1]}" if called else "a kernel"
    return (
        f"{which} cannot be compiled{where}: {text[:200]}; kernels compute with numbers and the "
        "arrays of their arguments, and call kernels"
    )


def kernel_problem(value: Any, names: Sequence[str]) -> str:
    """Return why ``value`` is no kernel with arguments of these ``names``, "" if it is one."""
    if not (isinstance(value, Kernel) or (is_plain() and callable(value))):
        return f"must be a kernel (netkf.kernels.kernel), not {quote(value)}"
    loops = inspect.unwrap(getattr(value, "loops", value))
    given = [*inspect.signature(loops).parameters]
    if len(given) == len(names):
        return ""
    takes = f"must take ({', '.join(names)}), not ({', '.join(given)})"
    return f"{takes} ({source_line(loops.__code__)})"


def describe_method(cls: type, function: FunctionType) -> str:
    """Return "Class.method (file, line n)"."""
    return f"{cls.__name__}.{function.__name__} ({source_line(function.__code__)})"


def hold_to_contract(cls: type) -> None:
    """Wrap the methods of a user's class that override a method of netkf, so that their results are
    looked at; raise ContractError if one takes other arguments, or is no method where one is due.
    """
    for name, own in list(vars(cls).items()):
        if name.startswith("_"):
            continue
        contract = _member_of_netkf(cls, name)
        _require_same_kind(cls, name, own, contract)
        if isinstance(own, FunctionType) and isinstance(contract, FunctionType):
            _require_arguments(cls, own, contract)
            setattr(cls, name, _watched(cls, own, contract))


def _member_of_netkf(cls: type, name: str) -> Any:
    """Return the nearest of netkf's members ``name``, a dataclass field if it is one, or None."""
    for parent in cls.__mro__[1:]:
        if is_netkf_class(parent) and name in _own_names(parent):
            return vars(parent).get("__dataclass_fields__", {}).get(name, vars(parent).get(name))
    return None


def _own_names(cls: type) -> set[str]:
    names = {*vars(cls), *vars(cls).get("__annotations__", {})}
    return {name for name in names if not name.startswith("_")}


def _require_same_kind(cls: type, name: str, own: Any, contract: Any) -> None:
    """Refuse a method where the contract has a value, and a value where it has a method."""
    if isinstance(own, FunctionType):
        where = describe_method(cls, own)
        if isinstance(contract, dataclasses.Field) and "ClassVar" not in str(contract.type):
            rule = "is never called, it has the name of a setting"
            raise ContractError(f"{where} {rule}; give it another name")
        is_value = contract is not None and not callable(contract)
        if is_value and not isinstance(contract, staticmethod | classmethod):
            raise ContractError(f"{where} must be a value or a property; write @property above it")
        return
    is_data = not callable(own) and not hasattr(own, "__get__")
    if isinstance(contract, FunctionType) and is_data and not isinstance(own, dataclasses.Field):
        raise ContractError(f"{cls.__name__}.{name} must be a method, not {quote(own)}")


def hold_to_flags(part: Any, called_if: Mapping[str, str]) -> None:
    """Raise ContractError if the class of a user's ``part`` overrides a method that is never
    called: the flag that ``called_if`` names for it is False, and inherited.
    """
    order = type(part).__mro__

    def owner(name: str) -> type:
        return next(cls for cls in order if name in _own_names(cls))

    for method, flag in called_if.items():
        cls, contract = owner(method), _member_of_netkf(type(part), method)
        if is_netkf_class(cls) or not is_netkf_class(owner(flag.partition(".")[0])):
            continue
        if not getattr(contract, "__isabstractmethod__", False) and not attrgetter(flag)(part):
            where = describe_method(type(part), inspect.unwrap(vars(cls)[method]))
            raise ContractError(
                f"{where} is never called where {flag} is False; state that it is True"
            )


SIMILAR = 0.8
"""Similarity of two names, by difflib, from which on one is taken for the other misspelled."""
_SOUND: WeakSet[type] = WeakSet()


def require_known_members(cls: type) -> None:
    """Raise ContractError for a member of a user's class that nothing in the class uses and whose
    name is similar to one of the contract that it does not define, or to a field of a value of it.
    """
    if cls in _SOUND:
        return
    own = [one for one in cls.__mro__ if not is_netkf_class(one) and one is not object]
    contracts = [one for one in cls.__mro__ if is_netkf_class(one)]
    defined, known = (set().union(*map(_own_names, classes)) for classes in (own, contracts))
    advice: dict[str, str] = {}
    for name, kind, fields in (stated for contract in contracts for stated in _values_of(contract)):
        advice.update((f, f"state it in {name}, as {kind}({f}=...)") for f in fields)
        advice[kind.lower()] = f"state it in {name}, as {kind}(...)"
    advice.update((name, f"did you mean {name}?") for name in known - defined)
    for name in sorted(defined - known - _used_names(own)):
        owner = next(one for one in own if name in _own_names(one))
        member = vars(owner).get(name)
        similar = difflib.get_close_matches(name, sorted(advice), 1, SIMILAR)
        if not similar or isinstance(member, type):
            continue
        where, verb = f"{owner.__name__}.{name}", "read"
        if isinstance(member, FunctionType):
            where, verb = describe_method(owner, member), "called"
        rule = f"is never {verb}: {advice[similar[0]]}"
        raise ContractError(f"{where} {rule}; give your member another name")
    _SOUND.add(cls)


def _values_of(contract: type) -> Iterator[tuple[str, str, tuple[str, ...]]]:
    """Yield each value that a class of netkf states, its class, and the names of its fields."""
    stated = {
        name: str(getattr(member.fget, "__annotations__", {}).get("return", ""))
        for name, member in vars(contract).items()
        if isinstance(member, property) and member.fget is not None
    }
    notes = vars(contract).get("__annotations__", {})
    stated |= {name: note for name, note in notes.items() if str(note).startswith("ClassVar")}
    module = vars(sys.modules[contract.__module__])
    for name, note in stated.items():
        for kind in (module.get(word) for word in re.findall(r"\w+", note)):
            fields = getattr(kind, "__match_args__", ())
            if isinstance(kind, type) and fields and not name.startswith("_"):
                yield name, kind.__name__, fields


def _used_names(classes: Sequence[type]) -> set[str]:
    """Return the names of members that functions may read, or that other members hold."""
    used: set[str] = set()
    todo: list[tuple[Any, int, str]] = []  # functions, how many arguments count, and a name
    for cls in classes:
        members = dict(vars(cls))
        for owner, member in members.items():
            parts = getattr(member, "__match_args__", ())
            used |= {p for p in parts if getattr(member, p, None) is members.get(p, dis)}
            held = [getattr(member, part, None) for part in (*parts, "fget", "func", "__func__")]
            functions = [inspect.unwrap(f) for f in (member, *held) if callable(f)]
            used |= {n for n, f in members.items() if n != owner and callable(f) and f in functions}
            # Not those that a dataclass makes, which read all fields.
            if owner == "__post_init__" or not owner.startswith("__"):
                todo += [(function, 1, cls.__name__) for function in functions]
    seen: set[CodeType] = set()
    while todo:
        function, count, name = todo.pop()
        code = getattr(function, "__code__", None)
        if not isinstance(code, CodeType) or code in seen:
            continue
        seen.add(code)
        names, called = _names_read(code, {name, *code.co_varnames[:count]})
        used |= names
        for helper in (function.__globals__.get(one) for one in called):
            if isinstance(helper, FunctionType) and helper.__module__ == function.__module__:
                todo.append((helper, helper.__code__.co_argcount, name))
    return used


def _names_read(code: CodeType, objects: set[str]) -> tuple[set[str], set[str]]:
    """Return the names that code may read from ``objects``, and all that it asks for."""
    read, asked, last = set(), set(code.co_names), None
    for instruction in dis.get_instructions(code):
        if instruction.opname in ("LOAD_ATTR", "LOAD_METHOD"):
            source: Any = last.argval if last is not None else None
            source = source[-1] if isinstance(source, tuple) else source
            # Of a variable it must be one of these; of any other value it may be.
            kind = last.opname if last is not None else ""
            if source in objects or not any(word in kind for word in ("FAST", "GLOBAL", "NAME")):
                read.add(str(instruction.argval))
        if instruction.opname != "EXTENDED_ARG":
            last = instruction
    for constant in code.co_consts:
        if isinstance(constant, str):
            read.add(constant)  # as in getattr(self, "name")
        if isinstance(constant, CodeType):
            inner, more = _names_read(constant, objects)
            read, asked = read | inner, asked | more
    return read, asked


def _require_arguments(cls: type, own: FunctionType, contract: FunctionType) -> None:
    """Raise ContractError unless ``own`` can be called as the ``contract`` is."""
    parameters = inspect.signature(contract).parameters.values()
    positional = inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD
    required = [p.name for p in parameters if p.kind in positional and p.default is p.empty]
    try:
        inspect.signature(own).bind(*required)
    except TypeError:
        listed = ", ".join(required[1:])
        raise ContractError(
            f"{describe_method(cls, own)} must take ({listed}), not "
            f"({', '.join(list(inspect.signature(own).parameters)[1:])})"
        ) from None


def _watched(cls: type, own: FunctionType, contract: FunctionType) -> Any:
    returned = str(contract.__annotations__.get("return", "None"))
    is_optional = returned == "None" or returned.endswith("| None")
    pair = re.match(r"tuple\[(.*)\]$", returned)
    length = _count(pair[1]) if pair else 0

    @functools.wraps(own)
    def watched(self: Any, *arguments: Any, **options: Any) -> Any:
        try:
            result = own(self, *arguments, **options)
        except SystemExit as error:  # it would end the command without a word
            raise ContractError(f"{describe_method(cls, own)} called exit") from error
        if not _Last.reshaped:
            _Last.call = Call(cls, own, result)
            states = (
                *arguments[:1],
                *(result[:1] if length and isinstance(result, tuple) else [result]),
            )
            _Last.reshaped = len({*map(_shape, states)} - {None}) > 1
        rule = ""
        if result is None and not is_optional:
            rule = "returned nothing; it must return a value"
        elif length and not (isinstance(result, tuple) and len(result) == length):
            rule = f"must return a tuple of {length}, not {quote(result)}"
        elif length and result[0] is None:
            rule = f"must return a value before the others, not {quote(result)}"
        if rule:
            raise ContractError(f"{describe_method(cls, own)} {rule}")
        return result

    return watched


def _shape(state: Any) -> tuple[int, ...] | None:
    return getattr(getattr(state, "xhat", None), "shape", None)


def _count(inner: str) -> int:
    """Return the number of entries of a tuple type by the text ``inner`` of its brackets."""
    if inner.endswith("..."):
        return 0
    depth, count = 0, 1
    for character in inner:
        depth += (character in "[(") - (character in "])")
        count += character == "," and depth == 0
    return count
