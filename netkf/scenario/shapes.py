"""The check of array shapes."""

from __future__ import annotations

from netkf.core.errors import ScenarioError
from netkf.linalg.arrays import FloatArray


def require_shape(key: str, value: FloatArray, shape: tuple[int | None, ...], why: str) -> None:
    """Raise ScenarioError at ``key`` unless the array ``value`` has the ``shape``, in which None is
    any length; ``why`` is the reason in the message.
    """
    fits = len(value.shape) == len(shape) and all(
        length is None or actual == length
        for actual, length in zip(value.shape, shape, strict=True)
    )
    if not fits:
        expected = " x ".join("any" if length is None else str(length) for length in shape)
        actual_shape = " x ".join(map(str, value.shape))
        rule = f"must be {expected}, not {actual_shape}, because {why}"
        raise ScenarioError(key, rule, value, "correct the shape")
