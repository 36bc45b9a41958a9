"""Where blocks of the state stand in a vector of several."""

from __future__ import annotations

from typing import NamedTuple

Key = tuple[str, int]
"""Name and owner (id) of a block, -1 if all share it."""


class Place(NamedTuple):
    """A block of the stacked state: ``name``, the ``node`` (id) that owns it, None if all share it,
    and its entries ``first`` to ``first + n`` - 1.
    """

    name: str
    node: int | None
    first: int
    n: int

    @property
    def key(self) -> Key:
        """Its name and owner (id), -1 if all share it."""
        return self.name, -1 if self.node is None else self.node

    @property
    def label(self) -> str:
        """Its name, and whose it is: pose@3."""
        return self.name if self.node is None else f"{self.name}@{self.node}"

    @property
    def entries(self) -> slice:
        """Its entries in the stacked state."""
        return slice(self.first, self.first + self.n)
