"""The figures ``stability`` and ``law``: where covariances stay bounded, and how they vary."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from netkf.algorithms.registry import built_in_filters
from netkf.core.errors import NetkfError, TheoryError
from netkf.figures.style import (
    EXACT,
    INK,
    LOST,
    RELAY,
    SENSING,
    SEQUENTIAL,
    SERIES,
    Picture,
    draw_legend,
    finish_figure,
    new_figure,
)
from netkf.figures.subject import Subject, UnavailableError
from netkf.linalg.arrays import FloatArray
from netkf.network.channels import Bernoulli
from netkf.scenario.scenario import Scenario
from netkf.theory import invariant_samples
from netkf.theory.hybrid.coupled import reason_without_bound
from netkf.theory.hybrid.steady import has_steady_state

RATE, DELIVERY = "network.activation.rate", "network.channel.loss.delivery"
FACTORS = tuple(2.0**k for k in range(-4, 5))
DELIVERIES = tuple(k / 8 for k in range(1, 9))
LAW_SAMPLES = 2000
MAX_TRACE = 1e100
"""Traces of P that are drawn; logarithmic axes overflow beyond."""
SPREAD = 20.0
"""Ratio of the largest to the smallest value beyond which an axis is logarithmic."""


def stability_figure(subject: Subject) -> Picture:
    """Draw for which link rates and delivery probabilities the bound H(12) has a steady state."""
    scenario = subject.scenario
    reason = "clocks in slots have no rate" if scenario.slotted else reason_without_bound(scenario)
    rate = getattr(scenario.network.activation, "rate", None)
    loss = scenario.network.channel.loss
    if reason or rate is None or not isinstance(loss, Bernoulli):
        reason = reason or "it is drawn over the rate of Poisson clocks and a Bernoulli delivery"
        raise UnavailableError(f"There is no map of the bound H(12): {reason}.")
    rates = [rate * factor for factor in FACTORS]
    stable = np.array([[_is_stable(scenario, r, d) for r in rates] for d in DELIVERIES])
    figure = new_figure(7.4, 4.6)
    axes = figure.add_subplot()
    x, y = np.meshgrid(rates, DELIVERIES)
    for group, marker, colour, label in (
        (stable, "o", RELAY, "the bound has a steady state"),
        (~stable, "x", LOST, "the bound grows without end"),
    ):
        axes.plot(x[group], y[group], ls="", marker=marker, ms=9, color=colour, label=label)
    here = float(loss.delivery)
    axes.plot([rate], [here], marker="*", ls="", ms=13, mfc="none", mec=INK, label="this scenario")
    axes.set_xscale("log", base=2)
    axes.set_xticks(rates, [f"{r:.3g}" for r in rates])
    axes.minorticks_off()
    axes.set(xlabel=f"{RATE}, 1/s", ylabel=DELIVERY)
    draw_legend(axes)
    holds = _is_stable(scenario, rate, here)
    claim = f"The bound of this scenario {'has a' if holds else 'has no'} steady state; it has one "
    claim += f"at {int(stable.sum())} of {stable.size} points of rate and delivery"
    caption = subject.caption(
        "From theory alone: no simulation. Existence of the steady state of H(12)."
    )
    finish_figure(figure, claim, caption)
    return figure


def _is_stable(scenario: Scenario, rate: float, delivery: float) -> bool:
    """Return True if H(12) has a steady state at this rate and delivery probability."""
    return has_steady_state(scenario.replace({RATE: rate, DELIVERY: delivery}))


def sweep_figure(name: str, table: Any, keys: Sequence[str], status: str) -> Picture:
    """Draw the largest RMS error of a sweep over one or two keys, and where runs diverged or the
    bound has no steady state. Raises UnavailableError for more keys, and without a finished point.
    """
    about = f"{name}: {len(table)} points"
    if status != "complete":
        about += f"; the sweep was {status}"
    runs = int(table["runs"].max()) if len(table) else 0
    bars = " Bars: 95% intervals." if runs > 1 and len(keys) == 1 else ""
    each = f"{runs} run{'s' if runs != 1 else ''} each, the same draws at all of them"
    caption = [f"{about}, {each}.{bars}"]
    if not len(table) or len(keys) > 2:
        why = "has no finished point" if not len(table) else "has more than two keys"
        raise UnavailableError(f"The sweep {why}.")
    figure = new_figure(7.4, 4.6)
    axes = figure.add_subplot()
    claim = (_draw_curve if len(keys) == 1 else _draw_map)(axes, table, list(keys))
    prefix = "" if status == "complete" else "Interrupted: "
    finish_figure(figure, prefix + claim, caption)
    return figure


def _draw_curve(axes: Any, table: Any, keys: list[str]) -> str:
    """Draw the errors of a sweep over one key; return the claim."""
    positions, labels = _axis_positions(axes.set_xscale, table[keys[0]])
    order = np.argsort(positions, kind="stable")
    series = (("worst_rms", "node with the largest error"), ("mean_rms", "all nodes"))
    for (name, label), look in zip(series, SERIES, strict=False):
        bars = 1.96 * table[f"{name}_se"].fillna(0.0).to_numpy()[order]
        style = {
            "color": look.colour,
            "ls": look.dashes,
            "marker": look.marker,
            "ms": 4,
            "capsize": 2,
        }
        axes.errorbar(
            positions[order], table[name].to_numpy()[order], yerr=bars, label=label, **style
        )
    bound = np.sqrt(table["bound"].to_numpy(dtype=np.float64))[order]
    if np.isfinite(bound).any():
        axes.plot(
            positions[order], bound, color=EXACT, ls=":", marker="_", label="root of the bound"
        )
    if labels:
        axes.set_xticks(
            range(len(labels)), labels, rotation=15 if sum(map(len, labels)) > 70 else 0
        )
    axes.set(xlabel=keys[0], ylabel="RMS error, units of the state")
    axes.set_ylim(bottom=0.0)
    draw_legend(axes)
    return _describe_best(table, keys)


def _draw_map(axes: Any, table: Any, keys: list[str]) -> str:
    """Draw a cell a point, shaded by the largest RMS error; crosses where runs diverged, circles
    where there is no bound.
    """
    columns, rows = (list(dict.fromkeys(table[key].tolist())) for key in keys)
    values = np.full((len(rows), len(columns)), np.nan)
    diverged, unbounded = (np.zeros(values.shape, dtype=bool) for _ in range(2))
    for point in table.to_dict("records"):
        at = rows.index(point[keys[1]]), columns.index(point[keys[0]])
        values[at] = point["worst_rms"]
        diverged[at] = "diverged" in str(point["status"])
        unbounded[at] = not np.isfinite(point["bound"])
    finite = values[np.isfinite(values) & (values > 0.0)]
    spread = finite.size and finite.max() > SPREAD * finite.min()
    image = axes.imshow(
        values, aspect="auto", origin="lower", cmap=SEQUENTIAL, norm="log" if spread else "linear"
    )
    for group, marker, label in (
        (diverged, "x", "runs diverged"),
        (unbounded, "o", "no bound H(12)"),
    ):
        up, along = np.nonzero(group)
        if len(up):
            style = {"marker": marker, "ls": "", "ms": 8, "mec": LOST, "mfc": "none", "mew": 1.5}
            axes.plot(along, up, label=label, **style)
    axes.set_xticks(range(len(columns)), [_short(v) for v in columns])
    axes.set_yticks(range(len(rows)), [_short(v) for v in rows])
    axes.set(xlabel=keys[0], ylabel=keys[1])
    axes.figure.colorbar(image, ax=axes, label="largest RMS error, units of the state")
    draw_legend(axes)
    return _describe_best(table, keys)


def _describe_best(table: Any, keys: Sequence[str]) -> str:
    """Return the claim of a sweep: the point with the smallest worst error."""
    finite = table[np.isfinite(table["worst_rms"])]
    diverged = int(table["status"].astype(str).str.contains("diverged").sum())
    if not len(finite):
        return "No point has a finite error"
    best = finite.loc[finite["worst_rms"].idxmin()]
    where = ", ".join(f"{key.rpartition('.')[2]} = {_short(best[key])}" for key in keys)
    claim = f"The largest RMS error is smallest, {best['worst_rms']:.3g}, at {where}"
    return claim + (f"; runs diverge at {diverged} of {len(table)} points" if diverged else "")


def _axis_positions(set_scale: Callable[[str], Any], values: Any) -> tuple[FloatArray, list[str]]:
    """Return positions on the axis: numbers on a scale, others side by side with labels."""
    if values.dtype.kind in "iuf":
        positions = values.to_numpy(dtype=np.float64)
        if positions.min() > 0.0 and positions.max() > SPREAD * positions.min():
            set_scale("log")
        return positions, []
    names = list(dict.fromkeys(values.astype(str)))
    positions = np.array([names.index(str(v)) for v in values], dtype=np.float64)
    return positions, [_short(name) for name in names]


def _short(value: Any) -> str:
    """Return a value as a text of at most 24 characters."""
    text = f"{value:.4g}" if isinstance(value, (int, float, np.number)) else str(value)
    return text if len(text) <= 24 else text[:21] + "..."


EQUAL_TRACES = 1e-6
"""Relative range of traces of P below which they are one value."""


def law_figure(subject: Subject) -> Picture:
    """Draw the share of samples whose trace of P exceeds a value, and the invariant law where the
    readings of one sensor arrive independently (R).
    """
    subject.require_samples()
    subject.require_covariance()
    if subject.runs > 1:
        raise UnavailableError("The law of P is that of single runs, and these are means of many.")
    late = subject.times >= 0.2 * subject.times[-1]
    values = np.where(subject.trace[late] < MAX_TRACE, subject.trace[late], np.nan)
    if not np.isfinite(values).any():
        raise UnavailableError(f"All traces of P are above {MAX_TRACE:g} or not finite.")
    figure = new_figure(7.4, 4.4)
    axes = figure.add_subplot()
    groups = (
        (subject.sensing, SENSING, "--", "with a sensor"),
        (~subject.sensing, INK, "-", "without"),
    )
    several = subject.sensing.any() and not subject.sensing.all()
    for group, colour, dashes, which in groups:
        sample = values[:, group].ravel()
        sample = np.sort(sample[np.isfinite(sample)])
        if sample.size:
            label = f"run, nodes {which}" if several else "run, all nodes"
            _draw_tail(axes, sample, colour, dashes, label)
    claim = _tail_claim(values)
    laws = _invariant_law(subject)
    if laws is not None:
        _draw_tail(axes, np.sort(laws), EXACT, ":", f"invariant law, {LAW_SAMPLES:,} draws")
        own = values[:, _hears_one(subject.scenario)]
        claim = (
            f"Mean trace of P {own.mean():.3g} in the run; the invariant law has {laws.mean():.3g}"
        )
    positive = values[np.isfinite(values) & (values > 0.0)]
    if positive.size and positive.max() > SPREAD * positive.min():
        axes.set_xscale("log")
    elif (
        positive.size and positive.max() - positive.min() < EQUAL_TRACES * positive.max()
    ):  # rounding alone
        axes.set_xlim(0.9 * positive.min(), 1.1 * positive.max())
    axes.set_yscale("log")
    axes.set(xlabel="trace of P, squared units of the state", ylabel="share of samples above")
    draw_legend(axes)
    note = "The first fifth of the samples is left out. Samples of one run are not independent."
    finish_figure(figure, subject.claim(claim), subject.caption(note))
    return figure


def _draw_tail(axes: Any, sample: FloatArray, colour: str, dashes: str, label: str) -> None:
    """Draw the share of a sorted ``sample`` (K,) above each value."""
    share = 1.0 - np.arange(len(sample)) / len(sample)
    axes.plot(sample, share, color=colour, ls=dashes, label=label, drawstyle="steps-post")


def _tail_claim(values: FloatArray) -> str:
    """Return the claim on the tail of the trace of P."""
    known = values[np.isfinite(values)]
    median, high = np.quantile(known, (0.5, 0.99))
    return f"The median trace of P is {median:.3g}; 1% of samples exceed {high:.3g}"


def _hears_one(scenario: Scenario) -> np.ndarray:
    """Return (N,) bool: nodes without a sensor that hear exactly one node with one."""
    heard = {
        node: [i for i, j in scenario.topology.directions if j == node] for node in scenario.nodes
    }
    return np.array(
        [
            node not in scenario.placed_sensors
            and sum(len(scenario.placed_sensors.get(i, ())) for i in heard[node]) == 1
            for node in scenario.nodes
        ]
    )


def _invariant_law(subject: Subject) -> FloatArray | None:
    """Return draws of the trace of P by the invariant law, None if R's model is not this one."""
    scenario = subject.scenario
    loss = scenario.network.channel.loss
    # Exactly the built-in class: a class derived from it may have another law.
    intermittent = type(scenario.filter.algorithm) is built_in_filters()["intermittent"]
    if not (intermittent and scenario.slotted and len(scenario.sensors) == 1):
        return None
    if not isinstance(loss, Bernoulli):
        return None
    H = getattr(scenario.sensors[0], "H", None)
    if H is None or not _hears_one(scenario).any() or not scenario.filters_know_the_truth:
        return None
    plant = scenario.slot_plant
    R = scenario.sensors[0].R
    try:
        drawn = invariant_samples(plant.F, plant.Q, H, R, loss.delivery, LAW_SAMPLES, subject.seed)
    except (TheoryError, NetkfError):
        return None
    return np.asarray(np.trace(drawn, axis1=1, axis2=2))
