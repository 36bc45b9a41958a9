"""Packages and hardware that results depend on, bit for bit, besides the scenario."""

from __future__ import annotations

import importlib
import platform
from functools import cache
from importlib import metadata
from typing import Any

import numpy as np

from netkf.core.version import __version__

PACKAGES = ("numpy", "scipy", "numba", "llvmlite", "simpy", "networkx")
"""Arithmetic and random draws (numpy, scipy), compiled code (numba, llvmlite), order of events
(simpy) and random graphs (networkx). pandas and pyarrow are left out: they do not change numbers.
"""


def versions() -> dict[str, str]:
    """Return the versions of the packages that results depend on, bit for bit."""
    return dict(_versions())


@cache
def _versions() -> dict[str, str]:
    found = {"netkf": __version__, "python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    blas = _build().get("Build Dependencies", {}).get("blas", {})
    if "name" in blas:
        found["blas"] = f"{blas['name']} {blas.get('version', '')}".strip()
    return found


@cache
def machine() -> dict[str, Any]:
    """Return the architecture, the processor for which numba compiles, and the vector instructions
    that numpy has found. Libraries choose their code, and so their rounding, by them.
    """
    found = {"architecture": platform.machine(), "system": platform.system()}
    try:
        binding = importlib.import_module("llvmlite.binding")
        found["processor"] = binding.get_host_cpu_name()
    except ImportError:
        pass
    simd = _build().get("SIMD Extensions", {})
    return {**found, "vector_instructions": [*simd.get("baseline", []), *simd.get("found", [])]}


def _build() -> dict[str, Any]:
    """Return the build configuration of numpy."""
    configuration: Any = np.show_config(mode="dicts")
    return dict(configuration or {})
