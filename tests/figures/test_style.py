"""Series can be told apart by all eyes and in grey; text is broken where it would not fit."""

import itertools

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.colors import to_rgb

from netkf.figures.catalogue import FigureSet
from netkf.figures.names import SERIES
from netkf.figures.style import (
    RELAY,
    SENSING,
    break_lines,
    new_figure,
    set_scale,
    style_context,
    text_width,
)
from tests.conftest import with_slow

# Machado, Oliveira and Fernandes (2009), severity 1.0, on linear RGB.
EYES = {
    "normal": np.eye(3),
    "protanopia": [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
    "deuteranopia": [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ],
    "tritanopia": [
        [1.255528, -0.076749, -0.178779],
        [-0.078411, 0.930809, 0.147602],
        [0.004733, 0.691367, 0.303900],
    ],
    "grey": np.tile([0.2126, 0.7152, 0.0722], (3, 1)),
}
CLEAR = 12.0
"""Distance in CIE Lab that is seen at a glance."""


def lab(colour, eyes):
    """Return CIE Lab (D65) of a colour as some eyes see it."""
    rgb = np.array(to_rgb(colour))
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    seen = np.clip(np.array(EYES[eyes]) @ linear, 0.0, 1.0)
    to_xyz = np.array(
        [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
    )
    xyz = to_xyz @ seen / np.array([0.95047, 1.0, 1.08883])
    f = np.where(xyz > (6 / 29) ** 3, np.cbrt(xyz), xyz / (3 * (6 / 29) ** 2) + 4 / 29)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def apart(one, other):
    """Return the smallest distance of two colours over all eyes and in grey."""
    return min(np.linalg.norm(lab(one, eyes) - lab(other, eyes)) for eyes in EYES)


def drawn_as(line):
    """Return dashes, marker and width of a line."""
    style = line.get_linestyle() if line.get_linewidth() > 0.0 else "None"
    return str(style), str(line.get_marker()), line.get_linewidth() >= 1.8


def test_groups_of_nodes_differ_by_colour_alone():
    """Lines of single nodes are all solid."""
    assert apart(RELAY, SENSING) > CLEAR


def test_categorical_series_differ_by_more_than_colour():
    for one, other in itertools.combinations(SERIES, 2):
        assert one.marker != other.marker
        assert str(one.dashes) != str(other.dashes)


@pytest.mark.one_in(3)
@pytest.mark.parametrize("kind", with_slow(["ring", "ensemble", "slots", "no truth"], {"no truth"}))
def test_no_two_series_of_a_figure_look_alike(results, kind):
    drawing = FigureSet(results(kind))
    pairs = 0
    for name in drawing.names:
        for axes in drawing.draw(name).axes:
            lines = [line for line in axes.get_lines() if not line.get_label().startswith("_")]
            for one, other in itertools.combinations(lines, 2):
                pairs += 1
                colours = [line.get_color() for line in (one, other)]
                if one.get_marker() not in ("None", "") and one.get_markerfacecolor() == "none":
                    continue
                different = drawn_as(one) != drawn_as(other) or apart(*colours) > CLEAR
                assert different, (name, one.get_label(), other.get_label())
    assert pairs > 10


@pytest.mark.parametrize("width", [60.0, 150.0, 400.0])
def test_lines_are_no_wider_than_asked(width):
    text = (
        "One long-word-that-cannot-be-broken-at-a-space-anywhere-in-it and Wide MMMM letters " * 3
    )
    for weight in ("normal", "bold"):
        lines = break_lines(text, width, 9.0, weight).split("\n")
        assert max(text_width(line, 9.0, weight) for line in lines) <= width
        assert "".join(lines).replace(" ", "") == text.replace(" ", "")


def test_a_unit_stays_with_its_number():
    lines = break_lines(
        "node 3 waits longest, 517 s", text_width("node 3 waits longest, 517", 9.0), 9.0
    )
    assert lines == "node 3 waits longest,\n517 s"


def test_names_are_no_formulas_and_have_no_control_characters():
    figure = new_figure()
    written = break_lines("costs $5$ \x1b[31m \n and _{x}", 300.0, 9.0)
    text = figure.text(0.1, 0.5, written)
    with style_context():
        figure.draw(figure.canvas.get_renderer())
    assert "\x1b" not in text.get_text()
    assert mpl.cbook.is_math_text(text.get_text()) is False


@pytest.mark.parametrize("values", [[1.0, 1.0, 1.7e308], [1e300, 1.2e308], [5e-324, 1e-300, 1.0]])
def test_axes_have_limits_for_all_numbers(values):
    figure = new_figure(4.0, 3.0)
    axes = figure.add_subplot()
    axes.plot(values)
    set_scale(axes, np.array([*values, np.inf, np.nan, 0.0, -1.0]))
    figure.canvas.draw()
    low, high = axes.get_ylim()
    assert 0.0 <= low < high < np.inf
