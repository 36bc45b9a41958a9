"""Results of single replicas of a check, also as plain arrays for files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from netkf.checks.parts.events import PART_TYPES
from netkf.checks.records.rows import Audit, audit_columns, read_audit
from netkf.checks.samples import ReplicaSummary, stack_summaries
from netkf.ensembles.replicas import Form
from netkf.laws import stack_runs


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
    summaries = [result.summary for result in results if result.summary is not None]
    parts = [result.parts or {} for result in results if result.summary is not None]
    if summaries:
        fields = vars(stack_summaries(summaries))
        columns |= {f"summary.{name}": values for name, values in fields.items()}
        for part in parts[0]:
            fields = stack_runs([one[part] for one in parts])._asdict()
            columns |= {f"{part}.{name}": values for name, values in fields.items()}
    return columns


def results_of_columns(columns: Mapping[str, Any]) -> list[ReplicaResult]:
    """Return the results of replicas, in order, of which these are the columns."""
    groups: dict[str, dict[str, Any]] = {}
    for name, values in columns.items():
        group, _, field = name.rpartition(".")
        groups.setdefault(group, {})[field] = values
    own, audits = groups.pop(""), groups.pop("audit", {})
    results, index = [], 0
    for k, diverged in enumerate(own["diverged"].tolist()):
        difference, expected = float(own["difference"][k]), bool(own["expected"][k])
        audit = read_audit({name: values[k] for name, values in audits.items()})
        if diverged:
            results.append(ReplicaResult(None, difference, expected, audit=audit))
            continue
        found = {g: {name: v[index] for name, v in of.items()} for g, of in groups.items()}
        summary = ReplicaSummary(**found.pop("summary"))
        parts = {part: PART_TYPES[part](**values) for part, values in found.items()}
        results.append(ReplicaResult(summary, difference, expected, parts, audit))
        index += 1
    return results


RESULTS_FORM = Form(result_columns, results_of_columns)
"""How plans store the results of replicas."""
