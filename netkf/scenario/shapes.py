"""The check of array shapes."""

from __future__ import annotations

from netkf.core.errors import ScenarioError
from netkf.linalg.arrays import FloatArray


def require_shape(key: str, value: FloatArray, shape: tuple[int | None, ...], why: str) -> None:
    """Raise ScenarioError unless an array has the shape; None stands for any length."""
    fits = len(value.shape) == len(shape) and all(
        want is None or have == want for have, want in zip(value.shape, shape, strict=True)
    )
    if not fits:
        wanted = " x ".join("any" if want is None else str(want) for want in shape)
        got = " x ".join(map(str, value.shape))
        raise ScenarioError(
            key, f"must be {wanted}, not {got}, because {why}", value, "correct the shape"
        )
