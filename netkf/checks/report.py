"""Verdicts as text for a terminal and as JSON."""

from __future__ import annotations

import dataclasses
import textwrap
from collections import Counter
from typing import Any

from netkf.checks.check import Verdict
from netkf.checks.evidence import BROKEN, NOT_PROMISED, VERDICTS, Evidence
from netkf.runs.files import finite

INDENT = " " * 13
WIDTH = 87


def verdict_text(verdict: Verdict, claim: str = "") -> str:
    """Return the text of ``netkf check``: the rows, then how many there are of each verdict."""
    lines = [f"{verdict.scenario}: {claim}" if claim else verdict.scenario, ""]
    for row in verdict.rows:
        mark = row.verdict.upper() if row.verdict == BROKEN else row.verdict
        lines.append(f"{mark:<{len(INDENT)}}{row.promise}  [{row.source}]")
        message = _describe(row)
        lines += textwrap.wrap(message, WIDTH, initial_indent=INDENT, subsequent_indent=INDENT)
    counts = Counter(row.verdict for row in verdict.rows)
    shown = ", ".join(f"{counts[v]} {v}" for v in VERDICTS if counts[v])
    together = f"all intervals together hold with probability {verdict.confidence:.6g}"
    return "\n".join([*lines, "", f"{shown}; {verdict.runs:,} runs, {together}"])


def _describe(row: Evidence) -> str:
    """Return the evidence of a row, how far off it is and what would have been seen, or the
    assumptions that fail.
    """
    message = row.evidence
    if row.verdict == NOT_PROMISED:
        message = row.assumptions
    elif row.low < row.high:
        message += f"; off by {row.off:.3g}, at most {max(0.0, -row.low):.3g}"
        if row.detectable > 0.0:
            message += f"; an error of {row.detectable:.2g} would have been seen"
        message += f"; {row.tolerance:g} is tolerated" if row.tolerance else ""
    if row.needed is not None:
        message += f"; needs about {row.needed:,} runs"
    return message


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
    plain: dict[str, Any] = finite(document)
    return plain
