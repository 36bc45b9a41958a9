"""Runs and ensembles in xarray, and in netCDF files that h5py and xarray read."""

import sys

import numpy as np
import pytest

import netkf
from netkf.cli.main import main
from tests.conftest import SCENARIOS

xarray = pytest.importorskip("xarray")


def test_a_dataset_has_what_the_run_has(run):
    dataset = run.to_xarray()
    assert dataset.sizes["time"] == len(run.times)
    lab = dict(zip(dataset.name.values, dataset.node.values, strict=True))["lab"]
    one = dataset.sel(node=lab, time=2.0)
    k, row = list(run.nodes).index(lab), run.states[(run.states.t == 2.0)]
    row = row[row.node == lab].iloc[0]
    assert float(one.xhat.sel(state=1)) == row.xhat1
    assert float(one.P.sel(state=0, other_state=1)) == row.P01
    assert (float(one.node_x), float(one.node_y)) == (3.0, 4.0)
    assert tuple(dataset.state_label.values) == run.scenario.state_labels
    np.testing.assert_array_equal(dataset.error.isel(node=k), run.x - run.xhat[:, k])
    kinds = dict(
        zip(
            dataset.event_kind.flag_values,
            dataset.event_kind.flag_meanings.split(),
            strict=True,
        )
    )
    assert [kinds[code] for code in dataset.event_kind.values] == list(run.events.kind)
    np.testing.assert_array_equal(dataset.event_t, run.events.t)


def test_netcdf_loses_nothing(run, tmp_path):
    h5py = pytest.importorskip("h5py")
    (path,) = netkf.export_netcdf(run, tmp_path)
    xarray.testing.assert_identical(xarray.load_dataset(path), run.to_xarray())
    with h5py.File(path) as file:  # without xarray's own reader
        assert file["P"][:].tobytes() == run.P.tobytes()
        assert file["event_age"][:].tobytes() == np.ascontiguousarray(run.log["age"]).tobytes()
        text = file["scenario"][()].decode()
    with pytest.raises(netkf.ScenarioError, match="exists already"):
        netkf.export_netcdf(run, path)
    copy = tmp_path / "copy.toml"
    copy.write_text(text)
    again = netkf.simulate(netkf.load(copy), engine="simpy")
    assert netkf.first_difference(run, again) is None


def test_an_ensemble_and_its_directory(tmp_path, capsys):
    pytest.importorskip("h5netcdf")
    changes = ["--set", "horizon=2.0", "--engine", "simpy", "--no-plot", "--workers", "1"]
    scenario = str(SCENARIOS / "poisson_ring.toml")
    assert main(["run", scenario, "--runs", "3", "--out", str(tmp_path / "e"), *changes]) == 0
    assert main(["export", str(tmp_path / "e"), "--to", "netcdf"]) == 0
    assert "written: " in capsys.readouterr().out
    ensemble = netkf.open(tmp_path / "e")
    dataset = xarray.load_dataset(tmp_path / "e" / "ensemble.nc")
    xarray.testing.assert_identical(dataset, ensemble.to_xarray())
    trace = dataset.mean_P.sel(state=0, other_state=0) + dataset.mean_P.sel(state=1, other_state=1)
    after = trace.where(dataset.time > 0.0, drop=True)
    np.testing.assert_allclose(after.mean("time"), dataset.average_trace_P, rtol=1e-12)
    assert float(dataset.average_nees_of_all) == ensemble.average[-1, 2]
    assert main(["export", str(tmp_path / "e"), "--to", "graphml"]) == 2
    assert "must be a run with its events" in capsys.readouterr().err


@pytest.mark.slow
def test_blocks_have_names_and_owners():
    scenario = netkf.load(SCENARIOS / "blocks" / "cooperative_localisation.toml", {"horizon": 2.0})
    run = netkf.simulate(scenario, engine="simpy")
    dataset = run.to_xarray()
    node = run.nodes[1]
    name = scenario.layout.owned(node)[0].name
    own = dataset.x.isel(entry=((dataset.block == name) & (dataset.owner == node)).values)
    np.testing.assert_array_equal(own, run.block(name, node).x)
    view = dataset.view.sel(node=node).values
    np.testing.assert_array_equal(
        dataset.x.isel(entry=view[view >= 0]).values - dataset.xhat.sel(node=node).values,
        run.error[:, 1],
    )


def test_without_the_extra_one_line_says_what_to_install(run, monkeypatch):
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(netkf.ScenarioError) as caught:
        run.to_xarray()
    line = "to_xarray: needs xarray; install it: pip install 'netkf[xarray]'"
    assert str(caught.value) == line
