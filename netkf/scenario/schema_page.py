"""The reference page of all keys of scenario files (Markdown), built from their schema."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from netkf.core.fields import Component
from netkf.scenario.registry import KINDS
from netkf.scenario.schema import TABLES, TableKey, list_keys, summary
from netkf.scenario.writing import part_as_table, toml_text

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
    if isinstance(key.default, (int, float)):
        return f"{key.default:g}"
    return "none"
