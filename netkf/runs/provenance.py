"""Software and hardware that the last bits of results depend on, besides the scenario."""

from __future__ import annotations

import hashlib
import importlib
import os
import platform
from functools import cache
from importlib import metadata
from typing import Any

import numpy as np

from netkf.core.version import __version__
from netkf.linalg.compiling import source_digest

PACKAGES = ("numpy", "scipy", "numba", "llvmlite", "simpy", "networkx")
"""Packages for arithmetic and random draws (numpy, scipy), compiled code (numba, llvmlite), the
order of events (simpy) and random graphs (networkx); pandas and pyarrow do not change numbers.
"""
VARIABLES = ("NUMBA_", "OPENBLAS_CORETYPE", "MKL_CBWR", "NPY_DISABLE_CPU_FEATURES")
"""Prefixes of the environment variables by which libraries choose the instructions they use."""
UNRELATED_VARIABLES = ("NUMBA_CACHE_DIR", "NUMBA_NUM_THREADS", "NUMBA_DEBUG_CACHE")
"""Variables with one of these prefixes that do not change results."""


def versions() -> dict[str, str]:
    """Return versions of packages that last bits depend on; ``source`` is netkf's own digest."""
    return dict(_cached_versions())


@cache
def _cached_versions() -> dict[str, str]:
    result = {"netkf": __version__, "source": source_digest(), "python": platform.python_version()}
    for package in PACKAGES:
        try:
            result[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    blas = _numpy_build().get("Build Dependencies", {}).get("blas", {})
    if "name" in blas:
        result["blas"] = f"{blas['name']} {blas.get('version', '')}".strip()
    return result


@cache
def machine() -> dict[str, Any]:
    """Return what libraries choose their code by, and so its rounding: ``architecture``,
    ``system``, ``processor``, ``features``, ``vector_instructions`` and ``environment`` variables.
    """
    result: dict[str, Any] = {"architecture": platform.machine(), "system": platform.system()}
    try:
        binding = importlib.import_module("llvmlite.binding")
        result["processor"] = binding.get_host_cpu_name()
        features = binding.get_host_cpu_features().flatten()
        result["features"] = hashlib.sha256(features.encode()).hexdigest()[:16]
    except (ImportError, RuntimeError):
        pass
    simd = _numpy_build().get("SIMD Extensions", {})
    result["vector_instructions"] = [*simd.get("baseline", []), *simd.get("found", [])]
    environment = {
        name: value
        for name, value in sorted(os.environ.items())
        if name.startswith(VARIABLES) and name not in UNRELATED_VARIABLES
    }
    return {**result, "environment": environment} if environment else result


def _numpy_build() -> dict[str, Any]:
    configuration: Any = np.show_config(mode="dicts")
    return dict(configuration or {})
