"""Software and hardware that results depend on, bit for bit, besides the scenario."""

from __future__ import annotations

import hashlib
import importlib
import json
import os
import platform
from functools import cache
from importlib import metadata
from typing import Any

import numpy as np

from netkf.core.version import __version__
from netkf.linalg.compiling import source_digest

PACKAGES = ("numpy", "scipy", "numba", "llvmlite", "simpy", "networkx")
"""Arithmetic and random draws (numpy, scipy), compiled code (numba, llvmlite), order of events
(simpy) and random graphs (networkx). pandas and pyarrow are left out: they do not change numbers.
"""
VARIABLES = ("NUMBA_", "OPENBLAS_CORETYPE", "MKL_CBWR", "NPY_DISABLE_CPU_FEATURES")
"""Prefixes of environment variables by which libraries choose their code."""
HARMLESS = ("NUMBA_CACHE_DIR", "NUMBA_NUM_THREADS", "NUMBA_DEBUG_CACHE")


def versions() -> dict[str, str]:
    """Return the versions of the packages that results depend on, bit for bit; ``source`` is the
    digest of netkf's own files, which change between versions.
    """
    return dict(_versions())


@cache
def _versions() -> dict[str, str]:
    """Return the versions of netkf, Python, packages and BLAS."""
    found = {"netkf": __version__, "source": source_digest(), "python": platform.python_version()}
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
    """Return the architecture, the processor and its features (as a digest) for which numba
    compiles, the vector instructions that numpy has found, and environment variables. Libraries
    choose their code, and so their rounding, by them.
    """
    found: dict[str, Any] = {"architecture": platform.machine(), "system": platform.system()}
    try:
        binding = importlib.import_module("llvmlite.binding")
        found["processor"] = binding.get_host_cpu_name()
        features = binding.get_host_cpu_features().flatten()
        found["features"] = hashlib.sha256(features.encode()).hexdigest()[:16]
    except (ImportError, RuntimeError):
        pass
    simd = _build().get("SIMD Extensions", {})
    found["vector_instructions"] = [*simd.get("baseline", []), *simd.get("found", [])]
    chosen = {k: v for k, v in sorted(os.environ.items()) if k.startswith(VARIABLES)}
    chosen = {name: value for name, value in chosen.items() if name not in HARMLESS}
    return {**found, "environment": chosen} if chosen else found


def installation() -> str:
    """Return the digest of all that results depend on, bit for bit, besides the scenario."""
    text = json.dumps([versions(), machine()], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def _build() -> dict[str, Any]:
    """Return the build configuration of numpy."""
    configuration: Any = np.show_config(mode="dicts")
    return dict(configuration or {})
