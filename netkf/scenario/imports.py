"""Modules of users' classes: which of them may be imported for a scenario, and what they hold.

Importing a module executes it. Without trust only modules of installed packages are imported, and
only if their source shows that the class is derived from one of netkf's. Everything here but
``import_class`` reads files and executes nothing.
"""

from __future__ import annotations

import ast
import importlib
import os
import site
import sys
import sysconfig
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

from netkf.core.errors import ScenarioError, quote

REMEDY = "add --trust if you trust its author (in Python: trust=True)"
MAX_HOPS = 50
"""Names that are followed from one source text to the next."""


class Origin(NamedTuple):
    """The folder of a scenario's tables, and what may be imported for them.

    ``trust`` allows modules in that folder, in the current folder and all others; without
    ``imports`` nothing is imported, and parts whose classes are not loaded yet wait.
    """

    folder: Path
    trust: bool = True
    imports: bool = True


def find_class(kind: str, origin: Origin) -> Any:
    """Return the object that ``kind``, "package.module:Class", names; None if it has to wait.

    Raises ScenarioError if it may not be imported, or cannot be.
    """
    module_name, _, class_name = kind.partition(":")
    allowed = None if origin.trust else _AllowedPaths(origin.folder)
    if allowed is not None:
        allowed.demand(kind, module_name, class_name)
    if not origin.imports and not is_loaded(module_name, class_name, origin.folder):
        return None
    beside = [p for p in (str(origin.folder), str(Path.cwd())) if p not in sys.path]
    with _import_path([*beside, *sys.path] if allowed is None else allowed.path):
        try:
            if allowed is None:
                forget_other(module_name, origin.folder)
            return getattr(importlib.import_module(module_name), class_name)
        except (Exception, SystemExit) as error:
            raise _failure(kind, error) from None


@contextmanager
def _import_path(entries: list[str]) -> Iterator[None]:
    """Set ``sys.path`` for a while; what modules add to it meanwhile stays."""
    before = list(sys.path)
    sys.path[:] = entries
    try:
        yield
    finally:
        sys.path[:] = [*(entry for entry in sys.path if entry not in entries), *before]


def _failure(kind: str, error: BaseException) -> ScenarioError:
    """Return the error for a class that could not be imported."""
    rule = f"could not be imported ({type(error).__name__}: {quote(str(error))})"
    remedy = "put the module beside the scenario file or on the Python path"
    return ScenarioError("kind", rule, kind, remedy)


def is_loaded(module_name: str, class_name: str, folder: Path) -> bool:
    """Return True if a class is there already, so that finding it executes nothing."""
    loaded = sys.modules.get(module_name)
    return hasattr(loaded, class_name) and not _is_other(loaded, module_name, folder)


def forget_other(module_name: str, folder: Path) -> None:
    """Forget a module imported from elsewhere whose name a module beside the scenario has."""
    if _is_other(sys.modules.get(module_name), module_name, folder):
        del sys.modules[module_name]
        importlib.invalidate_caches()


def _is_other(loaded: ModuleType | None, module_name: str, folder: Path) -> bool:
    """Return True if a loaded module is another one than the file beside the scenario."""
    beside = folder / f"{module_name}.py"
    if loaded is None or not beside.exists():
        return False
    other = getattr(loaded, "__file__", None)
    return other is None or not Path(other).exists() or not beside.samefile(other)


class _AllowedPaths:
    """The folders from which modules are imported for a scenario without trust.

    These are the import path without the scenario's folder, the current folder, and what lies
    below them; packages installed there (site-packages, editable installs) remain.
    """

    def __init__(self, folder: Path) -> None:
        self._scenario, self._current = folder.resolve(), Path.cwd().resolve()
        self.path = [entry for entry in sys.path if self._may_hold(entry)]

    def demand(self, kind: str, module_name: str, class_name: str) -> None:
        """Raise ScenarioError unless the class may be imported and is a part of netkf's."""
        absent = ModuleNotFoundError(f"No module named {module_name!r}")
        names = [*module_name.split("."), class_name]
        if not all(name.isidentifier() for name in names):
            raise _failure(kind, absent)
        if names[0] == "netkf":
            if module_name not in sys.modules and module_name != "netkf.parts":
                raise _failure(kind, absent)
            return
        specs = self._specs(module_name)
        if specs is None and self._is_somewhere(names[0]):
            rule = "names a module in the scenario's or the current folder, whose code would run"
            raise ScenarioError("kind", rule, kind, REMEDY)
        if specs is None:
            raise _failure(kind, absent)
        if any(_is_replaced(spec) for spec in specs):
            raise _failure(kind, ImportError("another module of that name is loaded"))
        if not self._is_part(module_name, class_name, set()):
            rule = "must be a class whose source derives it from a class of netkf"
            raise ScenarioError("kind", rule, kind, f"choose another, or {REMEDY}")

    def _may_hold(self, entry: str) -> bool:
        """Return True if modules may be imported from an entry of the path."""
        try:
            return self._allows(Path(entry).resolve())
        except (OSError, ValueError):
            return False

    def _allows(self, location: Path) -> bool:
        """Return True if code at a resolved location belongs to an installed package, or lies
        outside of both folders.
        """
        if any(location.is_relative_to(root) for root in _site_folders()):
            return True
        named = [root for root in self._editable if location.is_relative_to(root)]
        chosen = [root for root in _python_path() if location.is_relative_to(root)]
        if location.is_relative_to(self._scenario):
            return any(_is_below(root, self._scenario) for root in (*named, *chosen))
        if location.is_relative_to(self._current):
            return bool(named) or any(_is_below(root, self._current) for root in chosen)
        return True

    @cached_property
    def _editable(self) -> list[Path]:
        """Folders of packages that are installed in place."""
        return list(_path_files())

    def _specs(self, module_name: str) -> list[ModuleSpec] | None:
        """Return the specifications of a module and its packages; None if one is not allowed."""
        specs: list[ModuleSpec] = []
        path, names = self.path, module_name.split(".")
        for k in range(len(names)):
            name = ".".join(names[: k + 1])
            spec = (None if specs else self._map_editable(name)) or _spec(name, path)
            if spec is None:
                return None
            path = [
                location
                for location in spec.submodule_search_locations or ()
                if self._may_hold(location)
            ]
            files = [spec.origin or ""] if spec.has_location else path
            if not files or not all(map(self._may_hold, files)):
                return None
            specs.append(spec)
        return specs

    def _map_editable(self, name: str) -> ModuleSpec | None:
        """Return what the import hook of an editable install maps a name to."""
        for finder in sys.meta_path:
            hook = finder if isinstance(finder, type) else type(finder)
            if "editable" not in hook.__module__:
                continue
            spec = finder.find_spec(name, None)
            if spec is not None and spec.origin is not None:
                location = Path(spec.origin).resolve()
                self._editable.append(
                    location.parent if spec.submodule_search_locations else location
                )
                return spec
        return None

    def _is_somewhere(self, top: str) -> bool:
        """Return True if a top-level module can be found at all."""
        return _spec(top, [str(self._scenario), str(self._current), *sys.path]) is not None

    def _is_part(self, module_name: str, name: str, visited: set[tuple[str, str]]) -> bool:
        """Return True if the source of a module binds a name to a class derived from netkf's."""
        if module_name.partition(".")[0] == "netkf":
            return True
        if (module_name, name) in visited or len(visited) >= MAX_HOPS:
            return False
        visited.add((module_name, name))
        specs = self._specs(module_name)
        if specs is None:
            return False
        source = _Source(module_name, specs[-1])
        return any(self._is_part(*found, visited) for found in source.ancestors(name))


def _is_below(location: Path, folder: Path) -> bool:
    """Return True if the location lies inside the folder."""
    return location != folder and location.is_relative_to(folder)


def _is_replaced(spec: ModuleSpec) -> bool:
    """Return True if a module of that name was loaded from another file."""
    loaded = sys.modules.get(spec.name)
    if loaded is None or not spec.has_location:
        return False
    file = getattr(loaded, "__file__", None)
    return file is None or Path(file).resolve() != Path(spec.origin or "").resolve()


def _spec(name: str, path: list[str]) -> ModuleSpec | None:
    """Return the spec of a module on this path, None if there is none."""
    try:
        return PathFinder.find_spec(name, path)
    except (OSError, ImportError, ValueError):
        return None


def _site_folders() -> list[Path]:
    """Return the folders of the standard library and of installed packages."""
    names = ("stdlib", "platstdlib")
    folders = [sysconfig.get_paths()[name] for name in names]
    return [*(Path(folder).resolve() for folder in folders), *_package_folders()]


def _package_folders() -> list[Path]:
    """Return the folders in which Python installs packages."""
    paths = sysconfig.get_paths()
    folders = {paths["purelib"], paths["platlib"], *site.getsitepackages()}
    if site.ENABLE_USER_SITE:
        folders.add(site.getusersitepackages())
    return sorted(Path(folder).resolve() for folder in folders)


def _path_files() -> Iterator[Path]:
    """Yield the folders that ``.pth`` files name, as those of editable installs do."""
    for folder in _package_folders():
        for file in sorted(folder.glob("*.pth")):
            for line in file.read_text(encoding="utf-8", errors="replace").splitlines():
                if line.strip() and not line.startswith(("#", "import ", "import\t")):
                    yield (folder / line.strip()).resolve()


def _python_path() -> list[Path]:
    """Return the absolute folders of PYTHONPATH: relative ones depend on the current folder."""
    given = "" if sys.flags.ignore_environment else os.environ.get("PYTHONPATH", "")
    return [Path(entry).resolve() for entry in given.split(os.pathsep) if os.path.isabs(entry)]


class _Source:
    """The names that the source text of a module binds, without its execution."""

    def __init__(self, module_name: str, spec: ModuleSpec) -> None:
        self._module = module_name
        package = spec.submodule_search_locations is not None
        self._package = module_name if package else module_name.rpartition(".")[0]
        loader: Any = spec.loader  # not all loaders have a source
        try:
            text = loader.get_source(module_name)
            self._body = ast.parse(text or "").body
        except (AttributeError, ImportError, OSError, SyntaxError, ValueError, RecursionError):
            self._body = []

    def ancestors(self, name: str) -> Iterator[tuple[str, str]]:
        """Yield (module, class) of what a name was imported from, or is derived from."""
        for node in _statements(self._body):
            if isinstance(node, ast.ClassDef) and node.name == name:
                for base in node.bases:
                    yield from self._resolve(base, name)
            elif isinstance(node, ast.ImportFrom):
                yield from self._imported_names(node, name)
            elif isinstance(node, ast.Assign) and name in map(_name, node.targets):
                yield from self._resolve(node.value, name)

    def _imported_names(self, node: ast.ImportFrom, name: str) -> Iterator[tuple[str, str]]:
        """Yield the modules and names by which an import statement may bring ``name``."""
        for alias in node.names:
            if alias.name == "*" or (alias.asname or alias.name) == name:
                yield self._absolute(node), name if alias.name == "*" else alias.name

    def _absolute(self, node: ast.ImportFrom) -> str:
        """Return the absolute name of the module that an import statement names."""
        above = self._package.split(".")
        kept = above[: len(above) - node.level + 1] if node.level else []
        return ".".join([*kept, *([node.module] if node.module else [])])

    def _resolve(self, node: ast.expr, own: str) -> Iterator[tuple[str, str]]:
        """Yield what an expression ``Name`` or ``package.module.Name`` refers to."""
        names: list[str] = []
        while isinstance(node, ast.Attribute):
            names.insert(0, node.attr)
            node = node.value
        first = _name(node)
        if not names and first not in ("", own):
            yield self._module, first
        elif names and first:
            for module in self._modules(first):
                yield ".".join([module, *names[:-1]]), names[-1]

    def _modules(self, name: str) -> Iterator[str]:
        """Yield the modules that a name may refer to."""
        for node in _statements(self._body):
            for alias in node.names if isinstance(node, ast.Import | ast.ImportFrom) else ():
                bound = alias.asname or alias.name
                if isinstance(node, ast.ImportFrom) and bound == name:
                    yield f"{self._absolute(node)}.{alias.name}"
                elif isinstance(node, ast.Import) and bound.partition(".")[0] == name:
                    yield alias.name if alias.asname else name


def _name(node: ast.expr) -> str:
    """Return the identifier of an expression, empty for other expressions."""
    return node.id if isinstance(node, ast.Name) else ""


def _statements(body: list[Any]) -> Iterator[ast.stmt]:
    """Yield the statements of a module, and those inside ``if``, ``try`` and ``with``."""
    for node in body:
        if isinstance(node, ast.stmt):
            yield node
        if not isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            for part in ("body", "orelse", "handlers", "finalbody"):
                inside = getattr(node, part, None)
                yield from _statements(inside if isinstance(inside, list) else [])
