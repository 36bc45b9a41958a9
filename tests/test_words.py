"""The words that users and readers meet: the first screen, the field's terms, names of authors."""

import re
import shlex
from functools import cache

import pytest

from netkf.cli.main import make_parser
from netkf.scenario.registry import KINDS
from netkf.scenario.schema import schema_page
from tests.conftest import ROOT, SCENARIOS
from tests.documents import blocks

README = ROOT / "README.md"
KEYS = ROOT / "docs" / "keys.md"  # made by Sphinx, of schema_page()
PAGES = [README, *sorted(set((ROOT / "docs").rglob("*.md")) - {KEYS})]
TEXTS = [
    *PAGES,
    *(ROOT / name for name in ("CHANGELOG.md", "SECURITY.md", "CITATION.cff", "pyproject.toml")),
    *(file for folder in ("scenarios", "analysis") for file in sorted((ROOT / folder).rglob("*"))),
    *sorted((ROOT / "netkf").rglob("*")),
]
SUFFIXES = {".md", ".py", ".toml", ".js", ".html", ".css", ".cff"}
PHRASES = {
    r"too sure|so sure|as sure": "overconfident",
    r"too careful|very careful": "conservative",
    r"honest": "consistent",
    r"(of|about) (one's|your) own": "user-defined, custom",
    r"is what the errors are": "P is consistent with the errors",
    r"would have seen|would be seen": "detectable: the smallest error that the test detects",
    r"a row a promise": "one row per theorem",
    r"the data says?": "titles are generated from the data",
    r"asked back": "answered with a suggestion",
    r"keep the rules": "check the contract",
    r"nobody knows": "unknown, unavailable",
    r"\bluck\b": "draws",
    r"drawn again \(": "reproduced",
    r"by what they tell": "track by exchanging messages",
    r"stopped learning": "permanently frozen",
    r"(takes|take) in lots": "batches",
}
PLACE = r"(?: ?\([1-9]|,? (?:Theorem|Proposition|Lemma|Remark|Algorithm|Fig))"
LETTER = re.compile(rf"\b([HGRPD]){PLACE}")
AUTHORS = {"H": "Tanwani", "G": "Moura", "R": "Sinopoli", "P": "Battilotti", "D": "Xie"}


@cache
def texts():
    files = [file for file in TEXTS if file.suffix in SUFFIXES and file.is_file()]
    return [(file, file.read_text(encoding="utf-8")) for file in files]


@cache
def joined_texts():
    """Each text in one line."""
    joined = [(f, re.sub(r"\"\s*\n\s*f?\"|\s*\n\s*(# )?", " ", text)) for f, text in texts()]
    return [(file, re.sub(r"\s+", " ", text)) for file, text in joined]


def test_the_readme_is_one_screen_and_the_changes_are_few():
    assert len(README.read_text(encoding="utf-8")) < 7000
    assert len((ROOT / "CHANGELOG.md").read_text(encoding="utf-8").splitlines()) < 60


def test_the_commands_of_the_readme_are_those_of_the_gate_and_of_the_parser():
    run, test, commands = (b.text for b in blocks(README) if b.language == "sh")
    gate = (ROOT / ".ci" / "run").read_text(encoding="utf-8").strip().splitlines()
    assert test.strip().endswith(gate[-1])
    assert (ROOT / run.split()[-1]).exists()
    for line in commands.splitlines():
        program, *words = shlex.split(line, comments=True)
        options = make_parser().parse_args(words)
        assert program == "netkf"
        assert (ROOT / options.scenario).exists()
        for kind in getattr(options, "filters", "").split(","):
            assert not kind or kind in KINDS["filter"]


def test_the_code_of_the_readme_runs(tmp_path, monkeypatch):
    (code,) = (b.text for b in blocks(README) if b.language == "python")
    assert len(code.splitlines()) <= 12
    (tmp_path / "scenarios").symlink_to(SCENARIOS)
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "README.md", "exec"), {})
    assert (tmp_path / "kept" / "summary.json").exists()


def test_the_overview_has_every_kind_of_filter_and_every_command():
    page = (ROOT / "docs" / "overview.md").read_text(encoding="utf-8")
    for kind in {name.partition(" ")[0] for name in KINDS["filter"]}:
        assert f"`{kind}`" in page, kind
    for command in make_parser()._subparsers._group_actions[0].choices:
        assert f"`netkf {command}" in page, command
    for scenario in SCENARIOS.glob("*.toml"):
        assert f"`{scenario.stem}`" in page, scenario


@pytest.mark.one_in(3)
@pytest.mark.parametrize("phrase", PHRASES)
def test_nobody_has_to_decode_a_phrase(phrase):
    pattern = re.compile(phrase, re.IGNORECASE)
    found = []
    for file, joined in joined_texts():
        for match in pattern.finditer(joined):
            start = max(0, match.start() - 40)
            found.append(f"{file}: {joined[start : match.end() + 40]}")
    assert not found, f"write {PHRASES[phrase]!r}: " + "\n".join(found)


@pytest.mark.parametrize(
    "page",
    [*PAGES, ROOT / "analysis" / "README.md", *sorted((ROOT / "netkf").rglob("README.md"))],
    ids=lambda page: page.name,
)
def test_a_letter_stands_for_a_paper_whose_author_is_named_first(page):
    require_authors(page, page.read_text(encoding="utf-8"))


def test_the_page_of_all_keys_names_authors_before_letters():
    require_authors(KEYS, schema_page())


def require_authors(page, text):
    for letter, author in AUTHORS.items():
        first = next((m.start() for m in LETTER.finditer(text) if m[1] == letter), None)
        if first is not None:  # the author stands before it or in the same line
            line_end = text.find("\n", first)
            assert author in text[:line_end], f"{page}: {letter} before {author}"
