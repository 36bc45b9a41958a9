"""A JSON Schema of scenario files, made of the dataclasses and the rules of their fields.

It is for editors: it knows keys, kinds, types and ranges. What only the scenario as a whole can
tell (shapes, positive definiteness, nodes that exist, files) is checked when it is loaded.
"""

from __future__ import annotations

import dataclasses
import inspect
import re
from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

from netkf.algorithms.filter import Filter
from netkf.algorithms.registry import split_choice
from netkf.core.fields import Component, Rule
from netkf.network.channels import Channel
from netkf.scenario.model import Belief, Filtering, Network, ScenarioModel
from netkf.scenario.registry import KINDS, list_kinds
from netkf.scenario.scenario import Scenario
from netkf.scenario.tables import FORMAT

Schema = dict[str, Any]
DIALECT = "https://json-schema.org/draft/2020-12/schema"
CUSTOM = "^[A-Za-z_][\\w.]*:[A-Za-z_]\\w*$"
"""Pattern of a kind that is a class of the user."""
OPTIONAL_KIND = {"sensor": "linear"}
"""Kinds that are meant where a table of the family names none."""
OWN_TABLES: dict[tuple[type[Component], str], Schema] = {
    (ScenarioModel, "plant"): {"$ref": "#/$defs/plant"},
    (ScenarioModel, "sensors"): {"type": "array", "items": {"$ref": "#/$defs/sensor"}},
    (ScenarioModel, "network"): {"$ref": "#/$defs/network"},
    (ScenarioModel, "filter"): {"$ref": "#/$defs/filter"},
    (Network, "graph"): {"$ref": "#/$defs/graph"},
    (Network, "activation"): {"$ref": "#/$defs/activation"},
    (Network, "channel"): {"$ref": "#/$defs/channel"},
    (Channel, "loss"): {"$ref": "#/$defs/loss"},
    (Channel, "delay"): {"$ref": "#/$defs/delay"},
    (Filtering, "model"): {"$ref": "#/$defs/model"},
    (Filter, "inner"): {"$ref": "#/$defs/filter"},
}
"""Keys whose values are tables with kinds of their own, or with keys of another class."""
SAMPLING: Schema = {"anyOf": [{"const": "continuous"}, {"$ref": "#/$defs/sampling"}]}
FAMILIES = {
    "plant": ("plant", "continuous plant"),
    "sensor": ("sensor",),
    "sampling": ("sampling",),
    "graph": ("graph",),
    "activation": ("activation", "slot activation"),
    "loss": ("loss",),
    "delay": ("delay",),
    "filter": ("filter",),
}
"""The families of registry.KINDS that one table of a file can be of."""


class KeyOf(NamedTuple):
    """A key of a table: its ``name``, the ``schema`` of its value, the text of its ``rule`` and the
    ``description`` of its class; ``required`` if it has no default.
    """

    name: str
    schema: Schema
    rule: str
    description: str
    required: bool
    default: Any = None


def scenario_schema() -> Schema:
    """Return the JSON Schema (draft 2020-12) of scenario files."""
    keys = keys_of(Scenario)
    whole = _table_schema(
        keys, first={"format": {"const": FORMAT, "description": "The file format."}}
    )
    whole["required"] = ["format", *(name for name in whole["required"] if name != "sensors")]
    families = {name: _family_schema(name, parts) for name, parts in FAMILIES.items()}
    tables = {
        "network": _table_schema(keys_of(Network)),
        "channel": _table_schema(keys_of(Channel)),
        "model": _table_schema(keys_of(Belief)),
    }
    return {
        "$schema": DIALECT,
        "title": "netkf scenario",
        "description": summary(Scenario),
        **whole,
        "allOf": _kinds_of_time(),
        "$defs": {**families, **tables},
    }


def keys_of(cls: type[Component]) -> list[KeyOf]:
    """Return the keys of a table that is read as an object of this class."""
    text = documentation(cls)
    keys = []
    for field in dataclasses.fields(cls):
        if not field.init:
            continue
        rule: Rule | None = field.metadata.get("rule")
        own = _own_table(cls, field.name)
        schema = own or ({} if rule is None else dict(rule.schema))
        required = field.default is dataclasses.MISSING
        default = None if required else field.default
        requirement = "a table" if own else ""
        if rule is not None and not own:
            requirement = rule.requirement.removeprefix("must be ")
        description = describe(text, field.name)
        keys.append(KeyOf(field.name, schema, requirement, description, required, default))
    return keys


def _own_table(cls: type[Component], name: str) -> Schema | None:
    """Return the schema of a key that is a table of its own, None for other keys."""
    if name == "sampling":
        return SAMPLING
    return next((s for (c, n), s in OWN_TABLES.items() if issubclass(cls, c) and n == name), None)


def _table_schema(
    keys: Sequence[KeyOf], first: Mapping[str, Schema] = MappingProxyType({})
) -> Schema:
    """Return the schema of a table with these keys and no others."""
    return {
        "type": "object",
        "properties": {**first, **{key.name: _key_schema(key) for key in keys}},
        "required": [key.name for key in keys if key.required],
        "additionalProperties": False,
    }


def _key_schema(key: KeyOf) -> Schema:
    """Return the schema of the value of a key, with its description and its default."""
    known = key.rule and key.rule != "a table"
    sentences = [key.description, f"Must be {key.rule}." if known else ""]
    found = {**key.schema, "description": " ".join(filter(None, sentences))}
    if not found["description"]:
        del found["description"]
    if isinstance(key.default, (bool, int, float, str)):
        found["default"] = key.default
    return found


def _family_schema(name: str, parts: Sequence[str]) -> Schema:
    """Return the schema of a table whose ``kind`` says which keys it has."""
    shared = [key for key in keys_of(Filtering) if key.name != "algorithm"]
    shared = shared if name == "filter" else []
    variants = [
        _kind_schema(kind, cls, shared, OPTIONAL_KIND.get(name) == kind)
        for part in parts
        for kind, cls in KINDS[part].items()
    ]
    custom = {"type": "string", "pattern": CUSTOM, "description": "A class, package.module:Class."}
    own = {"type": "object", "properties": {"kind": custom}, "required": ["kind"]}
    return {"anyOf": [*variants, {"title": "a class of your own", **own}]}


def _kind_schema(
    kind: str, cls: type[Component], shared: Sequence[KeyOf], optional: bool
) -> Schema:
    """Return the schema of one kind of a family."""
    name, choice = split_choice(kind)
    first = {key: {"const": value} for key, value in {"kind": name, **choice}.items()}
    found = _table_schema([*keys_of(cls), *shared], first=first)
    if not optional:
        found["required"] = [*first, *found["required"]]
    return {"title": kind, "description": summary(cls), **found}


def _kinds_of_time() -> list[Schema]:
    """Return the rules that bind activations and filters to the kind of time of the plant."""
    recorded = {"enum": ["recorded", "unknown"]}

    def plant(kind: Schema, *keys: str) -> Schema:
        """Return the schema of scenarios whose plant is of this kind and has these keys."""
        has = {"properties": {"kind": kind}, "required": ["kind", *keys]}
        return {"properties": {"plant": has}, "required": ["plant"]}

    def then(activations: str, filters: Sequence[str]) -> Schema:
        """Return the schema that limits activation and filter to these kinds."""
        limits = {"activation": _kind_among(list_kinds(activations))}
        network = {"type": "object", "properties": limits}
        return {"properties": {"network": network, "filter": _kind_among(filters)}}

    slots = {"anyOf": [plant({"const": "linear"}), plant(recorded, "F")]}
    flow = {"anyOf": [plant({"const": "diffusion"}), plant(recorded, "A")]}
    clocked = {
        split_choice(name)[0]: None
        for name, cls in KINDS["filter"].items()
        if getattr(cls, "clocks", ()) or not getattr(cls, "talks", True)
    }
    return [
        {"if": slots, "then": then("slot activation", list_kinds("slot filter"))},
        {"if": flow, "then": then("activation", [*clocked])},
    ]


def _kind_among(kinds: Sequence[str]) -> Schema:
    """Return the schema of a table whose kind is one of these or a user's class."""
    kind = {"anyOf": [{"enum": [*kinds]}, {"type": "string", "pattern": CUSTOM}]}
    return {"type": "object", "properties": {"kind": kind}}


def documentation(cls: type) -> str:
    """Return the docstring of a class, plain text."""
    return inspect.cleandoc(cls.__doc__ or "").replace("``", "`")


def summary(cls: type) -> str:
    """Return the first paragraph of the docstring of a class as one line."""
    return " ".join(documentation(cls).split("\n\n")[0].split())


def describe(text: str, name: str) -> str:
    """Return what a docstring says about a field: its entry in a list of fields, or the sentences
    that name it.
    """
    entry = re.search(rf"^{re.escape(name)}  +(.+(?:\n +.*)*)", text, flags=re.MULTILINE)
    if entry:
        return _sentence(entry.group(1))
    found = [sentence for sentence in _sentences(text) if f"`{name}`" in sentence]
    return " ".join(found)


def _sentences(text: str) -> Iterator[str]:
    """Yield the sentences of a docstring."""
    for paragraph in text.split("\n\n"):
        yield from re.split(r"(?<=[.:])\s+(?=[A-Z`])", " ".join(paragraph.split()))


def _sentence(text: str) -> str:
    """Return the text on one line with a full stop."""
    plain = " ".join(text.split())
    return plain if plain.endswith(".") else f"{plain}."
