"""Columns of numbers as text: shuffled bytes, compressed with gzip, in base64."""

from __future__ import annotations

import base64
import gzip
from typing import Any

import numpy as np

TYPES = {"f8": "<f8", "u4": "<u4", "u2": "<u2", "u1": "u1", "i2": "<i2"}


class Packer:
    """Collects columns and returns them as one text.

    The bytes of a column are transposed, all first bytes before all second bytes: neighbouring
    numbers share their leading bytes, which gzip then finds. Numbers keep all their digits.
    """

    def __init__(self) -> None:
        self._parts: list[bytes] = []

    def add(self, values: Any, kind: str) -> dict[str, Any]:
        """Append a column of numbers of a type (a key of TYPES); return what finds it again."""
        column = np.ascontiguousarray(values, dtype=TYPES[kind])
        self._parts.append(_planes(column))
        return {"part": len(self._parts) - 1, "type": kind, "shape": list(column.shape)}

    def text(self) -> tuple[str, list[int]]:
        """Return all columns as text, and the number of bytes of each column."""
        packed = gzip.compress(b"".join(self._parts), compresslevel=9, mtime=0)
        return base64.b64encode(packed).decode("ascii"), [len(part) for part in self._parts]


def _planes(column: np.ndarray) -> bytes:
    """Return the bytes of a column, the first of all numbers, then the second, and so on."""
    octets = np.frombuffer(column.tobytes(), dtype=np.uint8)
    return octets.reshape(column.size, column.itemsize).T.tobytes()
