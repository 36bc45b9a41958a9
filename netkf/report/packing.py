"""Columns of numbers as text: shuffled bytes, compressed with gzip, in base64."""

from __future__ import annotations

import base64
import gzip
from typing import Any

import numpy as np

TYPES = {"f8": "<f8", "u4": "<u4", "u2": "<u2", "u1": "u1", "i2": "<i2"}
"""NumPy types of columns by the names that a page uses."""


class Packer:
    """Collects columns of numbers and returns them as one text, without loss.

    The bytes of a column are transposed, all first bytes before all second bytes: neighbouring
    numbers share their leading bytes, which gzip compresses better side by side.
    """

    def __init__(self) -> None:
        self._columns: list[bytes] = []

    def add(self, values: Any, dtype: str) -> dict[str, Any]:
        """Append an array of a type of TYPES; return its index, type and shape for the page."""
        column = np.ascontiguousarray(values, dtype=TYPES[dtype])
        # The first byte of all numbers, then the second, and so on: these compress better.
        octets = np.frombuffer(column.tobytes(), dtype=np.uint8)
        self._columns.append(octets.reshape(column.size, column.itemsize).T.tobytes())
        return {"part": len(self._columns) - 1, "type": dtype, "shape": list(column.shape)}

    def text(self) -> tuple[str, list[int]]:
        """Return all columns as base64 text, and the number of uncompressed bytes of each one."""
        compressed = gzip.compress(b"".join(self._columns), compresslevel=9, mtime=0)
        return base64.b64encode(compressed).decode("ascii"), list(map(len, self._columns))
