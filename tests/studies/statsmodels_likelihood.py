"""Two state space models with the same readings for statsmodels and for netkf.

python tests/studies/statsmodels_likelihood.py    # print REFERENCE of test_likelihood.py
"""

import json

import numpy as np

LEVEL = {"q": 0.3, "r": 2.0, "mean": 1.0, "cov": 4.0}
TREND = {"q": 0.02, "r": [0.5, 1.5], "mean": [0.0, 0.2], "cov": [[1.0, 0.3], [0.3, 0.5]]}


def level_readings():
    """Values (80,) of slots 1, 2, ... of a random walk in noise."""
    random = np.random.default_rng(5)
    return 1.0 + np.cumsum(random.normal(0.0, 0.7, 80)) + random.normal(0.0, 1.2, 80)


def trend_readings():
    """Times (60,) at uneven gaps, and values (60, 2) of a position, some missing (nan)."""
    random = np.random.default_rng(6)
    t = np.round(np.cumsum(random.exponential(0.7, 60)) + 0.01, 3)
    speed = 0.2 + np.cumsum(random.normal(0.0, 0.12, 60))
    position = np.cumsum(speed * np.diff(t, prepend=0.0))
    y = position[:, None] + random.normal(0.0, [0.6, 1.3], (60, 2))
    y[random.random((60, 2)) < 0.2] = np.nan
    y[np.isnan(y).all(axis=1), 0] = 0.0
    return t, y


def reference():
    """Log-likelihoods at the given variances, and maximum, variances and standard errors."""
    from statsmodels.tsa.statespace.mlemodel import MLEModel

    class Level(MLEModel):
        def __init__(self):
            super().__init__(level_readings(), k_states=1, loglikelihood_burn=0)
            self["transition"] = self["design"] = self["selection"] = np.eye(1)

        def update(self, params, **_):
            self["state_cov", 0, 0], self["obs_cov", 0, 0] = params
            self.ssm.initialize_known(
                np.array([LEVEL["mean"]]), np.array([[LEVEL["cov"] + params[0]]])
            )

    class Trend(MLEModel):
        def __init__(self):
            t, y = trend_readings()
            super().__init__(y, k_states=2, loglikelihood_burn=0)
            self["design"], self["selection"] = np.array([[1.0, 0.0], [1.0, 0.0]]), np.eye(2)
            # The transition from reading k to the next; the first is in the initial state.
            gaps = np.diff(t, prepend=0.0)
            self.gaps = gaps
            F = np.array([[[1.0, g], [0.0, 1.0]] for g in np.append(gaps[1:], 1.0)])
            self["transition"] = np.moveaxis(F, 0, 2)

        def noise(self, g, q):
            return q * np.array([[g**3 / 3.0, g**2 / 2.0], [g**2 / 2.0, g]])

        def update(self, params, **_):
            q, *r = params
            Q = np.array([self.noise(g, q) for g in np.append(self.gaps[1:], 1.0)])
            self["state_cov"], self["obs_cov"] = np.moveaxis(Q, 0, 2), np.diag(r)
            F = np.array([[1.0, self.gaps[0]], [0.0, 1.0]])
            P = F @ np.array(TREND["cov"]) @ F.T + self.noise(self.gaps[0], q)
            self.ssm.initialize_known(F @ np.array(TREND["mean"]), P)

    found = {}
    for name, model, start in (
        ("level", Level(), [LEVEL["q"], LEVEL["r"]]),
        ("trend", Trend(), [TREND["q"], *TREND["r"]]),
    ):
        model.ssm.tolerance = 0.0  # no steady-state gains
        model.ssm.filter_univariate = False
        fit = model.fit(start, method="bfgs", gtol=1e-10, maxiter=500, disp=False)
        fit = model.fit(fit.params, method="nm", ftol=1e-15, xtol=1e-12, maxiter=5000, disp=False)
        step = 1e-3 * fit.params
        # Second differences: statsmodels' own standard errors are of a numerical Hessian too.
        eye = np.diag(step)
        H = np.array(
            [
                [
                    sum(
                        s * u * model.loglike(fit.params + s * a + u * b)
                        for s in (1, -1)
                        for u in (1, -1)
                    )
                    / (4.0 * a.sum() * b.sum())
                    for b in eye
                ]
                for a in eye
            ]
        )
        found[name] = {
            "start": float(model.loglike(np.array(start))),
            "maximum": float(fit.llf),
            "values": fit.params.tolist(),
            "se": np.sqrt(np.diag(np.linalg.inv(-H))).tolist(),
        }
    return found


if __name__ == "__main__":
    print(json.dumps(reference(), indent=4))
