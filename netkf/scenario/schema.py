"""A JSON Schema of scenario files, and the page of all keys, built from dataclasses and rules.

It is for editors: it covers keys, kinds, types and ranges. Shapes of matrices, positive
definiteness, ids of nodes and files are only checked when a scenario is loaded.
"""

from __future__ import annotations

import dataclasses
import inspect
import re
from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

from netkf.algorithms.filter import Filter
from netkf.algorithms.gates import Gate
from netkf.algorithms.registry import default_timing, split_choice
from netkf.core.fields import Component, Rule
from netkf.network.channels import Channel
from netkf.network.contacts import Contacts
from netkf.network.node_clocks import NodeClock
from netkf.network.quantise import Quantisation
from netkf.network.radio import Energy, Radio
from netkf.network.scheduled import Hopping
from netkf.plants.blocks import Block
from netkf.plants.diffusion import Diffusion
from netkf.plants.linear import LinearPlant
from netkf.plants.maps import NonlinearPlant
from netkf.plants.plant import Plant
from netkf.plants.sensors import Sensor
from netkf.scenario.model import Belief, Filtering, Metrics, Network, ScenarioModel
from netkf.scenario.plugins import offered_kinds
from netkf.scenario.registry import KINDS, list_kinds
from netkf.scenario.scenario import Scenario
from netkf.scenario.tables import FORMAT
from netkf.scenario.time_grid import Time
from netkf.scenario.writing import part_as_table, toml_text

Schema = dict[str, Any]
DIALECT = "https://json-schema.org/draft/2020-12/schema"
USER_CLASS = "^[A-Za-z_][\\w.]*:[A-Za-z_]\\w*$"
"""Pattern of a kind that is a user's class, "package.module:Class"."""
DEFAULT_KINDS = {"sensor": "linear"}
"""The kind of a table without the key ``kind``, by family; other families need the key."""
TABLES: dict[str, type[Component]] = {
    "": Scenario,
    "plants": Block,
    "time": Time,
    "network": Network,
    "network.channel": Channel,
    "network.channel.channels": Hopping,
    "network.clocks": NodeClock,
    "network.radio": Radio,
    "network.quantise": Quantisation,
    "network.energy": Energy,
    "filter": Filtering,
    "filter.model": Belief,
    "filter.gate": Gate,
    "metrics": Metrics,
}
"""Classes of the tables without a kind, or beside whose keys a kind stands, by key path."""
KIND_TABLES: dict[tuple[type[Component], str], str] = {
    (ScenarioModel, "plant"): "plant",
    (ScenarioModel, "sensors"): "sensor",
    (Plant, "input"): "input",
    (Sensor, "fault"): "fault",
    (Network, "graph"): "graph",
    (Network, "activation"): "activation",
    (Network, "lives"): "life",
    (Channel, "loss"): "loss",
    (Channel, "delay"): "delay",
    (Filter, "inner"): "filter",
    (Contacts, "clock"): "activation",
}
"""The families of tables with a kind, by class and key."""
LISTS = ("plants", "sensors", "lives", "clocks")
"""Keys of lists of tables."""
SAMPLING: Schema = {"anyOf": [{"const": "continuous"}, {"$ref": "#/$defs/sampling"}]}
FAMILIES = {
    name: tuple(f for f in KINDS if f.rpartition(" ")[2] == name and f != "slot filter")
    for name in KINDS
    if " " not in name
}
"""The families of registry.KINDS that a table can belong to, by its name in ``$defs``."""


class TableKey(NamedTuple):
    """A key of a table in a scenario file.

    name        the key
    schema      JSON Schema of its value
    rule        what its value must be, as text; "" if anything
    description sentences of the docstring of its class; "" if there are none
    required    True if it has no default
    default     its default, None if it has none
    """

    name: str
    schema: Schema
    rule: str
    description: str
    required: bool
    default: Any = None


def scenario_schema() -> Schema:
    """Return the JSON Schema (draft 2020-12) of scenario files."""
    scenario_keys = list_keys(Scenario)
    file_format = {"const": FORMAT, "description": "The file format."}
    file_schema = _table_schema(scenario_keys, constants={"format": file_format})
    # A scenario without sensors may leave out the list.
    required = [name for name in file_schema["required"] if name not in ("plant", "sensors")]
    file_schema["oneOf"] = [{"required": ["plant"]}, {"required": ["plants"]}]
    file_schema["required"] = ["format", *required]
    definitions = {name: _family_schema(name, families) for name, families in FAMILIES.items()}
    definitions["plants"] = _block_schema()
    for path, cls in TABLES.items():
        name = path.rpartition(".")[2]
        definitions.setdefault(name, _table_schema(list_keys(cls)))
    del definitions[""]
    return {
        "$schema": DIALECT,
        "title": "netkf scenario",
        "description": summary(Scenario),
        **file_schema,
        "allOf": _time_model_rules(),
        "$defs": definitions,
    }


def list_keys(cls: type[Component]) -> list[TableKey]:
    """Return the keys of a table that is read as an object of this class."""
    docstring = plain_docstring(cls)
    keys = []
    for field in dataclasses.fields(cls):
        if not field.init:
            continue
        rule: Rule | None = field.metadata.get("rule")
        schema = _nested_table_schema(cls, field.name)
        requirement = "a table"
        if schema is None:
            schema = {} if rule is None else dict(rule.schema)
            requirement = "" if rule is None else rule.requirement.removeprefix("must be ")
        required = field.default is dataclasses.MISSING
        default = None if required else field.default
        description = describe_field(docstring, field.name)
        keys.append(TableKey(field.name, schema, requirement, description, required, default))
    return keys


def _nested_table_schema(cls: type[Component], key: str) -> Schema | None:
    if key == "sampling":
        return SAMPLING
    plain = {(TABLES[path.rpartition(".")[0]], path.rpartition(".")[2]) for path in TABLES if path}
    names = KIND_TABLES | {(owner, name): name for owner, name in plain}
    for (owner, name), definition in names.items():
        if issubclass(cls, owner) and name == key:
            table = {"$ref": f"#/$defs/{definition}"}
            return {"type": "array", "items": table} if key in LISTS else table
    return None


def _table_schema(
    keys: Sequence[TableKey], constants: Mapping[str, Schema] = MappingProxyType({})
) -> Schema:
    return {
        "type": "object",
        "properties": {**constants, **{key.name: _value_schema(key) for key in keys}},
        "required": [key.name for key in keys if key.required],
        "additionalProperties": False,
    }


def _value_schema(key: TableKey) -> Schema:
    has_rule = key.rule and key.rule != "a table"
    sentences = [key.description, f"Must be {key.rule}." if has_rule else ""]
    schema = dict(key.schema)
    if any(sentences):
        schema["description"] = " ".join(filter(None, sentences))
    if isinstance(key.default, (bool, int, float, str)):
        schema["default"] = key.default
    return schema


def _family_schema(name: str, families: Sequence[str]) -> Schema:
    shared_keys: list[TableKey] = []
    if name == "filter":  # the table also has the initial estimate and the model
        shared_keys = [key for key in list_keys(Filtering) if key.name != "algorithm"]
    variants = [
        _kind_schema(kind, cls, shared_keys, is_default=DEFAULT_KINDS.get(name) == kind)
        for family in families
        for kind, cls in KINDS[family].items()
    ]
    description = "A class, package.module:Class."
    kind_schema = {"type": "string", "pattern": _user_kinds(), "description": description}
    user_class = {"type": "object", "properties": {"kind": kind_schema}, "required": ["kind"]}
    return {"anyOf": [*variants, {"title": "a custom class", **user_class}]}


def _block_schema() -> Schema:
    own = [key for key in list_keys(Block) if key.name != "plant"]
    plants: list[type[Component]] = [Diffusion, LinearPlant, NonlinearPlant]
    names = {cls: name for name, cls in KINDS["plant"].items()}
    return {"anyOf": [_kind_schema(names[cls], cls, own, is_default=True) for cls in plants]}


def _kind_schema(
    name: str, cls: type[Component], shared_keys: Sequence[TableKey], is_default: bool
) -> Schema:
    kind, choice = split_choice(name)
    constants = {key: {"const": value} for key, value in {"kind": kind, **choice}.items()}
    schema = _table_schema([*list_keys(cls), *shared_keys], constants=constants)
    if not is_default:
        schema["required"] = [*constants, *schema["required"]]
    return {"title": name, "description": summary(cls), **schema}


def _time_model_rules() -> list[Schema]:
    """Return two if-then schemas: the plant's time limits the kinds of activation and filter."""
    # Plants of these kinds are in slots if they have F, and in continuous time if they have A.
    recorded = {"enum": ["recorded", "unknown"]}

    def plant_schema(kind: Schema, *keys: str) -> Schema:
        plant = {"properties": {"kind": kind}, "required": ["kind", *keys]}
        return {"properties": {"plant": plant}, "required": ["plant"]}

    def limit_kinds(activations: Sequence[str], filters: Sequence[str]) -> Schema:
        network = {"type": "object", "properties": {"activation": _component_schema(activations)}}
        return {"properties": {"network": network, "filter": _component_schema(filters)}}

    in_slots = {"anyOf": [plant_schema({"const": "linear"}), plant_schema(recorded, "F")]}
    continuous = {"anyOf": [plant_schema({"const": "diffusion"}), plant_schema(recorded, "A")]}
    clocked_filters = dict.fromkeys(
        split_choice(name)[0]
        for name, cls in KINDS["filter"].items()
        for timing in [default_timing(cls)]
        if timing is not None and (timing.clocks or not timing.talks)
    )
    slot_limits = limit_kinds(list_kinds("slot activation"), list_kinds("slot filter"))
    clock_limits = limit_kinds(list_kinds("activation"), [*clocked_filters])
    return [{"if": in_slots, "then": slot_limits}, {"if": continuous, "then": clock_limits}]


def _component_schema(kinds: Sequence[str]) -> Schema:
    kind = {"anyOf": [{"enum": [*kinds]}, {"type": "string", "pattern": _user_kinds()}]}
    return {"type": "object", "properties": {"kind": kind}}


def _user_kinds() -> str:
    offered = (f"^{re.escape(kind)}$".replace("\\-", "-") for kind in offered_kinds())
    return "|".join([USER_CLASS, *offered])


def plain_docstring(cls: type) -> str:
    """Return the docstring of a class without indentation, `code` in single backquotes."""
    return inspect.cleandoc(cls.__doc__ or "").replace("``", "`")


def summary(cls: type) -> str:
    """Return the first paragraph of the docstring of a class as one line."""
    return " ".join(plain_docstring(cls).split("\n\n")[0].split())


def describe_field(docstring: str, name: str) -> str:
    """Return the entry ``name  description`` of a docstring, or all sentences with `name`."""
    entry = re.search(rf"^{re.escape(name)}  +(.+(?:\n +.*)*)", docstring, flags=re.MULTILINE)
    if entry:
        line = " ".join(entry.group(1).split())
        return line if line.endswith(".") else f"{line}."
    paragraphs = (" ".join(paragraph.split()) for paragraph in docstring.split("\n\n"))
    # A colon may end a sentence too.
    sentences = (s for p in paragraphs for s in re.split(r"(?<=[.:])\s+(?=[A-Z`])", p))
    return " ".join(sentence for sentence in sentences if f"`{name}`" in sentence)


HEADINGS = {
    "": "The file",
    "plants": "plants, beside the keys of its plant",
    "filter": "filter, beside its kind",
}
"""Headings of tables without a kind whose key paths do not say all."""
SECTIONS = {
    "plant": "plant.kind",
    "continuous plant": "plant.kind in continuous time, with A and B",
    "input": "plant.input.kind",
    "sensor": "sensors.kind",
    "sampling": "sensors.sampling.kind",
    "fault": "sensors.fault.kind",
    "graph": "network.graph.kind",
    "activation": "network.activation.kind in continuous time",
    "slot activation": "network.activation.kind in slots",
    "life": "network.lives.kind",
    "loss": "network.channel.loss.kind",
    "delay": "network.channel.delay.kind",
    "filter": "filter.kind",
}
"""Headings of the tables with a kind, by their families in registry.KINDS."""


def schema_page() -> str:
    """Return the page as Markdown: a section for each table, with its kinds and their keys."""
    return "\n".join(_iterate_page_lines())


def _iterate_page_lines() -> Iterator[str]:
    yield "# Keys of scenario files"
    yield ""
    yield "`netkf schema --markdown` prints this page. Keys whose default is a dash must be given."
    for path, cls in TABLES.items():
        # Keys of these fields stand beside those of the table.
        inner = {"filter": "algorithm", "plants": "plant"}.get(path)
        keys = [key for key in list_keys(cls) if key.name != inner]
        yield from ("", f"## {HEADINGS.get(path, path)}", "", summary(cls), "")
        yield from _iterate_table_lines(keys)
    for family, heading in SECTIONS.items():
        yield from ("", f"## {heading}")
        for kind, cls in KINDS[family].items():
            yield from ("", f"### {kind}", "", summary(cls))
            keys = list_keys(cls)
            if keys:
                yield ""
                yield from _iterate_table_lines(keys)
    yield ""


def _iterate_table_lines(keys: Sequence[TableKey]) -> Iterator[str]:
    yield "| key | value | default | |"
    yield "|---|---|---|---|"
    for key in keys:
        cells = [f"`{key.name}`", key.rule, _format_default(key), key.description]
        escaped = [cell.replace("|", "\\|") for cell in cells]
        yield f"| {' | '.join(escaped)} |"


def _format_default(key: TableKey) -> str:
    """Return the default of a key as text: "-" if it must be given, "none" if it may be absent."""
    if key.required:
        return "-"
    if isinstance(key.default, Component):
        return f"`{toml_text(part_as_table(key.default))}`"
    if isinstance(key.default, bool):
        return str(key.default).lower()
    if isinstance(key.default, str):
        return f'"{key.default}"' if key.default else "none"
    return f"{key.default:g}" if isinstance(key.default, (int, float)) else "none"
