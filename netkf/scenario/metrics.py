"""What summaries say beside means over time."""

from __future__ import annotations

from dataclasses import dataclass

from netkf.core.fields import Component, boolean, field, list_of, number, positive


@dataclass(frozen=True, eq=False)
class Metrics(Component):
    """What summaries say beside means over time, of the length of the error |x - xhat|, or the root
    of trace P where the truth is unknown.

    level      ``time_above`` is the share of samples above it, in units of the state
    quantiles  orders of the quantiles over the samples
    network    ages, time connected and the traffic of each node: by default those of single runs,
               and ages of as many as 100 nodes with 100 sensors; true: of all, and of all runs of
               ensembles, sweeps and comparisons, which then takes longer; false: none
    """

    level: float | None = field(positive, default=None)
    quantiles: tuple[float, ...] = field(
        list_of(number(low=0.0, high=1.0), "numbers from 0 to 1", min_length=0),
        default=(0.5, 0.9, 0.99),
    )
    network: bool | None = field(boolean, default=None)
