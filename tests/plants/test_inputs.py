"""Inputs and the states that they alone would give, against closed forms and other integrators."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest
import scipy.integrate
import scipy.linalg

from netkf.core.errors import ScenarioError
from netkf.core.fields import SourceFile
from netkf.core.instants import TimeGrid
from netkf.parts import ConstantInput, Diffusion, LinearPlant, RecordedInput, SineInput
from netkf.plants.response import Difference, FlowResponse, SlotResponse
from netkf.scenario.reading import from_table, parse_toml
from netkf.scenario.writing import as_table, to_toml

PLANTS = {
    "stable": [[-0.3, 1.0], [-1.0, -0.2]],
    "unstable": [[0.4, 0.3], [0.0, 0.2]],
    "integrators": [[0.0, 1.0], [0.0, 0.0]],
    "stiff": [[-1e4, 0.0], [1.0, -1e-3]],
}
TIMES = np.array([0.0, 0.3, 1.0, 7.5, 40.0])


def flow_response(A, u):
    """The response of a plant that does not change."""
    return FlowResponse([(A, u.G)], np.zeros(0), u)


@pytest.mark.parametrize("name", PLANTS)
def test_constant_inputs_give_the_closed_form(name):
    A, G, value = np.array(PLANTS[name]), np.array([[1.0, 0.2], [-0.5, 2.0]]), [3.0, -1.0]
    m = flow_response(A, ConstantInput(G=G, value=value)).states(TIMES)
    drive = G @ value
    if name == "integrators":
        t = TIMES
        expected = np.stack([drive[0] * t + drive[1] * t**2 / 2.0, drive[1] * t], axis=1)
    else:
        steps = [scipy.linalg.expm(A * t) - np.eye(2) for t in TIMES]
        expected = np.array([np.linalg.solve(A, step @ drive) for step in steps])
    np.testing.assert_allclose(m, expected, rtol=1e-11, atol=1e-12)


def test_a_sine_at_the_frequency_of_the_plant_grows_as_time_does():
    # x'' = -w^2 x + sin(w t): x = (sin(w t) - w t cos(w t)) / (2 w^2)
    w = 2.0 * np.pi * 0.7
    A, t = np.array([[0.0, 1.0], [-(w**2), 0.0]]), np.linspace(0.0, 1000.0, 57)
    m = flow_response(A, SineInput(G=[[0.0], [1.0]], amplitude=1.0, frequency=0.7)).states(t)
    expected = (np.sin(w * t) - w * t * np.cos(w * t)) / (2.0 * w**2)
    np.testing.assert_allclose(m[:, 0], expected, atol=1e-9 * np.abs(expected).max())


def recorded(folder, text, name="u.csv", G=((1.0,), (2.0,))):
    (folder / name).write_text(text)
    return RecordedInput(G=G, path=SourceFile(name, folder))


def test_rows_hold_until_the_next(tmp_path):
    u = recorded(tmp_path, "# a log\nt;u1;u0\n2,5;7;-1\n1;3;4\n\n2,5;7;-1\n", G=np.eye(2))
    times = np.array([0.0, 0.999, 1.0, 2.0, 2.5, 9.0])
    assert u.values(times).tolist() == [[0, 0], [0, 0], [4, 3], [4, 3], [-1, 7], [-1, 7]]
    assert u.at(2.4).tolist() == [4, 3]
    assert (u.m, u.row_keys) == (2, [2.5, 1.0, 2.5])
    assert u.used_keys(9.0) == {1.0, 2.5}
    assert u.used_keys(2.0) == {1.0}
    assert u.used_keys(9.0, np.array([0.0, 0.5, 3.0])) == {2.5}


def test_a_recorded_input_is_integrated_row_by_row(tmp_path):
    random, A = np.random.default_rng(5), np.array(PLANTS["stable"])
    jumps = np.sort(random.uniform(0.0, 30.0, 5000).round(4))
    jumps = np.unique(jumps)
    values = random.normal(size=len(jumps)).round(5)
    rows = [f"{t},{v}" for t, v in zip(jumps, values, strict=True)]
    u = recorded(tmp_path, "\n".join(["t,u0", *rows[::-1]]))
    m, t, expected = np.zeros(2), 0.0, []
    times = np.array([0.7, 15.0, 29.99])
    for end in times:
        for cut in [*jumps[(jumps > t) & (jumps < end)], end]:
            held = values[jumps <= t]
            drive = u.G[:, 0] * (held[-1] if len(held) else 0.0)
            E = scipy.linalg.expm(np.block([[A, drive[:, None]], [np.zeros((1, 3))]]) * (cut - t))
            m, t = E[:2, :2] @ m + E[:2, 2], cut
        expected.append(m)
    response = flow_response(A, u)
    np.testing.assert_allclose(response.states(times[::-1]), expected[::-1], rtol=1e-10)
    # However many are asked for, and in whatever order.
    assert np.array_equal(response.states(times[1:2]), flow_response(A, u).states(times[:2])[1:])


def test_responses_over_pieces_are_states_and_moments(tmp_path):
    A, grid = np.array(PLANTS["stable"]), TimeGrid()
    step = recorded(tmp_path, "t,u0\n0.35,2\n0.8,-3\n0.85,1\n")
    sine = SineInput(G=[[1.0], [2.0]], amplitude=2.0, frequency=1.3, phase=0.5)
    start, end = np.array([0.0, 0.25, 0.5]), np.array([0.25, 0.5, 1.0])
    true = flow_response(A, step)
    for response in (true, flow_response(A, sine), Difference(true, flow_response(1.1 * A, step))):
        m, pieces = response.over_pieces(start, end, grid)
        np.testing.assert_allclose(m, response.states(start), atol=1e-14)
        np.testing.assert_allclose(pieces[:, 0], response.states(end), atol=1e-14)
        for k, (a, b) in enumerate(zip(start, end, strict=True)):

            def moments(t, a=a, b=b, response=response):
                m = response.states(np.array([t]))[0]
                return np.concatenate([m, m * (2.0 * (t - a) / (b - a) - 1.0)])

            total, _ = scipy.integrate.quad_vec(moments, a, b, points=[0.35, 0.8, 0.85])
            np.testing.assert_allclose(pieces[k, 1:].reshape(-1), total, atol=1e-10)


def test_in_slots_the_value_at_the_beginning_counts(tmp_path):
    F, G = np.array([[1.1, 0.2], [0.0, 0.7]]), np.array([[1.0], [2.0]])
    u = recorded(tmp_path, "t,u0\n0.05,1\n0.1,5\n0.29,2\n0.31,9\n")
    plant = LinearPlant(F=F, Q=np.eye(2), period=0.1, input=u)
    m, expected = np.zeros(2), []
    for k, value in enumerate([0.0, 5.0, 5.0, 2.0, 9.0] + [9.0] * 400):
        expected.append(m)
        m = F @ m + G[:, 0] * value
        assert k < 5 or value == 9.0
    response = SlotResponse([(F, plant.input.G)], (), plant)
    assert response.states(np.array([2]))[0].tolist() == expected[2].tolist()
    np.testing.assert_allclose(response.states(np.arange(401)), expected[:401], rtol=1e-12)


LINES = {
    "t,u0\n1,2\n1,3\n": r"u.csv lines 2 and 3: there may be one row a time, or equal ones",
    "t,u0\n-1,2\n": r"u.csv line 2: t must be at least 0",
    "t,u0,u2\n1,2,3\n": "u.csv must have the columns t, u0, u1",
    "t,x0\n1,2\n": "u.csv must have the columns t, u0",
    "t,u0\n1,\n": "u.csv line 2: u0 must be a finite number",
    "t,u0\n": "u.csv has no rows",
}


@pytest.mark.parametrize("text", LINES)
def test_mistakes_in_tables_name_the_line(text, tmp_path):
    with pytest.raises(ScenarioError, match=LINES[text]):
        recorded(tmp_path, text)


G = [[1], [2]]
KEYS = [
    ({"kind": "constant", "value": 1.0}, "G", "is missing"),
    ({"kind": "constant", "value": [1, 2], "G": G}, "G", "must be 2 x 2"),
    ({"kind": "constant", "value": "a", "G": G}, "value", "a number, or a"),
    ({"kind": "sine", "amplitude": 1, "G": G}, "frequency", "is missing"),
    ({"kind": "sine", "amplitude": 1, "frequency": -1, "G": G}, "frequency", "none below 0"),
    ({"kind": "sine", "amplitude": [1, 2], "frequency": [1] * 3, "G": G}, "amplitude", "3 entries"),
    ({"kind": "steps", "G": G}, "kind", "must be one of"),
    (3, "", "must be an input"),
]


def table(u):
    return {
        "format": 1, "name": "driven", "horizon": 1.0, "probe": 0.5,
        "plant": {"kind": "diffusion", "A": PLANTS["stable"], "B": [[1.0], [0.0]], "input": u},
        "sensors": [{"nodes": [0], "H": [[1.0, 0.0]], "R": [[1.0]]}],
        "network": {"graph": {"kind": "path", "nodes": 2}},
        "filter": {"kind": "local"},
    }  # fmt: skip


@pytest.mark.parametrize(("u", "key", "rule"), KEYS)
def test_mistakes_in_keys_are_told(u, key, rule):
    with pytest.raises(ScenarioError, match=rule) as refusal:
        from_table(table(u), Path())
    assert refusal.value.key == f"plant.input.{key}".rstrip(".")


def test_a_scenario_with_an_input_is_written_as_it_is_read(tmp_path):
    with gzip.open(tmp_path / "u.csv.gz", "wt") as file:
        file.write("t,u0,u1\n2009-07-22T15:10:04Z,1,2\n2009-07-22T15:10:05.5Z,3,4\n")
    inputs = [
        {"kind": "sine", "G": [[1.0], [2.0]], "amplitude": 2.0, "frequency": 0.1},
        {"kind": "constant", "G": [[1.0, 0.0], [0.0, 1.0]], "value": [1.0, 2.0]},
        {"kind": "recorded", "G": [[1.0, 0.0], [0.0, 1.0]], "path": "u.csv.gz"},
    ]
    for u in inputs:
        driven = from_table({**table(u), "time": {"origin": "2009-07-22T15:10:04Z"}}, tmp_path)
        again = from_table(parse_toml(to_toml(as_table(driven))), tmp_path)
        assert again == driven
        assert "model" not in as_table(driven)["filter"]
    assert driven.plant.input.values(np.array([0.0, 1.4, 1.5])).tolist() == [[1, 2], [1, 2], [3, 4]]
    deaf = driven.replace({"filter.model.input": False})
    assert as_table(deaf)["filter"]["model"] == {"input": False}
    assert deaf.misses_input
    assert not deaf.filters_know_the_truth


def test_a_plant_without_input_is_as_it_was():
    plant = Diffusion(A=PLANTS["stable"], B=np.eye(2))
    assert plant.input is None
    assert plant == Diffusion(A=PLANTS["stable"], B=np.eye(2), input=None)
