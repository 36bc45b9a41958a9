"""``netkf new`` writes a scenario and tests that run at once, and overwrites nothing."""

import importlib.util
from pathlib import Path

import pytest

import netkf
from netkf.cli.main import main


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("new")
    assert main(["new", "my-ring", "--folder", str(folder)]) == 0
    return folder


def loaded(path):
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
def test_the_scenario_loads_and_its_tests_pass(written):
    scenario = netkf.load(written / "my-ring.toml")
    assert scenario.name == "my-ring"
    assert not scenario.notes
    tests = loaded(written / "test_my_ring.py")
    tests.test_a_run_completes_and_a_seed_repeats_it(0)
    tests.test_the_mean_covariance_stays_below_the_bound()
    tests.test_no_promise_is_broken(4.0, 1.0)


def test_nothing_refers_to_files_that_only_the_repository_has(written):
    # Whoever has the installed package has no docs/, scenarios/ or tests/ beside it.
    files = [written / "my-ring.toml", written / "test_my_ring.py"]
    text = "".join(path.read_text() for path in files)
    assert not [name for name in ("docs/", "scenarios/", "tests/") if name in text]


def test_the_tests_can_fail(written, monkeypatch):
    bound = netkf.theory.covariance_bound
    monkeypatch.setattr(netkf.theory, "covariance_bound", lambda *asked: 0.6 * bound(*asked))
    with pytest.raises(AssertionError):
        loaded(written / "test_my_ring.py").test_the_mean_covariance_stays_below_the_bound()


def test_nothing_is_overwritten_and_bad_names_are_refused(written, capsys):
    before = (written / "my-ring.toml").read_text()
    refused = {"my-ring": "is there already", "../up": "must be a letter", "a.toml": "must be"}
    for name, words in refused.items():
        assert main(["new", name, "--folder", str(written)]) == 2
        printed = capsys.readouterr()
        assert words in printed.err
        assert printed.err.count("\n") == 1
    assert main(["new", "other", "--folder", str(written / "absent")]) == 2
    assert "No such file" in capsys.readouterr().err
    assert (written / "my-ring.toml").read_text() == before


def test_a_full_disk_leaves_neither_file(capsys, monkeypatch, tmp_path):
    def fail(self, *args, **kwargs):
        if self.suffix == ".py":
            raise OSError(28, "No space left on device")
        return before(self, *args, **kwargs)

    before = Path.open
    monkeypatch.setattr(Path, "open", fail)
    assert main(["new", "ring", "--folder", str(tmp_path)]) == 2
    assert "cannot write: No space left on device" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_completion_knows_every_command(shell, capsys):
    from netkf.cli.commands import COMMANDS

    pytest.importorskip("shtab")
    with pytest.raises(SystemExit) as stop:
        main(["--print-completion", shell])
    assert stop.value.code == 0
    script = capsys.readouterr().out
    assert all(command.name in script for command in COMMANDS)
    assert "--node" in script


def test_without_shtab_one_line_says_so(monkeypatch, capsys):
    import sys

    monkeypatch.setitem(sys.modules, "shtab", None)
    with pytest.raises(SystemExit) as stop:
        main(["--print-completion", "bash"])
    assert stop.value.code == 2
    assert capsys.readouterr().err == (
        "netkf: --print-completion needs shtab: pip install 'netkf[completion]'; see netkf --help\n"
    )
