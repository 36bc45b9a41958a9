"""Pages of the API: every public name stands on one page, and prose is not shown as code."""

import importlib
import importlib.util
import inspect
import re
from types import SimpleNamespace

import pytest

import netkf
from tests.documents import DOCS

API = DOCS / "api"
MODULES = ("netkf", "netkf.parts", "netkf.testing", "netkf.theory", "netkf.kernels")
DIRECTIVE = re.compile(r"^\.\. auto(?:class|function|exception):: (\S+)$", re.MULTILINE)
ELSEWHERE = {
    "netkf.parts.Scenario",
    "netkf.parts.Network",
    "netkf.parts.Filtering",
    "netkf.parts.Belief",
    "netkf.parts.Time",
}


def documented():
    """Names in the order of the pages, as often as they stand there."""
    return [
        name
        for page in sorted(API.rglob("*.md"))
        for name in DIRECTIVE.findall(page.read_text(encoding="utf-8"))
    ]


def public_names():
    for module in map(importlib.import_module, MODULES):
        for name in module.__all__:
            if not inspect.ismodule(getattr(module, name)):
                yield f"{module.__name__}.{name}"


def is_rule(name):
    """Rules of fields are described by a table."""
    short = name.rpartition(".")[2]
    return name.startswith("netkf.parts.") and short.islower() and short not in ("kinds", "setting")


def test_every_public_name_is_on_one_page():
    found = documented()
    assert sorted(found) == sorted(set(found)), "a name stands on two pages"
    rules = (API / "parts" / "contracts.md").read_text(encoding="utf-8")
    for name in {*public_names(), "netkf.open"} - ELSEWHERE:
        if is_rule(name):
            assert re.search(rf"`{name.rpartition('.')[2]}\b", rules), name
        else:
            assert name in found, f"{name} stands on no page of docs/api"


def test_pages_are_linked():
    text = (API / "parts.md").read_text(encoding="utf-8")
    for page in (API / "parts").glob("*.md"):
        assert f"(parts/{page.name})" in text
        assert f"\nparts/{page.stem}\n" in text


def docstrings():
    """Docstrings of all documented names and of their public members, by name."""
    for name in documented():
        module, _, attribute = name.rpartition(".")
        found = getattr(importlib.import_module(module), attribute, None)
        if found is None:
            continue
        yield name, inspect.getdoc(found) or ""
        for member, value in vars(found).items() if inspect.isclass(found) else ():
            if not member.startswith("_") and (callable(value) or isinstance(value, property)):
                yield f"{name}.{member}", inspect.getdoc(value) or ""


def restructured(text):
    spec = importlib.util.spec_from_file_location("docstrings", DOCS / "docstrings.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return "\n".join(module.restructured(text.splitlines()))


def parsed(text):
    core = pytest.importorskip("docutils.core")
    settings = {"report_level": 5, "halt_level": 5}
    return core.publish_doctree(restructured(text), settings_overrides=settings)


def code_in(text):
    """Blocks of a docstring that a page would show as code, quotation or error."""
    nodes = pytest.importorskip("docutils.nodes")
    kinds = (nodes.literal_block, nodes.block_quote, nodes.doctest_block, nodes.system_message)
    return [node.astext() for node in parsed(text).findall(lambda node: isinstance(node, kinds))]


def test_prose_is_not_shown_as_code():
    names = dict(docstrings())
    assert len(names) > 300
    for name, text in names.items():
        assert not code_in(text) or "::\n" in text, f"{name}: {code_in(text)}"


FIELDS = """Summary of all.

times, ends  (T,) in seconds, of `run` or
             of an ensemble with F_k P F_k'
x [unit] is  no field
"""


def test_lists_of_fields_are_lists():
    nodes = pytest.importorskip("docutils.nodes")
    (items,) = parsed(FIELDS.replace("x [unit] is  no field\n", "")).findall(nodes.bullet_list)
    assert (
        items.astext() == "times, ends: (T,) in seconds, of run or of an ensemble with F_k P F_k'"
    )
    assert not list(parsed(FIELDS).findall(nodes.bullet_list))  # prose, in one paragraph
    narrow = "weights entry [l][i]\n        of a matrix\non_loss a word"
    assert [item.astext() for item in parsed(narrow).findall(nodes.list_item)] == [
        "weights: entry [l][i] of a matrix",
        "on_loss: a word",
    ]


def test_code_stays_code():
    assert code_in("Use it so::\n\n    netkf.load(name)\n\nand no more.") == ["netkf.load(name)"]


def test_pages_show_the_settings_of_a_class(monkeypatch):
    pytest.importorskip("sphinx")
    for name in ("myst_parser", "latex2mathml"):
        pytest.importorskip(name)
    spec = importlib.util.spec_from_file_location("conf", DOCS / "conf.py")
    monkeypatch.syspath_prepend(DOCS)  # undone with what the file itself puts there
    conf = importlib.util.module_from_spec(spec)
    conf.tags = SimpleNamespace(has=lambda name: False)  # Sphinx gives the file those of -t
    spec.loader.exec_module(conf)
    connected = {}
    app = SimpleNamespace(add_html_math_renderer=lambda *_: None, connect=connected.__setitem__)
    conf.setup(app)

    def shown(cls):
        return connected["autodoc-process-signature"](app, "class", "", cls, {}, "(*values)", None)

    assert shown(netkf.parts.Hybrid) == ("(epsilon: float)", None)
    assert shown(netkf.parts.Bernoulli)[0].startswith("(delivery: ")
    assert shown(netkf.Run) is None
