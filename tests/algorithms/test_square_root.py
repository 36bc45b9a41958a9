"""Square-root recursions against the covariances that they stand for."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

import netkf
from netkf import parts
from netkf.algorithms.kernels.square_root import lower_triangular, reflect
from netkf.scenario.reading import from_table
from tests import reference


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("rows", "columns"), [(1, 1), (2, 5), (4, 4), (6, 9)])
def test_reflections_make_an_array_triangular(seed, rows, columns):
    array = np.random.default_rng(seed).normal(size=(rows, columns))
    expected, work = reference.triangular_root(array), array.copy()
    for i in range(rows):
        reflect(work, i, i, rows, columns)
    found = np.tril(work[:, :rows])  # what is right of the diagonal is left as rubbish
    signs = np.where(np.diag(found) < 0.0, -1.0, 1.0)
    np.testing.assert_allclose(found * signs, expected, rtol=1e-10, atol=1e-12)
    L = lower_triangular(array)
    np.testing.assert_allclose(L @ L.T, array @ array.T, rtol=1e-10, atol=1e-12)


TURN = np.array([[0.6, 0.8], [-0.8, 0.6]])
FORMS = {
    "turned": lambda array: array @ TURN if array.ndim == 2 else array,
    "by columns": np.asfortranarray,
    "float32": np.float32,
}


def form(array):
    return FORMS[form.name](array)


class Formed:
    """What a user's class may do: it keeps and sends roots of its own, P = root root'."""

    def _with_form(self, value):
        return value._replace(xhat=form(value.xhat), root=form(value.root))

    def init(self, *arguments):
        return self._with_form(super().init(*arguments))

    def predict(self, state, gap):
        return self._with_form(super().predict(state, gap))

    def update(self, state, reading):
        return self._with_form(super().update(state, reading))

    def emit(self, state, exchange):
        state, payload = super().emit(state, exchange)
        return state, self._with_form(payload)

    shift = parts.Hybrid.shift


@dataclass(frozen=True, eq=False)
class FormedDiffusion(Formed, parts.DiffusionFilter):
    pass


@dataclass(frozen=True, eq=False)
class Adopting(parts.Filter):
    """It takes the estimate of whom it hears last."""

    def absorb(self, state, messages, exchange):
        for message in messages:
            heard = message.payload
            xhat, root = state.model.extrapolate(heard.xhat, heard.root, message.age)
            state = state._replace(xhat=xhat, root=root)
        return state

    shift = parts.Filter.shift


@dataclass(frozen=True, eq=False)
class FormedAdopting(Formed, Adopting):
    pass


SLOTS = {"kind": "linear", "F": [[0.9, 0.3], [-0.2, 1.0]], "Q": [[0.2, 0.1], [0.1, 0.3]]}
CLOCKS = {"kind": "diffusion", "A": [[0.0, 1.0], [-0.5, -0.2]], "B": [[0.3], [0.5]]}
TURNING = {"kind": "nonlinear", "f": "tests.algorithms.test_square_root:Bend", "period": 1.0}


class Bend:
    def f(self, x, u, t):
        return np.array([0.3 * np.sin(x[1]) - 0.4 * x[0], -0.1 * x[0]])

    def jacobian(self, x, u, t):
        return np.array([[-0.4, 0.3 * np.cos(x[1])], [-0.1, 0.0]])


@pytest.mark.parametrize("name", FORMS)
@pytest.mark.parametrize("cls", [FormedDiffusion, FormedAdopting])
@pytest.mark.parametrize(
    ("plant", "sampling"),
    [
        (SLOTS | {"period": 1.0}, None),
        (SLOTS | {"period": 1.0, "schedule": [{"from": 4.0, "Q": [[1.0, 0.0], [0.0, 0.1]]}]}, None),
        (TURNING | {"Q": [[0.2, 0.1], [0.1, 0.3]]}, None),
        (TURNING | {"B": [[0.2, 0.1], [0.1, 0.3]], "period": None, "step": 0.25}, 0.5),
        (CLOCKS, None),
        (CLOCKS, 0.5),
        (CLOCKS | {"schedule": [{"from": 4.0, "B": [[1.0], [0.1]]}]}, 0.5),
    ],
)
def test_a_root_of_any_form_stands_for_its_covariance(plant, sampling, cls, name):
    form.name = name
    sensor = {"nodes": [0, 1], "H": [[1.0, 0.4]], "R": [[0.3]]}
    slotted = plant.get("period") is not None
    activation = {"kind": "broadcast"} if slotted else {"kind": "periodic", "period": 0.7}
    table = {
        "format": 1,
        "name": "turned",
        "horizon": 8.0,
        "probe": 1.0,
        "plant": {k: v for k, v in plant.items() if v is not None}
        | {"cov": [[1.0, 0.5], [0.5, 2.0]]},
        "sensors": [
            sensor | ({"sampling": {"kind": "periodic", "period": sampling}} if sampling else {})
        ],
        "network": {
            "graph": {"kind": "path", "nodes": 3},
            "activation": activation if slotted else activation | {"at": "nodes"},
            "channel": {} if slotted else {"delay": {"kind": "constant", "seconds": 0.2}},
        },
        "filter": {"kind": "local"},
    }
    scenario = from_table(table, Path(__file__).parent)
    found, expected = (
        netkf.simulate(scenario.replace({"filter": made()}), engine="simpy")
        for made in (cls, cls.__mro__[2])
    )
    tolerance = 1e-5 if name == "float32" else 1e-8
    np.testing.assert_allclose(found.P, expected.P, rtol=tolerance, atol=1e-12)
    np.testing.assert_allclose(found.xhat, expected.xhat, rtol=tolerance, atol=tolerance)
