"""Follow a page of docs/ as a reader would: write its files, give its commands, run its code.

    python -m tests.documents docs/tutorials/first_verdict.md > follow.sh

prints a shell script of the page, for an empty folder: `NETKF=/path/to/netkf bash -e follow.sh`.

What a block is follows from its language and its first line:

- `python` or `toml` beginning with `# NAME`: a file of that name;
- `sh`: commands that set up a computer, of the script only;
- `console`: commands after `$ `, each followed by what it prints;
- `python` without a name: code that runs in one namespace a page; a `text` block directly below
  is what it prints; it is left out if it imports a package of OPTIONAL that is not installed;
- `toml` without a name: part of a scenario file, which has to be TOML;
- `matlab`, `ini`: files of other programs, to read.

In what is printed `...` stands for any text in a line and, alone, for any number of lines.
"""

import contextlib
import importlib.util
import io
import itertools
import os
import re
import runpy
import shlex
import shutil
import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path

import pytest

from netkf.cli.main import main
from tests.conftest import ROOT

DOCS = ROOT / "docs"
FENCE = re.compile(r"^```(\S*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
NAME = re.compile(r"# (\S+\.(?:py|toml|csv|sh))\n")
STATUS = "echo $?"
OPTIONAL = ("duckdb", "polars")  # blocks that import them are left out where they are not there
LANGUAGES = {"python", "toml", "console", "sh", "text", "json", "matlab", "ini"}


@dataclass(frozen=True)
class Block:
    language: str
    text: str
    name: str  # of the file; "" for none
    line: int


def blocks(page):
    """All blocks of a page but those of Sphinx, in order."""
    text = page.read_text(encoding="utf-8")
    found = []
    for fence in FENCE.finditer(text):
        language, content = fence.groups()
        if language.startswith("{"):
            continue
        named = NAME.match(content) if language in ("python", "toml") else None
        name = named[1] if named else ""
        line = text[: fence.start()].count("\n") + 2
        found.append(Block(language, content[named.end() :] if named else content, name, line))
    return found


def sessions(block):
    """Pairs of a command and the lines that it prints, None where none is shown."""
    pairs = []
    for line in block.text.splitlines():
        if line.startswith("$ "):
            pairs.append((line[2:], []))
        else:
            pairs[-1][1].append(line)
    return [(command, shown or None) for command, shown in pairs]


def matches(shown, printed):
    """Whether lines are as shown on the page, where `...` stands for what is left out."""
    pattern = "".join(
        r"(?:[^\n]*\n)*"
        if line == "..."
        else re.escape(line.rstrip()).replace(r"\.\.\.", ".*") + r"\n"
        for line in shown
    )
    text = "".join(f"{line.rstrip()}\n" for line in printed)
    return re.fullmatch(pattern, text.rstrip("\n") + "\n") is not None


class Follower:
    """A reader in an empty folder."""

    def __init__(self, folder):
        self.folder, self.names, self.status = Path(folder), {"__name__": "page"}, 0
        self.before = set(sys.modules)

    def close(self):
        """Forget the modules that the page has written."""
        for name in set(sys.modules) - self.before:
            if (self.folder / f"{name}.py").exists():
                del sys.modules[name]

    def follow(self, page):
        """Raise AssertionError at the first block that does not do what the page shows."""
        found = blocks(page)
        for block, after in itertools.zip_longest(found, found[1:]):
            try:
                self.take(block, after)
            except Exception as error:
                raise AssertionError(f"{page.name}, line {block.line}: {error}") from error

    def take(self, block, after):
        """Write, parse or run one block."""
        assert block.language in LANGUAGES, f"a block of language {block.language!r}"
        if block.name:
            target = Path(block.name)
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_text(block.text, encoding="utf-8")
        elif block.language == "toml":
            tomllib.loads(block.text)
        elif block.language == "console":
            for command, shown in sessions(block):
                compare(command, shown, self.give(command))
        elif block.language == "python" and not needs_more(block):
            printed = captured(lambda: exec(compile(block.text, "page", "exec"), self.names))
            shown = after.text.splitlines() if after and after.language == "text" else None
            compare("the code", shown, printed)

    def give(self, command):
        """Run a command of a shell in this process and return what it prints."""
        program, *words = shlex.split(os.path.expandvars(command), comments=True)
        if program == "netkf":
            return self.captured_status(lambda: main(words))
        if program == "python":
            return self.captured_status(lambda: script(*words))
        if program == "pytest":
            options = ["-p", "no:cacheprovider", "-p", "no:xdist", "--rootdir", str(self.folder)]
            # What is printed must not depend on options of whoever runs the tests of this project.
            with pytest.MonkeyPatch.context() as patch:
                patch.delenv("PYTEST_ADDOPTS", raising=False)
                return self.captured_status(lambda: int(pytest.main([*options, *words])))
        if program == "echo" and words == ["$?"]:
            return f"{self.status}\n"
        if program == "mkdir":
            Path(words[-1]).mkdir(parents=True, exist_ok=True)
        elif program == "cd":
            os.chdir(words[0])
        elif program == "cp":
            copy(*words)
        else:
            raise AssertionError(f"an unknown command {command!r}")
        return ""

    def captured_status(self, call):
        def run():
            self.status = call() or 0

        return captured(run)


def needs_more(block):
    """Whether a block imports an optional package that is not installed."""
    wanted = [name for name in OPTIONAL if f"import {name}\n" in block.text]
    return any(importlib.util.find_spec(name) is None for name in wanted)


def script(path, *words):
    """`python PATH WORDS`."""
    before, sys.argv = sys.argv, [path, *words]
    try:
        runpy.run_path(path, run_name="__main__")
    finally:
        sys.argv = before


def copy(*words):
    """`cp -r FROM TO` and `cp FROM TO`."""
    *_, source, target = words
    if Path(source).is_dir():
        shutil.copytree(source, target)
    else:
        shutil.copy(source, target)


def captured(call):
    """What a call prints, errors included, as on a terminal."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(out):
        call()
    return out.getvalue()


def compare(what, shown, printed):
    """Raise AssertionError unless the lines are as shown."""
    if shown is not None and not matches(shown, printed.splitlines()):
        raise AssertionError(f"{what} prints\n{printed}")


def shell_script(page):
    """A shell script that writes the files of a page and gives its commands, in order.

    It ends at the first command that fails, but for one whose status the page shows.
    """
    lines, found = ["set -e"], blocks(page)
    statuses = iter(expected_statuses(found))
    for block in found:
        if block.name:
            lines += [f"mkdir -p $(dirname {block.name})"]
            lines += [f"cat > {block.name} <<'END_OF_FILE'", block.text + "END_OF_FILE"]
        elif block.language == "sh":
            lines.append(block.text)
        elif block.language == "console":
            commands = [c for c, _ in sessions(block) if c != STATUS]
            lines += [checked(command, next(statuses)) for command in commands]
    return "\n".join(lines)


def expected_statuses(found):
    """The exit status of each command of a page: 0 unless `echo $?` below it shows another."""
    statuses = []
    for command, shown in [p for b in found if b.language == "console" for p in sessions(b)]:
        if command == STATUS:
            statuses[-1] = int(shown[0])
        else:
            statuses.append(0)
    return statuses


def checked(command, status):
    """The command, or a line that fails unless the command ends with a status."""
    return command if status == 0 else f"{command} && exit 1 || test $? -eq {status}"


if __name__ == "__main__":
    print(shell_script(Path(sys.argv[1])))
