"""Sphinx builds the documentation: sphinx-build -W --keep-going -q docs build/docs."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from docutils.nodes import SkipNode
from latex2mathml.converter import convert

from netkf import __version__
from netkf.scenario.schema_page import schema_page

project = "netkf"
author = "The netkf developers"
copyright = "The netkf developers"
version = release = __version__
language = "en"
smartquotes = False

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.viewcode"]
html_theme = "furo"
html_title = f"netkf {release}"
html_copy_source = False
html_math_renderer = "mathml"  # browsers draw it, without a script from the network

myst_enable_extensions = ["dollarmath", "amsmath"]
myst_heading_anchors = 3

nitpicky = True  # every reference resolves, but for what has no page of its own:
nitpick_ignore_regex = [
    # types of other packages, and aliases, as signatures show them
    (r"py:.*", r"(numpy|pd|pandas|networkx|collections|concurrent|pathlib|tuple\[).*"),
    (
        r"py:class",
        r"ndarray|ArrayLike|FloatArray|IntArray|Edge|Entry|Executor|Path|Progress|dict\[.*",
    ),
    # parts of the inside: states of filters, paths of sensors, base classes without public members
    (r"py:class", r"netkf\.(algorithms|core|rng|network|plants|engines|trace|scenario)\..*"),
    (
        r"py:class",
        r"netkf\.theory\..*|.*\.(ReplicaResult|PromisedTraces|Probe|Target|MessageKey|Quantity)",
    ),
]

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_default_options = {"show-inheritance": True}
autodoc_preserve_defaults = True

CODE = re.compile(r"(``.+?``|`.+?`)", re.DOTALL)
MARKUP = re.compile(r"([\\*|_])")
ARRAY = re.compile(r"~?(?:numpy\.)?ndarray\[tuple\[.*?\], ~?(?:numpy\.)?dtype\[[^\]]*\]+")
ARRAY_LIKE = re.compile(r"_Buffer \| _SupportsArray.*?_NestedSequence\[complex \| bytes \| str\]")
BLOCK = "overflow-x: auto; overflow-y: hidden; padding: 0.4em 0"
INDENTED = re.compile(r"^(\s{4,})")


def literal_text(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Show docstrings as they are written: plain text with code between backticks.

    Matrices and bars of norms would else be read as reStructuredText; indented lines and lists
    are blocks of code.
    """
    lines[:] = [_literal(line) for line in _blocks(lines)]


def _literal(line: str) -> str:
    if INDENTED.match(line):
        return line
    parts = CODE.split(line)
    return "".join(
        f"``{part.strip('`')}``" if k % 2 else MARKUP.sub(r"\\\1", part)
        for k, part in enumerate(parts)
    )


def _blocks(lines: list[str]) -> list[str]:
    """The lines with a ``::`` before each indented block."""
    found: list[str] = []
    for line in lines:
        after_text = not found or not INDENTED.match(found[-1])
        if INDENTED.match(line) and after_text and (not found or found[-1] != "::"):
            found += ["", "::", ""]
        elif line.strip() and found and INDENTED.match(found[-1]) and not INDENTED.match(line):
            found.append("")
        found.append(line)
    return found


def short_types(
    app: Any, what: str, name: str, obj: Any, options: Any, signature: str, returns: str
) -> tuple[str, str]:
    """Write types of numpy as a reader would."""
    return tuple(
        text and ARRAY_LIKE.sub("ArrayLike", ARRAY.sub("ndarray", text))
        for text in (signature, returns)
    )


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


def setup(app: Any) -> None:
    """Connect the page of keys, and the reading of docstrings and signatures."""
    app.add_html_math_renderer("mathml", (inline_mathml, None), (block_mathml, None))
    app.connect("builder-inited", write_keys)
    app.connect("autodoc-process-signature", short_types)
    app.connect("autodoc-process-docstring", literal_text)
