"""A scenario of a stranger executes nothing; see docs/security.md."""

import dataclasses
import importlib
import os
import pickle
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import netkf
from netkf.cli.main import main
from netkf.ensembles.blocks import pack_scenario
from netkf.runs.files import scenario_digest
from netkf.scenario import plugins
from netkf.scenario.plugins import find_module_files
from netkf.scenario.writing import as_table, to_toml
from tests.conftest import SCENARIOS

PART = "from netkf.parts import Hybrid\n\n\nclass P(Hybrid):\n    pass\n"
COMMANDS = (
    ["theory"],
    ["run", "--out", "out"],
    ["check"],
    ["sweep", "--vary", "horizon=1,2"],
    ["size", "--vary", "horizon=1:2", "--target", "worst_rms<=1"],
    ["consistency"],
)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A stranger's folder; modules made by ``module`` note in ``ran`` that they were executed."""
    place = tmp_path / "stranger"
    place.mkdir()
    before = dict(sys.modules)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    yield place
    for name in [name for name in sys.modules if name not in before]:
        if str(tmp_path) in str(getattr(sys.modules[name], "__file__", "")):
            del sys.modules[name]


def module(path, text=PART):
    """Write a module that leaves a file ``ran`` beside it when it is executed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"open({str(path.with_suffix('.ran'))!r}, 'w').close()\n{text}")


def ran(folder):
    return sorted(file.name for file in folder.rglob("*.ran"))


def scenario(folder, kind="evil:P", **changes):
    table = as_table(netkf.load(SCENARIOS / "poisson_ring.toml"))
    table["filter"]["kind"] = kind
    file = folder / "ring.toml"
    file.write_text(to_toml(table | changes))
    return file


@pytest.mark.one_in(3)
@pytest.mark.parametrize(
    ("kind", "path"),
    [
        ("evil:P", "evil.py"),
        ("evil:P", "evil/__init__.py"),
        ("below.evil:P", "below/evil.py"),
        ("stranger.evil:P", "evil.py"),
        ("json_:P", "json_.py"),
    ],
)
@pytest.mark.parametrize("current", [".", ".."])
@pytest.mark.parametrize("on_path", [None, ".", ".."])
def test_modules_of_the_folder_need_trust(folder, monkeypatch, kind, path, current, on_path):
    module(folder / path)
    file = scenario(folder, kind)
    monkeypatch.chdir(folder / current)
    if on_path is not None:
        monkeypatch.syspath_prepend(folder / on_path)
    found = kind != "stranger.evil:P" or current == ".." or on_path == ".."
    with pytest.raises(netkf.ScenarioError, match=r"filter\.kind: .*add --trust"):
        netkf.load(file, trust=False)
    assert not ran(folder)
    if found:
        assert type(netkf.load(file).filter.algorithm).__name__ == "P"
        assert ran(folder)


def test_modules_of_the_current_folder_need_trust(folder, tmp_path, monkeypatch):
    here = tmp_path / "here"
    module(here / "evil.py")
    monkeypatch.chdir(here)
    monkeypatch.syspath_prepend("")
    with pytest.raises(netkf.ScenarioError, match="add --trust"):
        netkf.load(scenario(folder), trust=False)
    assert not ran(here)
    netkf.load(scenario(folder))
    with pytest.raises(netkf.ScenarioError, match="add --trust"):  # although it is loaded now
        netkf.load(scenario(folder), trust=False)


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command[0])
def test_every_command_refuses_in_one_line(folder, capsys, monkeypatch, command):
    module(folder / "evil.py")
    monkeypatch.chdir(folder)
    name, *options = command
    assert main([name, str(scenario(folder)), *options]) == 2
    out, err = capsys.readouterr()
    assert not out
    assert err.count("\n") == 1
    assert "--trust" in err
    assert not ran(folder)
    assert not (folder / "out").exists()


def test_trust_is_an_option_and_run_directories_need_it_too(folder, capsys, monkeypatch):
    module(folder / "evil.py")
    file, out = str(scenario(folder, horizon=1.0)), folder / "out"
    assert main(["run", file, "--trust", "--out", str(out), "--no-plot"]) == 0
    assert ran(folder) == ["evil.ran"]
    (folder / "evil.ran").unlink()
    for again in (
        ["theory", str(out / "scenario.toml")],
        ["run", file, "--resume", "--out", str(out)],
    ):
        assert main(again) == 2
        assert "--trust" in capsys.readouterr().err
        assert not ran(folder)
    assert main(["theory", str(out / "scenario.toml"), "--trust"]) == 0
    assert main(["compare", str(out), str(out)]) == 0


MISTAKES = {
    "nonsense": 1,
    "horizon": -1.0,
    "plant": {"kind": "diffusion", "A": [[0.0, 1.0]], "B": [[1.0]]},
    "sensors": [{"nodes": [0], "H": [[1.0, 0.0]], "R": [[-1.0]]}],
    "network": {"graph": {"kind": "cycle", "nodes": 6, "size": 1}},
    "filter": {"kind": "evil:P", "cov": [[-1.0]]},
}


@pytest.mark.parametrize("key", MISTAKES)
def test_a_file_that_is_refused_imports_nothing(folder, key):
    module(folder / "evil.py")
    with pytest.raises(netkf.ScenarioError, match=key):
        netkf.load(scenario(folder, **{key: MISTAKES[key]}))
    assert not ran(folder)


def test_the_other_parts_are_checked_where_the_plant_waits(folder):
    text = "from netkf.parts import LinearPlant\n\n\nclass P(LinearPlant):\n    pass\n"
    module(folder / "evil.py", text)
    plant = {"kind": "evil:P", "F": [[0.5]], "Q": [[1.0]], "period": 1.0}
    activation = {"kind": "matching", "protocol": "one-edge"}
    network = {"graph": {"kind": "path", "nodes": 2}, "activation": activation}
    good = {
        "plant": plant,
        "sensors": [{"nodes": [0], "H": [[1.0]], "R": [[1.0]]}],
        "network": network,
        "filter": {"kind": "gossip"},
        "probe": 1.0,
    }
    wrong = network | {"activation": activation | {"protocol": "two-edges"}}
    with pytest.raises(netkf.ScenarioError, match="protocol"):
        netkf.load(scenario(folder, **good | {"network": wrong}))
    assert not ran(folder)
    assert netkf.load(scenario(folder, **good)).slotted


def test_replace_and_pickle_keep_the_rule(folder):
    module(folder / "evil.py")
    stranger = netkf.load(scenario(folder, "hybrid"), trust=False)
    for again in (stranger, pickle.loads(pickle.dumps(stranger)), stranger.replace({"seed": 5})):
        with pytest.raises(netkf.ScenarioError, match="add --trust"):
            again.replace({"filter.kind": "evil:P"})
    assert not ran(folder)
    netkf.load(scenario(folder, "hybrid")).replace({"filter.kind": "evil:P"})
    assert ran(folder)


def offer(site, package, **offered):
    """Write the metadata of an installed package that offers classes, as pip leaves it."""
    info = site / f"{package}-1.0.dist-info"
    info.mkdir(parents=True)
    lines = [f"{kind.replace('_', '-')} = {value}" for kind, value in offered.items()]
    (info / "entry_points.txt").write_text("\n".join(["[netkf.parts]", *lines, ""]))
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")


@pytest.fixture
def site(folder, monkeypatch):
    """A folder of installed packages inside the stranger's folder, as that of a .venv can be."""
    place = folder / ".venv" / "site-packages"
    place.mkdir(parents=True)
    folders = plugins._package_folders()
    monkeypatch.setattr(plugins, "_package_folders", lambda: [*folders, place.resolve()])
    monkeypatch.syspath_prepend(place)
    return place


LOSS = """from netkf.parts import Loss, probability, setting
from dataclasses import dataclass


@dataclass(frozen=True, eq=False)
class Rare(Loss):
    delivery: float = setting(probability)

    def delivery_probability(self, sent):
        return self.delivery
"""


def test_a_package_offers_classes_as_kinds(folder, site, monkeypatch, capsys):
    """From the command line without --trust, up to the run directory and many processes."""
    offer(site, "good", my_hybrid="good.deep:Again", rare="good.losses:Rare")
    module(site / "good" / "__init__.py", "")
    module(site / "good" / "deep.py", PART + "Again = P\n")
    module(site / "good" / "losses.py", LOSS)
    monkeypatch.chdir(folder)
    file = scenario(folder, "my-hybrid", horizon=1.0)
    out = folder / "out"
    change = 'network.channel.loss={kind="rare", delivery=0.5}'
    options = ["--set", change, "--runs", "2", "--workers", "2", "--no-plot", "--out", str(out)]
    assert main(["run", str(file), *options]) == 0, capsys.readouterr().err
    assert sorted(set(ran(site))) == ["__init__.ran", "deep.ran", "losses.ran"]
    resolved = (out / "scenario.toml").read_text()
    assert 'kind = "my-hybrid"' in resolved
    assert 'kind = "rare"' in resolved
    again = netkf.open(out).scenario  # without trust
    assert type(again.filter.algorithm).__module__ == "good.deep"
    assert again.network.channel.loss.delivery == 0.5
    assert main(["compare-filters", str(file), "--filters", "hybrid,my-hybrid"]) == 0


def test_mistakes_of_an_installed_package_are_named_with_its_file(folder, site):
    offer(site, "poor", fails="poor:P", lacks="poor.deep:Absent", unmade="poor.deep:P")
    (site / "poor").mkdir()
    (site / "poor" / "deep.py").write_text(
        "from netkf.parts import Hybrid\n\n\nclass P(Hybrid):\n"
        "    def __post_init__(self):\n        raise RuntimeError('no')\n"
    )
    (site / "poor" / "__init__.py").write_text("")
    for kind, words in (("lacks", r"module, poor\.deep"), ("unmade", r"no; .*deep\.py, line 6\)")):
        with pytest.raises(netkf.ScenarioError, match=words):
            netkf.load(scenario(folder, kind))
    sys.modules.pop("poor"), sys.modules.pop("poor.deep")
    (site / "poor" / "__init__.py").write_text("\n1 / 0\n")
    importlib.invalidate_caches()
    with pytest.raises(netkf.ScenarioError, match=r"correct the module, .*__init__\.py, line 2$"):
        netkf.load(scenario(folder, "fails"))


def test_nothing_is_imported_to_find_out_what_packages_offer(folder, site, capsys, monkeypatch):
    offer(site, "good", my_hybrid="good:P", other="good:Q")
    module(site / "good.py")
    with pytest.raises(netkf.ScenarioError, match=r"of those of packages, .my-hybrid., .other.; "):
        netkf.load(scenario(folder, "my-hibrid"))
    with pytest.raises(netkf.ScenarioError, match="horizon"):
        netkf.load(scenario(folder, "my-hybrid", horizon=-1.0))
    assert main(["schema"]) == 0
    assert "|^my-hybrid$|^other$" in capsys.readouterr().out
    assert not ran(site)
    for kind in ("good:P", "json:JSONDecoder", "no_such_module:P"):
        with pytest.raises(netkf.ScenarioError, match=r"whose code would run.*add --trust"):
            netkf.load(scenario(folder, kind), trust=False)
    assert not ran(site)
    for kind, words in (
        ("netkf.cli.main:make_parser", "must be a subclass .* derive .* from netkf.parts.Filter"),
        ("netkf.nonsense:P", "could not be imported"),
        ("netkf.__main__:main", "could not be imported"),
    ):
        with pytest.raises(netkf.ScenarioError, match=words):
            netkf.load(scenario(folder, kind), trust=False)


@pytest.mark.parametrize(
    ("value", "text", "words"),
    [
        ("side:P", "class P:\n    pass\n", "must be a subclass of netkf's Filter"),
        ("side:Rare", LOSS, "must be a subclass of netkf's Filter"),
        ("side:Q", PART, "could not be imported"),
        ("side:P", "def P(:\n", "could not be imported"),
        ("side", PART, "must be a subclass of netkf's Filter"),
        ("side side", PART, "could not be imported"),
        ("sid:P", PART, "could not be imported"),
    ],
)
def test_what_a_package_offers_must_be_such_a_part(folder, site, value, text, words):
    offer(site, "side", bad=value)
    module(site / "side.py", text)
    with pytest.raises(netkf.ScenarioError, match=rf"filter\.kind: {words}"):
        netkf.load(scenario(folder, "bad"), trust=False)


def test_built_in_kinds_stay_and_a_kind_of_two_packages_is_nobodys(folder, site):
    for package in ("one", "two"):
        module(site / f"{package}.py")
        offer(site, package, hybrid=f"{package}:P", mine=f"{package}:P")
    assert type(netkf.load(scenario(folder, "hybrid")).filter.algorithm) is netkf.parts.Hybrid
    with pytest.raises(netkf.ScenarioError, match="by several packages, as one:P, two:P"):
        netkf.load(scenario(folder, "mine"))
    assert not ran(site)


def test_installed_packages_win_over_the_folder_and_do_not_import_from_it(
    folder, site, monkeypatch
):
    offer(site, "good", good="good:P")
    module(site / "good.py", "import helper\n" + PART)
    module(site / "helper.py", "")
    for name in ("good.py", "helper.py"):
        module(folder / name)
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(folder)
    loaded = netkf.load(scenario(folder, "good"), trust=False)
    assert ran(site) == ["good.ran", "helper.ran"]
    assert not list(folder.glob("*.ran"))
    assert find_module_files(loaded) == {"good": None}  # the one beside the scenario is not copied


@pytest.mark.parametrize("current", [".", ".."])
def test_what_lies_in_the_folder_is_not_installed(folder, monkeypatch, current):
    """A stranger's folder may pretend to be one of installed packages."""
    offer(folder, "evil", evil="evil:P")
    module(folder / "evil.py")
    monkeypatch.syspath_prepend(folder)
    monkeypatch.chdir(folder / current)
    with pytest.raises(netkf.ScenarioError, match="add --trust"):
        netkf.load(scenario(folder, "evil"), trust=False)
    assert not ran(folder)
    netkf.load(scenario(folder, "evil"))
    assert ran(folder)


@pytest.mark.parametrize(("given", "allowed"), [("{}/lib", True), ("lib", False), ("{}", True)])
def test_the_python_path_counts_where_it_does_not_depend_on_the_folder(
    folder, monkeypatch, given, allowed
):
    entry = given.format(folder)
    root = Path(os.path.join(folder, entry))
    offer(root, "mine", mine="mine:P")
    module(root / "mine.py")
    monkeypatch.chdir(folder)
    monkeypatch.setenv("PYTHONPATH", entry)
    monkeypatch.syspath_prepend(root)
    chosen = scenario(folder, "mine")
    if allowed:
        netkf.load(chosen, trust=False)
    else:
        with pytest.raises(netkf.ScenarioError, match="add --trust"):
            netkf.load(chosen, trust=False)
    assert bool(ran(folder)) is allowed


def test_editable_installs_are_installed(folder, site, monkeypatch):
    """Their metadata lie with the packages, and a ``.pth`` file there names the folder."""
    offer(site, "mine", mine="mine:P")
    (site / "mine.pth").write_text("# a comment\nimport os\n../..\n")
    module(folder / "mine.py")
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(folder)
    netkf.load(scenario(folder, "mine"), trust=False)
    assert ran(folder)


def test_a_loaded_module_of_that_name_is_not_taken_for_an_installed_one(folder, site):
    offer(site, "good", good="good:P")
    module(site / "good.py")
    module(folder / "good.py")
    loaded = type(netkf.load(scenario(folder, "good:P")).filter.algorithm).__module__
    assert "stranger/good" in str(sys.modules[loaded].__file__)
    with pytest.raises(netkf.ScenarioError, match="another module of that name is loaded"):
        netkf.load(scenario(folder, "good"), trust=False)


def test_workers_import_nothing_from_the_current_folder(folder):
    """Python starts them with ``-c``, which puts the current folder on the import path."""
    for name in ("multiprocessing", "pickle", "numpy", "random"):
        module(folder / f"{name}.py", "raise ImportError\n")
    shutil.copy(SCENARIOS / "poisson_ring.toml", folder)
    root = Path(netkf.__file__).parents[1]
    (folder / "bin").mkdir()
    script = folder / "bin" / "netkf"
    script.write_text("import sys\nfrom netkf.cli.main import main\nsys.exit(main())\n")
    options = ["--runs", "4", "--workers", "2", "--no-plot", "--out", "out", "--engine", "simpy"]
    done = subprocess.run(
        [sys.executable, str(script), "run", "poisson_ring.toml", *options],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(root)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert not ran(folder)


def test_what_a_class_imports_from_its_folder_comes_along(folder, tmp_path):
    """A run directory has it, also a second file has its own, and a changed one is another run."""
    for place, epsilon in ((folder, 0.1), (tmp_path / "other", 0.2)):
        module(
            place / "evil.py",
            "import json, netkf, numpy, midway\nclass P(midway.Base):\n    pass\n",
        )
        base = "from lowest import EPSILON\n\n\nclass Base(P):\n    own = EPSILON\n"
        module(place / "midway.py", PART + base)
        (place / "lowest.py").write_text(f"EPSILON = {epsilon}\n")
        for name in ("json", "netkf", "numpy"):  # are loaded already, from elsewhere
            (place / f"{name}.py").write_text("raise RuntimeError\n")
        first_file = scenario(place)
        first = netkf.load(first_file)
        assert first.filter.algorithm.own == epsilon
        assert set(find_module_files(first)) == {"evil", "midway", "lowest"}
    short = first.replace({"horizon": 1.0})
    out = netkf.save(netkf.simulate(short), short, tmp_path / "out")
    assert {"evil.py", "midway.py", "lowest.py"} <= {file.name for file in out.iterdir()}
    digest = scenario_digest(first)
    (tmp_path / "other" / "lowest.py").write_text("EPSILON = 0.3\n")
    # What a scenario was loaded with is its own; workers would import the new one.
    assert scenario_digest(first) == digest
    again = netkf.save(netkf.simulate(short), short, tmp_path / "again")
    assert (again / "lowest.py").read_text() == "EPSILON = 0.2\n"
    with pytest.raises(netkf.EngineError, match=r"lowest.py, which was edited since the scenario"):
        pack_scenario(first)
    assert scenario_digest(netkf.load(first_file)) != digest


SETTINGS = """from dataclasses import dataclass, field
from typing import Any

from netkf.parts import Hybrid


@dataclass(frozen=True, eq=False)
class P(Hybrid):
    given: Any = field(default=None, kw_only=True)
"""
GIVEN = """{ "odd key" = [1, [2.5, "x\\u007f"]], at = [07:32:00, 1979-05-27], b = { c = true } }"""


def test_settings_of_any_form_are_written_as_they_were_given(folder, tmp_path):
    module(folder / "evil.py", SETTINGS)
    path = scenario(folder, horizon=1.0)
    path.write_text(path.read_text().replace('"evil:P"', f'"evil:P"\ngiven = {GIVEN}'))
    loaded = netkf.load(path)

    def saved(algorithm, name):
        filtering = dataclasses.replace(loaded.filter, algorithm=algorithm)
        changed = dataclasses.replace(loaded, filter=filtering)
        out = netkf.save(netkf.simulate(changed), changed, tmp_path / name)
        return netkf.load(out / "scenario.toml").filter.algorithm

    first = loaded.filter.algorithm
    assert saved(first, "as given") == first
    for name, given, back in (
        ("number", np.float64(0.5), 0.5),
        ("tuple", (1, np.arange(2)), [1, [0, 1]]),
    ):
        assert saved(dataclasses.replace(first, given=given), name).given == back
    with pytest.raises(netkf.ScenarioError, match=r"scenario.toml: cannot hold P.given; got \{1\}"):
        saved(dataclasses.replace(first, given={1}), "set")


@pytest.mark.parametrize("edited", ["evil", "lowest"])
def test_a_module_that_was_edited_is_imported_anew(folder, edited):
    """A notebook went on with the classes of before, whose files the run directory has anew."""
    texts = {
        "evil": "from lowest import OWN\n\n\nclass P(Hybrid):\n    own = 1.0 * OWN\n",
        "lowest": "OWN = 2.0\n",
    }
    for name, text in texts.items():
        (folder / f"{name}.py").write_text("from netkf.parts import Hybrid\n" + text)
    file = scenario(folder)
    first, again = netkf.load(file), netkf.load(file)
    assert type(first.filter.algorithm) is type(again.filter.algorithm)
    changed = texts[edited].replace("1.0", "3.0").replace("2.0", "6.0")
    (folder / f"{edited}.py").write_text("from netkf.parts import Hybrid\n" + changed)
    assert netkf.load(file).filter.algorithm.own == 6.0
    # Also others that are made of the first have its class, not the one of that name by now.
    for same in (first, first.replace({"seed": 5}), again.replace({"filter": first.filter})):
        assert same.filter.algorithm.own == 2.0
    assert first.replace({"filter.kind": "evil:P"}).filter.algorithm.own == 6.0


@pytest.mark.parametrize("kind", ["evil:P", "evil.deep:P"])
def test_packages_in_the_folder_are_as_modules_there(folder, tmp_path, kind):
    """Edited inner modules were not seen, and a second folder got the package of the first."""
    text = "from netkf.parts import Hybrid\n\n\nclass P(Hybrid):\n    own = {}\n"
    for place, own in ((folder, 1.0), (tmp_path / "other", 2.0)):
        module(place / "evil" / "__init__.py", "from evil.deep import P\n")
        (place / "evil" / "deep.py").write_text(text.format(own))
        file = scenario(place, kind)
        assert netkf.load(file).filter.algorithm.own == own
    (place / "evil" / "deep.py").write_text(text.format(3.0))
    again = netkf.load(file)
    assert again.filter.algorithm.own == 3.0
    digest = scenario_digest(again)
    (place / "evil" / "deep.py").write_text(text.format(4.0))
    assert scenario_digest(again) == digest
    with pytest.raises(netkf.EngineError, match=r"deep.py, which was edited since the scenario"):
        pack_scenario(again)
    assert scenario_digest(netkf.load(file)) != digest
