"""The structure of the package: no circles of imports, and no public name with two meanings."""

import ast
import os
import re
import shutil
import subprocess
import sys
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
    # The package imports its public names at first use, which is no circle of modules.
    lazy = {"netkf"}
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


def test_every_room_is_in_a_wing():
    rooms = {file.parent.name for file in ROOT.glob("*/__init__.py")}
    assert rooms == {room for wing in conftest.WINGS.values() for room in wing}


CORE_ALONE = """
import importlib, pkgutil
import netkf

for module in pkgutil.walk_packages(netkf.__path__, "netkf."):
    if module.name != "netkf.__main__":
        importlib.import_module(module.name)
scenario = netkf.load("scenarios/gossip_ring.toml", {"horizon": 4.0, "probe": 1.0})
run = netkf.simulate(scenario, engine="simpy")
directory = netkf.save(run, scenario, "run")
assert "netkf.theory is not installed" in (directory / "summary.json").read_text()
assert netkf.monte_carlo(scenario, 2, workers=1, engine="simpy").runs.max() == 2
try:
    netkf.theory
except ModuleNotFoundError:
    print("alone")
"""


def test_the_core_passes_its_tests_without_the_other_wings(tmp_path):
    """In plain Python: nothing is compiled, so that it takes seconds."""
    known = conftest.ROOT
    for name in ("netkf", "tests", "scenarios"):
        others = {*conftest.WINGS["theory"], *conftest.WINGS["tools"]} if name == "netkf" else set()
        where = str(known / name)
        shutil.copytree(
            known / name,
            tmp_path / name,
            ignore=lambda folder, _, where=where, others=others: {
                "__pycache__",
                *(others if folder == where else ()),
            },
        )
    shutil.copy(known / "pyproject.toml", tmp_path)
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1", "PYTHONPATH": str(tmp_path)}

    def run(*command):
        return subprocess.run(
            [sys.executable, "-P", *command],
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
            check=False,
            timeout=120,
        )

    alone = run("-c", CORE_ALONE)
    assert (alone.stdout, alone.stderr.count("\n")) == ("alone\n", 1)  # a note of plain Python
    tested = run("-m", "pytest", "-q", *(f"tests/{name}" for name in conftest.CORE_TESTS))
    assert tested.returncode == 0, tested.stdout


def test_files_that_run_first_are_there():
    tests = conftest.ROOT / "tests"
    assert [name for name in conftest.LONGEST if not (tests / name).exists()] == []
