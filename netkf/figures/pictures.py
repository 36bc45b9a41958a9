"""``run.png``: what ``netkf run`` leaves beside the files of a run or an ensemble."""

from __future__ import annotations

from netkf.ensembles.directory import FinishedEnsemble
from netkf.figures.network import draw_network, error_label, shades_of
from netkf.figures.panels import draw_covariances, draw_errors, draw_nees
from netkf.figures.style import Picture, finish_figure, look, new_figure, write
from netkf.figures.subject import Subject, subject_of_completed, subject_of_ensemble
from netkf.runs.run import CompletedRun
from netkf.scenario.scenario import Scenario


def run_picture(scenario: Scenario, completed: CompletedRun) -> None:
    """Write ``run.png``: errors, roots of trace P beside the bound and the limits, NEES, and the
    network; without ground truth estimates, and no NEES.
    """
    with look():
        figure = overview(subject_of_completed(scenario, completed))
    write(figure, completed.directory / "run.png")


def ensemble_picture(scenario: Scenario, finished: FinishedEnsemble) -> None:
    """Write ``run.png``: the same of the means of many runs, with intervals."""
    with look():
        figure = overview(subject_of_ensemble(scenario, finished.ensemble, finished.promised))
    write(figure, finished.directory / "run.png")


def overview(subject: Subject) -> Picture:
    """Return the picture of a run or an ensemble in four panels, or three without errors."""
    figure = new_figure(11.0, 8.2)
    if subject.shows_errors:
        grid = figure.add_gridspec(2, 2)
        cells = [grid[0, 0], grid[0, 1], grid[1, 0], grid[1, 1]]
        drawings = [draw_errors, draw_covariances, draw_nees]
    else:
        grid = figure.add_gridspec(2, 2, height_ratios=[1.0, 1.25])
        cells = [grid[0, 0], grid[0, 1], grid[1, :]]
        drawings = [draw_errors, draw_covariances]
    *panels, network = (figure.add_subplot(cell) for cell in cells)
    for axes, draw in zip(panels, drawings, strict=True):
        draw(axes, subject)
    key, label = error_label(subject)
    draw_network(network, subject, shades_of(subject, key), label)
    network.legend(loc="lower left", bbox_to_anchor=(0.0, 1.04), ncols=2, borderaxespad=0.2)
    scenario = subject.scenario
    title = f"{scenario.name}: {scenario.claim}" if scenario.claim else scenario.name
    finish_figure(
        figure, subject.claim(title), subject.caption(*_caption_sentences(subject), notes="both")
    )
    return figure


def _caption_sentences(subject: Subject) -> list[str]:
    """Return the sentences on bands, links and messages."""
    sentences = []
    if subject.runs > 1:
        sentences.append("Bands: 95% intervals of the means (1.96 standard errors).")
    if subject.delivered:
        sentences.append("Links are as wide as the messages that they delivered.")
    messages = subject.messages
    if messages.get("sent"):
        sent = f"{messages['sent']:,.0f} messages"
        if 0 < messages.get("transmissions", 0) < messages["sent"]:
            sent += f" in {messages['transmissions']:,.0f} transmissions"
        sentences.append(f"{sent}, {messages['lost']:,.0f} lost.")
    return sentences
