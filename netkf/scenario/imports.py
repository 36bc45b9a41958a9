"""Importing the classes of users that a scenario names, and the rules for files without trust.

Importing a module executes it. Without trust only modules of installed packages are imported, and
only if their source shows that the class is derived from one of netkf's. Everything here but
``find_class`` only reads files and executes nothing.
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

from netkf.core.contracts import ContractError, place_of_error
from netkf.core.errors import ScenarioError, quote
from netkf.core.stamps import TimeBase

REMEDY = "add --trust if you trust its author (in Python: trust=True)"
MAX_HOPS = 50
"""Pairs of module and name that are looked up to find out what a class is derived from."""


class Origin(NamedTuple):
    """The ``folder`` of a scenario's files, and what may be imported for it.

    With ``trust`` any module may be imported, also those in that folder and the current folder;
    else see ``_AllowedPaths``. Without ``imports`` nothing is imported: ``find_class`` returns None
    for a class that is not loaded yet. ``stamps`` says how its tables are read.
    """

    folder: Path
    trust: bool = True
    imports: bool = True
    stamps: TimeBase = TimeBase()


def find_class(kind: str, origin: Origin) -> Any:
    """Return the object that ``kind``, "package.module:Class", names.

    Returns None if it is not loaded yet and ``origin.imports`` is false. Raises ScenarioError if it
    may not be imported, or if the import fails.
    """
    module_name, _, class_name = kind.partition(":")
    allowed = None if origin.trust else _AllowedPaths(origin.folder)
    if allowed is not None:
        allowed.require_user_class(kind, module_name, class_name)
    if not origin.imports and not is_loaded(module_name, class_name, origin.folder):
        return None
    if allowed is None:
        folders = (str(origin.folder), str(Path.cwd()))
        import_path = [*(folder for folder in folders if folder not in sys.path), *sys.path]
    else:
        import_path = allowed.path
    with _replace_import_path(import_path):
        try:
            if allowed is None:
                unload_namesake(module_name, origin.folder)
            return getattr(importlib.import_module(module_name), class_name)
        except (Exception, SystemExit) as error:
            raise _import_error(kind, error) from None


@contextmanager
def _replace_import_path(entries: list[str]) -> Iterator[None]:
    """Set ``sys.path`` to ``entries`` in a block; entries that modules add meanwhile stay."""
    before = list(sys.path)
    sys.path[:] = entries
    try:
        yield
    finally:
        sys.path[:] = [*(entry for entry in sys.path if entry not in entries), *before]


def _import_error(kind: str, error: BaseException) -> ScenarioError:
    """Return the error for a class "package.module:Class" that could not be imported."""
    if isinstance(error, ContractError):
        return ScenarioError("kind", str(error), kind, "write what the contract asks for")
    rule = f"could not be imported ({type(error).__name__}: {quote(str(error), 300)})"
    is_missing = isinstance(error, ModuleNotFoundError) and error.name == kind.partition(":")[0]
    remedy = "put the module beside the scenario file or on the Python path"
    if not is_missing:
        place = place_of_error(error)
        remedy = f"correct the module, {place}" if place else "correct the module"
    return ScenarioError("kind", rule, kind, remedy)


def is_loaded(module_name: str, class_name: str, folder: Path) -> bool:
    """Return True if a class is loaded already, so that finding it executes nothing.

    A module in ``folder``, that of the scenario, takes precedence over a loaded one of its name.
    """
    module = sys.modules.get(module_name)
    return hasattr(module, class_name) and not _is_namesake(module, module_name, folder)


def unload_namesake(module_name: str, folder: Path) -> None:
    """Remove a loaded module if another file of its name is in ``folder``, that of a scenario."""
    if _is_namesake(sys.modules.get(module_name), module_name, folder):
        del sys.modules[module_name]
        importlib.invalidate_caches()


def _is_namesake(module: ModuleType | None, module_name: str, folder: Path) -> bool:
    """Return True if ``folder`` has a module of this name and the loaded one is not that file."""
    file_in_folder = folder / f"{module_name}.py"
    if module is None or not file_in_folder.exists():
        return False
    file = getattr(module, "__file__", None)
    return file is None or not Path(file).exists() or not file_in_folder.samefile(file)


class _AllowedPaths:
    """The rules for imports without trust: what may be imported, and from which folders.

    ``path`` is the import path without the scenario's folder, the current folder, and the folders
    below them; packages installed there (site-packages, editable installs) remain.
    """

    def __init__(self, folder: Path) -> None:
        self._scenario_folder, self._current_folder = folder.resolve(), Path.cwd().resolve()
        self.path = [entry for entry in sys.path if self._may_import_from(entry)]

    def require_user_class(self, kind: str, module_name: str, class_name: str) -> None:
        """Raise ScenarioError unless a class may be imported and is derived from one of netkf's.

        ``kind`` is "module_name:class_name" as the scenario has it, for the message.
        """
        not_found = ModuleNotFoundError(f"No module named {module_name!r}")
        names = [*module_name.split("."), class_name]
        if not all(name.isidentifier() for name in names):
            raise _import_error(kind, not_found)
        if names[0] == "netkf":
            # The modules of all classes for scenarios are loaded; no other code may be run.
            if module_name not in sys.modules and module_name != "netkf.parts":
                raise _import_error(kind, not_found)
            return
        specs = self._find_allowed_specs(module_name)
        if specs is None and self._exists_anywhere(names[0]):
            rule = "names a module in the scenario's or the current folder, whose code would run"
            raise ScenarioError("kind", rule, kind, REMEDY)
        if specs is None:
            raise _import_error(kind, not_found)
        if any(_is_loaded_from_elsewhere(spec) for spec in specs):
            raise _import_error(kind, ImportError("another module of that name is loaded"))
        if not self._is_derived_from_netkf(module_name, class_name, set()):
            rule = "must be a class whose source derives it from a class of netkf"
            raise ScenarioError("kind", rule, kind, f"choose another, or {REMEDY}")

    def _may_import_from(self, path: str) -> bool:
        """Return True if modules may be imported from a file or folder, given as text."""
        try:
            return self._is_allowed(Path(path).resolve())
        except (OSError, ValueError):
            return False

    def _is_allowed(self, location: Path) -> bool:
        """Return True if modules may be imported from a resolved file or folder.

        That is: it belongs to an installed package, or it is neither in the scenario's folder nor
        in the current folder, or a folder further down that contains it was made importable by the
        user, through an editable install or an absolute entry of PYTHONPATH.
        """
        if any(location.is_relative_to(folder) for folder in _site_folders()):
            return True
        editable = [root for root in self._editable_roots if location.is_relative_to(root)]
        on_python_path = [root for root in _python_path() if location.is_relative_to(root)]
        if location.is_relative_to(self._scenario_folder):
            # A root above the scenario's folder does not vouch for the modules in that folder.
            roots = (*editable, *on_python_path)
            return any(_is_below(root, self._scenario_folder) for root in roots)
        if location.is_relative_to(self._current_folder):
            is_below = any(_is_below(root, self._current_folder) for root in on_python_path)
            return bool(editable) or is_below
        return True

    @cached_property
    def _editable_roots(self) -> list[Path]:
        """Import folders of editable installs; ``_find_editable`` adds those of import hooks."""
        return list(_iterate_path_file_folders())

    def _find_allowed_specs(self, module_name: str) -> list[ModuleSpec] | None:
        """Return the specs of the packages that contain a module, outermost first, and its own.

        Returns None if one of them is not found or may not be imported.
        """
        specs: list[ModuleSpec] = []
        path, names = self.path, module_name.split(".")
        for k in range(len(names)):
            name = ".".join(names[: k + 1])
            # Import hooks are asked for top-level modules only; their submodules are on a path.
            spec = self._find_editable(name) if k == 0 else None
            spec = spec or _find_spec(name, path)
            if spec is None:
                return None
            path = [
                location
                for location in spec.submodule_search_locations or ()
                if self._may_import_from(location)
            ]
            # A namespace package has no file of its own, only folders.
            files = [spec.origin or ""] if spec.has_location else path
            if not files or not all(map(self._may_import_from, files)):
                return None
            specs.append(spec)
        return specs

    def _find_editable(self, name: str) -> ModuleSpec | None:
        """Return the spec of a top-level module that an import hook of an editable install finds.

        Its folder is added to ``_editable_roots``. Returns None if no hook finds it.
        """
        for finder in sys.meta_path:
            # Build tools name the modules of their hooks so, "__editable___NAME_finder" for one.
            hook = finder if isinstance(finder, type) else type(finder)
            if "editable" not in hook.__module__:
                continue
            spec = finder.find_spec(name, None)
            if spec is not None and spec.origin is not None:
                file = Path(spec.origin).resolve()
                is_package = bool(spec.submodule_search_locations)
                self._editable_roots.append(file.parent if is_package else file)
                return spec
        return None

    def _exists_anywhere(self, top_level_name: str) -> bool:
        """Return True if a top-level module exists, be it in a folder that is not allowed."""
        folders = [str(self._scenario_folder), str(self._current_folder)]
        return _find_spec(top_level_name, [*folders, *sys.path]) is not None

    def _is_derived_from_netkf(
        self, module_name: str, name: str, visited: set[tuple[str, str]]
    ) -> bool:
        """Return True if the source of a module binds a name to a class derived from netkf's.

        The name is followed through imports, assignments and base classes; ``visited`` holds the
        pairs (module, name) seen on the way, which ends circles.
        """
        if module_name.partition(".")[0] == "netkf":
            return True
        if (module_name, name) in visited or len(visited) >= MAX_HOPS:
            return False
        visited.add((module_name, name))
        specs = self._find_allowed_specs(module_name)
        if specs is None:
            return False
        source = _Source(module_name, specs[-1])
        return any(
            self._is_derived_from_netkf(origin_module, origin_name, visited)
            for origin_module, origin_name in source.find_origins(name)
        )


def _is_below(location: Path, folder: Path) -> bool:
    """Return True if the location lies inside the folder."""
    return location != folder and location.is_relative_to(folder)


def _is_loaded_from_elsewhere(spec: ModuleSpec) -> bool:
    """Return True if a module of that name is loaded already, but from another file."""
    module = sys.modules.get(spec.name)
    if module is None or not spec.has_location:
        return False
    file = getattr(module, "__file__", None)
    return file is None or Path(file).resolve() != Path(spec.origin or "").resolve()


def _find_spec(name: str, path: list[str]) -> ModuleSpec | None:
    """Return the spec of a module on an import path, None if it is not found."""
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


def _iterate_path_file_folders() -> Iterator[Path]:
    """Yield the folders that ``.pth`` files add to the import path, as editable installs do."""
    for folder in _package_folders():
        for file in sorted(folder.glob("*.pth")):
            # A line of a .pth file is a folder, a comment, or code that begins with "import".
            for line in file.read_text(encoding="utf-8", errors="replace").splitlines():
                if line.strip() and not line.startswith(("#", "import ", "import\t")):
                    yield (folder / line.strip()).resolve()


def _python_path() -> list[Path]:
    """Return the absolute folders of PYTHONPATH: relative ones depend on the current folder."""
    text = "" if sys.flags.ignore_environment else os.environ.get("PYTHONPATH", "")
    return [Path(entry).resolve() for entry in text.split(os.pathsep) if os.path.isabs(entry)]


class _Source:
    """The origins of the names in a module, read from its source text without executing it.

    The text is that of the module ``module_name`` with the given spec; a module without readable
    Python source counts as empty.
    """

    def __init__(self, module_name: str, spec: ModuleSpec) -> None:
        """Read the source text of the module, if it has one."""
        self._module_name = module_name
        is_package = spec.submodule_search_locations is not None
        self._package = module_name if is_package else module_name.rpartition(".")[0]
        loader: Any = spec.loader  # not all loaders have a source
        try:
            text = loader.get_source(module_name)
            self._body = ast.parse(text or "").body
        except (AttributeError, ImportError, OSError, SyntaxError, ValueError, RecursionError):
            self._body = []

    def find_origins(self, name: str) -> Iterator[tuple[str, str]]:
        """Yield (module, name) of everything that a module-level name may come from.

        For a class these are its bases, for an imported name its original, for a variable the name
        assigned to it.
        """
        for statement in _iterate_statements(self._body):
            if isinstance(statement, ast.ClassDef) and statement.name == name:
                for base in statement.bases:
                    yield from self._resolve(base, name)
            elif isinstance(statement, ast.ImportFrom):
                yield from self._resolve_import(statement, name)
            elif isinstance(statement, ast.Assign) and name in map(_identifier, statement.targets):
                yield from self._resolve(statement.value, name)

    def _resolve_import(self, statement: ast.ImportFrom, name: str) -> Iterator[tuple[str, str]]:
        """Yield (module, original name) if ``from module import ...`` may bind ``name``."""
        for alias in statement.names:
            if alias.name == "*":
                yield self._absolute_module(statement), name
            elif (alias.asname or alias.name) == name:
                yield self._absolute_module(statement), alias.name

    def _absolute_module(self, statement: ast.ImportFrom) -> str:
        """Return the absolute name of ``module`` in ``from module import ...``."""
        packages: list[str] = []
        if statement.level:  # dots before the name: one is this package, two the one around it
            packages = self._package.split(".")
            packages = packages[: len(packages) - statement.level + 1]
        return ".".join([*packages, *([statement.module] if statement.module else [])])

    def _resolve(self, expression: ast.expr, bound_name: str) -> Iterator[tuple[str, str]]:
        """Yield (module, name) for an expression ``name`` or ``package.module.name``.

        ``bound_name`` is the name that the statement binds: ``x = x`` leads nowhere. Other
        expressions yield nothing.
        """
        attributes: list[str] = []
        while isinstance(expression, ast.Attribute):
            attributes.insert(0, expression.attr)
            expression = expression.value
        first = _identifier(expression)
        if not first:
            return
        if attributes:
            for module in self._find_modules(first):
                yield ".".join([module, *attributes[:-1]]), attributes[-1]
        elif first != bound_name:
            yield self._module_name, first

    def _find_modules(self, name: str) -> Iterator[str]:
        """Yield the absolute names of the modules that import statements may bind ``name`` to."""
        for statement in _iterate_statements(self._body):
            if isinstance(statement, ast.ImportFrom):
                for alias in statement.names:
                    if (alias.asname or alias.name) == name:
                        yield f"{self._absolute_module(statement)}.{alias.name}"
            elif isinstance(statement, ast.Import):
                for alias in statement.names:
                    if alias.asname == name:
                        yield alias.name
                    # ``import a.b`` binds ``a``.
                    elif not alias.asname and alias.name.partition(".")[0] == name:
                        yield name


def _identifier(expression: ast.expr) -> str:
    """Return the identifier of an expression that is a plain name, else an empty text."""
    return expression.id if isinstance(expression, ast.Name) else ""


def _iterate_statements(body: list[Any]) -> Iterator[ast.stmt]:
    """Yield the statements that a module executes when it is imported.

    Those inside ``if``, ``try``, ``with``, ``match`` and loops are among them, those inside
    functions and classes are not.
    """
    for node in body:
        if isinstance(node, ast.stmt):
            yield node
        if not isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            for block in ("body", "orelse", "handlers", "finalbody", "cases"):
                statements = getattr(node, block, None)
                yield from _iterate_statements(statements if isinstance(statements, list) else [])
