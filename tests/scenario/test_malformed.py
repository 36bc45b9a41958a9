"""Whatever a file or a setting holds, it is refused in one line, soon, or it is a scenario.

``python -m tests.scenario.malformed`` runs thousands of drawn cases as commands.
"""

import contextlib
import functools
import os
import resource
import subprocess
import sys
import time
import tomllib

import pytest

import netkf
from netkf.cli.options import parse_changes
from netkf.scenario.reading import parse_toml
from tests.conftest import SCENARIOS
from tests.scenario import malformed

MEMORY = 1 << 30


@functools.cache
def seconds():
    """Return how long the reader of TOML needs for 10^6 numbers: here and now."""
    began = time.process_time()
    tomllib.loads("a = [" + "1," * 10**5 + "]")
    return 10.0 * (time.process_time() - began)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("malformed")
    malformed.prepare(place)
    return place


@pytest.mark.one_in(3)
@pytest.mark.parametrize("first", range(0, 300, 50))
def test_drawn_cases_are_refused_in_one_line_or_are_scenarios(folder, first):
    for seed in range(first, first + 50):
        case = malformed.draw(seed)
        malformed.write(case, folder)
        words = case.arguments
        settings = [words[k + 1] for k, word in enumerate(words) if word == "--set"]
        began = time.process_time()
        with contextlib.suppress(netkf.ScenarioError):
            try:
                netkf.load(folder / words[1], parse_changes(settings), trust=False)
            except netkf.ScenarioError as error:
                line = str(error)
                assert line.isprintable(), seed
                assert len(line) < 2500, seed
                raise
        assert time.process_time() - began < 4.0 * seconds(), seed
    assert not (folder / "ran").exists()


RING, SLOTS = "poisson_ring.toml", "gossip_ring.toml"
CLOCK = {"kind": "poisson", "rate": 1}
CLOCKED = [{"nodes": [0], "H": [[1.0, 0.0]], "R": [[1.0]], "sampling": CLOCK}]
FAR = {"kind": "constant", "seconds": 2.0**63}
LIMITS = [
    (SLOTS, {"plant.period": 5e-324}, "plant.period", "from 1e-09 to 1e"),
    (SLOTS, {"plant.period": 1e-9, "horizon": 3.0, "probe": 1.0}, "plant.period", "slots"),
    (SLOTS, {"horizon": 3e9, "probe": 1e9}, "plant.period", "100,000,000 slots"),
    (RING, {"horizon": 5e-324, "probe": 5e-324}, "horizon", "from 1e-09 to 1e"),
    (RING, {"horizon": 1e300}, "horizon", "from 1e-09 to 1e"),
    (RING, {"probe": 5e-324}, "probe", "from 1e-09 to 1e"),
    (RING, {"probe": 1e-9}, "probe", "at most 10,000,000 samples"),
    (RING, {"probe": 1e-6, "horizon": 10.0}, "probe", "entries of covariances"),
    (RING, {"network.graph.nodes": 100_000, "probe": 0.01}, "probe", "entries of covariances"),
    (RING, {"plant.sensing_period": 5e-324}, "plant.sensing_period", "100,000,000 steps"),
    (RING, {"plant.A": [[0.0, 1e20], [-1.0, 0.1]], "sensors": CLOCKED}, "plant.A", "1e+15 time"),
    (RING, {"plant.A": [[1e8, 0.0], [0.0, 1e8]], "sensors": CLOCKED}, "plant.A", "grow"),
    (RING, {"network.channel.delay": FAR}, "plant.A", "delay of 9.2"),
    (RING, {"seed": 16**10_000}, "seed", "integer"),
    (RING, {"seed.x": [1] * 1_000_000}, "seed.x", "is not a key path"),
    (RING, {"name": [1] * 1_000_000}, "name", "one line of text"),
    (RING, {"filter.kind": ["hybrid"] * 1_000_000}, "filter.kind", "must be one of"),
    (RING, {"network.graph.kind": "x" * 1_000_000}, "network.graph.kind", "must be one of"),
    (RING, {"x" * 1_000_000: 1}, "x" * 60, "is not a key here"),
    (RING, {"a" + ".b" * 50_000: 1}, "a.b.b", "is not a key path"),
    (RING, {"plant.A": malformed.nest(400)}, "plant.A", "matrix"),
]
GRAPHS = [
    {"kind": "cycle", "nodes": 10**9},
    {"kind": "cycle", "nodes": 1_000_000},
    {"kind": "complete", "nodes": 1_000_000},
    {"kind": "complete", "nodes": 4000},
    {"kind": "geometric", "nodes": 1_000_000, "radius": 0.5},
    {"kind": "geometric", "nodes": 20_000, "radius": 1.5},
    {"kind": "geometric", "nodes": 20_000, "radius": 1e300},
    {"kind": "erdos-renyi", "nodes": 1_000_000, "p": 1e-5},
    {"kind": "regular", "nodes": 1_000_000, "degree": 999},
    {"kind": "regular", "nodes": 1_000_000, "degree": 999_998},
    {"kind": "grid", "rows": 1_000_000, "columns": 1_000_000},
    {"kind": "edges", "edges": [[0, 1]], "nodes": 10**7},
]
LIMITS += [(RING, {"network.graph": g}, "network.graph", "at most") for g in GRAPHS]


@pytest.mark.one_in(3)
@pytest.mark.parametrize(("file", "changes", "key", "words"), LIMITS)
def test_sizes_are_answered_before_they_hurt(file, changes, key, words):
    began, before = time.process_time(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(netkf.ScenarioError) as refused:
        netkf.load(SCENARIOS / file, changes)
    assert refused.value.key.startswith(key)
    assert words in str(refused.value)
    assert len(str(refused.value)) < 1000
    assert time.process_time() - began < 2.0 * seconds()
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < MEMORY >> 10


def test_a_graph_that_is_never_connected_is_given_up_soon():
    began = time.process_time()
    graph = {"kind": "geometric", "nodes": 20_000, "radius": 0.001, "connected": True}
    with pytest.raises(netkf.ScenarioError, match=r"none of \d+ graphs"):
        netkf.load(SCENARIOS / RING, {"network.graph": graph})
    assert time.process_time() - began < 6.0 * seconds()


@pytest.mark.one_in(3)
@pytest.mark.parametrize("number", range(len(malformed.DOCUMENTS)))
def test_documents_that_are_hard_to_read_are_refused_soon(tmp_path, number):
    file = tmp_path / "case.toml"
    file.write_text(malformed.DOCUMENTS[number])
    began = time.process_time()
    with pytest.raises(netkf.ScenarioError) as refused:
        netkf.load(file)
    assert str(refused.value).isprintable()
    assert len(str(refused.value)) < 1000
    assert time.process_time() - began < 2.0 * seconds()


def test_a_device_that_never_ends_is_no_scenario(tmp_path):
    with pytest.raises(netkf.ScenarioError, match="at most 64 MiB"):
        netkf.load("/dev/zero")
    (tmp_path / "readings.csv").symlink_to("/dev/zero")
    changes = {"network.activation": {"kind": "recorded", "path": "readings.csv"}}
    text = (SCENARIOS / RING).read_text()
    (tmp_path / "ring.toml").write_text(text)
    with pytest.raises(netkf.ScenarioError, match=r"network\.activation\.path"):
        netkf.load(tmp_path / "ring.toml", changes)


@pytest.mark.slow
def test_large_tables_are_refused_or_read_in_bounded_memory(tmp_path):
    """A table of 4 MB, and one whose size alone is too large."""
    (tmp_path / "ring.toml").write_text((SCENARIOS / RING).read_text())
    rows = "".join(f"{0.001 * k:.3f},{k % 6},{(k + 1) % 6}\n" for k in range(1, 300_000))
    (tmp_path / "ticks.csv").write_text("t,node,peer\n" + rows)
    code = "import netkf, re, sys; print(netkf.load('ring.toml', {'network.activation': "
    code += "{'kind': 'recorded', 'path': sys.argv[1]}}).network.activation.rows.size, "
    # The peak of this program: that of getrusage begins with that of the process it was forked of.
    code += "re.search(r'VmHWM:\\s*(\\d+)', open('/proc/self/status').read())[1])"
    command = [sys.executable, "-c", code]

    def run(name):
        done = subprocess.run(
            [*command, name], cwd=tmp_path, capture_output=True, text=True, check=False
        )
        return done.stdout + done.stderr

    rows_read, kilobytes = run("ticks.csv").split()
    assert int(rows_read) == 299_999
    assert int(kilobytes) < MEMORY >> 10
    with (tmp_path / "large.csv").open("wb") as file:
        os.truncate(file.fileno(), 10**12)
    assert "large.csv must have at most 256 MiB" in run("large.csv")


@pytest.mark.parametrize("option", ["--runs", "--workers", "--seed", "--replica"])
@pytest.mark.parametrize("value", ["9" * 13, "9" * 5000, "0x1", "²", "\n", "-1"])
def test_absurd_options_are_refused_in_one_line(folder, capsys, monkeypatch, option, value):
    if (option, value) == ("--seed", "9" * 13):
        value = "9" * 31
    monkeypatch.chdir(folder)
    status, out, err = malformed.attempt(["run", RING, option, value])
    assert (status, out, err.count("\n")) == (2, "", 1)
    assert err.strip().isprintable()


def test_long_lines_of_numbers_are_read_as_toml_reads_them(tmp_path):
    rows = [[k, k + 0.5, -1e-3 * k] for k in range(20_000)]
    text = f"a = {rows}\n[b]\n  c = {list(range(30_000))}\nd = '{'1,' * 60_000}'\n"
    odd = "e = [" + "1_000, " * 20_000 + "]\nf = [" + "+1.0, inf, 2020-01-01, " * 10_000 + "]\n"
    odd += "g = [" + "1," * 60_000 + "]\nh = [[" + "1,2 , ],[" * 20_000 + "3,] , ]\n"
    assert parse_toml(text + odd) == tomllib.loads(text + odd)
    for wrong in ("01, " * 50_000, " , " * 50_000, "1, " * 50_000 + ", 1", "1 2," * 50_000):
        with pytest.raises(tomllib.TOMLDecodeError):
            parse_toml(f"a = [{wrong}]\n")


def test_a_regressor_that_overflows_is_named():
    regression = netkf.load(SCENARIOS / "diffusion_regression.toml")
    A = (1e20 * regression.sensors[0].A).tolist()
    with pytest.raises(netkf.TheoryError, match="regressor sensor overflows"):
        netkf.theory.information_level(regression.replace({"sensors.0.A": A}))


@pytest.mark.parametrize("words", [["run", RING, "--set"], ["sweep", RING, "--vary"]])
def test_lines_about_long_keys_are_short(words):
    for value in ("[", "[[1,", "x" * 2000, ""):
        status, _, err = malformed.attempt([*words, f"{'x' * 50_000}={value}"])
        assert status == 2
        assert err.count("\n") == 1
        assert len(err) < 2500
