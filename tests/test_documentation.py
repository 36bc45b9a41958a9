"""Every block of every page of docs/ does what the page says, read from an empty folder."""

import re
import subprocess

import pytest

from netkf.theory.common.papers import PAPERS
from tests.conftest import ROOT
from tests.documents import DOCS, Follower, blocks, matches, shell_script

PAGES = sorted(DOCS.rglob("*.md"))
ELSEWHERE = {  # pages whose blocks have tests of their own
    "errors_in_the_papers.md": "test_errors_in_the_papers.py",
    "scenario_files.md": "test_docs.py",
}
NEEDS = {"formats.md": ("xarray", "h5netcdf", "stonesoup", "filterpy")}
# Tests of other files run their scripts and commands.
SLOW = (
    *("blocks.md", "faults.md", "gallery.md", "look.md", "packet_log.md", "sizing.md"),
    "writing_filters.md",
)
FOLLOWED = [page for page in PAGES if page.name not in ELSEWHERE and blocks(page)]


def page_name(page):
    return str(page.relative_to(DOCS))


@pytest.fixture
def follower(tmp_path, monkeypatch):
    monkeypatch.setenv("NETKF", str(ROOT))
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    found = Follower(tmp_path)
    yield found
    found.close()


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, marks=pytest.mark.slow) if page.name in SLOW else page
        for page in FOLLOWED
    ],
    ids=page_name,
)
def test_the_page_does_what_it_says(follower, page):
    for package in NEEDS.get(page.name, ()):
        pytest.importorskip(package)
    if page.parent.name != "tutorials":  # these begin with nothing, others beside the scenarios
        (follower.folder / "scenarios").symlink_to(ROOT / "scenarios")
    follower.follow(page)


def test_pages_that_are_tested_elsewhere_are():
    for page, test in ELSEWHERE.items():
        assert page in (ROOT / "tests" / test).read_text(encoding="utf-8")


def test_a_page_that_is_wrong_is_found(follower, tmp_path):
    """The follower sees what is printed, and what is not as shown."""
    page = tmp_path / "page.md"
    right = "```python\nprint(2 + 2, 'and more')\nprint(1)\n```\n\n```text\n4 and ...\n...\n```\n"
    page.write_text(right)
    follower.follow(page)
    for wrong in (
        right.replace("4 and", "5 and"),
        right.replace("\n...", ""),
        "```console\n$ netkf run nowhere.toml\n$ echo $?\n0\n```\n",
        "```console\n$ format disk\n```\n",
        "```julia\n1\n```\n",
    ):
        page.write_text(wrong)
        with pytest.raises(AssertionError, match=r"page\.md, line \d+"):
            follower.follow(page)


def test_dots_stand_for_what_is_left_out():
    assert matches(["a", "...", "d"], ["a", "b", "c", "d"])
    assert matches(["a", "...", "d"], ["a", "d"])
    assert matches(["in ... s"], ["in 0.3 s"])
    assert not matches(["a"], ["a", "b"])
    assert not matches(["a...", "d"], ["a", "b", "d"])


@pytest.mark.parametrize("page", sorted((DOCS / "tutorials").glob("*.md")), ids=page_name)
def test_a_tutorial_is_a_script(page):
    """It names every file that it writes, and bash can read what comes of it."""
    assert all(block.name for block in blocks(page) if block.language in ("python", "toml"))
    text = shell_script(page)
    assert "pip install" in text
    assert "test $? -eq 2" in text  # the command that fails on purpose
    subprocess.run(["bash", "-n"], input=text, text=True, check=True)


@pytest.mark.parametrize("page", PAGES, ids=page_name)
def test_code_fits_its_column(page):
    """Of 100 characters, by docs/_static/code.css; commands and texts wrap there."""
    code = [block for block in blocks(page) if block.language in ("python", "toml", "json")]
    wide = [line for block in code for line in block.text.splitlines() if len(line) > 100]
    assert wide == []


def test_pictures_are_small_and_used():
    texts = "".join(page.read_text(encoding="utf-8") for page in [*PAGES, ROOT / "README.md"])
    for picture in [*DOCS.rglob("*.svg"), *DOCS.rglob("*.png"), *DOCS.rglob("*.gif")]:
        assert picture.name in texts, picture
        limit = 1_500_000 if picture.parent == DOCS else 200_000
        assert picture.stat().st_size < limit, picture


def test_a_paper_has_one_title():
    """On its page, among the errors, and in the legend of a verdict."""
    errors = (DOCS / "errors_in_the_papers.md").read_text(encoding="utf-8")
    pages = [page.read_text(encoding="utf-8") for page in (DOCS / "papers").glob("*.md")]
    letters = [re.match(r"# .* \((\w)\): ", page)[1] for page in pages]
    assert set(letters) == set(PAPERS)
    for letter, page in zip(letters, pages, strict=True):
        title = PAPERS[letter].partition(": ")[2]
        assert f"*{title}*" in page
        assert f"*{title}*" in errors
