"""What a record does not show: the law that it came from. Rows of assumptions then say None."""

from __future__ import annotations

from netkf.network.channels import Channel
from netkf.network.recorded import RecordedDelay, RecordedLoss
from netkf.scenario.scenario import Scenario

Row = tuple[str, str, bool | None, str]
"""assumption, source, holds (None: not known), evidence."""

UNKNOWN_LAW = "the state or readings are recorded, and nobody knows their law"
RECORDED = "losses or delays are recorded: one outcome, not a law"
SAME = "the filters know the plant and the sensors"


def recorded_channel(channel: Channel) -> bool:
    """Whether losses or delays are read from a table."""
    return isinstance(channel.loss, RecordedLoss) or isinstance(channel.delay, RecordedDelay)


def knowledge(scenario: Scenario, source: str, matrices: str) -> Row:
    """Whether the filters have the true model, which only those who draw everything know."""
    if not scenario.drawn:
        return SAME, source, None, UNKNOWN_LAW
    same = scenario.filters_know_the_truth
    return SAME, source, same, matrices if same else "filter.model differs from the truth"


def of_the_truth(scenario: Scenario, holds: bool, words: str) -> tuple[bool | None, str]:
    """A verdict about the plant's own matrices, which are assumed where the state is recorded."""
    if scenario.plant.drawn:
        return holds, words
    return None, f"assumed, not known: {words}"
