"""Run directories from elsewhere: whatever is in them, one line and status 2, or a comparison."""

import json
import os
import shutil

import numpy as np
import pandas as pd
import pytest

import netkf
from netkf.cli.main import main
from netkf.ensembles.directory import EnsembleOptions, runs_to_directory
from netkf.ensembles.pools import PoolOptions
from netkf.runs.documents import file_digests, write_sealed
from netkf.studies.compare import DIAGONAL, compare
from netkf.trace.schema import state_columns
from tests.conftest import SCENARIOS

HOSTILE = "x\x1b[31m\x9b\u202e\u2066\nnetkf: done\r\x00y"


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("made") / "runs"
    scenario = netkf.load(SCENARIOS / "poisson_ring.toml", {"horizon": 1.0})
    runs_to_directory(scenario, 4, folder, EnsembleOptions(trace="full", pool=PoolOptions(1)))
    return folder


@pytest.fixture
def copy(made, tmp_path):
    return shutil.copytree(made, tmp_path / "copy")


def compared(capsys, *directories):
    """Return the status of ``compare`` and what it printed."""
    status = main(["compare", *map(str, directories)])
    printed = capsys.readouterr()
    assert (printed.out + printed.err).replace("\n", "").isprintable()
    assert len(printed.err.splitlines()) == (status == 2)
    return status, printed.out + printed.err


def reseal(folder):
    """Make all digests right again, as one who wants to deceive would."""
    found = json.loads((folder / "manifest.json").read_text())
    del found["sha256"]
    found["files"] = file_digests(folder, found["files"])
    write_sealed(folder / "manifest.json", found)


@pytest.mark.parametrize("name", ["manifest.json", "summary.json"])
@pytest.mark.parametrize(
    "text",
    ["", "null", "[1]", "{}", '{"a":' * 100_000, "[" * 100_000, "NaN", "7" * 10_000, "\ufeff{}"],
)
def test_a_document_that_is_none_is_one_line(copy, made, capsys, name, text):
    (copy / name).write_text(text, encoding="utf-8")
    status, printed = compared(capsys, made, copy)
    assert status == 2
    assert name in printed


def as_fifo(path):
    path.unlink()
    os.mkfifo(path)


def as_folder(path):
    path.unlink()
    path.mkdir()


@pytest.mark.parametrize("name", ["manifest.json", "summary.json", "states.parquet"])
@pytest.mark.parametrize("change", [as_fifo, as_folder])
def test_what_is_no_file_is_one_line(copy, made, capsys, name, change):
    change(copy / name)
    assert compared(capsys, made, copy)[0] == 2


CHANGES = {
    "overall.rms_error": ["1", True, [], {}, 1e400, 10**400],
    "overall": [None, [], "x"],
    "nodes": [None, {}, [None], [{"node": 0}], [{"node": None}]],
    "messages": [None, []],
    "messages.sent": ["1", {}],
    "notes": [None, "x", [1]],
    "limit": ["1"],
    "rounding_from": ["1", []],
}


@pytest.mark.parametrize("key", CHANGES)
def test_text_for_numbers_is_one_line(copy, made, capsys, key):
    """Even where the digests are right."""
    before = (copy / "summary.json").read_text()
    for value in CHANGES[key]:
        summary = json.loads(before)
        table, _, last = key.rpartition(".")
        (summary[table] if table else summary)[last] = value
        (copy / "summary.json").write_text(json.dumps(summary))
        reseal(copy)
        status, printed = compared(capsys, made, copy)
        assert (status, "summary.json" in printed) == (2, True), value


def test_numbers_that_overflow_are_compared(copy, made, capsys):
    summary = json.loads((copy / "summary.json").read_text())
    summary["overall"] = dict.fromkeys(summary["overall"], 1e308)
    summary["overall"]["mean_trace"] = -1e308
    (copy / "summary.json").write_text(json.dumps(summary))
    reseal(copy)
    assert compared(capsys, made, copy)[0] == 0


def test_control_characters_of_files_do_not_reach_the_terminal(copy, made, capsys):
    for name, key in (("manifest.json", "name"), ("summary.json", "notes")):
        found = json.loads((copy / name).read_text())
        found[key] = [HOSTILE] if key == "notes" else HOSTILE * 1000
        (copy / name).write_text(json.dumps(found))
    reseal(copy)
    lines = len(compared(capsys, made, made)[1].splitlines())
    status, printed = compared(capsys, made, copy)
    assert status == 0
    assert len(printed.splitlines()) == lines + 2  # the note, and the empty line before it
    assert max(map(len, printed.splitlines())) < 1000
    status, printed = compared(capsys, made, copy / HOSTILE.replace("\0", ""))
    assert status == 2
    manifest = json.loads((copy / "manifest.json").read_text())
    (copy / "manifest.json").write_text(json.dumps({**manifest, "status": HOSTILE}))
    assert compared(capsys, made, copy)[0] == 2


@pytest.mark.parametrize("name", ["scenario.toml", "summary.json", "states.parquet"])
def test_files_that_were_changed_since_are_named(copy, made, capsys, name):
    with (copy / name).open("ab") as file:
        file.write(b"\n")
    status, printed = compared(capsys, made, copy)
    assert status == 2
    assert f"{name} was changed since the run ended" in printed


def test_a_manifest_that_was_changed_is_named(copy, made, capsys):
    manifest = json.loads((copy / "manifest.json").read_text())
    (copy / "manifest.json").write_text(json.dumps({**manifest, "seed": 2}))
    status, printed = compared(capsys, made, copy)
    assert status == 2
    assert "manifest.json was changed since it was written" in printed
    del manifest["sha256"], manifest["files"]  # as older versions wrote it
    (copy / "manifest.json").write_text(json.dumps(manifest))
    assert compared(capsys, made, copy)[0] == 0


TABLES = {
    "no run": lambda t: t.drop(columns="run"),
    "no nees": lambda t: t.drop(columns="nees"),
    "text": lambda t: t.assign(sq_error=HOSTILE),
    "lists": lambda t: t.assign(P00=[[1.0]] * len(t)),
    "missing": lambda t: t.assign(t=t.t.astype("Float64").where(t.t > 0.5)),
    "truth": lambda t: t.assign(x0=True),
}


@pytest.mark.parametrize("how", TABLES)
def test_a_foreign_table_is_one_line(copy, made, capsys, how):
    TABLES[how](pd.read_parquet(copy / "states.parquet")).to_parquet(copy / "states.parquet")
    reseal(copy)
    status, printed = compared(capsys, made, copy)
    assert (status, "states.parquet" in printed) == (2, True)


@pytest.mark.parametrize("keep", [0, 4, 100, 0.5, 0.99])
def test_a_table_that_was_cut_is_one_line(copy, made, capsys, keep):
    path = copy / "states.parquet"
    whole = path.read_bytes()
    path.write_bytes(whole[: int(keep * len(whole)) if isinstance(keep, float) else keep])
    reseal(copy)
    assert compared(capsys, made, copy)[0] == 2


@pytest.mark.parametrize("n", [1, 10, 11, 23])
def test_the_trace_of_large_states_is_that_of_P(n):
    """Columns of P have an underscore from eleven states on."""
    names = [name for name in state_columns(n) if DIAGONAL.match(name)]
    join = "" if n <= 10 else "_"
    assert names == [f"P{k}{join}{k}" for k in range(n)]


def test_the_same_directory_has_no_differences(made):
    found = compare([made, made])
    assert not any(entry.real for row in found.rows for entry in row.entries)
    assert np.isfinite([row.entries[0].value for row in found.rows if row.quantity == "sent"]).all()


@pytest.mark.one_in(3)
@pytest.mark.parametrize("kind", ["Int64", "Float64", "float64"])
@pytest.mark.parametrize("column", ["peer", "message", "t", "age"])
def test_types_that_pandas_notes_in_a_file_do_not_matter(copy, capsys, kind, column):
    """Empty cells of its own types were an exception of pandas, not of netkf."""
    table = pd.read_parquet(copy / "events.parquet")
    kept = netkf.open(copy).replica(0).log[column]
    table[column] = table[column].round().astype(kind).where(table.index % 3 > 0)
    table.to_parquet(copy / "events.parquet", index=False)
    reseal(copy)
    if column == "age" and kind != "Int64":  # empty where there is none
        assert len(netkf.open(copy).replica(0).log) == len(kept)
        return
    with pytest.raises(netkf.ScenarioError, match=r"events\.parquet has"):
        netkf.open(copy).replica(0)
    assert main(["why", str(copy)]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


WRONG = {  # in a document of which every digest is right
    "manifest.json": {"versions": [0, [1], "x"], "error": [1, []]},
    "verdict.json": {"versions": [0, None], "rows": [0, [1], {}], "confidence": [None, "x"]},
    "sweep.json": {"vary": [{"network.activation.rate": None}, []]},
}


@pytest.fixture(scope="module")
def kinds(made, tmp_path_factory):
    """A directory of each kind that has a document in WRONG."""
    folder = tmp_path_factory.mktemp("kinds")
    ring = [str(SCENARIOS / "poisson_ring.toml"), "--set", "horizon=1.0", "--no-plot"]
    few = ["--workers", "1", "--out"]
    vary = ["--vary", "network.activation.rate=1,2", "--runs", "2"]
    assert main(["sweep", *ring, *vary, *few, str(folder / "sweep.json")]) == 0
    assert main(["check", *ring, "--runs", "10", *few, str(folder / "verdict.json")]) in (0, 1)
    shutil.copytree(made, folder / "manifest.json")
    return folder


def assert_one_line(capsys, *arguments):
    capsys.readouterr()
    assert main([*map(str, arguments)]) == 2, arguments
    assert len(capsys.readouterr().err.splitlines()) == 1, arguments


@pytest.mark.one_in(3)
@pytest.mark.parametrize("kind", WRONG)
def test_wrong_types_in_documents_with_right_digests_are_one_line(kinds, tmp_path, capsys, kind):
    folder = shutil.copytree(kinds / kind, tmp_path / "copy")
    path = folder / ("verdict.json" if kind == "verdict.json" else "manifest.json")
    before = path.read_text()
    for key, values in WRONG[kind].items():
        for value in values:
            found = {**json.loads(before), key: value}
            del found["sha256"]
            write_sealed(path, found)
            assert_one_line(capsys, "report", folder, "--out", tmp_path / "page.html")
            assert_one_line(capsys, "plot", folder, "--out", tmp_path / "figures")
            with pytest.raises(netkf.ScenarioError):
                netkf.open(folder)
    assert [entry.name for entry in tmp_path.iterdir()] == ["copy"]


def test_a_negative_standard_error_is_one_line(kinds, tmp_path, capsys):
    folder = shutil.copytree(kinds / "sweep.json", tmp_path / "copy")
    table = pd.read_parquet(folder / "sweep.parquet")
    table.assign(mean_rms_se=-1.0).to_parquet(folder / "sweep.parquet", index=False)
    assert_one_line(capsys, "plot", folder, "--out", tmp_path / "figures")


def test_a_refusal_of_why_is_one_line(copy, capsys):
    """It named the sample that it had chosen first."""
    assert_one_line(capsys, "why", copy, "--replica", "0", "--below", "-1")
