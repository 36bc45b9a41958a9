"""The command line as a user meets it."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pandas as pd
import pytest

import netkf
from netkf.cli.main import main
from netkf.cli.options import parse_changes
from netkf.scenario.values import parse_values
from tests.conftest import ROOT, SCENARIOS

RING = str(SCENARIOS / "poisson_ring.toml")


def test_run_ends_with_a_table_and_a_picture(tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["run", RING, "--out", str(out), "--set", "horizon=5.0"]) == 0
    printed = capsys.readouterr()
    assert printed.err == ""
    for words in (
        "node  RMS error  mean trace P  bound   ratio",
        "messages: ",
        "events: ",
        "limit S of Tanwani's H(13)",
        str(out),
    ):
        assert words in printed.out
    assert (out / "run.png").read_bytes().startswith(b"\x89PNG")


def test_a_missing_matplotlib_is_told_and_costs_the_picture_only(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "netkf.figures.pictures", None)
    out = tmp_path / "out"
    assert main(["run", RING, "--out", str(out), "--set", "horizon=2.0"]) == 0
    assert "pip install 'netkf[plot]'" in capsys.readouterr().err
    assert json.loads((out / "manifest.json").read_text())["status"] == "complete"
    assert not (out / "run.png").exists()


def test_no_bound_is_shown_where_none_is_promised(tmp_path, capsys):
    changes = ["--set", 'network.channel.delay={kind="exponential", mean=0.1}', "--no-plot"]
    assert main(["run", RING, "--out", str(tmp_path / "o"), "--set", "horizon=3.0", *changes]) == 0
    assert "bound: not promised: " in capsys.readouterr().out


def test_theory_says_what_holds_before_anything_runs(capsys):
    assert main(["theory", str(SCENARIOS / "threshold.toml")]) == 0
    printed = capsys.readouterr().out
    assert "the rate 1.7 is below the threshold 2" in printed
    assert "FAILS" not in printed


def test_theory_as_json_is_one_document(capsys):
    assert main(["theory", RING, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert all(row["holds"] for row in found["assumptions"])
    assert len(found["steady_bound"]["value"]) == 6
    assert found["limit_covariance"]["trace"] == pytest.approx(2.194, rel=1e-3)


@pytest.mark.parametrize("path", sorted(SCENARIOS.rglob("*.toml")), ids=lambda path: path.stem)
def test_theory_of_every_scenario_is_a_json_document(path, capsys):
    assert main(["theory", str(path), "--json", "--trust"]) in (0, 1)
    assert json.loads(capsys.readouterr().out)["assumptions"]


def test_settings_are_toml_or_bare_words():
    changes = parse_changes(["a.b=1.5", "c=[1, 2]", 'd="x y"', "e=word", "f=true", "g={ k = 1 }"])
    assert changes == {"a.b": 1.5, "c": [1, 2], "d": "x y", "e": "word", "f": True, "g": {"k": 1}}


@pytest.mark.parametrize(
    ("text", "number"), [(".5", 0.5), ("-.25", -0.25), ("2.", 2.0), ("+1.e3", 1e3)]
)
def test_numbers_need_no_digit_on_one_side_of_the_point(text, number):
    assert parse_changes([f"probe={text}"]) == {"probe": number}
    assert parse_values("--vary", "probe", f"{text},3") == [number, 3]


@pytest.mark.parametrize("text", [".", "1.2.3", ".5s", "0.5.", "v1."])
def test_words_with_points_are_words(text):
    assert parse_changes([f"name={text}"]) == {"name": text}


def test_seed_makes_another_run(tmp_path, capsys):
    for name, seed in (("a", "1"), ("b", "2")):
        arguments = ["--set", "horizon=2.0", "--no-plot", "--trace", "none"]
        main(["run", RING, "--seed", seed, "--out", str(tmp_path / name), *arguments])
    one, other = (json.loads((tmp_path / n / "manifest.json").read_text()) for n in "ab")
    assert one["fingerprint"] != other["fingerprint"]
    assert other["seed"] == 2
    assert not (tmp_path / "a" / "events.parquet").exists()


def test_import_is_quick_and_light():
    code = (
        "import sys, netkf;"
        "heavy = {'pandas', 'matplotlib', 'numba', 'scipy', 'networkx', 'simpy', 'pyarrow'};"
        "print(sorted(heavy & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout.strip() == "[]"


def test_public_names_exist():
    for name in netkf.__all__:
        assert getattr(netkf, name) is not None
    assert set(netkf.__all__) <= set(dir(netkf))
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = netkf.nothing


@pytest.mark.one_in(2)
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_an_interrupted_run_leaves_what_was_finished(tmp_path, name):
    out = tmp_path / "out"
    arguments = ["run", RING, "--set", "horizon=100000.0", "--set", "probe=1.0", "--out", str(out)]
    code = f"import sys; from netkf.cli.main import main; sys.exit(main({arguments!r}))"
    run = subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.PIPE, text=True)
    for _ in range(600):
        time.sleep(0.1)
        if (out / "events.parquet.part").exists():
            break
    run.send_signal(getattr(signal, name))
    _, printed = run.communicate(timeout=60)
    assert run.returncode == 130
    assert printed == f"netkf: interrupted; what was finished is kept in {out}\n"
    manifest = json.loads((out / "manifest.json").read_text())
    assert manifest["status"] == "interrupted"
    events = pd.read_parquet(out / "events.parquet")
    assert len(events) == manifest["events"] > 0
    assert pd.read_parquet(out / "states.parquet").t.max() > 0.0
    assert not list(out.glob("*.part"))


def test_nothing_is_claimed_to_be_kept_where_nothing_was_written(capsys, monkeypatch):
    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("netkf.theory.promises.compute_promises", stop)
    assert main(["theory", RING]) == 130
    assert capsys.readouterr().err == "netkf: interrupted\n"


def is_full_device():
    """True if /dev/full is that device, and not a file that somebody made in its place."""
    try:
        return os.stat("/dev/full").st_rdev == os.makedev(1, 7)
    except OSError:
        return False


@pytest.mark.skipif(not is_full_device(), reason="no device /dev/full here")
def test_a_full_disk_is_told_in_one_line(tmp_path):
    arguments = ["run", RING, "--set", "horizon=2.0", "--no-plot", "--out", str(tmp_path / "out")]
    code = f"import sys; from netkf.cli.main import main; sys.exit(main({arguments!r}))"
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-c", code],
            check=False,
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
        )
    assert done.returncode == 2
    assert done.stderr == "netkf: cannot write: No space left on device\n"


def test_refusals_do_not_wait_for_matplotlib(tmp_path):
    run = tmp_path / "run"
    assert main(["run", RING, "--set", "horizon=2.0", "--no-plot", "--out", str(run)]) == 0
    (tmp_path / "a.png").mkdir()
    os.symlink("nowhere", tmp_path / "b.png")
    refused = [
        *(["plot", "run", "--figure", "eror"], ["plot", "absent"], ["plot", "run", "--figure", ""]),
        *(["plot", "run", "--out", "run/summary.json"], ["plot", "run", "--out", "b.png"]),
        *(["plot", "run", "run", "--out", "c.png"], ["plot", "run", "--format", "gif"]),
        *(["plot", "run", "--out", "new.jpg"], ["plot", "run", "run", "--out", "new.EPS"]),
        *(["report", "absent"], ["report", "run", "--out", "run/summary.json"]),
        *(["report", "run", "--out", "b.png"], ["report", "run", "--out", "run"]),
        *(["report", "run", "run", "run"], ["report", "run", "--replica", "x"]),
    ]
    assert modules_after(refused, tmp_path) & {"matplotlib"} == set()


def test_what_is_refused_at_once_does_not_wait_for_imports(tmp_path):
    wrong = [RING, "--set", "filter.epsilno=0.3"]
    refused = [
        *([name, *wrong] for name in ("check", "theory", "consistency", "innovations")),
        *(["plan", *wrong, "--runs", "2"], ["sweep", *wrong, "--vary", "seed=1,2"]),
        ["size", *wrong, "--vary", "network.activation.rate=1:2", "--target", "error<=1"],
        ["compare-filters", *wrong, "--filters", "hybrid", "--runs", "2"],
        *([name, "absent"] for name in ("why", "compare", "report", "fit", "work", "merge")),
        ["export", "absent", "--to", "log"],
    ]
    assert (
        modules_after(refused, tmp_path) & {"scipy.linalg", "pandas", "pyarrow", "matplotlib"}
        == set()
    )


def modules_after(refused, folder):
    """Names of the modules after commands that are refused, in one line each."""
    code = (
        "import sys\nfrom netkf.cli.main import main\n"
        f"for arguments in {refused}:\n"
        "    try:\n        print(main(arguments))\n"
        "    except SystemExit as end:\n        print(end.code)\n"
        "print(*sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code],
        check=False,
        cwd=folder,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *filter(None, sys.path)])},
        capture_output=True,
        text=True,
    )
    *statuses, modules = done.stdout.splitlines()
    assert statuses == ["2"] * len(refused)
    assert len(done.stderr.splitlines()) == len(refused)
    return set(modules.split())


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["sweep", RING, "--vary", "seed=1,2", "--slurm"], "--slurm: means nothing without --plan"),
        (["sweep", RING, "--vary", "seed=1,2", "--tasks", "3"], "--tasks: means nothing without"),
        (["plan", RING, "--runs", "2", "--time", "1h"], "--time: means nothing without --slurm"),
        (["check", RING, "--most", "50"], "--most: means nothing without --until"),
        (["plot", ".", "--format", "svg", "--out", "a.png"], "--format: is not that of a.png"),
        (["import", ".", "--kind", "mrclam", "--hole", "5", "--out", "x"], "are of packet logs"),
        (
            ["size", RING, "--out", "x"],
            "netkf size: unrecognized arguments: --out x; see netkf size",
        ),
    ],
)
def test_options_that_would_do_nothing_are_refused(tmp_path, capsys, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    if words[0] == "size":
        words = [*words, "--vary", "seed=1:2", "--target", "worst_rms<=1"]
    try:
        status = main(words)
    except SystemExit as end:
        status = end.code
    error = capsys.readouterr().err
    assert (status, error.count("\n")) == (2, 1)
    assert message in error
    assert not list(tmp_path.iterdir())
