"""Sphinx builds the documentation: sphinx-build -W --keep-going -q docs build/docs.

With ``-t check`` the pages have no links to the source.
"""

from __future__ import annotations

import inspect
import sys
from pathlib import Path
from typing import Any

from docutils.nodes import SkipNode
from latex2mathml.converter import convert
from sphinx.util.inspect import TypeAliasForwardRef, stringify_signature

from netkf import __version__, parts
from netkf.core.fields import Component
from netkf.scenario.schema import schema_page

sys.path.insert(0, str(Path(__file__).parent))

from docstrings import restructured

project = "netkf"
author = "The netkf developers"
copyright = "The netkf developers"
version = release = __version__
language = "en"
smartquotes = False

extensions = ["myst_parser", "sphinx.ext.autodoc"]
if not tags.has("check"):  # noqa: F821 -- pages of all source files are half of the work
    extensions.append("sphinx.ext.viewcode")
html_theme = "furo"
html_title = f"netkf {release}"
html_copy_source = False
html_static_path, html_css_files = ["_static"], ["code.css"]
html_math_renderer = "mathml"  # browsers draw it, without a script from the network

myst_enable_extensions = ["dollarmath", "amsmath"]
myst_heading_anchors = 3

nitpicky = True  # every reference resolves, but for what has no page of its own:
nitpick_ignore_regex = [
    # types of other packages, and aliases, as signatures show them
    (r"py:.*", r"(numpy|pd|pandas|networkx|collections|concurrent|pathlib|tuple\[).*"),
    (
        r"py:class",
        r"ndarray|ArrayLike|FloatArray|IntArray|Edge|Entry|Link|SourceFile|Executor|Path"
        r"|Progress|Coupling|StackedStates|Key|(Diffusion|Linear|Map|Rate)Change|Course|Fault"
        r"|Drawn|dict\[.*",
    ),
    # parts of the inside: states of filters, paths of sensors, base classes without public members
    (
        r"py:class",
        r"netkf\.(algorithms|core|linalg|rng|network|plants|engines|trace|scenario|figures)\..*",
    ),
    (
        r"py:class",
        r"netkf\.theory\..*|.*\.(ReplicaResult|PromisedTraces|Probe|Target|MessageKey|Quantity)"
        r"|.*\.(LogFit|Downtime|innovation_tests\.Law)",
    ),
]

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
autodoc_type_aliases = {"ArrayLike": "ArrayLike", "FloatArray": "ndarray", "IntArray": "ndarray"}

TypeAliasForwardRef.__repr__ = lambda self: self.name  # inside other types, and of properties
BLOCK = "overflow-x: auto; overflow-y: hidden; padding: 0.4em 0"


def readable_text(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Show docstrings, and for the class of a kind how a scenario file names it."""
    lines[:] = [*KIND_LINES.get(name, []), *restructured(lines)]


def named_settings(
    app: Any, what: str, name: str, obj: Any, options: Any, signature: Any, returned: Any
) -> tuple[str, Any] | None:
    """Show which settings a class takes, not that ``Component.__new__`` looks at any."""
    if what == "class" and issubclass(obj, Component):
        return stringify_signature(inspect.signature(obj), show_return_annotation=False), returned
    return None


TABLES = {
    "plant": "[plant]",
    "continuous plant": "[plant]",
    "input": "[plant.input]",
    "sensor": "[[sensors]]",
    "sampling": "sensors.sampling",
    "fault": "sensors.fault",
    "graph": "network.graph",
    "activation": "network.activation",
    "slot activation": "network.activation",
    "life": "[[network.lives]]",
    "loss": "network.channel.loss",
    "delay": "network.channel.delay",
    "filter": "[filter]",
    "slot filter": "[filter]",
}
"""The table of a scenario file that holds the keys of a family of classes."""


def kind_lines() -> dict[str, list[str]]:
    """Return for each class of ``netkf.parts`` a line with the keys that choose it in a file."""
    found: dict[str, list[str]] = {}
    for family, classes in parts.kinds().items():
        for kind, cls in classes.items():
            first, *further = kind.split()
            keys = [f'kind = "{first}"', *(key.replace("=", ' = "') + '"' for key in further)]
            text = f"``{', '.join(keys)}`` of ``{TABLES[family]}``"
            texts = found.setdefault(f"netkf.parts.{cls.__name__}", [])
            if text not in texts:
                texts.append(text)
    return {name: [f"In a scenario file {', '.join(texts)}.", ""] for name, texts in found.items()}


def inline_mathml(translator: Any, node: Any) -> None:
    """Write a formula in a line as MathML."""
    translator.body.append(convert(node.astext()))
    raise SkipNode


def block_mathml(translator: Any, node: Any) -> None:
    """Write a formula of its own as MathML; what is wider than the page scrolls."""
    formula = convert(node.astext().strip().rstrip("\\"), display="block")
    translator.body.append(f'<div class="math" style="{BLOCK}">{formula}</div>')
    raise SkipNode


def write_keys(app: Any) -> None:
    """Write the page of all keys, which `netkf schema --markdown` prints."""
    page = Path(__file__).with_name("keys.md")
    text = schema_page()
    if not page.exists() or page.read_text(encoding="utf-8") != text:
        page.write_text(text, encoding="utf-8")


KIND_LINES = kind_lines()


def setup(app: Any) -> None:
    """Connect the page of keys, and the reading of docstrings."""
    app.add_html_math_renderer("mathml", (inline_mathml, None), (block_mathml, None))
    app.connect("builder-inited", write_keys)
    app.connect("autodoc-process-docstring", readable_text)
    app.connect("autodoc-process-signature", named_settings)
