"""The list of errors in the papers: every block of code prints what the list says."""

import contextlib
import io
import re

import pytest

from tests.conftest import ROOT

TEXT = (ROOT / "docs" / "errors_in_the_papers.md").read_text(encoding="utf-8")
PREAMBLE = re.search(r"```python\n(.*?)```", TEXT, flags=re.DOTALL)[1]
ENTRIES = re.findall(
    r"### ([HRGPD]): ([^\n]*)\n(.*?)```python\n(.*?)```\n\n```text\n(.*?)```", TEXT, flags=re.DOTALL
)


@pytest.fixture(scope="module")
def names():
    found = {}
    with contextlib.chdir(ROOT):
        exec(PREAMBLE, found)
    return found


@pytest.mark.one_in(12)
@pytest.mark.parametrize(
    ("paper", "title", "text", "code", "printed"), ENTRIES, ids=[f"{e[0]}-{e[1]}" for e in ENTRIES]
)
def test_each_error_is_shown_by_its_code(names, paper, title, text, code, printed):
    assert "Printed: " in text
    assert "Right: " in text
    shown = io.StringIO()
    with contextlib.chdir(ROOT), contextlib.redirect_stdout(shown):
        exec(code, dict(names))
    assert shown.getvalue() == printed


def test_all_five_papers_are_there_and_no_block_is_skipped():
    assert {entry[0] for entry in ENTRIES} == set("HRGPD")
    assert TEXT.count("```python") == len(ENTRIES) + 1
    assert TEXT.count("### ") == len(ENTRIES)
