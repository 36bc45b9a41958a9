"""Checkers for custom classes and assertions for pytest.

Each raises AssertionError with one line (method, rule, the value got, what to do), and returns None
if all is well.
"""

from netkf.testing.assertions import assert_dominated, assert_promises, scenario_files
from netkf.testing.channels import check_channel
from netkf.testing.clocks import check_clock
from netkf.testing.filters import check_filter
from netkf.testing.matchings import check_matching
from netkf.testing.plants import check_plant
from netkf.testing.sensors import check_sensor

__all__ = [
    "assert_dominated",
    "assert_promises",
    "check_channel",
    "check_clock",
    "check_filter",
    "check_matching",
    "check_plant",
    "check_sensor",
    "scenario_files",
]


def __dir__() -> list[str]:
    return sorted(__all__)
