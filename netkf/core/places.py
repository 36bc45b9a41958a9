"""Where blocks of the state stand in a vector of several."""

from __future__ import annotations

from typing import NamedTuple


class Place(NamedTuple):
    """A block of the stacked state: ``name``, the ``node`` (id) that owns it, None if all share it,
    and its entries ``first`` to ``first + n`` - 1.
    """

    name: str
    node: int | None
    first: int
    n: int

    @property
    def label(self) -> str:
        """Its name, and whose it is: pose@3."""
        return self.name if self.node is None else f"{self.name}@{self.node}"

    @property
    def entries(self) -> slice:
        """Its entries in the stacked state."""
        return slice(self.first, self.first + self.n)
