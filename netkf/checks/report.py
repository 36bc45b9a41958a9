"""Verdicts as text for a terminal and as JSON."""

from __future__ import annotations

import dataclasses
import math
import textwrap
from collections import Counter
from typing import Any

from netkf.checks.check import Verdict
from netkf.checks.evidence import BROKEN, COMPUTED, NOT_PROMISED, VERDICTS, Evidence
from netkf.runs.files import to_json_value
from netkf.theory.common.papers import paper_legend

INDENT = " " * 13
WIDTH = 87  # with the indent 100 columns


def verdict_text(verdict: Verdict, claim: str = "", command: str = "", full: bool = True) -> str:
    """Return the text of ``netkf check``: broken rows first, and short at the end with ``command``;
    unless ``full``, other rows have one line below their promise.
    """
    lines = [f"{verdict.scenario}: {claim}" if claim else verdict.scenario, ""]
    broken = [row for row in verdict.rows if row.verdict == BROKEN]
    others = [row for row in verdict.rows if row.verdict != BROKEN]
    folded = [] if full else [row for row in others if row.group == COMPUTED]
    for row in [*broken, *(row for row in others if row not in folded)]:
        mark = row.verdict.upper() if row.verdict == BROKEN else row.verdict
        lines.append(f"{mark:<{len(INDENT)}}{row.promise}  [{row.source}]")
        if full or row.verdict == BROKEN:
            message = _describe_row(row)
            lines += textwrap.wrap(message, WIDTH, initial_indent=INDENT, subsequent_indent=INDENT)
        else:
            lines.append(INDENT + textwrap.shorten(_summarise_row(row), WIDTH, placeholder=" ..."))
    if folded:
        listed = "; ".join(f"{row.promise} [{row.source}]: {row.verdict}" for row in folded)
        text = f"{'computed':<{len(INDENT)}}no run can break these: {listed}"
        lines += textwrap.wrap(text, len(INDENT) + WIDTH, subsequent_indent=INDENT)
    lines += ["", *paper_legend(row.source for row in verdict.rows), *_summary_lines(verdict)]
    if not full:
        lines.append("detectable: an error found with probability 0.9; --all shows all evidence")
    lines += [""] if broken else []
    for row in broken:
        values = f": seen {row.seen:.4g}, expected {row.expected:.4g}"
        lines.append(f"BROKEN: {row.promise}  [{row.source}]{values}")
        if command and row.replica is not None:
            lines.append(f"        replay it: {command} {row.replica}")
    return "\n".join(lines)


def _summary_lines(verdict: Verdict) -> list[str]:
    counts = Counter(row.verdict for row in verdict.rows)
    counted_verdicts = ", ".join(f"{counts[v]} {v}" for v in VERDICTS if counts[v])
    looks = f" at all of {verdict.looks} looks" if verdict.looks > 1 else ""
    joint = f"all intervals{looks} hold together with probability {verdict.confidence:.6g}"
    lines = [f"{counted_verdicts}; {verdict.runs:,} runs, {joint}"]
    needed = [row.needed for row in verdict.rows if row.needed is not None]
    if needed:
        lines.append(
            f"about {max(needed):,} runs would decide what is undecided: --runs {max(needed)}, or "
            "--until decided"
        )
    return lines


def _describe_row(row: Evidence) -> str:
    if row.verdict == NOT_PROMISED:
        return row.assumptions
    parts = [f"needs about {row.needed:,} runs"] if row.needed is not None else []
    # A row that compares exactly has no interval: low and high are equal.
    if row.low < row.high:
        limits = [f"{row.tolerance:g} is tolerated"] if row.tolerance else []
        if row.detectable > 0.0:
            limits.append(f"an error of {row.detectable:.2g} is detectable")
        off = f"off by {row.off:.3g}, at most {max(0.0, -row.low):.3g}"
        parts.append(off + (f" ({'; '.join(limits)})" if limits else ""))
        if math.isfinite(row.seen) and math.isfinite(row.expected):
            parts.append(f"seen {row.seen:.4g}, expected {row.expected:.4g}")
    return "; ".join([*parts, row.evidence])


def _summarise_row(row: Evidence) -> str:
    if row.verdict == NOT_PROMISED or not row.low < row.high:
        return _describe_row(row)
    needed = f"needs about {row.needed:,} runs; " if row.needed is not None else ""
    limit = f"detectable {row.detectable:.2g}" if row.detectable > 0.0 else row.evidence
    return f"{needed}off by {row.off:.3g}, at most {max(0.0, -row.low):.3g}; {limit}"


def verdict_json(verdict: Verdict) -> dict[str, Any]:
    """Return the verdict as plain JSON values."""
    document = {
        "scenario": verdict.scenario,
        "runs": verdict.runs,
        "seed": verdict.seed,
        "confidence": verdict.confidence,
        "rows": [dataclasses.asdict(row) for row in verdict.rows],
        "holds": bool(verdict),
        "decided": verdict.is_decided,
    }
    plain: dict[str, Any] = to_json_value(document)
    return plain
