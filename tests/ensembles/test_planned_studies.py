"""Plans of studies: what jobs leave in a directory ends as the command itself would have."""

import json
import re
import shutil
from argparse import Namespace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from netkf.cli.main import main, make_parser
from netkf.cli.planned import work_on_study
from netkf.core.errors import EngineError
from netkf.ensembles import block_files
from netkf.ensembles.merge_tree import MergeTree
from netkf.ensembles.parts import Part
from netkf.ensembles.planned_study import StudyBlocks
from netkf.ensembles.plans import open_plan
from netkf.ensembles.pools import PoolOptions
from netkf.ensembles.replicas import Form, form_of
from netkf.runs import provenance
from netkf.runs.documents import write_sealed
from tests.conftest import SCENARIOS, with_slow

RING = [str(SCENARIOS / "poisson_ring.toml"), "--set", "horizon=1.0"]
SLOW = ["--engine", "simpy"]
RATES = "network.activation.rate="
STUDIES = {
    "sweep": ["sweep", *RING, "--vary", f"{RATES}1.0,3.0", "--runs", "5", *SLOW, "--no-plot"],
    "filters": [
        *["compare-filters", *RING, "--filters", "hybrid,local", "--runs", "4"],
        *[*SLOW, "--json", "--no-plot"],
    ],
    "until": ["check", *RING, "--runs", "10", "--until", "decided", "--most", "20", "--no-plot"],
}
SIZE = [
    "size",
    *RING,
    "--set",
    "horizon=0.6",
    "--vary",
    f"{RATES}0.5:2.0",
    "--target",
    "worst_trace<=9",
    *SLOW,
]
SIZE += ["--by", "simulation", "--runs", "32"]


def files(folder):
    return {f.relative_to(folder): f.read_bytes() for f in folder.rglob("*") if f.is_file()}


def said(capsys):
    """What a command printed, without where it writes and how long it took."""
    text = re.sub(r"in \d+\.\d+ s|written to .*", "", capsys.readouterr().out)
    return re.sub(r'"directory": .*', "", text)


@pytest.mark.parametrize("name", with_slow(STUDIES, {"until"}))
def test_parts_of_a_study_are_the_study(name, tmp_path, capsys):
    line, plan, out = STUDIES[name], tmp_path / "plan", tmp_path / "out"
    status = main([*line, "--out", str(tmp_path / "whole"), "--workers", "1"])
    expected = said(capsys)
    assert main([*line, "--out", str(out), "--plan", str(plan), "--tasks", "3"]) == 0
    assert "none of them simulated" in capsys.readouterr().out
    assert not out.exists()
    for part in ("3/3", "1/3"):
        assert main(["work", str(plan), "--part", part]) == (1 if name == "until" else 0)
    assert main(["merge", str(plan)]) == 1
    printed = capsys.readouterr().out
    assert "have no result: " in printed
    assert "or submit these of its 3 jobs again: --array=" in printed
    assert not out.exists()
    assert main(["work", str(plan)]) == 0
    capsys.readouterr()
    assert main(["merge", str(plan)]) == status
    assert said(capsys) == expected
    assert files(out) == files(tmp_path / "whole")
    assert main(["work", str(plan)]) == 0
    assert "0 runs simulated; nothing is left to do" in capsys.readouterr().out


@pytest.mark.slow
def test_a_search_goes_round_by_round(tmp_path, capsys):
    plan = tmp_path / "plan"
    status = main([*SIZE, "--workers", "1"])
    expected = capsys.readouterr().out
    assert main([*SIZE, "--plan", str(plan), "--tasks", "2"]) == 0
    assert "in the first round for 2 jobs" in capsys.readouterr().out
    # The second part ends the first round and begins the next, the last: both ends are enough.
    for part in ("1/2", "2/2", "1/2"):
        assert main(["merge", str(plan)]) == 1
        assert re.search(r"of \d+ runs of round \d have no result", capsys.readouterr().out)
        ended = main(["work", str(plan), "--part", part])
    assert ended == 0
    assert "the next round needs the runs of other parts" not in capsys.readouterr().out
    assert main(["merge", str(plan)]) == status
    assert capsys.readouterr().out == expected


@pytest.fixture
def plan(tmp_path, capsys):
    folder = tmp_path / "plan"
    assert main([*STUDIES["sweep"], "--out", str(tmp_path / "out"), "--plan", str(folder)]) == 0
    capsys.readouterr()
    return folder


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """What the command of ``plan`` writes."""
    folder = tmp_path_factory.mktemp("studies") / "whole"
    assert main([*STUDIES["sweep"], "--out", str(folder), "--workers", "1"]) == 0
    return files(folder)


def one_line(capsys):
    error = capsys.readouterr().err
    assert len(error.splitlines()) == 1
    return error


def test_damaged_and_mixed_results_of_studies(plan, monkeypatch, capsys):
    assert main(["work", str(plan), "--part", "1/2"]) == 0
    block = max((plan / "blocks" / "0002").iterdir(), key=lambda file: file.stat().st_size)
    block.write_bytes(block.read_bytes()[:-9] + b"123456789")
    capsys.readouterr()
    assert main(["merge", str(plan)]) == 1
    printed = capsys.readouterr()
    assert f"{block.name} was changed since it was written" in printed.err
    assert "ensemble 2: 0-" in printed.out
    with monkeypatch.context() as patch:
        other = {**provenance.machine(), "processor": "another"}
        patch.setattr(block_files, "machine", lambda: other)
        assert main(["work", str(plan)]) == 0
    capsys.readouterr()
    assert main(["merge", str(plan)]) == 2
    assert "machines of different kinds" in capsys.readouterr().err.splitlines()[-1]
    assert main(["merge", str(plan), "--mixed"]) == 0
    assert "last digits may be others" in capsys.readouterr().err


def test_a_full_disk_keeps_what_was_written(plan, whole, monkeypatch, capsys):
    written, write = [], Path.write_bytes

    def fills(path, data):
        if len(written) == 2:
            raise OSError(28, "No space left on device")
        written.append(path)
        return write(path, data)

    with monkeypatch.context() as patch:
        patch.setattr(type(plan), "write_bytes", fills)
        assert main(["work", str(plan)]) == 2
    assert "No space left on device" in one_line(capsys)
    kept = files(plan / "blocks")
    assert len(kept) == 2
    assert main(["work", str(plan)]) == 0
    assert "5 runs simulated" in capsys.readouterr().out
    assert kept.items() <= files(plan / "blocks").items()
    assert main(["merge", str(plan)]) == 0
    assert files(plan.with_name("out")) == whole


@pytest.mark.parametrize(("part", "simulated"), [(Part(0, 1), 5), (Part(1, 2), 7)])
def test_two_workers_on_one_block_do_no_harm(part, simulated, plan, whole, monkeypatch, capsys):
    """The second begins and ends before the first has written its block of the first ensemble."""
    add, other = StudyBlocks.add, []
    options = Namespace(trust=False, seconds=None, parse=make_parser().parse_args)

    def meanwhile(*given):
        if not other:
            other.append(None)
            other[0] = work_on_study(open_plan(plan), part, PoolOptions(1), options)
        return add(*given)

    monkeypatch.setattr(StudyBlocks, "add", meanwhile)
    assert main(["work", str(plan)]) == 0
    assert other == [0]
    assert f": {simulated} runs simulated" in capsys.readouterr().out
    assert main(["merge", str(plan)]) == 0
    assert files(plan.with_name("out")) == whole


def test_a_second_merge_knows_the_results_of_the_first(plan, whole, tmp_path, monkeypatch, capsys):
    out = tmp_path / "out"
    assert main(["work", str(plan)]) == 0
    capsys.readouterr()
    assert main(["merge", str(plan)]) == 0
    first = capsys.readouterr().out
    assert main(["merge", str(plan)]) == 0
    again = capsys.readouterr().out
    assert again.splitlines()[:-2] == first.splitlines()[:-2]  # the next one has the time it took
    assert again.splitlines()[-1] == f"nothing left to do in {out}"
    # What a full disk left out of the first, and what is not netkf's.
    (out / "sweep.csv").unlink()
    manifest = json.loads((out / "manifest.json").read_text())
    write_sealed(out / "manifest.json", {**manifest, "status": "failed"})
    (out / "notes.txt").write_text("mine")
    assert main(["merge", str(plan)]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == f"written to {out}"
    assert files(out) == {**whole, Path("notes.txt"): b"mine"}
    (out / "sweep.csv").write_text("edited")
    assert main(["merge", str(plan)]) == 2
    assert "must be a new or empty directory" in one_line(capsys)
    assert (out / "sweep.csv").read_text() == "edited"

    # The default directory is the first free one, unless an earlier one has these results.
    monkeypatch.chdir(tmp_path)
    no_out = shutil.copytree(plan, tmp_path / "no out")
    document = json.loads((no_out / "manifest.json").read_text())
    at = document["arguments"].index("--out")
    del document["sha256"], document["arguments"][at : at + 2]
    write_sealed(no_out / "manifest.json", document)
    for last in (
        "written to runs/poisson-ring-sweep-1",
        "nothing left to do in runs/poisson-ring-sweep-1",
    ):
        assert main(["merge", str(no_out)]) == 0
        assert capsys.readouterr().out.splitlines()[-1] == last
    (tmp_path / "runs" / "poisson-ring-sweep-1" / "sweep.csv").write_text("edited")
    assert main(["merge", str(no_out)]) == 0
    assert files(tmp_path / "runs" / "poisson-ring-sweep-2") == whole


def test_what_is_no_plan_of_a_study_is_refused_in_one_line(plan, tmp_path, capsys):
    changed = shutil.copytree(plan, tmp_path / "changed")
    text = (changed / "scenario.toml").read_text()
    (changed / "scenario.toml").write_text(text.replace("seed = 1", "seed = 2"))
    lines = shutil.copytree(plan, tmp_path / "lines")
    manifest = (lines / "manifest.json").read_text()
    (lines / "manifest.json").write_text(manifest.replace('"5"', '"6"'))
    other = shutil.copytree(plan, tmp_path / "other")
    document = json.loads((other / "manifest.json").read_text())
    document["arguments"] = ["theory", *RING]
    del document["sha256"]
    write_sealed(other / "manifest.json", document)
    for folder in (changed, lines, other):
        for command in ("work", "merge"):
            before = files(folder)
            assert main([command, str(folder)]) == 2
            assert "DIR" in one_line(capsys)
            assert files(folder) == before


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--workers", "2"], "does not go with --plan"),
        (["--vary", "network.activation.rat=1"], "did you mean"),
        (["--out", str(SCENARIOS)], "must be a new or empty directory"),
        (["--plan", str(SCENARIOS)], "--plan: must be a new or empty directory"),
        # Results are written into an empty directory.
        (["--out", "nowhere", "--plan", "nowhere"], "--plan: must lie outside"),
        (["--out", "nowhere", "--plan", "nowhere/plan"], "--plan: must lie outside"),
    ],
)
def test_a_bad_command_line_writes_no_plan(options, words, tmp_path, capsys):
    line = [*STUDIES["sweep"], "--plan", str(tmp_path / "plan")]
    assert main([*line, *options]) == 2
    assert words in one_line(capsys)
    assert not (tmp_path / "plan").exists()


def test_files_of_neighbours_are_merged_into_one(tmp_path):
    """However often they are written, at most a file for each bit of the number of runs is left."""

    class Texts(block_files.BlockFiles):
        """Results that say in which order they were merged."""

        def pack(self, value):
            return {"text": value}

        def unpack(self, arrays):
            return str(arrays["text"])

        def require_fit(self, arrays, stored):
            pass

    def merge(a, b):
        return f"({a}{b})"

    identity = block_files.RunIdentity("x", 1, 13, "none", "")
    blocks, tree = Texts(tmp_path, merge), MergeTree(merge)
    for k in (4, 5, 0, 2, 1, 3, 12, 8, 9, 7, 6, 11, 10):
        tree.add(k, str(k))
        blocks.add((k, 1), str(k), identity, 0.0)
        blocks.write(identity)
    assert blocks.nodes == [(0, 8), (8, 4), (12, 1)]
    assert len(list(tmp_path.iterdir())) == 3
    assert [blocks.load(node) for node in blocks.nodes] == [v for _, _, v in tree.nodes()]


class Squares(NamedTuple):
    values: np.ndarray


@pytest.mark.parametrize("as_list", [True, False])
def test_results_are_found_where_another_worker_has_merged_them(as_list, tmp_path):
    """A study with rounds reads all blocks, while other workers merge theirs with them."""

    def result(*runs):
        return [k * k for k in runs] if as_list else Squares(np.array(runs) ** 2)

    def merge(a, b):
        return a + b if as_list else Squares(np.concatenate([a.values, b.values]))

    form = Form(lambda v: {"values": v}, lambda a: list(a["values"])) if as_list else None
    reader, one, other = (
        StudyBlocks(tmp_path, merge, form or form_of(Squares)) for _ in ("reader", "one", "other")
    )
    identity = block_files.RunIdentity("x", 1, 8, "none", "")
    one.add((2, 2), result(2, 3), identity, 0.0)
    one.write(identity)
    assert reader.find(identity, True)[0] == other.find(identity, True)[0] == [(2, 2)]
    for node in ((0, 2), (4, 4)):
        other.add(node, result(*range(node[0], sum(node))), identity, 0.0)
    other.write(identity)
    assert [file.name for file in tmp_path.iterdir()] == ["000000000-8.npz"]
    found = reader.load((2, 2))
    assert (found if as_list else found.values.tolist()) == [4, 9]
    shutil.rmtree(tmp_path)
    with pytest.raises(EngineError, match="give the same command again"):
        reader.load((2, 2))


def test_a_plan_has_all_that_it_needs(tmp_path, monkeypatch, capsys):
    """Other machines lack the file and the folder in which it was planned."""
    here, elsewhere = tmp_path / "here", tmp_path / "elsewhere"
    here.mkdir(), elsewhere.mkdir()
    shutil.copy(SCENARIOS / "gossip_ring.toml", here)
    monkeypatch.chdir(here)
    line = ["sweep", "gossip_ring.toml", "--vary", "horizon=2,3", "--runs", "2", "--no-plot"]
    assert main([*line, "--set", "probe=1.0", "--out", str(tmp_path / "out"), "--plan", "p"]) == 0
    (here / "p").rename(elsewhere / "p")
    shutil.rmtree(here)
    monkeypatch.chdir(elsewhere)
    assert main(["work", "p"]) == 0
    assert main(["merge", "p"]) == 0
    assert (tmp_path / "out" / "sweep.csv").is_file()
