"""Results of single replicas of a check, also as plain arrays for files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from netkf.checks.parts.samples import PART_TYPES
from netkf.checks.records.rows import Audit, audit_columns, read_audit
from netkf.checks.samples import ReplicaSummary
from netkf.ensembles.replicas import Form


class ReplicaResult(NamedTuple):
    """The result of one replica.

    summary    : values that the promises of the paper are about; None if the run diverged
    difference : largest difference of the errors from those of the built-in base of a user's
                 filter class, on the same readings and messages, in standard deviations; nan if the
                 base was not run or rounding hides the difference
    expected   : a divergence is no surprise, because the built-in filter diverges too
    parts      : statistics of the parts of the scenario, by the names of PART_TYPES
    audit      : what is wrong with the record of the run
    """

    summary: ReplicaSummary | None
    difference: float
    expected: bool = False
    parts: Mapping[str, Any] | None = None
    audit: Audit = Audit()

    @property
    def diverged(self) -> bool:
        """True if the run ended early."""
        return self.summary is None


def result_columns(results: Sequence[ReplicaResult]) -> dict[str, np.ndarray]:
    """Return the results of replicas as arrays by name."""
    columns = {
        "difference": np.array([result.difference for result in results]),
        "expected": np.array([result.expected for result in results]),
        "diverged": np.array([result.diverged for result in results]),
        **audit_columns([result.audit for result in results]),
    }
    completed = [result for result in results if result.summary is not None]
    if not completed:
        return columns
    for name in vars(completed[0].summary):
        columns[f"summary.{name}"] = np.array(
            [getattr(result.summary, name) for result in completed]
        )
    for part, first in (completed[0].parts or {}).items():
        for name in first._fields:
            values = [getattr((result.parts or {})[part], name) for result in completed]
            columns[f"{part}.{name}"] = np.array(values)
    return columns


def results_of_columns(columns: Mapping[str, Any]) -> list[ReplicaResult]:
    """Return the results of replicas, in order, of which these are the columns."""
    columns = dict(columns)
    audits = {name: columns.pop(name) for name in list(columns) if name.startswith("audit.")}
    results, index = [], 0
    for k, diverged in enumerate(columns["diverged"].tolist()):
        difference, expected = float(columns["difference"][k]), bool(columns["expected"][k])
        audit = read_audit(_select_fields({name: v[k] for name, v in audits.items()}, "audit"))
        if diverged:
            results.append(ReplicaResult(None, difference, expected, audit=audit))
            continue
        values_of_replica = {name: v[index] for name, v in columns.items() if "." in name}
        summary = ReplicaSummary(**_select_fields(values_of_replica, "summary"))
        fields = {part: _select_fields(values_of_replica, part) for part in PART_TYPES}
        parts = {part: PART_TYPES[part](**values) for part, values in fields.items() if values}
        results.append(ReplicaResult(summary, difference, expected, parts, audit))
        index += 1
    return results


def _select_fields(values: dict[str, Any], prefix: str) -> dict[str, Any]:
    """Return the values named ``prefix.name``, by ``name``."""
    return {
        name.split(".", 1)[1]: value
        for name, value in values.items()
        if name.split(".", 1)[0] == prefix
    }


RESULTS_FORM = Form(result_columns, results_of_columns)
"""How plans store the results of replicas."""
