"""``run.png``: the picture that ``netkf run`` writes beside the files of a run or an ensemble."""

from __future__ import annotations

from netkf.ensembles.directory import FinishedEnsemble
from netkf.figures import style
from netkf.figures.figure_data import FigureData, reduce_completed_run, reduce_ensemble
from netkf.figures.network import draw_network, error_label, explain_network, node_values
from netkf.figures.style import draw_covariances, draw_errors, draw_nees
from netkf.runs.run import CompletedRun
from netkf.scenario.scenario import Scenario


def run_picture(scenario: Scenario, completed: CompletedRun) -> None:
    """Write the overview of a run as ``run.png``; raises WriteError."""
    with style.style_context():
        figure = overview(reduce_completed_run(scenario, completed))
        style.write_figure(figure, completed.directory / "run.png")


def ensemble_picture(scenario: Scenario, finished: FinishedEnsemble) -> None:
    """Write the overview of an ensemble as ``run.png``; raises WriteError."""
    with style.style_context():
        figure = overview(reduce_ensemble(scenario, finished.ensemble, finished.promised))
    style.write_figure(figure, finished.directory / "run.png")


def overview(data: FigureData) -> style.Picture:
    """Return four panels: errors, roots of trace P with bound and limits, NEES, and the network;
    without ground truth estimates, and no NEES.
    """
    figure = style.new_figure(11.0, 8.2)
    drawings, heights = [draw_errors, draw_covariances], [1.0, 1.25]
    if data.shows_errors:
        drawings, heights = [*drawings, draw_nees], [1.0, 1.0]
    grid = figure.add_gridspec(2, 2, height_ratios=heights)
    lower = [grid[1, 0], grid[1, 1]] if data.shows_errors else [grid[1, :]]
    *panels, network = (figure.add_subplot(cell) for cell in [grid[0, 0], grid[0, 1], *lower])
    for axes, draw in zip(panels, drawings, strict=True):
        if len(data.times):
            draw(axes, data)
        else:
            style.draw_message(axes, "there are no samples")
    key, label = error_label(data)
    draw_network(network, data, node_values(data, key), label)
    network.legend(loc="lower left", bbox_to_anchor=(0.0, 1.04), ncols=2, borderaxespad=0.2)
    scenario = data.scenario
    title = f"{scenario.name}: {scenario.claim}" if scenario.claim else scenario.name
    return style.finish_figure(
        figure, data.title(title), data.caption(*_caption_sentences(data), notes="both")
    )


def _caption_sentences(data: FigureData) -> list[str]:
    sentences = []
    if data.runs > 1:
        sentences.append("Bands: 95% intervals of the means (1.96 standard errors).")
    sentences += explain_network(data)
    messages = data.messages
    if messages.get("sent"):
        sent = f"{messages['sent']:,.0f} messages"
        if 0 < messages.get("transmissions", 0) < messages["sent"]:
            sent += f" in {messages['transmissions']:,.0f} transmissions"
        sentences.append(f"{sent}, {messages['lost']:,.0f} lost.")
    return sentences
