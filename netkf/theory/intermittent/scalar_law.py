"""The exact invariant law of the scalar random Riccati equation (derived; the paper simulates it).

Where ``sup f_1 < f_0(P*)`` the images of f_0 and f_1 do not meet: the support falls apart into
what an arrival made, below sup f_1 = F^2 R / H^2 + Q, and what an outage made, from f_0(P*) on.
Then the distribution function obeys a recursion with one branch at a time,

    P(X <= x) = g P(X <= f_1^-1(x)) below the hole,   g + (1 - g) P(X <= f_0^-1(x)) above it,

and its inverse the same backwards. In the example of R, F = sqrt 2 and H = Q = R = 1, outages of n
slots or more have probability (1-g)^n and the hole above them is (2^(n+1) + 1, ...).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from netkf.core.errors import TheoryError
from netkf.linalg.arrays import ArrayLike, FloatArray
from netkf.theory.intermittent.riccati import check_system, steady_covariance

NEGLIGIBLE = 1e-18
DEPTH = 18


@dataclass(frozen=True)
class ScalarLaw:
    """The law for scalar F, Q, H, R and delivery probability g; made by :func:`scalar_law`."""

    F: float
    Q: float
    H: float
    R: float
    delivery: float
    least: float
    """P*, the least point of the support."""

    def without(self, P: FloatArray) -> FloatArray:
        """``f_0``."""
        with np.errstate(over="ignore"):  # at a hole's lower edge all earlier letters are outages
            return np.asarray(self.F**2 * P + self.Q)

    def with_reading(self, P: FloatArray) -> FloatArray:
        """``f_1``, also at infinity."""
        with np.errstate(invalid="ignore"):
            gain = np.where(np.isinf(P), self.R / self.H**2, P * self.R / (self.H**2 * P + self.R))
        return np.asarray(self.F**2 * gain + self.Q)

    @property
    def hole(self) -> tuple[float, float]:
        """The open interval (sup f_1, f_0(P*)), which the law never meets."""
        return self.F**2 * self.R / self.H**2 + self.Q, float(self.without(np.array(self.least)))

    def cdf(self, x: ArrayLike) -> FloatArray:
        """P(X <= x), exact to about 1e-15, elementwise."""
        place = np.array(x, dtype=np.float64)
        total, share = np.zeros_like(place), np.ones_like(place)
        top = self.hole[0]
        while (share > NEGLIGIBLE).any():
            share = np.where(place < self.least * (1.0 - 1e-15), 0.0, share)
            above = place >= top
            total = total + np.where(above, share * self.delivery, 0.0)
            share = share * np.where(above, 1.0 - self.delivery, self.delivery)
            with np.errstate(divide="ignore", invalid="ignore"):
                reduced = (place - self.Q) / self.F**2
                before = reduced * self.R / (self.R - self.H**2 * reduced)
            place = np.where(above, reduced, before)
        return total

    def quantile(self, u: ArrayLike) -> FloatArray:
        """The least x with P(X <= x) >= u for 0 <= u < 1, elementwise."""
        level = np.array(u, dtype=np.float64)
        if ((level < 0.0) | (level >= 1.0)).any():
            raise TheoryError("quantiles are for levels in [0, 1)")
        letters = []
        for _ in range(2000):
            outage = level > self.delivery
            letters.append(outage)
            level = np.where(
                outage, (level - self.delivery) / (1.0 - self.delivery), level / self.delivery
            )
            if len(letters) >= 60 and not outage.any():
                break
        P = np.full_like(level, self.least)
        for outage in reversed(letters):
            P = np.where(outage, self.without(P), self.with_reading(P))
        return P

    def mean(self) -> float:
        """E[X], infinite where (1-g) F^2 >= 1; to about 1e-9 relative.

        E = g E[f_1(X)] + (1-g)(F^2 E + Q), and E[f_1(X)] lies between two sums over the words of 18
        letters, which bound X from both sides.
        """
        growth = (1.0 - self.delivery) * self.F**2
        if growth >= 1.0:
            return float("inf")
        low, high = np.array([self.least]), np.array([np.inf])
        weight = np.ones(1)
        for _ in range(DEPTH):
            low = np.concatenate([self.without(low), self.with_reading(low)])
            high = np.concatenate([self.without(high), self.with_reading(high)])
            weight = np.concatenate([(1.0 - self.delivery) * weight, self.delivery * weight])
        below, above = (float(weight @ self.with_reading(bound)) for bound in (low, high))
        if above - below > 1e-6 * above:
            raise TheoryError(f"the mean is known to {(above - below) / above:.1e} only")
        middle = 0.5 * (below + above)
        return (self.delivery * middle + (1.0 - self.delivery) * self.Q) / (1.0 - growth)


def scalar_law(
    F: ArrayLike, Q: ArrayLike, H: ArrayLike, R: ArrayLike, delivery: float
) -> ScalarLaw:
    """The exact invariant law of a scalar system (1 x 1 matrices or numbers).

    Raises TheoryError where the system is not scalar, has no P*, or where the images of f_0 and
    f_1 meet, so that the recursion does not close.
    """
    system = check_system(*(np.atleast_2d(value) for value in (F, Q, H, R)))
    if len(system.F) != 1 or len(system.H) != 1:
        raise TheoryError("the exact law is for one state and one output")
    if not 0.0 < delivery < 1.0:
        raise TheoryError(f"delivery must lie in (0, 1), got {delivery!r}")
    F_, Q_, H_, R_ = (float(matrix[0, 0]) for matrix in system)
    least = float(steady_covariance(*system)[0, 0])
    if F_ == 0.0 or H_ == 0.0:
        raise TheoryError("the exact law needs F and H that are not zero")
    law = ScalarLaw(F_, Q_, H_, R_, float(delivery), least)
    if not law.hole[0] < law.hole[1]:
        raise TheoryError("the images of f_0 and f_1 meet: no recursion with one branch")
    return law
