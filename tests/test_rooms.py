"""The structure of the package: no circles of imports, and no public name with two meanings."""

import ast
import re
from collections import defaultdict
from functools import cache
from pathlib import Path

import networkx

import netkf
from tests import conftest

ROOT = Path(netkf.__file__).parent


@cache
def modules():
    """Every module of the package by its name, parsed."""
    found = {}
    for file in sorted(ROOT.rglob("*.py")):
        name = ".".join(("netkf", *file.relative_to(ROOT).with_suffix("").parts))
        found[name.removesuffix(".__init__")] = ast.parse(file.read_text(encoding="utf-8"))
    return found


def imported(tree, known):
    """The modules of the package that a module imports anywhere: in functions and for types too."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in known)
        elif isinstance(node, ast.ImportFrom) and node.module in known:
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                yield inner if inner in known else node.module


def test_no_modules_import_each_other():
    # The two packages import their public names at first use, which is no circle of modules.
    lazy = {"netkf", "netkf.testing"}
    known = modules()
    graph = networkx.DiGraph()
    for name, tree in known.items():
        graph.add_edges_from((name, other) for other in imported(tree, known) if name not in lazy)
    graph.remove_edges_from(list(networkx.selfloop_edges(graph)))
    circles = [sorted(c) for c in networkx.strongly_connected_components(graph) if len(c) > 1]
    assert circles == []


PER_ROOM = (
    *("testing", "scenario", "network", "plants", "trace", "rng", "core", "engines.simpy"),
    *("runs", "ensembles", "figures", "report", "studies", "cli"),
)
"""Rooms in which no public class or function has a name that the same room uses twice."""


def test_a_room_defines_each_public_name_once():
    defined = defaultdict(list)
    for name, tree in modules().items():
        room = next((r for r in PER_ROOM if name.startswith(f"netkf.{r}.")), None)
        for node in tree.body if room else []:
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
                defined[room, node.name].append(name)
    assert {key: where for key, where in defined.items() if len(where) > 1} == {}


def is_registered(tree):
    """A module of a table: a built-in filter, a command, or the promises of one paper."""
    targets = [ast.unparse(t) for n in tree.body if isinstance(n, ast.Assign) for t in n.targets]
    classes = [node for node in tree.body if isinstance(node, ast.ClassDef)]
    decorators = [ast.unparse(d) for node in classes for d in node.decorator_list]
    return {"COMMAND", "CHECKS"} & set(targets) or any(d.startswith("built_in") for d in decorators)


def test_the_readme_of_a_room_names_all_of_its_modules_and_no_others():
    missing, unknown = [], []
    folders = ("netkf", "tests", "docs", "analysis", "scenarios")
    files = {file.name for name in folders for file in (ROOT.parent / name).rglob("*.py")}
    for readme in sorted(ROOT.rglob("README.md")):
        room, text = readme.parent, readme.read_text(encoding="utf-8")
        for file in sorted(room.glob("*.py")):
            name = ".".join(("netkf", *file.relative_to(ROOT).with_suffix("").parts))
            special = file.stem.startswith("__") or file.parent == ROOT
            if special or is_registered(modules()[name]):
                continue
            if not re.search(rf"`{file.stem}(\.py)?`", text):
                missing.append(str(file.relative_to(ROOT)))
        unknown += [
            f"{readme}: {name}" for name in re.findall(r"`(\w+\.py)`", text) if name not in files
        ]
    assert (missing, unknown) == ([], [])


def test_files_that_run_first_are_there():
    tests = conftest.ROOT / "tests"
    assert [name for name in conftest.LONGEST if not (tests / name).exists()] == []
