"""What the core asks of the wings above it, which it does not import: ``netkf`` hands it in."""

from __future__ import annotations

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Any


class Wings:
    """Functions of the theory and of the tools; ModuleNotFoundError where these are missing.

    promise_traces : (scenario, times) -> PromisedTraces, see ``runs.summary``
    draw : (result, name of a figure) -> the figure, see ``figures.catalogue``
    to_xarray, to_stonesoup : result -> objects of these libraries, see ``neighbours``
    """

    promise_traces: Callable[..., Any]
    draw: Callable[..., Any]
    to_xarray: Callable[..., Any]
    to_stonesoup: Callable[..., Any]


WINGS = Wings()
