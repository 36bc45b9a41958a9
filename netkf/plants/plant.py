"""What every plant is: a state of some dimension that starts somewhere."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from netkf.core.fields import Component, covariance, field, vector
from netkf.linalg.arrays import FloatArray


@dataclass(frozen=True, eq=False)
class Plant(Component):
    """x(0) is Gaussian of ``mean`` (n,) and ``cov`` (n, n), both zero by default."""

    is_random: ClassVar[bool] = True
    """Whether runs draw the state from the model; else the model is what the filters believe."""
    truth_known: ClassVar[bool] = True
    """Whether the state is known, so that there are errors to speak of."""

    mean: FloatArray | None = field(vector, default=None)
    cov: FloatArray | None = field(covariance, default=None)

    @property
    @abstractmethod
    def n(self) -> int:
        """Dimension of the state."""

    @property
    def start_mean(self) -> FloatArray:
        """(n,) mean of x(0)."""
        return np.zeros(self.n) if self.mean is None else self.mean

    @property
    def start_cov(self) -> FloatArray:
        """(n, n) covariance of x(0)."""
        return np.zeros((self.n, self.n)) if self.cov is None else self.cov
