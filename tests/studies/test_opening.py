"""``netkf.open`` against what was in memory when the directory was written."""

import json
import shutil

import numpy as np
import pandas as pd
import pytest

import netkf
from netkf.checks.storage import save_verdict
from netkf.ensembles.directory import EnsembleOptions, runs_to_directory
from netkf.ensembles.pools import PoolOptions
from netkf.runs.documents import file_digests, write_sealed
from netkf.runs.run import run_to_directory
from netkf.scenario.writing import resolve_defaults, to_toml
from netkf.studies.compare_filters import compare_filters, write_comparison
from netkf.studies.sweep import plan_sweep, sweep_to_directory
from netkf.studies.tables import format_filters
from tests.conftest import SCENARIOS

SHORT = {"horizon": 3.0, "probe": 0.5}


@pytest.fixture(scope="module")
def short():
    return netkf.load(SCENARIOS / "poisson_ring.toml", SHORT)


@pytest.fixture(scope="module")
def kept(short, tmp_path_factory):
    """The directory of an ensemble of five runs that kept all traces."""
    folder = tmp_path_factory.mktemp("kept") / "many"
    runs_to_directory(short, 5, folder, EnsembleOptions(trace="full", pool=PoolOptions(1)))
    return folder


def assert_same_run(found, run):
    assert netkf.first_difference(found, run) is None
    assert (found.nodes, found.seed, found.replica) == (run.nodes, run.seed, run.replica)
    for name in ("times", "x", "xhat", "P", "error", "sq_error", "nees"):
        np.testing.assert_allclose(getattr(found, name), getattr(run, name), rtol=1e-9, atol=1e-12)
    pd.testing.assert_frame_equal(found.states, run.states)
    assert repr(found) == repr(run)


@pytest.mark.parametrize("function", [netkf.open, netkf.load, lambda x: netkf.why(x, 0, 1.0)])
@pytest.mark.parametrize("value", [3, None, b"x", netkf.load(SCENARIOS / "poisson_ring.toml")])
def test_what_is_no_path_is_refused(function, value):
    with pytest.raises(netkf.ScenarioError, match="must be a path"):
        function(value)


@pytest.mark.one_in(2)
@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("poisson_ring", SHORT),
        ("push_sum_planar", {"horizon": 2.0}),  # sums that exchanges conserve
        ("gossip_periodic", {"horizon": 40.0}),  # the state grows
        ("ulb_library", {"horizon": 300.0}),  # no truth
    ],
)
def test_a_run_comes_back_as_it_was(name, changes, tmp_path):
    scenario = netkf.load(SCENARIOS / f"{name}.toml", changes)
    run = netkf.simulate(scenario)
    found = netkf.open(netkf.save(run, scenario, tmp_path / "run"))
    assert_same_run(found, run)
    assert (found.status, found.engine) == (run.status, run.engine)
    assert (found.fingerprint, found.truth_known) == (run.fingerprint, run.truth_known)
    assert found.sums == run.sums
    assert to_toml(resolve_defaults(found.scenario)) == to_toml(resolve_defaults(scenario))
    bound = found.bound
    assert (bound is None) == (name != "poisson_ring")
    if bound is not None:
        exact = np.trace(netkf.theory.covariance_bound(scenario, run.times), axis1=2, axis2=3)
        np.testing.assert_allclose(bound, exact, rtol=1e-12)


@pytest.mark.slow
def test_errors_keep_the_digits_that_were_written(tmp_path):
    """A state of 1e12 leaves no digits of x - xhat, and the tables have them."""
    changes = {"plant.mean": [1e13, 0.0], "plant.A": [[0.0, 1.0], [-1.0, 4.0]], **SHORT}
    scenario = netkf.load(SCENARIOS / "poisson_ring.toml", changes)
    run = netkf.simulate(scenario)
    assert run.exact_errors
    found = netkf.open(netkf.save(run, scenario, tmp_path / "run"))
    assert np.abs(run.x).max() > 1e12
    del found.states["sq_error"]  # of a copy
    np.testing.assert_array_equal(found.sq_error, run.sq_error)
    assert found.rounding_from < np.inf


def test_an_ensemble_comes_back_as_it_was(short, kept, monkeypatch):
    ensemble, found = netkf.monte_carlo(short, 5, workers=1), netkf.open(kept)
    pd.testing.assert_frame_equal(found.table, ensemble.table, rtol=1e-12)
    for name in ("average", "se_average", "runs", "times"):
        np.testing.assert_array_equal(getattr(found, name), getattr(ensemble, name))
    for name in ("nodes", "messages", "diverged", "events", "seed", "fingerprint", "truth_known"):
        assert getattr(found, name) == getattr(ensemble, name)
    assert repr(found) == repr(ensemble)
    assert_same_run(found.replica(3), netkf.simulate(short, replica=3))
    monkeypatch.chdir(kept.parent)
    found = netkf.open(kept.name)
    monkeypatch.chdir("/")
    assert_same_run(found.replica(3), netkf.simulate(short, replica=3))
    with pytest.raises(netkf.ScenarioError, match="has not kept the trace of replica; got 5"):
        found.replica(5)


def test_a_sweep_comes_back_as_it_was(short, tmp_path):
    vary = {
        "network.activation.rate": [1.0, 4.0],
        "filter": [{"kind": "local"}, {"kind": "central"}],
    }
    done = sweep_to_directory(plan_sweep(short, vary, 2), tmp_path / "sweep", PoolOptions(1))
    found = netkf.open(tmp_path / "sweep")
    assert found.keys == tuple(vary)
    assert (found.status, found.scenario.name) == ("complete", short.name)
    pd.testing.assert_frame_equal(found.table, done.table, check_dtype=False)
    assert repr(found) == (
        "<netkf sweep of 'poisson-ring': complete, 4 points of network.activation.rate, filter>"
    )


@pytest.fixture(scope="module")
def compare(tmp_path_factory):
    """A function: a comparison over some runs of which one filter cannot run there, and its
    directory.
    """

    def compare(runs):
        slots = netkf.load(SCENARIOS / "push_sum_planar.toml", {"horizon": 2.0})
        filters = ["push-sum", {"kind": "hcmci", "steps": 2}, "central", "hybrid"]
        comparison = compare_filters(slots, filters, runs, workers=1)
        folder = tmp_path_factory.mktemp("compared") / "filters"
        return comparison, write_comparison(slots, comparison, folder)

    return compare


@pytest.fixture(scope="module")
def compared(compare):
    return compare(4)


def test_a_comparison_of_single_runs_comes_back_as_it_was(compare):
    """One run leaves the consistency of all filters unknown, and that of one that cannot run."""
    comparison, folder = compare(1)
    found = netkf.open(folder)
    assert [row.consistency for row in found.rows] == ["-"] * 4
    assert [row.ran for row in found.rows] == [row.ran for row in comparison.rows]
    pd.testing.assert_frame_equal(found.table, comparison.table)
    assert format_filters(found) == format_filters(comparison)


def test_a_comparison_of_filters_comes_back_as_it_was(compared):
    comparison, folder = compared
    found = netkf.open(folder)
    pd.testing.assert_frame_equal(found.table, comparison.table)
    assert (found.runs, found.seed, found.confidence) == (4, comparison.seed, 0.95)
    assert repr(found) == repr(comparison)
    assert format_filters(found) == format_filters(comparison)
    assert found.base.name == "push-sum-planar"
    assert "hcmci steps=2" in found._repr_html_()


def test_a_comparison_that_was_changed_is_refused(compared, tmp_path):
    _, folder = compared
    for name, words in (
        ("filters.parquet", "filters.parquet was changed since"),
        ("manifest.json", "manifest.json"),
    ):
        copy = shutil.copytree(folder, tmp_path / name)
        (copy / name).write_bytes((folder / name).read_bytes()[:-40])
        assert words in refused(copy)
    copy = shutil.copytree(folder, tmp_path / "other")
    manifest = json.loads((copy / "manifest.json").read_text())
    del manifest["sha256"]
    write_sealed(copy / "manifest.json", {**manifest, "filters": ["kcf"]})
    assert "does not have the filters of the manifest" in refused(copy)
    write_sealed(copy / "manifest.json", {**manifest, "confidence": None})
    assert "needs a number at confidence" in refused(copy)


def test_a_verdict_comes_back_as_it_was(short, tmp_path):
    verdict = netkf.check(short, runs=10, workers=1)
    save_verdict(tmp_path, short, verdict)
    found = netkf.open(tmp_path)
    assert (found.runs, found.seed, found.confidence) == (10, verdict.seed, verdict.confidence)
    assert bool(found) == bool(verdict)
    assert len(repr(found)) < 120
    assert repr(found).startswith("<netkf verdict on 'poisson-ring': ")
    for name in ("promise", "verdict", "seen", "low"):
        expected = verdict.table[name].replace([np.inf, -np.inf], np.nan)
        pd.testing.assert_series_equal(found.table[name], expected, check_dtype=False)
    assert "E[P_i(t)]" in found._repr_html_() or "promise" in found._repr_html_()


def interrupt(*_):
    raise KeyboardInterrupt


def test_what_was_interrupted_has_what_was_kept(short, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        run_to_directory(short, tmp_path / "one", progress=interrupt)
    assert netkf.open(tmp_path / "one").status == "interrupted"
    calls = []

    def after_two(done, wanted):
        calls.append(done)
        if len(calls) == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        runs_to_directory(
            short, 40, tmp_path / "many", EnsembleOptions(pool=PoolOptions(1)), progress=after_two
        )
    found = netkf.open(tmp_path / "many")
    done = int(found.runs[0])
    assert (found.status, 0 < done < 40) == ("interrupted", True)
    whole = netkf.monte_carlo(short, done, workers=1)
    np.testing.assert_allclose(found.mean_P, whole.mean_P, rtol=1e-10)
    points = plan_sweep(short, {"seed": [1, 2]})
    for done, when in ((1, {"progress": interrupt}), (2, {"finish": interrupt})):
        with pytest.raises(KeyboardInterrupt, match="what was finished is kept in"):
            sweep_to_directory(points, tmp_path / str(done), PoolOptions(1), **when)
        found = netkf.open(tmp_path / str(done))
        assert (found.status, len(found.table)) == ("interrupted", done)
        kept = json.loads((tmp_path / str(done) / "manifest.json").read_text())
        assert kept["runs"] == {"wanted": 2, "done": done}


def test_without_tables_there_are_no_samples(short, tmp_path):
    run_to_directory(short, tmp_path / "none", trace="none")
    found = netkf.open(tmp_path / "none")
    assert (len(found.times), len(found.log), found.xhat.shape) == (0, 0, (0, 6, 2))
    assert found.summary["overall"]["rms_error"] > 0.0


def refused(path):
    with pytest.raises(netkf.ScenarioError) as error:
        netkf.open(path)
    line = str(error.value)
    assert line.isprintable()
    return line


def test_what_is_no_directory_of_netkf_is_one_line(tmp_path):
    assert "cannot be opened: manifest.json is missing; name a directory" in refused(tmp_path)
    assert "it does not exist" in refused(tmp_path / "nowhere")
    (tmp_path / "file").touch()
    assert "it is no directory" in refused(tmp_path / "file")
    (tmp_path / "verdict.json").touch()
    assert "verdict.json cannot be read" in refused(tmp_path)


def reseal(folder):
    found = json.loads((folder / "manifest.json").read_text())
    del found["sha256"]
    found["files"] = file_digests(folder, found["files"])
    write_sealed(folder / "manifest.json", found)


DAMAGE = {
    "states.parquet": {
        "rows": lambda t: t.iloc[1:],
        "order": lambda t: t.iloc[::-1],
        "columns": lambda t: t.rename(columns={"P01": "P10"}),
        "nodes": lambda t: t.assign(node=7),
        "times": lambda t: t.assign(t=t.t + 1e-3 * (t.index == 1)),
        "text": lambda t: t.assign(x0="1"),
    },
    "events.parquet": {
        "kinds": lambda t: t.assign(kind="explode"),
        "numbers for kinds": lambda t: t.assign(kind=1),
        "nodes": lambda t: t.assign(peer=77),
        "order": lambda t: t.iloc[::-1],
        "columns": lambda t: t.drop(columns="age"),
        "missing": lambda t: t.assign(t=np.nan),
    },
    "ensemble.parquet": {
        "rows": lambda t: t.iloc[1:],
        "columns": lambda t: t.drop(columns="nees"),
        "missing": lambda t: t.assign(runs=np.nan),
    },
}
CASES = [(name, how) for name, table in DAMAGE.items() for how in table]


@pytest.mark.parametrize(("name", "how"), CASES)
def test_a_damaged_table_is_one_line_that_names_it(kept, tmp_path, name, how):
    copy = shutil.copytree(kept, tmp_path / "copy")
    damaged = DAMAGE[name][how](pd.read_parquet(copy / name))
    damaged.to_parquet(copy / name, index=False)
    if name == "ensemble.parquet":
        assert "was changed since the run ended" in refused(copy)
    reseal(copy)
    if name == "ensemble.parquet":
        assert name in refused(copy)
        return
    with pytest.raises(netkf.ScenarioError, match=name):
        netkf.open(copy).replica(0)


@pytest.mark.parametrize(
    ("damage", "complaint"),
    [
        (lambda t: t.assign(worst_rms_se="much"), "texts in columns of numbers: worst_rms_se"),
        (lambda t: t.assign(bound="none"), "texts in columns of numbers: bound"),
        (lambda t: t.drop(columns="mean_rms_se"), "no column mean_rms_se"),
    ],
)
def test_a_damaged_table_of_a_sweep_is_one_line_that_names_its_column(
    short, tmp_path, damage, complaint
):
    folder = tmp_path / "sweep"
    sweep_to_directory(plan_sweep(short, {"filter.epsilon": [0.1, 0.3]}), folder, PoolOptions(1))
    damage(pd.read_parquet(folder / "sweep.parquet")).to_parquet(folder / "sweep.parquet")
    assert f"sweep.parquet has {complaint}" in refused(folder)


def test_modules_of_a_directory_are_not_imported_without_trust(tmp_path):
    module = tmp_path / "mine.py"
    module.write_text("import netkf\n\nclass Mine(netkf.parts.Hybrid):\n    pass\n")
    toml = (SCENARIOS / "poisson_ring.toml").read_text().replace('"hybrid"', '"mine:Mine"')
    (tmp_path / "mine.toml").write_text(toml.replace("horizon = 20.0", "horizon = 1.0"))
    scenario = netkf.load(tmp_path / "mine.toml")
    folder = netkf.save(netkf.simulate(scenario), scenario, tmp_path / "run")
    assert "trust" in refused(folder)
    assert type(netkf.open(folder, trust=True).scenario.filter.algorithm).__name__ == "Mine"


def test_open_is_no_name_that_a_star_brings():
    names = {}
    exec("from netkf import *", names)
    assert "open" not in names
    assert "open" in dir(netkf)
