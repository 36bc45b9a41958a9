"""Checkers for custom classes and assertions for pytest.

Each raises AssertionError with one line (method, rule, the value got, what to do), and returns None
if all is well.
"""

from netkf.testing.assertions import assert_dominated as assert_dominated
from netkf.testing.assertions import assert_promises as assert_promises
from netkf.testing.assertions import scenario_files as scenario_files
from netkf.testing.channels import check_channel as check_channel
from netkf.testing.clocks import check_clock as check_clock
from netkf.testing.clocks import check_matching as check_matching
from netkf.testing.filters import check_filter as check_filter
from netkf.testing.plants import check_plant as check_plant
from netkf.testing.sensors import check_sensor as check_sensor

__all__ = [name for name, value in sorted(globals().items()) if callable(value)]


def __dir__() -> list[str]:
    return __all__
