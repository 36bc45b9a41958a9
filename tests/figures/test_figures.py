"""Every figure of every kind of result: drawn, within its canvas, and without overlapping text."""

import dataclasses
import itertools

import matplotlib as mpl
import numpy as np
import pandas as pd
import pytest

import netkf
from netkf.cli.main import main
from netkf.ensembles.pools import PoolOptions
from netkf.figures import network
from netkf.figures.catalogue import FIGURES, FigureSet, plot_to_files
from netkf.figures.names import FIGURE_NAMES
from netkf.figures.several import errors_figure
from netkf.figures.style import lay_out, style_context
from netkf.figures.traffic import envelope_figure
from netkf.runs.curves import ErrorCurve
from netkf.studies.sweep import plan_sweep, sweep_to_directory
from tests.conftest import SCENARIOS, with_slow
from tests.figures.conftest import KINDS

SLACK = 1.0
"""Pixels by which boxes may touch: letters do not fill theirs."""


def shown_texts(figure):
    """Return the texts that are drawn: axes that are off hide theirs, and ticks beyond the limits
    are not drawn.
    """
    hidden = set()
    for axes in figure.axes:
        if not axes.axison:
            hidden |= {
                id(t) for axis in (axes.xaxis, axes.yaxis) for t in axis.findobj(mpl.text.Text)
            }
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            low, high = sorted(axis.get_transform().transform(axis.get_view_interval()))
            pad = 1e-9 * (high - low)
            for tick in (*axis.get_major_ticks(), *axis.get_minor_ticks()):
                place = float(axis.get_transform().transform([tick.get_loc()])[0])
                if not low - pad <= place <= high + pad:
                    hidden |= {id(tick.label1), id(tick.label2)}
    renderer = figure.canvas.get_renderer()
    seen = [
        text
        for text in figure.findobj(mpl.text.Text)
        if text.get_visible() and text.get_text().strip() and id(text) not in hidden
    ]
    return [(text.get_text(), text.get_window_extent(renderer)) for text in seen]


def assert_well_laid_out(figure):
    with style_context():
        lay_out(figure)
        figure.draw_without_rendering()
    texts = shown_texts(figure)
    width, height = figure.bbox.width, figure.bbox.height
    for words, box in texts:
        inside = box.x0 >= -SLACK and box.y0 >= -SLACK
        inside &= box.x1 <= width + SLACK and box.y1 <= height + SLACK
        assert inside, f"{words!r} leaves the canvas: {box}"
    for (one, a), (other, b) in itertools.combinations(texts, 2):
        across = min(a.x1, b.x1) - max(a.x0, b.x0)
        along = min(a.y1, b.y1) - max(a.y0, b.y0)
        assert min(across, along) <= SLACK, f"{one!r} overlaps {other!r}"


@pytest.fixture(scope="module")
def drawing(results):
    made = {}

    def of(kind):
        if kind not in made:
            made[kind] = FigureSet(results(kind))
        return made[kind]

    return of


@pytest.mark.one_in(16)
@pytest.mark.parametrize("name", FIGURES)
@pytest.mark.parametrize("kind", with_slow(KINDS, {"no samples", "interrupted", "diverged"}))
def test_text_neither_overlaps_nor_leaves_the_canvas(drawing, kind, name):
    assert_well_laid_out(drawing(kind).draw(name))


SAYS = [
    ("one node", "error", "In this run the node claims"),
    ("no truth", "error", "Without ground truth"),
    ("no samples", "error", "There are no samples"),
    ("no samples", "overview", "there are no samples"),
    ("interrupted", "error", "Interrupted: "),
    ("diverged", "error", "Diverged: "),
    ("ring", "nis", "NIS per row of a reading is"),
    ("ensemble", "age", "Only single runs have events"),
    ("slots", "stability", "There is no map of Tanwani's bound H(12)"),
    ("one node", "nees", "with 1 degree of freedom."),
]


@pytest.mark.one_in(2)
@pytest.mark.parametrize(("kind", "name", "words"), SAYS)
def test_what_a_run_lacks_stands_in_its_figure(drawing, kind, name, words):
    figure = drawing(kind).draw(name)
    assert words in " ".join(" ".join(text for text, _ in shown_texts(figure)).split())


def test_a_theorem_without_an_answer_leaves_the_other_figures(tmp_path, monkeypatch):
    """Samples at known times: the bound goes round a cycle and has no steady state."""
    monkeypatch.setattr(
        netkf.figures.catalogue, "FIGURES", {name: FIGURES[name] for name in ("stability", "error")}
    )
    every = {"kind": "periodic", "period": 1.0}
    loss = {"loss": {"kind": "bernoulli", "delivery": 0.5}}
    scenario = netkf.load(SCENARIOS / "poisson_ring.toml")
    changes = {"horizon": 2.0, "sensors.0.sampling": every, "network.channel": loss}
    run = netkf.simulate(scenario.replace(changes), engine="simpy")
    paths = plot_to_files(run, (), tmp_path / "out", "svg")
    assert [path.stem for path in paths] == ["stability", "error"]
    text = " ".join(text for text, _ in shown_texts(netkf.plot(run, "stability")))
    assert "Theory has no answer: samples at known times" in " ".join(text.split())


def test_titles_say_what_the_data_says(results, drawing):
    """Computed again from the arrays of the run, with numpy alone."""
    run = results("ring")
    bound = np.trace(netkf.theory.covariance_bound(run.scenario, run.times), axis1=2, axis2=3)
    trace = np.trace(run.P, axis1=2, axis2=3)
    after = run.times > 0.0
    below = (trace[after].mean(axis=0) <= bound[after].mean(axis=0)).sum()
    title = drawing("ring").draw("error").get_suptitle()
    assert title == f"In this run {below} of 6 nodes claim no more than the bound"
    error = np.sqrt(((run.x[:, None] - run.xhat) ** 2).sum(axis=2))[after]
    at, worst = np.unravel_index(error.argmax(), error.shape)
    title = drawing("ring").draw("quantiles").get_suptitle()
    where = f"of node {worst} at {run.times[after][at]:g} s"
    assert title.startswith(f"The largest error after the start is {error.max():.3g}, {where}")
    kinds = run.events["kind"].value_counts()
    lost = drawing("ring").draw("links").get_suptitle()
    total = kinds["lost"] + kinds["deliver"]
    assert (
        lost == f"{kinds['lost']:,} of {total:,} messages were lost ({kinds['lost'] / total:.1%})"
    )


def test_an_ensemble_claims_only_what_its_intervals_show(results, drawing):
    ensemble = results("ensemble")
    bound = np.trace(
        netkf.theory.covariance_bound(ensemble.scenario, ensemble.times), axis1=2, axis2=3
    )[1:].mean(axis=0)
    sure = ensemble.average[:6, 1] + 1.96 * ensemble.se_average[:6, 1] <= bound
    title = drawing("ensemble").draw("ratios").get_suptitle()
    expected = "All 6 nodes stay" if sure.all() else f"{sure.sum()} of 6 nodes stay"
    assert title.startswith(f"{expected} below the bound in the mean")


def test_captions_name_runs_seed_and_interval(drawing):
    text = drawing("ensemble").draw("error")._supxlabel.get_text().replace("\n", " ")
    assert "12 runs, seed 1" in text
    assert "95% intervals" in text


def test_axes_have_units(drawing):
    for kind in ("ring", "ensemble", "slots"):
        for axes in drawing(kind).draw("error").axes:
            assert "units" in axes.get_ylabel() or "error |x - xhat|" in axes.get_ylabel()


def test_axes_have_the_unit_of_the_states_and_values_that_differ(tmp_path):
    """Of sweeps and of the law of P; large whole numbers keep their digits."""
    scenario = netkf.load(SCENARIOS / "poisson_ring.toml", {"horizon": 1.0})
    scenario = scenario.replace({"plant.units": ["m", "m"], "network.radio": {}})
    bits = {"network.radio.bits_per_second": [20001, 20002], "filter.epsilon": [0.1, 0.3]}
    plan = plan_sweep(scenario, bits, 1, engine="simpy")
    sweep_to_directory(plan, tmp_path / "sweep", PoolOptions(1))
    figure = netkf.open(tmp_path / "sweep").plot()
    assert any(axes.get_ylabel() == "largest RMS error, m" for axes in figure.axes)
    assert [label.get_text() for label in figure.axes[0].get_xticklabels()] == ["20001", "20002"]
    law = netkf.simulate(scenario, engine="simpy").plot("law")
    assert law.axes[0].get_xlabel() == "trace of P, squared m"


def test_the_plane_has_the_names_and_units_of_its_coordinates():
    file = SCENARIOS / "blocks" / "formation.toml"
    for states, units, expected in (
        (["east", "north"], ["m", "m"], ("east (m)", "north (m)")),
        ([], ["m", "m"], ("first coordinate (m)", "second coordinate (m)")),
        ([], [], ("first coordinate", "second coordinate")),
    ):
        given = [("states", states), ("units", units)]
        changes = {f"plants.{k}.{key}": x for k in range(5) for key, x in given if x}
        run = netkf.simulate(netkf.load(file, changes | {"horizon": 3.0}), engine="simpy")
        (axes,) = run.plot("plane").axes
        assert (axes.get_xlabel(), axes.get_ylabel()) == expected


def test_coordinates_of_a_map_are_whole_numbers():
    """Eastings and northings differ in their last digits."""
    file = SCENARIOS / "blocks" / "formation.toml"
    changes = {"plants.0.mean": [4.6e5, 5.5e6], "horizon": 3.0}
    changes |= {f"plants.{k}.mean": [4.6e5 + k, 5.5e6] for k in range(1, 5)}
    (axes,) = netkf.simulate(netkf.load(file, changes), engine="simpy").plot("plane").axes
    axes.figure.draw_without_rendering()
    assert axes.yaxis.get_offset_text().get_text() == ""
    labels = [text.get_text() for text in axes.get_yticklabels()]
    assert len(set(labels)) == len(labels)


def test_an_envelope_of_equal_values_has_an_axis():
    row = {"replay": 0.0, "low": 0.0, "median": 0.0, "high": 0.0, "p": 1.0}
    rows = [row | {"law": law, "quantity": "time connected"} for law in ("bernoulli", "per-link")]
    figure = envelope_figure(pd.DataFrame(rows).assign(inside=True, runs=20))
    assert np.ptp(figure.axes[0].get_xlim()) > 0.1
    assert len(figure.axes[0].get_legend().get_texts()) == 3  # no replay is outside


def test_results_draw_themselves(results, sweeps):
    for kind in ("ring", "ensemble"):
        figure = results(kind).plot("ratios")
        assert isinstance(figure, mpl.figure.Figure)
        assert figure._repr_png_().startswith(b"\x89PNG")
    assert sweeps["two"].plot().get_suptitle().startswith("The largest RMS error is smallest")
    with pytest.raises(
        netkf.ScenarioError, match=r'is not known; got .eror.; did you mean "error"'
    ):
        results("ring").plot("eror")


@pytest.mark.parametrize("name", ["one", "two", "parts"])
def test_sweeps_are_drawn_as_maps_and_curves(sweeps, name):
    figure = sweeps[name].plot()
    assert_well_laid_out(figure)
    table = sweeps[name].table
    assert f"{table['worst_rms'].min():.3g}" in figure.get_suptitle()


def test_the_settings_of_the_user_change_nothing_and_are_left_alone(results):
    with mpl.rc_context({"font.size": 30.0, "axes.spines.top": True}):
        assert_well_laid_out(results("ring").plot("ratios"))
        assert mpl.rcParams["font.size"] == 30.0


def test_the_command_writes_files(results, tmp_path, capsys):
    run = results("ring")
    folder = netkf.save(run, run.scenario, tmp_path / "run")
    assert main(["plot", str(folder), "--figure", "error,age", "--format", "svg"]) == 0
    written = capsys.readouterr().out.splitlines()
    assert written == [str(folder / "figures" / f"{name}.svg") for name in ("error", "age")]
    assert main(["plot", str(folder), "--figure", "links", "--out", str(tmp_path / "l.pdf")]) == 0
    assert (tmp_path / "l.pdf").read_bytes().startswith(b"%PDF")
    assert not capsys.readouterr().err
    failed = dataclasses.replace(run, status="failed")
    half = netkf.save(failed, run.scenario, tmp_path / "failed")
    assert main(["plot", str(half), "--figure", "error"]) == 0
    assert capsys.readouterr().err == f"note: {half}: failed; figures show what it has kept\n"
    for arguments, words in (
        ([str(tmp_path)], "manifest.json is missing"),
        ([str(folder), "--figure", "eror"], 'did you mean "error"'),
        ([str(folder), "--figure", ""], "--figure: must name figures"),
        ([str(folder), "--out", str(tmp_path / "one.png")], "one file for several figures"),
        ([str(folder), "--out", str(folder / "manifest.json")], "cannot be made (File exists)"),
        ([str(folder), "--out", str(tmp_path / "x.jpg")], "a file that ends in .png, .svg, .pdf"),
    ):
        assert main(["plot", *arguments]) == 2
        line = capsys.readouterr().err
        assert words in line
        assert len(line.splitlines()) == 1


def test_errors_of_several_results_are_drawn_in_one_figure(results, tmp_path, capsys):
    run, ensemble = results("ring"), results("ensemble")
    figure = netkf.plot({"one $run$": run, "many": ensemble}, "error")
    assert_well_laid_out(figure)
    one, many = figure.axes[0].lines[:2]
    squares = ((run.x[:, None] - run.xhat) ** 2).sum(axis=2).mean(axis=1)
    np.testing.assert_allclose(one.get_ydata(), squares, rtol=1e-9)
    means = np.trace(ensemble.mean_error, axis1=2, axis2=3).mean(axis=1)
    np.testing.assert_allclose(many.get_ydata(), means, rtol=1e-12)
    bounds = netkf.theory.covariance_bound(run.scenario, run.times)
    bound = np.trace(bounds, axis1=2, axis2=3).mean(axis=1)
    drawn = [
        line.get_ydata() for line in figure.axes[0].lines if len(line.get_xdata()) == len(bound)
    ]
    assert any(np.allclose(line, bound, rtol=1e-9) for line in drawn)
    both = min(run.times[-1], ensemble.times[-1])  # they are compared over the time of both
    later = [(result.times > 0.0) & (result.times <= both) for result in (run, ensemble)]
    averages = {"one $run$": squares[later[0]].mean(), "many": means[later[1]].mean()}
    best = min(averages, key=averages.get).replace("$", r"\$")
    assert figure.get_suptitle().startswith(f"{best} has the smallest mean square error")
    # Runs of different lengths are compared over the time that all have.
    half = len(run.times) // 2
    short = ErrorCurve("short", run.times[: half + 1], squares[: half + 1])
    longer = ErrorCurve("long", run.times, np.where(np.arange(len(squares)) > half, 1e9, 0.0))
    title = errors_figure([short, longer]).get_suptitle().replace("\n", " ")
    assert title.startswith(f"long has the smallest mean square error up to {run.times[half]:g} s")
    assert_well_laid_out(netkf.plot([run, results("no truth"), run] * 10))
    with pytest.raises(netkf.ScenarioError, match="its figures are error"):
        netkf.plot([run, ensemble], "nees")
    with pytest.raises(netkf.ScenarioError, match="name at least one"):
        netkf.plot([])
    folders = [str(netkf.save(run, run.scenario, tmp_path / name)) for name in ("a", "b")]
    assert main(["plot", *folders, "--figure", "error,age", "--out", str(tmp_path / "o")]) == 0
    written = [str(tmp_path / "o" / name) for name in ("errors.png", "a/age.png", "b/age.png")]
    assert capsys.readouterr().out.splitlines() == written
    assert main(["plot", *folders, "--figure", "error", "--out", str(tmp_path / "e.SVG")]) == 0
    assert (tmp_path / "e.SVG").is_file()


def test_a_map_that_takes_minutes_is_drawn_on_request_only(results, monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(netkf.figures.stability, "MAX_UNKNOWNS", 1)
    monkeypatch.setattr(
        netkf.figures.catalogue, "FIGURES", {name: FIGURES[name] for name in ("stability", "links")}
    )
    run = results("ring")
    folder = netkf.save(run, run.scenario, tmp_path / "run")
    drawn = {}
    monkeypatch.setattr(
        netkf.figures.catalogue,
        "write_figure",
        lambda figure, path: drawn.setdefault(path.stem, figure),
    )
    assert main(["plot", str(folder)]) == 0
    assert set(drawn) == {"stability", "links"}
    left_out = " ".join(" ".join(text for text, _ in shown_texts(drawn["stability"])).split())
    assert "it takes minutes for 6 nodes of 2 states" in left_out
    assert "netkf plot --figure stability" in left_out
    drawn.clear()
    assert main(["plot", str(folder), "--figure", "stability"]) == 0
    assert "steady state" in drawn["stability"].get_suptitle()


def test_figures_are_known_by_name_before_they_are_drawn():
    assert set(FIGURE_NAMES) == set(FIGURES)


def test_a_missing_matplotlib_is_one_line(results, monkeypatch, capsys, tmp_path):
    import sys

    monkeypatch.setitem(sys.modules, "matplotlib", None)
    for name in [n for n in sys.modules if n.startswith("netkf.figures")]:
        monkeypatch.delitem(sys.modules, name)
    with pytest.raises(netkf.ScenarioError, match=r"needs matplotlib; install it: pip install"):
        results("ring").plot()
    assert main(["plot", str(tmp_path)]) == 2
    assert "pip install 'netkf[plot]'" in capsys.readouterr().err


@pytest.mark.slow
def test_paths_in_the_plane_are_those_of_the_nodes_and_their_own_estimates():
    """Errors and the share inside ellipses computed again with numpy alone."""
    file = SCENARIOS / "blocks" / "mrclam_small" / "scenario.toml"
    run = netkf.simulate(netkf.load(file, {"horizon": 8.0}))
    figure = run.plot("plane")
    assert_well_laid_out(figure)
    blocks = {node: run.block("pose", node) for node in run.nodes}
    errors = {node: (one.x - one.xhat)[:, :2] for node, one in blocks.items()}
    rms = {node: np.sqrt(np.mean(np.sum(e**2, axis=1))) for node, e in errors.items()}
    (best, low), *_, (worst, high) = sorted(rms.items(), key=lambda pair: pair[1])
    title = f"RMS error of positions: {low:.3g} (node {best}) to {high:.3g} (node {worst})"
    assert figure.get_suptitle() == title
    inside = [
        e @ np.linalg.solve(P[:2, :2], e) <= -2.0 * np.log(0.05)
        for node, one in blocks.items()
        for e, P in zip(errors[node][1:], one.P[1:], strict=True)
    ]
    text = " ".join(figure._supxlabel.get_text().split())
    assert f"{np.mean(inside):.0%} of the sampled positions are where P says that 95%" in text
    axes = figure.axes[0]
    drawn = [line.get_xydata() for line in axes.lines]
    assert len(drawn) == 10
    np.testing.assert_array_equal(drawn[2], blocks[2].x[:, :2])
    np.testing.assert_array_equal(drawn[3], blocks[2].xhat[:, :2])
    seen = axes.collections[0].get_offsets()
    assert len(seen) == 15
    assert [text.get_text() for text in axes.texts[:15]] == [str(k) for k in range(6, 21)]


def test_landmarks_have_the_numbers_of_the_log():
    """Those of the data set's own table, subject, x and y."""
    scenario = netkf.load(SCENARIOS / "blocks" / "mrclam_small" / "scenario.toml")
    table = SCENARIOS / "data" / "mrclam_small" / "Landmark_Groundtruth.dat"
    rows = np.loadtxt(table)
    assert network.landmark_names(scenario) == {(x, y): f"{k:.0f}" for k, x, y, *_ in rows}


def test_the_plane_needs_nodes_that_estimate_their_coordinates(drawing):
    for kind, words in (("ring", "position = [0, 1]"), ("ensemble", "Only single runs have paths")):
        assert words in " ".join(
            " ".join(t for t, _ in shown_texts(drawing(kind).draw("plane"))).split()
        )


def test_the_names_of_nodes_on_a_circle_stand_outside_of_it():
    """Inside they would lie on the links."""
    changes = {"horizon": 1.0, "network.graph": {"kind": "complete", "nodes": 9}}
    changes["filter.epsilon"] = 0.1
    figure = netkf.simulate(netkf.load(SCENARIOS / "poisson_ring.toml", changes)).plot("network")
    figure.canvas.draw()
    axes = next(axes for axes in figure.axes if len(axes.texts) >= 9)
    for text in axes.texts[:9]:
        box = text.get_window_extent().transformed(axes.transData.inverted())
        assert np.hypot(*np.mean([box.min, box.max], axis=0)) > np.hypot(*text.xy)


@pytest.mark.parametrize(
    ("scenario", "changes"),
    [
        ("gossip_ring", {"horizon": 20.0, "network.quantise": {"bits": 8, "range": 50.0}}),
        ("push_sum_planar", {"horizon": 10.0}),
        ("intermittent_random10", {"horizon": 10.0, "network.radio": {"bytes_per_number": 4}}),
    ],
)
def test_bytes_of_a_picture_are_those_of_the_summary(scenario, changes, tmp_path):
    """Of messages as the filter sends them, not of an estimate with its covariance."""
    scenario = netkf.load(SCENARIOS / f"{scenario}.toml", changes)
    run = netkf.simulate(scenario)
    netkf.save(run, scenario, tmp_path / "kept")
    kept = netkf.open(tmp_path / "kept")
    stated = sorted(row["bytes"] / 1000.0 for row in kept.summary["nodes"])
    for result in (run, kept):
        shown = [value for dots in kilobytes(result) for value in dots.get_array()]
        assert sorted(shown) == pytest.approx(stated)


def kilobytes(run):
    """Return the dots of a run in the last panel of its network, by group of nodes."""
    figure = run.plot("network")
    assert figure.axes[-1].get_xlabel() == "kilobytes transmitted, broadcasts once"
    figure.canvas.draw()
    return [c for c in figure.axes[2].collections if isinstance(c, mpl.collections.PathCollection)]


def test_equal_values_have_one_colour():
    """With a sensor and without one: all ten nodes send as many bytes."""
    run = netkf.simulate(netkf.load(SCENARIOS / "push_sum_planar.toml", {"horizon": 10.0}))
    both = kilobytes(run)
    assert len(both) == 2
    assert len({value for dots in both for value in dots.get_array()}) == 1
    assert len({tuple(color) for dots in both for color in dots.get_facecolors()}) == 1
    assert not any(dots.get_clip_on() for dots in both)  # whole at the rim of their panel


def test_the_legend_of_a_network_has_no_colour_of_a_node():
    figure = netkf.simulate(netkf.load(SCENARIOS / "poisson_ring.toml")).plot("network")
    legend = next(axes.get_legend() for axes in figure.axes if axes.get_legend())
    assert [line.get_markerfacecolor() for line in legend.get_lines()] == ["white", "white"]


def test_the_names_of_the_lowest_nodes_stand_above_the_legend():
    changes = {
        "horizon": 1.0,
        "network.graph": {"kind": "edges", "edges": [[0, 1], [1, 2], [2, 3]]},
    }
    figure = netkf.simulate(netkf.load(SCENARIOS / "poisson_ring.toml", changes)).plot("network")
    assert_well_laid_out(figure)
    legend = figure.axes[0].get_legend().get_window_extent()
    assert all(text.get_window_extent().y0 >= legend.y1 for text in figure.axes[0].texts)


@pytest.mark.parametrize("name", ["error", "overview", "quantiles"])
def test_exponents_of_small_and_large_numbers_are_not_in_the_legend(name):
    changes = {"horizon": 2.0, "plant.cov": [[1e-12, 0.0], [0.0, 1e-12]]}
    changes |= {"plant.B": [[0.0], [1e-6]], "sensors.0.R": [[1e-12]]}
    changes["filter.cov"] = changes["plant.cov"]
    figure = netkf.simulate(netkf.load(SCENARIOS / "poisson_ring.toml", changes)).plot(name)
    assert_well_laid_out(figure)
    left = [axes.yaxis for axes in figure.axes if axes.get_legend() and axes.axison]
    assert left
    assert not any(axis.get_offset_text().get_text() for axis in left)


def test_only_what_happened_stands_in_titles_and_on_axes():
    """Nobody waits where nothing is sent to it, and the axis has room for the law too."""
    run = netkf.simulate(netkf.load(SCENARIOS / "intermittent_scalar.toml"))
    assert "waits" not in run.plot("age").get_suptitle()
    assert run.plot("law").axes[0].get_xscale() == "log"
    ring = netkf.load(SCENARIOS / "gossip_ring.toml", {"horizon": 20.0})
    run = netkf.simulate(ring)
    assert run.plot("losses").get_suptitle().endswith("messages were lost")
    assert len(run.plot("links").axes[0].get_legend().get_texts()) == 1


def test_nodes_of_a_matrix_that_have_labels_are_equally_far_apart():
    scenario = netkf.load(SCENARIOS / "intel_lab.toml", {"horizon": 0.5})
    axes = netkf.simulate(scenario).plot("matrix").axes[0]
    assert len(set(np.diff(axes.get_xticks()))) == 1
