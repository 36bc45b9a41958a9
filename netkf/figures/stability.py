"""The figures ``stability`` and ``law``: where covariances stay bounded, and their distribution.

The figure of a sweep is here too: it is called ``stability`` as well.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from netkf.algorithms.registry import built_in_filters
from netkf.core.errors import NetkfError, TheoryError
from netkf.core.printable import count_phrase
from netkf.figures.figure_data import FigureData, UnavailableError
from netkf.figures.names import SERIES
from netkf.figures.style import (
    EXACT,
    INK,
    LOG_RATIO,
    LOST,
    MAX_DRAWN,
    RELAY,
    SENSING,
    SEQUENTIAL,
    Picture,
    draw_legend,
    finish_figure,
    label_text,
    new_figure,
)
from netkf.linalg.arrays import FloatArray
from netkf.network.losses import Bernoulli
from netkf.runs.summary import NORMAL_QUANTILE
from netkf.scenario.scenario import Scenario
from netkf.theory import invariant_samples
from netkf.theory.hybrid.coupled import reason_without_bound
from netkf.theory.hybrid.steady import has_stabilising_gains, has_steady_state

RATE, DELIVERY = "network.activation.rate", "network.channel.loss.delivery"
FACTORS = tuple(2.0**k for k in range(-4, 5))
"""Link rates of the map, as multiples of that of the scenario."""
DELIVERIES = tuple(k / 8 for k in range(1, 9))
"""Delivery probabilities of the map."""
MAX_UNKNOWNS = 20_000
"""Numbers in the covariances of all nodes up to which the map takes seconds: 1000 nodes of five
states."""
LAW_SAMPLES = 2000
"""Samples of the invariant law of P."""
START_SHARE = 0.2
"""Share of a run whose samples are left out of the distribution of P."""
MAX_TEXT = 24
"""Characters of a value on an axis."""


def stability_figure(data: FigureData) -> Picture:
    """Draw for which link rates and delivery probabilities the bound H (12) has a steady state.

    Raises UnavailableError if it does not apply, or without a rate and a delivery probability.
    """
    scenario = data.scenario
    reason = "clocks in slots have no rate" if scenario.slotted else reason_without_bound(scenario)
    rate = getattr(scenario.network.activation, "rate", None)
    loss = scenario.network.channel.loss
    if reason or rate is None or not isinstance(loss, Bernoulli):
        reason = reason or "it is drawn over the rate of Poisson clocks and a Bernoulli delivery"
        raise UnavailableError(f"There is no map of Tanwani's bound H(12): {reason}.")
    rates = [rate * factor for factor in FACTORS]
    # Before the map: it raises TheoryError for plants of which no point can be decided.
    verb = "has a" if has_steady_state(scenario) else "has no"
    stable = _map_stable(scenario, rates)
    figure = new_figure(7.4, 4.6)
    axes = figure.add_subplot()
    x, y = np.meshgrid(rates, DELIVERIES)
    for group, marker, colour, label in (
        (stable, "o", RELAY, "the bound has a steady state"),
        (~stable, "x", LOST, "the bound grows without end"),
    ):
        if group.any():
            axes.plot(x[group], y[group], ls="", marker=marker, ms=9, color=colour, label=label)
    delivery = float(loss.delivery)
    style: dict[str, Any] = {"marker": "*", "ls": "", "ms": 13, "mfc": "none", "mec": INK}
    axes.plot([rate], [delivery], label="this scenario", **style)
    axes.set_xscale("log", base=2)
    axes.set_xticks(rates, [f"{r:.3g}" for r in rates])
    axes.minorticks_off()
    axes.set(xlabel=f"{RATE}, 1/s", ylabel=DELIVERY)
    draw_legend(axes)
    headline = f"The bound of this scenario {verb} steady state; it has one "
    headline += f"at {int(stable.sum())} of {stable.size} points of rate and delivery"
    caption = data.caption(
        "From theory alone: no simulation. Existence of the steady state of Tanwani's H(12)."
    )
    return finish_figure(figure, headline, caption)


def reason_to_omit_stability(data: FigureData) -> str | None:
    """Return why the map is left out where all figures are drawn, None if it takes seconds: it
    solves coupled equations of all N nodes at up to 17 points.
    """
    scenario = data.scenario
    n = scenario.plant.n
    unknowns = len(scenario.nodes) * n * (n + 1) // 2
    # Where there is no map, the figure says why.
    if unknowns <= MAX_UNKNOWNS or scenario.slotted or reason_without_bound(scenario):
        return None
    return (
        f"The map is left out: it takes minutes for {len(scenario.nodes)} nodes of {n} states. "
        "Draw it with: netkf plot --figure stability"
    )


def _map_stable(scenario: Scenario, rates: Sequence[float]) -> np.ndarray:
    """Return a mask (D, K): P has a bounded mean at DELIVERIES and link ``rates``."""
    stable = np.zeros((len(DELIVERIES), len(rates)), dtype=bool)
    first = 0
    # From a threshold on all rates have a steady state, and with fewer deliveries it is not lower:
    # one walk along the border instead of all points, each of which takes up to a second.
    for row in reversed(range(len(DELIVERIES))):
        delivery = DELIVERIES[row]
        while first < len(rates) and not has_stabilising_gains(
            scenario.replace({RATE: rates[first], DELIVERY: delivery})
        ):
            first += 1
        stable[row, first:] = True
    return stable


def sweep_figure(scenario: Scenario, table: Any, keys: Sequence[str], status: str) -> Picture:
    """Draw the largest RMS error of a ``table`` of ``netkf.sweep`` over one or two keys, and mark
    points that diverged or have no bound. Raises UnavailableError for more keys or no point.
    """
    points = f"{scenario.name}: {len(table)} points"
    if status != "complete":
        points += f"; the sweep was {status}"
    runs = int(table["runs"].max()) if len(table) else 0
    bars = " Bars: 95% intervals." if runs > 1 and len(keys) == 1 else ""
    replicas = f"{count_phrase(runs, 'run')} each, the same draws at all of them"
    caption = [f"{points}, {replicas}.{bars}"]
    if not len(table) or len(keys) > 2:
        reason = "has no finished point" if not len(table) else "has more than two keys"
        raise UnavailableError(f"The sweep {reason}.")
    figure = new_figure(7.4, 4.6)
    axes = figure.add_subplot()
    draw = _draw_sweep_curves if len(keys) == 1 else _draw_sweep_map
    draw(axes, table, list(keys), label_text(scenario.unit))
    prefix = "" if status == "complete" else "Interrupted: "
    return finish_figure(figure, prefix + _describe_best(table, keys), caption)


def _draw_sweep_curves(axes: Any, table: Any, keys: list[str], unit: str) -> None:
    places, labels = _axis_positions(axes.set_xscale, table[keys[0]])
    order = np.argsort(places, kind="stable")
    columns = (("worst_rms", "node with the largest error"), ("mean_rms", "all nodes"))
    for (column, label), series in zip(columns, SERIES, strict=False):
        bars = NORMAL_QUANTILE * table[f"{column}_se"].fillna(0.0).to_numpy()[order]
        style = {"color": series.colour, "ls": series.dashes, "marker": series.marker}
        errors = table[column].to_numpy()[order]
        axes.errorbar(places[order], errors, yerr=bars, label=label, ms=4, capsize=2, **style)
    bound = np.sqrt(table["bound"].to_numpy(dtype=np.float64))[order]
    if np.isfinite(bound).any():
        axes.plot(places[order], bound, color=EXACT, ls=":", marker="_", label="root of the bound")
    if labels:
        # Long labels overlap unless they are tilted.
        rotation = 15 if sum(map(len, labels)) > 70 else 0
        axes.set_xticks(range(len(labels)), labels, rotation=rotation)
    axes.set(xlabel=keys[0], ylabel=f"RMS error, {unit}")
    axes.set_ylim(bottom=0.0)
    draw_legend(axes)


def _draw_sweep_map(axes: Any, table: Any, keys: list[str], unit: str) -> None:
    x_values, y_values = (list(dict.fromkeys(table[key].tolist())) for key in keys)
    errors = np.full((len(y_values), len(x_values)), np.nan)
    diverged, unbounded = (np.zeros(errors.shape, dtype=bool) for _ in range(2))
    for point in table.to_dict("records"):
        cell = y_values.index(point[keys[1]]), x_values.index(point[keys[0]])
        errors[cell] = point["worst_rms"]
        diverged[cell] = "diverged" in str(point["status"])
        unbounded[cell] = not np.isfinite(point["bound"])
    positive = errors[np.isfinite(errors) & (errors > 0.0)]
    norm = "log" if positive.size and positive.max() > LOG_RATIO * positive.min() else "linear"
    image = axes.imshow(errors, aspect="auto", origin="lower", cmap=SEQUENTIAL, norm=norm)
    for group, marker, label in ((diverged, "x", "runs diverged"), (unbounded, "o", "no bound")):
        rows, columns = np.nonzero(group)
        if len(rows):
            style = {"marker": marker, "ls": "", "ms": 8, "mec": LOST, "mfc": "none", "mew": 1.5}
            axes.plot(columns, rows, label=label, **style)
    axes.set_xticks(range(len(x_values)), [label_text(_format_value(value)) for value in x_values])
    axes.set_yticks(range(len(y_values)), [label_text(_format_value(value)) for value in y_values])
    axes.set(xlabel=keys[0], ylabel=keys[1])
    axes.figure.colorbar(image, ax=axes, label=f"largest RMS error, {unit}")
    draw_legend(axes)


def _describe_best(table: Any, keys: Sequence[str]) -> str:
    finite = table[np.isfinite(table["worst_rms"])]
    diverged = int(table["status"].astype(str).str.contains("diverged").sum())
    if not len(finite):
        return "No point has a finite error"
    best = finite.loc[finite["worst_rms"].idxmin()]
    settings = ", ".join(f"{key.rpartition('.')[2]} = {_format_value(best[key])}" for key in keys)
    headline = f"The largest RMS error is smallest, {best['worst_rms']:.3g}, at {settings}"
    return headline + (f"; runs diverge at {diverged} of {len(table)} points" if diverged else "")


def _axis_positions(set_scale: Callable[[str], Any], values: Any) -> tuple[FloatArray, list[str]]:
    """Return the positions (K,) of ``values`` on an axis, and the labels of texts."""
    if values.dtype.kind in "iuf":
        positions = values.to_numpy(dtype=np.float64)
        if positions.min() > 0.0 and positions.max() > LOG_RATIO * positions.min():
            set_scale("log")
        return positions, []
    names = list(dict.fromkeys(values.astype(str)))
    positions = np.array([names.index(str(value)) for value in values], dtype=np.float64)
    return positions, [label_text(_format_value(name)) for name in names]


def _format_value(value: Any) -> str:
    text = str(value)
    if isinstance(value, (int, float, np.number)):
        text = f"{value:.15g}" if float(value).is_integer() else f"{value:.4g}"
    return text if len(text) <= MAX_TEXT else text[: MAX_TEXT - 3] + "..."


SAME_TRACES = 1e-6
"""Relative range of traces of P below which they differ by rounding only."""


def law_figure(data: FigureData) -> Picture:
    """Draw the law of trace P of samples and that of its steady state by the paper R (readings of
    one sensor that arrive independently). Raises UnavailableError where there is none.
    """
    data.require_samples()
    data.require_covariance()
    if data.runs > 1:
        raise UnavailableError("The law of P is that of single runs, and these are means of many.")
    # The first samples still depend on P(0).
    traces = data.trace[data.times >= START_SHARE * data.times[-1]]
    traces = np.where(traces < MAX_DRAWN, traces, np.nan)
    if not np.isfinite(traces).any():
        raise UnavailableError(f"All traces of P are above {MAX_DRAWN:g} or not finite.")
    figure = new_figure(7.4, 4.4)
    axes = figure.add_subplot()
    groups = (
        (data.has_sensor, SENSING, "--", "with a sensor"),
        (~data.has_sensor, INK, "-", "without"),
    )
    has_both = data.has_sensor.any() and not data.has_sensor.all()
    for group, colour, dashes, description in groups:
        sample = traces[:, group].ravel()
        sample = np.sort(sample[np.isfinite(sample)])
        if sample.size:
            label = f"run, nodes {description}" if has_both else "run, all nodes"
            _draw_tail(axes, sample, colour, dashes, label)
    median, high = np.quantile(traces[np.isfinite(traces)], (0.5, 0.99))
    headline = f"The median trace of P is {median:.3g}; 1% of samples exceed {high:.3g}"
    law_traces = _sample_invariant_law(data)
    if law_traces is not None:
        label = f"invariant law, {LAW_SAMPLES:,} draws"
        _draw_tail(axes, np.sort(law_traces), EXACT, ":", label)
        run_mean = traces[:, _hears_one_sensor(data.scenario)].mean()
        headline = (
            f"Mean trace of P {run_mean:.3g} in the run; the invariant law has "
            f"{law_traces.mean():.3g}"
        )
    drawn = np.concatenate([traces.ravel(), [] if law_traces is None else law_traces])
    positive = drawn[np.isfinite(drawn) & (drawn > 0.0)]
    if positive.size:
        low, high = positive.min(), positive.max()
        if high > LOG_RATIO * low:
            axes.set_xscale("log")
        elif high - low < SAME_TRACES * high:
            # An axis over rounding errors would suggest a spread.
            axes.set_xlim(0.9 * low, 1.1 * high)
    axes.set_yscale("log")
    axes.set(xlabel=f"trace of P, squared {data.unit}", ylabel="share of samples above")
    draw_legend(axes)
    note = "The first fifth of the samples is left out. Samples of one run are not independent."
    return finish_figure(figure, data.title(headline), data.caption(note))


def _draw_tail(axes: Any, sample: FloatArray, colour: str, dashes: str, label: str) -> None:
    """Draw the share of an increasing ``sample`` (K,) at least as large as each value."""
    share = 1.0 - np.arange(len(sample)) / len(sample)
    axes.plot(sample, share, color=colour, ls=dashes, label=label, drawstyle="steps-post")


def _hears_one_sensor(scenario: Scenario) -> np.ndarray:
    """Return a mask (N,) of nodes without a sensor whose neighbours have one sensor in all."""
    placed, senders = scenario.placed_sensors, scenario.topology.senders
    heard = {node: sum(len(placed.get(i, ())) for i in senders(node)) for node in scenario.nodes}
    return np.array([node not in placed and count == 1 for node, count in heard.items()])


def _sample_invariant_law(data: FigureData) -> FloatArray | None:
    """Return steady traces (LAW_SAMPLES,) of P by the random Riccati equation, or None."""
    scenario = data.scenario
    loss = scenario.network.channel.loss
    # A class derived from the built-in filter may have another law.
    is_intermittent = type(scenario.filter.algorithm) is built_in_filters()["intermittent"]
    if not (is_intermittent and scenario.slotted and len(scenario.sensors) == 1):
        return None
    if not isinstance(loss, Bernoulli) or len(scenario.plant.changes):
        return None
    H = getattr(scenario.sensors[0], "H", None)
    if H is None or not _hears_one_sensor(scenario).any() or not scenario.filters_know_the_truth:
        return None
    plant = scenario.linear_plant
    R = scenario.sensors[0].R
    try:
        samples = invariant_samples(plant.F, plant.Q, H, R, loss.delivery, LAW_SAMPLES, data.seed)
    except (TheoryError, NetkfError):
        return None
    return np.asarray(np.trace(samples, axis1=1, axis2=2))
