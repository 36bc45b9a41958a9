"""Packages that netkf does without: each is imported where it is used, and belongs to an extra."""

from __future__ import annotations

import importlib
from typing import Any

from netkf.core.errors import ScenarioError


def require(module: str, extra: str, user: str) -> Any:
    """Return a ``module`` (a dotted name) for ``user``, the function that needs it; raises
    ScenarioError, which says what to install, if its package is not there.
    """
    package = module.partition(".")[0]
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != package:
            raise
        raise missing(package, extra, user) from None


def missing(package: str, extra: str, user: str) -> ScenarioError:
    """Return the error that says what to install for ``user``, which needs a ``package``."""
    remedy = f"install it: pip install 'netkf[{extra}]'"
    return ScenarioError(user, f"needs {package}", None, remedy)
