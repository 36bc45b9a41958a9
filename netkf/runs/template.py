"""``netkf new``: a first scenario and its tests, to start from."""

from __future__ import annotations

import contextlib
import re
from pathlib import Path

from netkf.core.errors import ScenarioError
from netkf.runs.files import writing_file

NAME_PATTERN = re.compile(r"[A-Za-z][A-Za-z0-9_-]{0,60}")

SCENARIO = """\
# netkf run {name}.toml                  simulates it
# netkf theory {name}.toml               computes what theory promises
# netkf check {name}.toml --runs 200     compares the two
# Every key is in `netkf schema --markdown`. For an editor: netkf schema > netkf.schema.json, and as
# first line #:schema ./netkf.schema.json
format  = 1
name    = "{name}"
claim   = "the covariances stay below the coupled Riccati bound in the mean"
horizon = 10.0    # simulated seconds
probe   = 0.5     # period of the samples of the state, seconds
seed    = 1       # the same seed gives the same run

[plant]           # dx = A x dt + B dw: position and velocity of something that is pushed at random
kind = "diffusion"
A    = [[0.0, 1.0], [-0.5, -0.2]]
B    = [[0.0], [1.0]]
cov  = [[4.0, 0.0], [0.0, 1.0]]    # of x(0), whose mean is 0

[[sensors]]       # dy = H x dt + dv, cov(dv) = R dt, at each of these nodes
nodes = [0, 2]
H     = [[1.0, 0.0]]
R     = [[0.25]]
# sampling = {{ kind = "poisson", rate = 5.0 }}    # samples y = H x + v in place of increments

[network]         # a ring; each link ticks by itself, and both ends send what they know
graph      = {{ kind = "cycle", nodes = 5 }}
activation = {{ kind = "poisson", rate = 2.0 }}

[network.channel] # `symmetric = true`: both messages of a tick come or none
loss      = {{ kind = "bernoulli", delivery = 0.7 }}
delay     = {{ kind = "none" }}
symmetric = true

[filter]          # resets with weight epsilon, at most one over the most links of a node
kind    = "hybrid"
epsilon = 0.3
"""

TESTS = '''\
"""Tests of {name}.toml: `pytest {file}`."""

from pathlib import Path

import netkf
import pytest
from netkf import testing

SCENARIO = Path(__file__).with_name("{name}.toml")


@pytest.mark.parametrize(("rate", "delivery"), [(1.0, 0.5), (4.0, 1.0)])
def test_no_promise_is_broken(rate, delivery):
    changes = {{"network.activation.rate": rate, "network.channel.loss.delivery": delivery}}
    testing.assert_promises(netkf.load(SCENARIO, changes), runs=25)


@pytest.mark.parametrize("seed", range(3))
def test_a_run_completes_and_a_seed_repeats_it(seed):
    scenario = netkf.load(SCENARIO)
    run, again = (netkf.simulate(scenario, seed=seed) for _ in range(2))
    assert run.status == "complete"
    assert netkf.first_difference(run, again) is None


def test_the_mean_covariance_stays_below_the_bound():
    scenario = netkf.load(SCENARIO)
    ensemble = netkf.monte_carlo(scenario, runs=100, workers=1)
    bound = netkf.theory.covariance_bound(scenario, ensemble.times)
    testing.assert_dominated(ensemble.mean_P, bound, tolerance=0.3)
'''


def write_template(name: str, folder: Path) -> tuple[Path, Path]:
    """Write NAME.toml and test_NAME.py into a folder and return their paths; raises ScenarioError
    for a wrong name or an existing file, and WriteError after removing both.
    """
    if not NAME_PATTERN.fullmatch(name):
        rule = "must be a letter, then letters, digits, - and _"
        raise ScenarioError("NAME", rule, name, "choose another name, without .toml")
    paths = folder / f"{name}.toml", folder / f"test_{name.replace('-', '_')}.py"
    for path in paths:
        if path.exists():
            rule = "is there already, and nothing is overwritten"
            raise ScenarioError(str(path), rule, None, "choose another name or remove it")
    created: list[Path] = []
    try:
        for path, text in zip(paths, (SCENARIO, TESTS), strict=True):
            # Mode "x" fails if another process has written the file in the meantime.
            with writing_file(path), path.open("x", encoding="utf-8") as file:
                created.append(path)
                file.write(text.format(name=name, file=paths[1].name))
    except BaseException:
        for path in created:
            with contextlib.suppress(OSError):
                path.unlink()
        raise
    return paths
