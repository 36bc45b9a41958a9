"""The JSON Schema of scenario files accepts what netkf does, and refuses wrong keys and kinds."""

import copy
import json
import re
import tomllib

import jsonschema
import pytest

import netkf
from netkf.cli.main import main
from netkf.core.errors import ScenarioError
from netkf.core.fields import setting
from netkf.parts import number
from netkf.scenario.reading import from_table
from netkf.scenario.registry import KINDS
from netkf.scenario.schema import describe_field, list_keys, scenario_schema
from netkf.scenario.writing import as_table
from tests.conftest import ROOT, SCENARIOS, scenario_files

PAGES = (ROOT / "docs" / "scenario_files.md", ROOT / "docs" / "writing_filters.md")


@pytest.fixture(scope="module")
def validator():
    schema = scenario_schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    assert schema == json.loads(json.dumps(schema))
    return jsonschema.Draft202012Validator(schema)


@pytest.mark.one_in(3)
@pytest.mark.parametrize("path", scenario_files(), ids=lambda path: path.stem)
def test_shipped_scenarios_are_valid_as_written_and_with_every_default(validator, path):
    validator.validate(tomllib.loads(path.read_text(encoding="utf-8")))
    resolved = as_table(netkf.load(path))
    validator.validate(json.loads(json.dumps(resolved, default=plain)))


def plain(value):
    """What TOML would hold in place of arrays and files."""
    return value.tolist() if hasattr(value, "tolist") else value.name


def test_scenarios_of_the_documentation_are_valid(validator):
    found = [
        tomllib.loads(block)
        for page in PAGES
        for block in re.findall(r"```toml\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    ]
    whole = [table for table in found if "format" in table]
    assert whole
    for table in whole:
        validator.validate(table)
        for other in found:  # each of the others replaces a part of the first example
            replaced = {**whole[0], **{k: v for k, v in other.items() if k in whole[0]}}
            if "format" not in other and accepted(replaced):
                validator.validate(replaced)


def accepted(table):
    try:
        from_table(table, SCENARIOS)
    except ScenarioError:
        return False
    return True


FLOW = tomllib.loads((SCENARIOS / "poisson_ring.toml").read_text(encoding="utf-8"))
SLOTS = tomllib.loads((SCENARIOS / "gossip_ring.toml").read_text(encoding="utf-8"))
WRONG = [
    (FLOW, "format", 2),
    (FLOW, "horizon", -1.0),
    (FLOW, "horizon", "long"),
    (FLOW, "sede", 3),
    (FLOW, "plant.kind", "difusion"),
    (FLOW, "plant.A", [1.0, 2.0]),
    (FLOW, "plant.C", [[1.0]]),
    (FLOW, "sensors", {"nodes": [0]}),
    (FLOW, "sensors.0.R", 0.25),
    (FLOW, "sensors.0.sampling", {"kind": "poisson", "period": 0.1}),
    (FLOW, "network.graph.kind", "ring"),
    (FLOW, "network.graph.nodes", 2.5),
    (FLOW, "network.activation.rate", 0.0),
    (FLOW, "network.activation", {"kind": "broadcast"}),
    (FLOW, "network.channel.loss.delivery", 1.5),
    (FLOW, "network.channel.loss", {"kind": "bernoulli"}),
    (FLOW, "network.channel.symmetric", "yes"),
    (FLOW, "filter.epsilon", 0.0),
    (FLOW, "filter", {"kind": "icf"}),
    (SLOTS, "filter", {"kind": "hybrid", "epsilon": 0.3}),
    (SLOTS, "network.activation", {"kind": "poisson", "rate": 1.0}),
    (SLOTS, "network.activation.protocol", "both"),
]


@pytest.mark.parametrize(("table", "key", "value"), WRONG, ids=str)
def test_what_the_loader_refuses_by_key_kind_or_range_is_not_valid(validator, table, key, value):
    changed = copy.deepcopy(table)
    *path, last = [int(k) if k.isdecimal() else k for k in key.split(".")]
    inner = changed
    for step in path:
        inner = inner[step]
    inner[last] = value
    assert not accepted(changed)
    assert not validator.is_valid(changed)


@pytest.mark.parametrize("key", ["format", "horizon", "plant", "network", "filter"])
def test_a_missing_key_is_not_valid(validator, key):
    assert not validator.is_valid({k: v for k, v in FLOW.items() if k != key})


def test_classes_of_users_are_valid_kinds(validator):
    table = copy.deepcopy(FLOW)
    table["filter"] = {"kind": "mymodule:MyFilter", "weight": 3}
    validator.validate(table)
    table["filter"]["kind"] = "my module:MyFilter"
    assert not validator.is_valid(table)


def test_rules_of_users_have_a_schema():
    from dataclasses import dataclass

    @dataclass(frozen=True, eq=False)
    class Lossy(netkf.parts.Loss):
        """Losses of a link whose ``decay`` is given."""

        decay: float = setting(number(above=0.0, high=2.0), default=1.0)

        def delivery_probability(self, sent):
            """Return it."""
            return 0.5

    (key,) = list_keys(Lossy)
    assert key.schema == {"type": "number", "exclusiveMinimum": 0.0, "maximum": 2.0}
    assert key.description == "Losses of a link whose `decay` is given."
    assert (key.required, key.default) == (False, 1.0)


def test_descriptions_come_from_the_docstrings():
    text = "What it is.\n\nlate    how: one\n        or two\nwindow  seconds\n\nUses `p` and `q`."
    assert describe_field(text, "late") == "how: one or two."
    assert describe_field(text, "q") == "Uses `p` and `q`."
    assert not describe_field(text, "r")
    described = [
        key for table in KINDS.values() for cls in table.values() for key in list_keys(cls)
    ]
    assert sum(bool(key.description) for key in described) > 0.5 * len(described)


def test_the_command_prints_the_schema_or_the_page(validator, capsys):
    assert main(["schema"]) == 0
    assert json.loads(capsys.readouterr().out) == validator.schema
    assert main(["schema", "--markdown"]) == 0
    page = capsys.readouterr().out
    for family, kinds in KINDS.items():
        for kind, cls in kinds.items() if family != "slot filter" else ():
            _, found, rest = page.partition(f"\n### {kind}\n")
            assert found, kind
            for key in list_keys(cls):
                assert f"\n| `{key.name}` |" in rest
