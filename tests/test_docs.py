"""The reference in docs/ says what there is, and its snippets do what they say."""

import dataclasses
import re
import tomllib

import pytest

import netkf
from netkf.cli.main import make_parser
from netkf.scenario.model import Belief
from netkf.scenario.reading import from_table
from netkf.scenario.registry import KINDS
from netkf.scenario.scenario import Scenario
from netkf.trace.schema import EVENT_COLUMNS
from tests.conftest import ROOT, SCENARIOS

TEXT = (ROOT / "docs" / "scenario_files.md").read_text(encoding="utf-8")
HEADINGS = {
    "plant": "plant.kind",
    "input": "plant.input.kind",
    "sensor": "sensors.kind",
    "sampling": "sensors.sampling.kind",
    "fault": "sensors.fault.kind",
    "graph": "network.graph.kind",
    "activation": "network.activation.kind in continuous time",
    "life": "network.lives.kind",
    "loss": "network.channel.loss.kind",
    "delay": "network.channel.delay.kind",
    "filter": "filter.kind",
    "slot activation": "network.activation.kind in slots",
}
OF_NETWORKS = {"at", "rates"}  # keys of clocks that mean nothing for a sensor


def section(heading):
    _, found, rest = TEXT.partition(f"### {heading}\n")
    assert found, f"docs/scenario_files.md has no section {heading}"
    return re.split(r"^##", rest, flags=re.MULTILINE)[0]


def rows(family):
    """The rows of the table of a family by the names of registry.KINDS, which say the key and its
    value where several classes share a kind.
    """
    start = re.compile(r'^\| `([^`]+)`(?: with `(\w+) = "([^"]+)"`)?')
    found = filter(None, map(start.match, section(HEADINGS[family]).splitlines()))
    return {one[1] + (f" {one[2]}={one[3]}" if one[2] else ""): one.string for one in found}


def described():
    for family in HEADINGS:
        for kind, cls in KINDS[family].items():
            yield pytest.param(family, kind, cls, id=f"{family}-{kind}")


@pytest.mark.parametrize(("family", "kind", "cls"), list(described()))
def test_every_kind_and_key_is_described(family, kind, cls):
    row = rows(family)[kind]
    keys = {field.name for field in dataclasses.fields(cls) if field.init}
    for key in keys - (OF_NETWORKS if family == "sampling" else set()):
        assert f"`{key}`" in row, f"the row of {kind} does not mention {key}"


def test_every_family_has_a_section():
    assert set(KINDS) - {"slot filter", "continuous plant"} == set(HEADINGS)
    assert KINDS["slot filter"].items() <= KINDS["filter"].items()
    assert KINDS["continuous plant"].keys() <= KINDS["plant"].keys()


def test_no_kind_is_described_that_does_not_exist():
    for family in HEADINGS:
        assert sorted(rows(family)) == sorted(KINDS[family])


def test_shared_keys_columns_options_and_names_are_mentioned():
    options = {o for a in make_parser()._actions for o in a.option_strings if o.startswith("--")}
    commands = make_parser()._subparsers._group_actions[0].choices
    for name, command in commands.items():
        assert f"netkf {name}" in TEXT
        options |= {o for a in command._actions for o in a.option_strings if o.startswith("--")}
    for option in options - {"--help", "--version"}:
        assert option in TEXT, option
    keys = [f.name for cls in (Scenario, Belief) for f in dataclasses.fields(cls) if f.init]
    for word in (*keys, *EVENT_COLUMNS):
        assert f"`{word}`" in TEXT, word
    for name in netkf.__all__:
        assert name in TEXT, name


def test_the_example_file_is_a_scenario(tmp_path):
    example = re.search(r"```toml\n(.*?)```", TEXT, flags=re.DOTALL)[1]
    tomllib.loads(example)
    (tmp_path / "example.toml").write_text(example)
    assert netkf.load(tmp_path / "example.toml").filter.algorithm.epsilon == 0.3


CSV = {
    "samples": "t,node\n0.5,0\n1.5,0\n",
    "ticks": "t,node,peer\n0.5,0,1\n0.7,1,0\n",
    "lost": "sender,receiver,message,delivered\n0,1,0,1\n1,0,0,1\n",
    "delays": "sender,receiver,message,seconds\n0,1,0,0.1\n1,0,0,0.2\n",
    "readings": "t,node,y0\n0.4,0,1.0\n0.9,1,0.5\n",
}


def test_the_examples_in_continuous_time_run(tmp_path):
    first, *parts = re.findall(r"```toml\n(.*?)```", TEXT, flags=re.DOTALL)
    assert len(parts) == 7
    for name, text in CSV.items():
        (tmp_path / f"{name}.csv").write_text(text)
    at, kinds = set(), set()
    for part in parts:
        table = tomllib.loads(first) | tomllib.loads(part)
        if "plants" in table:
            del table["plant"]
        scenario = from_table(table, tmp_path)
        run = netkf.simulate(scenario, engine="simpy")
        assert run.status == "complete"
        assert {"sense", "deliver"} <= set(run.events.kind)
        at.add(scenario.network.activation.at)
        kinds |= {type(getattr(s, "sampling", None)).__name__ for s in scenario.sensors}
    assert at == {"links", "directions", "nodes", "readings"}
    assert {"Poisson", "Renewal", "Periodic", "RecordedSampling"} <= kinds


def test_the_snippets_run(tmp_path, monkeypatch):
    snippets = re.findall(r"```python\n(.*?)```", TEXT, flags=re.DOTALL)
    snippets = [s for s in snippets if "import pytest" not in s]  # run by tests/testing
    assert len(snippets) == 2
    (tmp_path / "scenarios").symlink_to(SCENARIOS)
    monkeypatch.chdir(tmp_path)
    for snippet in snippets:
        exec(compile(snippet, "docs/scenario_files.md", "exec"), {})
    assert len((tmp_path / "replay" / "lost.csv").read_text().splitlines()) > 100
    assert (tmp_path / "slower" / "summary.json").exists()


@pytest.mark.parametrize(("family", "kind", "cls"), list(described()))
def test_the_class_of_a_kind_is_named_like_it_or_stands_beside_it(family, kind, cls):
    guessed = "".join(word.capitalize() for word in kind.partition(" ")[0].split("-"))
    assert cls.__name__ == guessed or f"`{cls.__name__}`" in rows(family)[kind].partition(")")[0]
