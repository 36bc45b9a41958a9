"""True states of plants that change: their law piece by piece, and what scenario files say."""

import itertools
import tomllib
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm

import netkf
from netkf.core.errors import ScenarioError
from netkf.parts import Diffusion, LinearPlant
from netkf.plants.changes import dividing_period
from netkf.rng.normals import GeneratorNormals
from netkf.scenario.reading import from_table
from netkf.scenario.writing import as_table, to_toml

RUNS = 2000
F = [np.array([[1.0, 0.4], [-0.1, 0.9]]), np.array([[0.7, -0.5], [0.6, 0.8]])]
Q = [np.array([[0.2, 0.05], [0.05, 0.1]]), np.array([[0.05, 0.0], [0.0, 0.6]])]
A = [np.array([[0.0, 1.0], [-0.3, -0.1]]), np.array([[-0.5, -2.0], [2.0, 0.1]]), -0.2 * np.eye(2)]
B = [np.array([[0.1], [0.7]]), np.array([[0.3, 0.0], [0.1, 0.5]]), np.array([[0.6], [0.0]])]
TIMES = (2.3, 4.1)
SCHEDULE = [{"from": t, "A": A[k + 1], "B": B[k + 1]} for k, t in enumerate(TIMES)]
COV = np.array([[0.5, 0.1], [0.1, 0.3]])


def law(gap, k):
    """Transition and noise over a gap within piece k, by Van Loan."""
    n = len(A[k])
    block = expm(np.block([[-A[k], B[k] @ B[k].T], [np.zeros((n, n)), A[k].T]]) * gap)
    Phi = block[n:, n:].T
    return Phi, Phi @ block[:n, n:]


def joint_law(times):
    """Covariance of the states at increasing times together, from P(0) = COV."""
    blocks, P, previous = {}, COV, 0.0
    for j, t in enumerate(times):
        Phi = np.eye(2)
        edges = [previous, *(c for c in TIMES if previous < c < t), t]
        for a, b in itertools.pairwise(edges):
            step, noise = law(b - a, int(np.searchsorted(TIMES, a, side="right")))
            P, Phi = step @ P @ step.T + noise, step @ Phi
        for i in range(j):
            blocks[j, i] = Phi @ blocks[j - 1, i]
        blocks[j, j], previous = P, t
    rows = [
        [blocks[j, i] if i <= j else blocks[i, j].T for i in range(len(times))]
        for j in range(len(times))
    ]
    return np.block(rows)


def agree(x, expected):
    """The second moments of R draws (R, d) are the expected ones, within five deviations."""
    found, size = x.T @ x / len(x), np.sqrt(np.diag(expected))
    spread = np.sqrt((np.outer(size, size) ** 2 + expected**2) / len(x))
    assert (np.abs(found - expected) < 5.0 * spread + 1e-12).all()


def test_states_in_slots_have_the_law_of_each_piece():
    schedule = [{"from": 1.5, "F": F[1]}, {"from": 2.5, "Q": Q[1]}]
    plant = LinearPlant(F=F[0], Q=Q[0], period=0.5, cov=COV, schedule=schedule)
    x = np.array(
        [
            [plant.truth(np.random.default_rng(k)).absolute(slot) for slot in (7,)]
            for k in range(RUNS)
        ]
    )[:, 0]
    P = COV
    for slot in range(7):
        Fk, Qk = F[slot >= 3], Q[slot >= 5]
        P = Fk @ P @ Fk.T + Qk
    agree(x, P)


def test_states_at_samples_have_the_law_of_each_piece():
    plant, times = Diffusion(A=A[0], B=B[0], cov=COV, schedule=SCHEDULE), (1.0, 2.3, 3.3, 5.2)
    x = []
    for k in range(RUNS):
        truth = plant.sampled_truth(np.random.Generator(np.random.Philox(k)), np.array(times), 6.0)
        x.append(np.concatenate([truth.absolute(t) for t in times]))
    agree(np.array(x), joint_law(times))


def test_a_state_does_not_depend_on_other_instants():
    plant = Diffusion(A=A[0], B=B[0], cov=COV, schedule=SCHEDULE)

    def at(*times):
        random = np.random.Generator(np.random.Philox(5))
        return plant.sampled_truth(random, np.array(times), 6.0)

    few, many = at(3.3, 5.2), at(0.1, 2.3, 2.4, 3.3, 4.1, 5.0, 5.2, 5.9)
    for t in (3.3, 5.2):
        np.testing.assert_array_equal(few.absolute(t), many.absolute(t))


def test_paths_on_the_sensing_grid_have_the_law_of_each_piece():
    plant = Diffusion(A=A[0], B=B[0], cov=COV, sensing_period=0.1, schedule=SCHEDULE)
    normals = [GeneratorNormals([np.random.default_rng(k) for k in range(RUNS)]) for _ in range(2)]
    probes = np.array([2.25, 3.3])
    paths = plant.paths(
        normals[0], GeneratorNormals([np.random.default_rng(RUNS + k) for k in range(RUNS)]), probes
    )
    states, integrals, now = {}, {}, 0.0
    while now < 5.2:
        block = paths.following()
        assert not any(block.start[0] < t < block.end[-1] for t in TIMES)
        for k, end in enumerate(block.end.tolist()):
            states[round(end, 6)] = block.x_end[:, k]
            integrals[round(end, 6)] = (
                block.x_start[:, k],
                block.moments[:, k, 0],
                end - block.start[k],
            )
        now = float(block.end[-1])
    times = (1.0, 2.25, 2.3, 3.3, 5.2)
    agree(np.hstack([states[t] for t in times]), joint_law(times))
    # The integral of x over a step of the second piece: E[int x | x(0)] = int e^{A s} ds x(0).
    start, integral, gap = integrals[3.0]
    whole = expm(np.block([[A[1], np.eye(2)], [np.zeros((2, 4))]]) * gap)[:2, 2:]
    residual = integral - start @ whole.T
    # Its noise has the variance int (int_0^s e^{A r} dr) B B' (...)' ds, about B B' gap^3 / 3.
    steps = (np.arange(2000) + 0.5) * gap / 2000
    maps = [
        expm(np.block([[A[1], np.eye(2)], [np.zeros((2, 4))]]) * s)[:2, 2:] @ B[1] for s in steps
    ]
    agree(residual, sum(M @ M.T for M in maps) * gap / 2000)


@pytest.mark.parametrize(
    ("changes", "longest", "expected"),
    [
        ((), 0.05, 0.05),
        ((1.0, 2.5), 0.05, 0.05),
        ((2.3, 4.1), 0.5, 0.1),
        ((1 / 3, 2.0), 0.5, 1 / 3),
        ((7.0,), 2.0, 7 / 4),
    ],
)
def test_all_changes_are_multiples_of_the_sensing_period(changes, longest, expected):
    period = dividing_period(np.array(changes), longest)
    assert period == pytest.approx(expected, rel=1e-15)
    assert period <= longest
    for t in changes:
        assert (
            Fraction(t).limit_denominator(1000) / Fraction(period).limit_denominator(1000)
        ).denominator == 1


def test_changes_that_hardly_any_period_divides_leave_it_as_it_is():
    assert dividing_period(np.array([1.0, 1.0001]), 0.25) == 0.25


PLANT = """
kind = "diffusion"
A = [[0.0, 1.0], [-0.3, -0.1]]
B = [[0.1], [0.7]]
"""


def scenario(schedule, plant=PLANT, kind="poisson"):
    rate, own = "", 'kind = "diffusion"'
    if kind == "poisson":
        rate, own = ", rate = 1.0", 'kind = "hybrid"\nepsilon = 0.3'
    text = f"""
format = 1
name = "changes"
horizon = 6.0
probe = 0.5
[plant]{plant}
schedule = {schedule}
[[sensors]]
nodes = [0]
H = [[1.0, 0.0]]
R = [[0.1]]
[network]
graph = {{ kind = "path", nodes = 2 }}
activation = {{ kind = "{kind}"{rate} }}
[filter]
{own}
"""
    return from_table(tomllib.loads(text), Path())


WRONG = {
    "5": "plant.schedule: must be a list of tables",
    "[5]": "plant.schedule[0]: must be a table",
    "[{ A = [[1.0]] }]": "plant.schedule[0].from: is missing",
    "[{ from = 1.0 }]": "plant.schedule[0]: must change a matrix",
    "[{ from = -1.0, A = [[1.0]] }]": "plant.schedule[0].from: must be a finite number",
    "[{ from = 0.0, A = [[1.0]] }]": "plant.schedule[0].from: must be a finite number",
    "[{ from = 1.0, F = [[1.0]] }]": "plant.schedule[0].F: is not a key here",
    "[{ from = 1.0, A = [[1.0, 2.0]] }]": "plant.schedule[0].A: must be a square matrix",
    "[{ from = 1.0, A = [[1.0]] }]": "plant.schedule[0].A: must be 2 x 2, not 1 x 1",
    "[{ from = 1.0, B = [[1.0]] }]": "plant.schedule[0].B: must be 2 x any, not 1 x 1",
    "[{ from = 2.0, B = [[1.0], [1.0]] }, { from = 2.0, B = [[2.0], [1.0]] }]": (
        "plant.schedule[1].from: must be later"
    ),
}


@pytest.mark.parametrize("schedule", WRONG)
def test_mistakes_are_refused_by_key(schedule):
    with pytest.raises(ScenarioError) as refused:
        scenario(schedule)
    assert str(refused.value).startswith(WRONG[schedule])


def test_changes_are_where_slots_begin_and_where_sensors_read():
    slots = PLANT.replace("diffusion", "linear").replace("A =", "F =")
    slots = slots.replace("B = [[0.1], [0.7]]", "Q = [[1.0, 0.0], [0.0, 1.0]]\nperiod = 0.5")
    with pytest.raises(ScenarioError, match=r"plant.schedule\[0\].from: must be a multiple"):
        scenario("[{ from = 1.2, F = [[1.0, 0.0], [0.0, 1.0]] }]", slots, kind="broadcast")
    given = f"{PLANT}sensing_period = 0.01\n"
    assert scenario("[{ from = 1.23, A = [[0.0, 0.0], [0.0, 0.0]] }]", given)
    with pytest.raises(ScenarioError, match=r"from: must be a multiple of plant.sensing_period"):
        scenario("[{ from = 1.234, A = [[0.0, 0.0], [0.0, 0.0]] }]", given)
    free = scenario("[{ from = 1.234, A = [[0.0, 0.0], [0.0, 0.0]] }]")
    steps = 1.234 / free.diffusion.sensing_period
    assert steps == pytest.approx(round(steps), abs=1e-9)


def test_the_last_piece_may_have_noise_that_drives_less(tmp_path):
    """Its filter inverts P, which is singular at time 0, and no longer when that piece begins."""
    schedule = [{"from": 1.0, "A": (-0.5 * np.eye(2)).tolist(), "B": [[1.0], [0.0]]}]
    plant = {"kind": "diffusion", "A": A[0].tolist(), "B": B[0].tolist(), "schedule": schedule}
    sampling = {"kind": "periodic", "period": 0.5}
    sensors = [{"nodes": [0], "H": [[1.0, 0.0]], "R": [[0.1]], "sampling": sampling}]
    activation = {"kind": "poisson", "at": "nodes", "rate": 2.0}
    network = {"graph": {"kind": "path", "nodes": 2}, "activation": activation}
    filtering = {"kind": "track-fusion", "rule": "ci"}
    table = {"format": 1, "name": "less", "horizon": 3.0, "probe": 1.0, "plant": plant}
    table |= {"sensors": sensors, "network": network, "filter": filtering}
    less = from_table(table, tmp_path)
    assert (tmp_path / "run" / "summary.json") in netkf.save(
        netkf.simulate(less), less, tmp_path / "run"
    ).iterdir()
    assert len(netkf.theory.assumptions(less))


def test_a_schedule_survives_its_file(tmp_path):
    s = scenario(
        "[{ from = 2.3, A = [[-0.5, -2.0], [2.0, 0.1]] }, { from = 4.1, B = [[0.6], [0.0]] }]"
    )
    path = tmp_path / "copy.toml"
    path.write_text(to_toml(as_table(s)))
    again = netkf.load(path)
    assert again == s
    assert again.plant.schedule[0].start == 2.3
    changed = s.replace(
        {"plant.schedule[1].from": 5.0, "plant.schedule[0].A": [[0.0, 0.0], [0.0, 0.0]]}
    )
    assert changed.plant.changes.tolist() == [2.3, 5.0]
    assert not changed.plant.pieces[2].A.any()
    np.testing.assert_array_equal(changed.plant.pieces[2].B, [[0.6], [0.0]])
