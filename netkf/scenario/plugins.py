"""The classes of users that a scenario names: their import, list, files, failures and trust.

Importing a module executes it, and nothing is imported to find out what a class is. Installed
packages offer classes by entry points of the group PARTS, whose names are kinds; every other class
that is not netkf's own is imported with trust only.
"""

from __future__ import annotations

import ast
import dataclasses
import importlib
import inspect
import os
import site
import sys
import sysconfig
import traceback
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from importlib.machinery import PathFinder
from operator import attrgetter
from pathlib import Path
from types import CodeType, FrameType, FunctionType, ModuleType
from typing import TYPE_CHECKING, Any, NamedTuple

from netkf.core.contracts import (
    ContractError,
    describe_error,
    error_line,
    is_netkf_class,
    is_of_compiler,
    last_call,
    source_line,
)
from netkf.core.errors import NetkfError, ScenarioError, quote
from netkf.core.fields import Component, walk
from netkf.core.stamps import TimeBase
from netkf.plants.dynamics import CustomDynamics

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint


class GivenName(str):
    """The name of a user's class in the table of a part of a scenario, with what was ``given``, the
    class or the dynamics of a plant: by the name another class may be found by now.
    """

    given: Any

    def __new__(cls, name: str, given: Any) -> GivenName:
        """Return the text ``name`` with what it names."""
        self = super().__new__(cls, name)
        self.given = given
        return self

    def __reduce__(self) -> tuple[type[GivenName], tuple[str, Any]]:
        return GivenName, (str(self), self.given)


def user_components(value: Any) -> list[Component]:
    """Return the components in a scenario that are not netkf's, inner ones after outer ones."""
    parts: Iterator[Any] = (part for part in walk(value) if isinstance(part, Component))
    parts = (part.part if isinstance(part, CustomDynamics) else part for part in parts)
    return [part for part in parts if not is_netkf_class(type(part))]


def find_unimportable_class(scenario: Any, in_script: bool = True) -> str | None:
    """Return the name of a user's class that other processes cannot import, defined in a function
    or a prompt, or, unless ``in_script``, in the running script; None without one.
    """
    main_file = getattr(sys.modules.get("__main__"), "__file__", None)
    has_script = main_file is not None and Path(main_file).is_file()
    for component in user_components(scenario):
        cls = type(component)
        in_main = cls.__module__ == "__main__" and not (in_script and has_script)
        if in_main or "<locals>" in cls.__qualname__:
            return cls.__name__
    return None


def unguarded_line(scenario: Any) -> tuple[int, int] | None:
    """Return the line of a class of the running script, and that of the script being executed if
    not under ``if __name__ == "__main__":``, else None: worker processes run a script again.
    """
    classes = [type(one) for one in user_components(scenario) if type(one).__module__ == "__main__"]
    file = getattr(sys.modules.get("__main__"), "__file__", None)
    frame: FrameType | None = sys._getframe()
    while frame is not None and not (
        frame.f_code.co_name == "<module>" and frame.f_globals.get("__name__") == "__main__"
    ):
        frame = frame.f_back
    if not classes or file is None or frame is None or frame.f_code.co_filename != file:
        return None
    try:
        body = ast.parse(Path(file).read_bytes()).body
        defined = inspect.getsourcelines(classes[0])[1]
    except (OSError, SyntaxError, ValueError, TypeError):
        return None
    line = frame.f_lineno
    guarded = any(
        isinstance(one, ast.If)
        and "__name__" in ast.dump(one.test)
        and one.lineno <= line <= (one.end_lineno or line)
        for one in body
    )
    return None if guarded else (defined, line)


def find_module_files(scenario: Component) -> dict[str, Path | None]:
    """Return the files of modules of users' classes, and of those in their folder that these
    import, by name; None for those outside the scenario's folder.
    """
    folder = getattr(scenario, "_folder", None)
    files: dict[str, Path | None] = {}
    for component in user_components(scenario):
        name = type(component).__module__
        files[name] = None
        if folder is None or "." in name or not (path := folder / f"{name}.py").is_file():
            continue
        file = getattr(sys.modules.get(name), "__file__", None)
        # The loaded module may be it where no other file is known.
        if file is None or not Path(file).is_file() or path.samefile(file):
            files[name] = path
            files = imports_beside(folder, name) | files
    return files


def imports_beside(folder: Path, name: str) -> dict[str, Path | None]:
    """Return the modules that the file of module ``name`` in ``folder`` imports from there, and
    those that these import, by name: their files, None for packages.
    """
    found: dict[str, Path | None] = {}
    waiting = [folder / f"{name}.py"]
    while waiting:
        try:
            nodes = list(ast.walk(ast.parse(waiting.pop().read_bytes())))
        except (OSError, SyntaxError, ValueError):  # importing it says what is wrong
            continue
        imported = [
            alias.name for one in nodes if isinstance(one, ast.Import) for alias in one.names
        ]
        imported += [one.module or "" for one in nodes if isinstance(one, ast.ImportFrom)]
        for module in {full.partition(".")[0] for full in imported} - {name, *found}:
            path = folder / f"{module}.py"
            if module in sys.stdlib_module_names or _is_loaded_package(module):
                continue
            if (folder / module / "__init__.py").is_file():
                found[module] = None
            elif path.is_file():
                found[module] = path
                waiting.append(path)
    return found


def _is_loaded_package(name: str) -> bool:
    """Return True if ``name`` is netkf or loaded from an installed package: a file of that name in
    a folder is not what is imported.
    """
    file = getattr(sys.modules.get(name), "__file__", None)
    folders = _package_folders() if file is not None else ()
    return name == "netkf" or any(Path(file or "").resolve().is_relative_to(one) for one in folders)


def explain_user_error(scenario: Any, error: Exception) -> str | None:
    """Return ``module:Class failed in method: error; file, line n`` for an error in a user's class:
    the deepest method of one in the traceback, or else the one that returned last, with its result.
    None if all classes are netkf's own, or what the operating system refuses was not asked by one.
    """
    components = user_components(scenario)
    if not components:
        return None
    text = describe_error(error)
    methods = {
        code: (type(component), name)
        for component in components
        for cls in reversed(type(component).__mro__)
        if not is_netkf_class(cls)
        for name, member in vars(cls).items()
        for code in _codes_of(member)
    }
    found: tuple[type, str, FrameType, int] | None = None
    for frame, line in _frames_of(error):
        if frame.f_code in methods:
            found = (*methods[frame.f_code], frame, line)
        elif found is not None and frame.f_code.co_filename == found[2].f_code.co_filename:
            found = (*found[:2], frame, line)
    if found is not None:
        cls, name, frame, line = found
        return f"{_name_of(cls)} failed in {name}: {text}; {source_line(frame.f_code, line)}"
    if isinstance(error, OSError):  # such as a full disk
        return None
    if isinstance(error, ContractError):
        return f"{_name_of(type(components[0]))}: {error}"
    call = last_call()
    if (
        is_of_compiler(error)
        or call is None
        or not any(isinstance(part, call.cls) for part in components)
    ):
        return f"{_name_of(type(components[0]))} failed: {text}"
    where = f"{call.function.__name__} ({source_line(call.function.__code__)})"
    return f"{_name_of(call.cls)} failed after {where} returned {quote(call.result)}: {text}"


@contextmanager
def explained(scenario: Any, make: Callable[[str], Exception]) -> Iterator[None]:
    """Turn an error of a user's class in the body into what ``make`` makes of its explanation."""
    try:
        yield
    except NetkfError:  # it names its cause
        raise
    except Exception as error:
        rule = explain_user_error(scenario, error)
        if rule is None:
            raise
        raise make(rule) from error


def _codes_of(member: Any) -> list[CodeType]:
    """Return the code of a method, a property or the functions in a value, and what they define."""
    if dataclasses.is_dataclass(member) and not isinstance(member, type):
        return [code for one in vars(member).values() for code in _codes_of(one)]
    function = getattr(member, "fget", member)
    function = inspect.unwrap(function) if callable(function) else function
    if not isinstance(function, FunctionType):
        return []
    code = function.__code__
    return [code, *(inner for inner in code.co_consts if isinstance(inner, CodeType))]


def _frames_of(error: BaseException) -> Iterator[tuple[FrameType, int]]:
    """Yield frame and line of each call that led to an error, or to the errors that caused it."""
    # SimPy raises a copy of an error of a process, whose cause is the error itself.
    chain: list[BaseException] = []
    cause: BaseException | None = error
    while cause is not None and cause not in chain:
        chain.append(cause)
        cause = cause.__cause__
    for one in chain:
        yield from traceback.walk_tb(one.__traceback__)


def _name_of(cls: type) -> str:
    return f"{cls.__module__}:{cls.__qualname__}"


def describe_failure(error: BaseException) -> str:
    """Return what an exception of a user's class says, with its file and line, on one line."""
    if isinstance(error, ContractError):
        return str(error)
    if is_of_compiler(error):
        return f"failed: {describe_error(error)}"
    place = error_line(error)
    return f"failed with {describe_error(error)}" + (f" ({place})" if place else "")


_sources: dict[Path, bytes] = {}
"""What was in the file of a module beside a scenario when it was imported last."""
PARTS = "netkf.parts"
"""The group of entry points by which installed packages offer classes."""
REMEDY = "add --trust if you trust its author (in Python: trust=True)"


class Origin(NamedTuple):
    """The ``folder`` of a scenario's files, and what may be imported for it.

    With ``trust`` any module may be imported, also those in that folder and the current folder;
    else only classes that installed packages offer. Without ``imports`` nothing is imported: a
    class that is not loaded yet is None. ``stamps`` says how its tables are read.
    """

    folder: Path
    trust: bool = True
    imports: bool = True
    stamps: TimeBase = TimeBase()


def find_class(kind: str, origin: Origin) -> Any:
    """Return the object that ``kind``, "package.module:Class", names; None if it is not loaded and
    ``origin.imports`` is false. Raises ScenarioError if it may not or cannot be imported.
    """
    module_name, _, class_name = kind.partition(":")
    if module_name.partition(".")[0] != "netkf":
        if not origin.trust:
            rule = "names a class of a module whose code would run"
            raise ScenarioError("kind", rule, kind, REMEDY)
    elif module_name not in {*sys.modules, PARTS}:
        # The modules of all classes for scenarios are loaded; no other code may be run.
        raise _import_error(kind, ModuleNotFoundError(f"No module named {module_name!r}"))
    if not origin.imports:
        module = sys.modules.get(module_name)
        if not hasattr(module, class_name) or _is_namesake(module, module_name, origin.folder):
            return None
    folders = (str(origin.folder), str(Path.cwd()))
    path = [*(folder for folder in folders if folder not in sys.path), *sys.path]

    def load() -> Any:
        with current_module(module_name, origin.folder):
            return getattr(importlib.import_module(module_name), class_name)

    return _load(kind, load, path, module_name)


def find_offered_class(kind: str, origin: Origin) -> Any:
    """Return the class that a package offers as ``kind``; None if it is not loaded and
    ``origin.imports`` is false. Raises ScenarioError if none, or several, offer it.
    """
    path = sys.path if origin.trust else _installed_path(origin.folder)
    offers = [entry for entry in _offers(tuple(path)) if entry.name == kind]
    if not offers:
        rule = "names a class of a package in the scenario's or the current folder"
        raise ScenarioError("kind", rule, kind, REMEDY)
    if len(offers) > 1:
        values = sorted(entry.value for entry in offers)
        rule = f"is offered by several packages, as {', '.join(values)}"
        raise ScenarioError("kind", rule, kind, "uninstall one, or name the class, with --trust")
    entry = offers[0]
    if _is_loaded_from_elsewhere(entry, path):
        raise _import_error(kind, ImportError("another module of that name is loaded"))
    if not origin.imports and _loaded_class(entry) is None:
        return None
    return _load(kind, entry.load, list(path), entry.value)


def offered_kinds(cls: type | None = None) -> list[str]:
    """Return the kinds that installed packages offer, of a class ``cls`` if it is loaded."""
    offers = _offers(tuple(sys.path))
    return sorted({entry.name for entry in offers if cls is None or _loaded_class(entry) is cls})


@lru_cache(maxsize=8)
def _offers(path: tuple[str, ...]) -> tuple[EntryPoint, ...]:
    # Not needed for built-in kinds, and slow to import.
    from importlib.metadata import entry_points

    with _replace_import_path(list(path)):
        return tuple(entry_points(group=PARTS))


def _loaded_class(entry: EntryPoint) -> Any:
    try:
        return attrgetter(entry.attr)(sys.modules[entry.module])
    # Not loaded, or no "package.module:Class", which is one of four errors, by the version.
    except (AttributeError, KeyError, TypeError, ValueError, AssertionError):
        return None


def _is_loaded_from_elsewhere(entry: EntryPoint, path: list[str]) -> bool:
    """Return True if a package of the name of an offered one is loaded, but from another file."""
    name = entry.value.partition(":")[0].partition(".")[0].strip()
    file = getattr(sys.modules.get(name), "__file__", None)
    spec = PathFinder.find_spec(name, path) if file is not None else None
    if spec is None or spec.origin is None:
        return False
    return Path(file or "").resolve() != Path(spec.origin).resolve()


def _load(kind: str, load: Callable[[], Any], path: list[str], target: str) -> Any:
    with _replace_import_path(path):
        try:
            return load()
        except (Exception, SystemExit) as error:
            raise _import_error(kind, error, target) from None


@contextmanager
def _replace_import_path(entries: list[str]) -> Iterator[None]:
    before = list(sys.path)
    sys.path[:] = entries
    try:
        yield
    finally:
        sys.path[:] = [*(entry for entry in sys.path if entry not in entries), *before]


def _import_error(kind: str, error: BaseException, target: str = "") -> ScenarioError:
    if isinstance(error, ContractError):
        return ScenarioError("kind", str(error), kind, "write what the contract asks for")
    rule = f"could not be imported ({type(error).__name__}: {quote(str(error), 300)})"
    is_missing = isinstance(error, ModuleNotFoundError) and error.name == kind.partition(":")[0]
    remedy = "put the module beside the scenario file or on the Python path"
    if not is_missing:
        module = target.partition(":")[0].strip()
        place = error_line(error, module.partition(".")[0]) or module
        remedy = f"correct the module, {place}" if place else "correct the module"
    return ScenarioError("kind", rule, kind, remedy)


@contextmanager
def current_module(module_name: str, folder: Path) -> Iterator[None]:
    """Within this context a module of a scenario in ``folder`` is imported as it is there, with
    those that it imports: others of their names are removed, and all if one was edited.
    """
    names = module_name, *imports_beside(folder, module_name)
    outdated = {name for name in names if _is_namesake(sys.modules.get(name), name, folder)}
    present = _loaded_sources(names, folder)
    if any(_sources.get(file, text) != text for file, text in present.items()):
        outdated = {*names}
    for name in _with_packages(outdated):
        del sys.modules[name]
    if outdated:
        importlib.invalidate_caches()
    yield
    _sources.update(_loaded_sources(names, folder))


def imported_source(file: Path) -> bytes:
    """Return what was in the ``file`` of a module beside a scenario when it was imported."""
    return _sources.get(file.resolve()) or file.read_bytes()


def module_sources(scenario: Component) -> dict[str, bytes]:
    """Return what was imported from the scenario's folder for users' classes, by the names of the
    files there; of a package all of its modules.
    """
    folder = getattr(scenario, "_folder", None) or Path.cwd()
    files = []
    for name, file in find_module_files(scenario).items():
        package = folder / name.partition(".")[0]
        if file is not None:
            files.append(file)
        elif (package / "__init__.py").is_file() and not _is_loaded_package(name):
            files += package.rglob("*.py")
    return {file.relative_to(folder).as_posix(): imported_source(file) for file in files}


def edited_module(scenario: Component) -> Path | None:
    """Return the file of a module of a user's class that was edited since it was imported."""
    modules = find_module_files(scenario)
    files = [file for file in modules.values() if file is not None]
    files += _loaded_sources(modules, getattr(scenario, "_folder", None) or Path.cwd())
    return next((f for f in files if not f.is_file() or f.read_bytes() != imported_source(f)), None)


def _loaded_sources(names: Iterable[str], folder: Path) -> dict[Path, bytes]:
    """Return what is in the files in ``folder`` of those modules, and all of their packages, that
    are loaded.
    """
    here, sources = folder.resolve(), {}
    for name in _with_packages(names):
        file = Path(getattr(sys.modules[name], "__file__", None) or ".").resolve()
        is_here = file.parent == here or file.is_relative_to(here / name.partition(".")[0])
        if is_here and file.is_file():
            sources[file] = file.read_bytes()
    return sources


def _with_packages(names: Iterable[str]) -> list[str]:
    """Return the loaded ones of these modules, with all modules of their packages."""
    tops = {name.partition(".")[0] for name in names} - {"netkf"}
    return [name for name in [*sys.modules] if name.partition(".")[0] in tops]


def _is_namesake(module: ModuleType | None, module_name: str, folder: Path) -> bool:
    """Return True if ``folder`` has a module of this name and the loaded one is not that file."""
    path = folder.joinpath(*module_name.split("."))
    here = [file for file in (path / "__init__.py", Path(f"{path}.py")) if file.is_file()]
    if module is None or not here:
        return False
    file = getattr(module, "__file__", None)
    return file is None or not Path(file).exists() or not here[0].samefile(file)


def _installed_path(folder: Path) -> list[str]:
    """Return the import path without ``folder``, that of a scenario, and the current folder."""
    text = "" if sys.flags.ignore_environment else os.environ.get("PYTHONPATH", "")
    entries = [entry for entry in text.split(os.pathsep) if entry]
    relative = {Path(entry).resolve() for entry in entries if not os.path.isabs(entry)}
    absolute = {Path(entry).resolve() for entry in entries if os.path.isabs(entry)}
    barred = {folder.resolve(), Path.cwd().resolve(), *relative}
    barred -= {*absolute, *_package_folders(), *_path_file_folders()}
    return [entry for entry in sys.path if Path(entry).resolve() not in barred]


def _package_folders() -> list[Path]:
    paths = sysconfig.get_paths()
    folders = {paths["purelib"], paths["platlib"], *site.getsitepackages()}
    if site.ENABLE_USER_SITE:
        folders.add(site.getusersitepackages())
    return sorted(Path(folder).resolve() for folder in folders)


def _path_file_folders() -> Iterator[Path]:
    """Yield the folders that ``.pth`` files add to the import path, as editable installs do."""
    for folder in _package_folders():
        for file in sorted(folder.glob("*.pth")):
            # A line of a .pth file is a folder, a comment, or code that begins with "import".
            for line in file.read_text(encoding="utf-8", errors="replace").splitlines():
                if line.strip() and not line.startswith(("#", "import ", "import\t")):
                    yield (folder / line.strip()).resolve()
