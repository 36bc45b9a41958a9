"""Gates: readings that are too far from what a filter expects."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from netkf.core.fields import Component, field, number, one_of
from netkf.linalg.arrays import FloatArray
from netkf.linalg.portable import cholesky, solve_lower

NEVER = 1e300
"""A factor on R beyond all use."""


@dataclass(frozen=True, eq=False)
class Gate(Component):
    """A reading of p numbers, of the node or in a message, is refused if its normalised innovation
    squared z' S^-1 z, with S = H P H' + R, is beyond the quantile ``probability`` of the chi-square
    law with p degrees of freedom.

    probability  that a consistent filter takes a healthy reading
    then         "ignore": a refused reading is not used; "inflate": its R is multiplied so that it
                 is just taken
    """

    probability: float = field(number(above=0.0, below=1.0))
    then: str = field(one_of("ignore", "inflate"), default="ignore")

    def limit(self, p: int) -> float:
        """Return the largest normalised innovation squared of p numbers that is taken."""
        return float(scipy.stats.chi2.ppf(self.probability, p))

    def refused_spread(self, p: int) -> float:
        """Return g with E[z z'] = g S for healthy innovations z of p numbers that are refused:
        after one of them that is ignored, of a filter whose gain would be K, the covariance of the
        error is P + (g - 1) K S K'.

        The integral of a Gaussian law over the outside of an ellipsoid: by symmetry E[z z'] is
        proportional to S, and the factor E[u; u > c] / p of a chi-square number u is the tail of
        the law with p + 2 degrees of freedom.
        """
        limit = self.limit(p)
        tails = (float(scipy.stats.chi2.sf(limit, p + k)) for k in (2, 0))
        return next(tails) / next(tails)

    def factor(self, z: FloatArray, spread: FloatArray, R: FloatArray) -> float:
        """Return by what R (p, p) of the innovation z (p,) is multiplied, ``spread`` (p, n) being H
        times a root of P: 1 for a reading that is taken, inf for one that is ignored.
        """
        root = cholesky(R)
        w, G = solve_lower(root, z[:, None])[:, 0], solve_lower(root, spread)
        # Of a filter that has diverged.
        if not len(z) or not np.isfinite(w).all() or not np.isfinite(G).all():
            return 1.0
        # S is singular to rounding where P is very much larger than R: its root is not.
        U, s, _ = np.linalg.svd(G)
        squares, variances, limit = (U.T @ w) ** 2, np.zeros(len(z)), self.limit(len(z))
        variances[: len(s)] = s**2

        def excess(factor: float) -> float:
            return float((squares / (variances + factor)).sum()) - limit

        if excess(1.0) <= 0.0:
            return 1.0
        if self.then == "ignore":
            return np.inf
        high = 2.0
        while excess(high) > 0.0 and high < NEVER:
            high *= 4.0
        return float(scipy.optimize.brentq(excess, 1.0, high, xtol=1e-12, rtol=1e-12))
