"""Checkers for custom classes and assertions for pytest.

Each raises AssertionError with one line (method, rule, the value got, what to do), and returns None
if all is well.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from netkf.testing.channels import check_channel
    from netkf.testing.clocks import check_clock
    from netkf.testing.filters import check_filter
    from netkf.testing.matchings import check_matching
    from netkf.testing.matrices import assert_dominated
    from netkf.testing.plants import check_plant
    from netkf.testing.scenarios import assert_promises, scenario_files
    from netkf.testing.sensors import check_sensor

_WHERE = {
    "assert_dominated": "matrices",
    "assert_promises": "scenarios",
    "check_channel": "channels",
    "check_clock": "clocks",
    "check_filter": "filters",
    "check_matching": "matchings",
    "check_plant": "plants",
    "check_sensor": "sensors",
    "scenario_files": "scenarios",
}

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


def __getattr__(name: str) -> Any:
    if name not in _WHERE:
        raise AttributeError(f"module 'netkf.testing' has no attribute {name!r}")
    return getattr(importlib.import_module(f"netkf.testing.{_WHERE[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
