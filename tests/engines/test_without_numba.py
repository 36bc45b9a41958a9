"""Scenarios run without numba, and with NUMBA_DISABLE_JIT=1, to the same events and states."""

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import netkf
from netkf.linalg.plain import is_plain

ROOT = Path(__file__).parents[2]
HIDDEN = "import sys; sys.modules['numba'] = sys.modules['llvmlite'] = None\n"
SHORT = {
    "ulb_library": 120.0,
    "diffusion_regression": 100.0,
    "intel_lab": 0.5,
    "intel_lab_radio": 0.5,
}
"""Seconds to simulate of scenarios that do little, or much, in the second of the others."""

pytestmark = pytest.mark.skipif(is_plain(), reason="compares plain kernels with compiled ones")


def shortened(path):
    scenario = netkf.load(path)
    horizon = max(scenario.probe, SHORT.get(path.stem, 1.0))
    return dataclasses.replace(scenario, horizon=horizon)


def results(files, engine="simpy"):
    """Fingerprint, and sums of estimates and covariances, of each scenario."""
    made = {}
    for path in map(Path, files):
        run = netkf.simulate(shortened(path), engine=engine)
        made[str(path.relative_to(ROOT))] = [
            run.fingerprint,
            *map(float, (np.abs(run.xhat).sum(), run.P.sum())),
        ]
    return made


def elsewhere(code, **environment):
    told = {**os.environ, "PYTHONPATH": str(ROOT), **environment}
    command = [sys.executable, "-c", code]
    return subprocess.run(command, check=False, env=told, capture_output=True, text=True, cwd=ROOT)


def results_elsewhere(first, files, *engines, **environment):
    code = f"{first}import json; from tests.engines.test_without_numba import results\n"
    code += f"print(json.dumps([results({files!r}, engine) for engine in {engines!r}]))"
    done = elsewhere(code, **environment)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def assert_same(got, expected):
    assert got.keys() == expected.keys()
    for name, (fingerprint, *sums) in expected.items():
        assert got[name][0] == fingerprint, name
        np.testing.assert_allclose(got[name][1:], sums, rtol=1e-10, err_msg=name)


@pytest.mark.parametrize(
    ("pattern", "least"), [("*_r*.toml", 3), pytest.param("**/*.toml", 20, marks=pytest.mark.slow)]
)
def test_simpy_runs_every_scenario_without_numba(pattern, least):
    files = [str(path) for path in sorted((ROOT / "scenarios").glob(pattern))]
    assert len(files) > least
    (got,) = results_elsewhere(HIDDEN, files, "simpy")
    assert_same(got, results(files))


@pytest.mark.slow
def test_both_engines_run_with_compiling_disabled():
    names = ("delayed_links", "intel_lab_radio", "gossip_ring", "push_sum_planar")
    files = [str(ROOT / "scenarios" / f"{name}.toml") for name in names]
    expected = results(files)
    for got in results_elsewhere("", files, "simpy", "compiled", NUMBA_DISABLE_JIT="1"):
        assert_same(got, expected)


def test_auto_takes_simpy_with_a_note_and_compiled_is_refused_in_one_line(tmp_path):
    run = ["run", "scenarios/threshold.toml", "--set", "horizon=2.0", "--engine"]
    commands = [[*run, name, "--out", str(tmp_path / name)] for name in ("auto", "compiled")]
    code = "from netkf.cli.main import main\n"
    code += f"print([main(command) for command in {commands!r}])"
    done = elsewhere(HIDDEN + code)
    assert done.stdout.splitlines()[-1] == "[0, 2]", done.stderr
    *notes, refusal = done.stderr.strip().splitlines()
    assert any("numba is not installed: runs in" in note for note in notes)
    assert 'engine "compiled" needs numba' in refusal
    assert "install it (pip install numba)" in refusal
    assert 'engine "compiled"' not in "".join(notes)
    assert not (tmp_path / "compiled").exists()
    assert json.loads((tmp_path / "auto" / "manifest.json").read_text())["engine"] == "simpy"
