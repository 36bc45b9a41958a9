"""Scenario files as parameters, promises as assertions: on every file of ours that has some."""

import itertools
import os
import re
import subprocess
import sys

import pytest

import netkf
from netkf import testing
from netkf.checks.check import find_checks
from netkf.core.errors import ScenarioError, TheoryError
from tests.checks.broken import Overconfident
from tests.conftest import ROOT, SCENARIOS, with_slow
from tests.testing.test_filters import SOUND

SHORT = {
    "blind_unstable": 8.0,
    "delayed_links": 4.0,
    "diffusion_regression": 40.0,
    "gossip_copies": 48.0,
    "gossip_periodic": 40.0,
    "gossip_ring": 48.0,
    "intermittent_random10": 24.0,
    "poisson_ring": 8.0,
    "push_sum_planar": 10.0,
    "threshold": 8.0,
}
"""Horizons that keep these tests short."""


def is_promising(path):
    """Whether something is promised of the filter of a file that check knows, and anything is
    random that a law could be about.
    """
    scenario = netkf.load(path)
    try:
        find_checks(scenario)
    except TheoryError:
        return False
    return scenario.is_random


def test_all_our_files_are_found():
    found = testing.scenario_files(SCENARIOS)
    assert found == sorted(SCENARIOS.glob("*.toml"))
    assert testing.scenario_files(str(SCENARIOS)) == found
    assert {path.stem for path in found if is_promising(path)} >= {*SHORT, "intermittent_scalar"}


def test_a_folder_without_scenarios_is_no_empty_test(tmp_path):
    with pytest.raises(ScenarioError, match="holds no scenario files"):
        testing.scenario_files(tmp_path)
    with pytest.raises(ScenarioError, match="is not a folder"):
        testing.scenario_files(tmp_path / "nowhere")


LONG = ("blind_unstable", "delayed_links", "diffusion_regression", "intermittent_random10")


@pytest.mark.one_in(2)
@pytest.mark.parametrize("name", with_slow(SHORT, LONG))
def test_the_promises_of_our_files_are_kept(name):
    horizon = SHORT[name]
    scenario = netkf.load(SCENARIOS / f"{name}.toml").replace(
        {"horizon": horizon, "probe": [horizon]}
    )
    assert testing.assert_promises(scenario, runs=10, confidence=0.999, workers=1) is None


@pytest.mark.one_in(3)
@pytest.mark.parametrize("path", testing.scenario_files(SCENARIOS), ids=lambda path: path.stem)
def test_the_parts_of_our_files_keep_their_contracts(path):
    scenario = netkf.load(path)
    # The filters of test_filters.py keep theirs.
    assert any(
        type(scenario.filter.algorithm) is type(part) for part in itertools.chain(*SOUND.values())
    )
    clock = scenario.network.activation
    if isinstance(clock, netkf.parts.LinkClock):
        testing.check_clock(clock, link=scenario.topology.links[0])


@pytest.mark.slow
def test_the_channels_of_our_files_keep_their_contracts():
    channels = {}
    for path in testing.scenario_files(SCENARIOS):
        channel = netkf.load(path).network.channel
        channels[repr((channel.loss, channel.delay))] = channel
    assert len(channels) > 3
    for channel in channels.values():
        testing.check_channel(channel)


def test_covariances_stay_above_the_exact_ones_of_the_errors(ring):
    """H (10), given the events of one run, as an assertion of a test suite."""
    run = netkf.simulate(ring.replace({"horizon": 4.0}))
    exact = netkf.theory.error_covariance(ring, run)
    assert testing.assert_dominated(exact, run.P) is None
    with pytest.raises(AssertionError, match=r"P\[\d+, \d+\]: must stay below the bound"):
        testing.assert_dominated(run.P, exact)


@pytest.mark.slow
@pytest.mark.parametrize("path", testing.scenario_files(SCENARIOS), ids=lambda path: path.stem)
def test_the_promises_of_our_files_are_kept_in_full(path):
    if not is_promising(path):
        pytest.skip("nothing is promised")
    testing.assert_promises(path, runs=500)


def test_a_broken_promise_fails_with_its_row():
    scenario = netkf.load(SCENARIOS / "intermittent_scalar.toml")
    wrong = scenario.replace(
        {"filter": {"kind": f"{Overconfident.__module__}:{Overconfident.__name__}"}}
    )
    with pytest.raises(AssertionError) as caught:
        testing.assert_promises(wrong, runs=30)
    head, *rows = str(caught.value).splitlines()
    assert head.startswith("intermittent-scalar: ")
    assert "promises are broken (30 runs from seed 1, confidence 0.99)" in head
    assert len(rows) == int(head.split()[1])
    assert all(" [" in row and "margin" in row for row in rows)


def test_where_nothing_is_promised_theory_says_so(build):
    filtering = {"kind": "tests.checks.broken:OwnReset", "epsilon": 0.3}
    with pytest.raises(TheoryError, match="nothing is promised of OwnReset"):
        testing.assert_promises(build(filter=filtering))


def test_the_names_are_public():
    assert netkf.testing is testing
    for name in testing.__all__:
        assert callable(getattr(testing, name))
    assert dir(testing) == sorted(testing.__all__)
    with pytest.raises(AttributeError, match="no attribute 'check_weather'"):
        _ = testing.check_weather


@pytest.mark.slow
def test_the_ten_lines_of_the_reference_are_a_test_file(tmp_path):
    """The example of a user's test file, run by pytest as a user would."""
    text = (ROOT / "docs" / "scenario_files.md").read_text(encoding="utf-8")
    listed = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)
    [example] = [snippet for snippet in listed if "import pytest" in snippet]
    (tmp_path / "scenarios").mkdir()
    source = (SCENARIOS / "gossip_ring.toml").read_text()
    short = source.replace("horizon = 400.0", "horizon = 24.0")
    assert short != source
    (tmp_path / "scenarios" / "ring.toml").write_text(short)
    (tmp_path / "test_mine.py").write_text(example)
    (tmp_path / "fusion.py").write_text(FUSION)
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--rootdir=."],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        # Nothing that happens to be installed here is loaded.
        env={**os.environ, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"},
    )
    assert "3 passed" in done.stdout, done.stdout + done.stderr


FUSION = '''
from dataclasses import dataclass

from netkf.parts import ExponentialDelay, Hybrid


@dataclass(frozen=True, eq=False)
class MyFilter(Hybrid):
    """One's own."""


class MyDelay(ExponentialDelay):
    """One's own."""
'''
