"""The exact invariant law of the scalar random Riccati equation (derived; the paper simulates it).

If ``sup f_1 < f_0(P*)`` the images of f_0 and f_1 are disjoint: the support splits into the values
after an arrival, below sup f_1 = F^2 R / H^2 + Q, and those after an outage, from f_0(P*) on. The
distribution function then obeys a recursion with one branch,

    P(X <= x) = g P(X <= f_1^-1(x)) below the hole,   g + (1 - g) P(X <= f_0^-1(x)) above it,

and the quantile function its inverse. In the example of R, F = sqrt 2 and H = Q = R = 1, P lies
above the hole (2^(n+1) - 1, 2^n (2 + sqrt 2) - 1) after an outage of n slots or more, which has the
probability (1-g)^n.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from netkf.core.errors import TheoryError
from netkf.linalg.arrays import ArrayLike, FloatArray
from netkf.linalg.spectra import contracts
from netkf.theory.intermittent.riccati import check_system, steady_covariance
from netkf.theory.numerics.matrices import as_number, as_numbers

NEGLIGIBLE = 1e-18  # probability of the values that the recursion has not resolved yet
DEPTH = 18  # maps that the bounds of the mean compose
MIN_MAPS, MAX_MAPS = 60, 2000  # of the expansion of a quantile


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
        """Return ``f_0(P) = F^2 P + Q`` elementwise, an array of the shape of P."""
        # The lower edge of a hole is a quantile whose earlier slots are all outages: it overflows.
        with np.errstate(over="ignore"):
            return np.asarray(self.F**2 * P + self.Q)

    def with_reading(self, P: FloatArray) -> FloatArray:
        """Return ``f_1(P) = F^2 P R / (H^2 P + R) + Q`` elementwise, also at infinity."""
        with np.errstate(invalid="ignore"):
            gain = np.where(np.isinf(P), self.R / self.H**2, P * self.R / (self.H**2 * P + self.R))
        return np.asarray(self.F**2 * gain + self.Q)

    @property
    def hole(self) -> tuple[float, float]:
        """The interval (sup f_1, f_0(P*)), which P never enters."""
        return self.F**2 * self.R / self.H**2 + self.Q, float(self.without(np.array(self.least)))

    def cdf(self, x: ArrayLike) -> FloatArray:
        """Return P(X <= x) to about 1e-15, slot by slot: x tells if the last had a reading."""
        point = np.array(x, dtype=np.float64)
        total, weight = np.zeros_like(point), np.ones_like(point)
        top = self.hole[0]
        while (weight > NEGLIGIBLE).any():
            weight = np.where(point < self.least * (1.0 - 1e-15), 0.0, weight)
            # Above the hole every value after an arrival is smaller, and the last slot an outage.
            above = point >= top
            total = total + np.where(above, weight * self.delivery, 0.0)
            weight = weight * np.where(above, 1.0 - self.delivery, self.delivery)
            with np.errstate(divide="ignore", invalid="ignore"):
                reduced = (point - self.Q) / self.F**2
                # f_1^-1: R y / (R - H^2 y) with y = (x - Q) / F^2
                preimage = reduced * self.R / (self.R - self.H**2 * reduced)
            point = np.where(above, reduced, preimage)
        return total

    def cdf_after(self, x: ArrayLike, slots: int, start: float) -> FloatArray:
        """Return P(P_t <= x) after t = ``slots`` slots from P_0 = ``start``, exact, in the shape of
        ``x``: ``P(P_t <= x) = (1 - g) P(P_{t-1} <= f_0^-1(x)) + g P(P_{t-1} <= f_1^-1(x))``. At or
        above P* one of the terms is 0 or 1; below it both count.
        """
        x = np.asarray(x, dtype=np.float64)
        point, owner = x.reshape(-1), np.arange(x.size)
        weight, total = np.ones(x.size), np.zeros(x.size)
        # All values after s slots lie between those without losses and those without readings.
        lowest, highest = [np.array(start)], [np.array(start)]
        for _ in range(slots):
            lowest.append(self.with_reading(lowest[-1]))
            highest.append(self.without(highest[-1]))
        # Backwards in time, each x becomes several weighted points; ``owner`` is the index of x.
        # A point above all values counts in full, one below all of them not at all.
        for slots_left in range(slots, -1, -1):
            above = point >= highest[slots_left] * (1.0 - 1e-15)
            np.add.at(total, owner[above], weight[above])
            open_ = ~above & (point >= lowest[slots_left] * (1.0 - 1e-15)) & (weight > NEGLIGIBLE)
            point, owner, weight = point[open_], owner[open_], weight[open_]
            reduced = (point - self.Q) / self.F**2
            # f_0^-1 and f_1^-1 of each point; the latter is infinite at or above sup f_1.
            denominator = self.R - self.H**2 * reduced
            with np.errstate(divide="ignore", invalid="ignore"):
                preimage = np.where(denominator > 0.0, reduced * self.R / denominator, np.inf)
            point = np.concatenate([reduced, preimage])
            owner = np.concatenate([owner, owner])
            weight = np.concatenate([weight * (1.0 - self.delivery), weight * self.delivery])
        return total.reshape(x.shape)

    def quantile(self, u: ArrayLike) -> FloatArray:
        """Return the least x with P(X <= x) >= u, for u in [0, 1); else TheoryError."""
        level = np.array(u, dtype=np.float64)
        if ((level < 0.0) | (level >= 1.0)).any():
            raise TheoryError("quantiles are for levels in [0, 1)")
        # The level determines if the last slot was an outage, and the level within that branch.
        outages = []
        for _ in range(MAX_MAPS):
            outage = level > self.delivery
            outages.append(outage)
            # Below the hole u = g v, above it u = g + (1 - g) v, with v the level in the slot
            # before.
            level = np.where(
                outage, (level - self.delivery) / (1.0 - self.delivery), level / self.delivery
            )
            if len(outages) >= MIN_MAPS and not outage.any():
                break
        # Apply the maps in the order of time, from any start: the oldest no longer matter.
        P = np.full_like(level, self.least)
        for outage in reversed(outages):
            P = np.where(outage, self.without(P), self.with_reading(P))
        return P

    def mean(self) -> float:
        """Return the mean of the invariant law to about 1e-9, infinite if (1-g) F^2 >= 1, by two
        sums over compositions of 18 maps; raises TheoryError if these differ by more than 1e-6.
        """
        growth = (1.0 - self.delivery) * self.F**2
        if not contracts(growth):
            return float("inf")
        low, high = np.array([self.least]), np.array([np.inf])
        # All compositions at once: both maps applied to every value, with their probabilities.
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
    """Return the exact invariant law of a scalar system: F, Q, H and R are numbers or 1 x 1
    matrices, and readings arrive with probability ``delivery``.

    Raises TheoryError if the system is not scalar, has no steady covariance P* with all readings,
    or if the values of P after a slot without a reading (f_0) and those after one with it (f_1)
    overlap, so that the recursion of the distribution function has two branches.
    """
    system = check_system(
        *(np.atleast_2d(as_numbers(*named)) for named in zip("FQHR", (F, Q, H, R), strict=True))
    )
    if len(system.F) != 1 or len(system.H) != 1:
        raise TheoryError("the exact law is for one state and one output")
    delivery = as_number("delivery", delivery)
    if not 0.0 < delivery < 1.0:
        raise TheoryError(f"delivery must lie in (0, 1), got {delivery!r}")
    F_, Q_, H_, R_ = (float(matrix[0, 0]) for matrix in system)
    smallest = float(steady_covariance(*system)[0, 0])
    if F_ == 0.0 or H_ == 0.0:
        raise TheoryError("the exact law needs F and H that are not zero")
    law = ScalarLaw(F_, Q_, H_, R_, delivery, smallest)
    if not law.hole[0] < law.hole[1]:
        raise TheoryError("the images of f_0 and f_1 meet: no recursion with one branch")
    return law
