"""Rows about the parts of a scenario: healthy ones pass, parts with one thing wrong do not."""

import copy
import math
from pathlib import Path

import numpy as np
import pytest
import scipy.stats

import netkf
from netkf.checks.evidence import BROKEN, HOLDS, judge
from netkf.checks.parts.events import CELLS, _sort_gaps
from netkf.checks.parts.moments import (
    compare_correlations,
    compare_means,
    compare_variances,
    moments,
    whitening_matrix,
)
from netkf.checks.parts.network_rows import _correlation_of_runs, _neighbours_variance
from netkf.checks.parts.noises import start_states
from netkf.checks.parts.rows import part_promises
from netkf.checks.parts.samples import stack_parts, summarise_parts
from netkf.checks.statistics import probability_interval, scale_interval
from netkf.scenario.reading import from_table as scenario_from

PLANT = {
    "kind": "linear",
    "F": [[0.9, 0.2], [0.0, 0.8]],
    "Q": [[1.0, 0.3], [0.3, 0.5]],
    "period": 1.0,
    "cov": [[2.0, 0.1], [0.1, 1.0]],
    "mean": [1.0, -1.0],
}
SENSORS = [
    {"nodes": [0, 1], "H": [[1.0, 0.0]], "R": [[0.5]]},
    {"nodes": [2], "H": [[0.3, 1.0], [1.0, 0.0]], "R": [[1.0, 0.2], [0.2, 0.4]]},
]
SLOTS = {
    "format": 1,
    "name": "slots",
    "horizon": 20.0,
    "probe": [2.0],
    "plant": PLANT,
    "sensors": SENSORS,
    "network": {
        "graph": {"kind": "cycle", "nodes": 4},
        "activation": {"kind": "matching", "protocol": "one-edge", "lazy": 0.2},
        "channel": {"loss": {"kind": "bernoulli", "delivery": 0.7}},
    },
    "filter": {"kind": "gossip"},
}
CLOCKS = {
    "format": 1,
    "name": "clocks",
    "horizon": 10.0,
    "probe": [2.0],
    "plant": {
        "kind": "diffusion",
        "A": [[-0.3, 0.5], [-0.6, 0.1]],
        "B": [[0.8, 0.0], [0.1, 0.5]],
        "cov": [[1.0, 0.2], [0.2, 2.0]],
    },
    "sensors": [
        {"nodes": [0], "H": [[1.0, 0.3]], "R": [[0.4]]},
        {
            "nodes": [1, 2],
            "H": [[0.2, 1.0]],
            "R": [[0.2]],
            "sampling": {"kind": "poisson", "rate": 2.0},
        },
    ],
    "network": {
        "graph": {"kind": "cycle", "nodes": 4},
        "activation": {"kind": "poisson", "rate": 2.0},
        "channel": {"loss": {"kind": "bernoulli", "delivery": 0.6}, "symmetric": False},
    },
    "filter": {"kind": "hybrid", "epsilon": 0.3},
}
# Without increments, which take most of the time in the engine that runs classes of users.
TICKS = {**CLOCKS, "sensors": CLOCKS["sensors"][1:]}
BURSTS = {"kind": "gilbert-elliott", "mean_loss": 0.3, "mean_burst": 4.0}
GAMMA = {"kind": "renewal", "distribution": "gamma", "shape": 3.0, "mean": 0.5}
READINGS_SENT = {
    **SLOTS,
    "network": {
        "graph": {"kind": "cycle", "nodes": 4},
        "activation": {"kind": "broadcast"},
        "channel": {"loss": {"kind": "bernoulli", "delivery": 0.4}, "symmetric": False},
    },
    "filter": {"kind": "intermittent"},
}
HEALTHY = {
    "slots": (SLOTS, {}),
    "one direction of some links": (READINGS_SENT, {}),
    "bursts": (SLOTS, {"network.channel.loss": BURSTS}),
    "maximal": (SLOTS, {"network.activation": {"kind": "matching", "protocol": "maximal"}}),
    "clocks": (CLOCKS, {}),
    "one fate": (TICKS, {"network.channel.symmetric": True}),
    "gamma": (TICKS, {"network.activation": GAMMA}),
    "nodes": (TICKS, {"network.activation": {"kind": "poisson", "rate": 2.0, "at": "nodes"}}),
}


def from_table(table):
    return scenario_from(table, Path())


def verdicts(scenario, runs, seed=1, level=0.01):
    found = [summarise_parts(scenario, netkf.simulate(scenario, seed, k)) for k in range(runs)]
    samples = stack_parts(scenario, seed, found)
    return judge(part_promises(samples), samples, [], runs, level)


def broken(rows):
    return {row.promise for row in rows if row.verdict == BROKEN}


@pytest.mark.parametrize("name", HEALTHY)
def test_healthy_parts_are_not_accused(name):
    table, changes = HEALTHY[name]
    rows = verdicts(from_table(table).replace(changes), 40)
    assert len(rows) >= 9
    assert not broken(rows)
    assert sum(row.verdict == HOLDS for row in rows) >= 3
    assert all(row.detectable > 0.0 for row in rows if math.isfinite(row.low))


@pytest.mark.parametrize("table", [SLOTS, CLOCKS], ids=["slots", "clocks"])
def test_starts_drawn_together_are_those_of_the_runs(table):
    scenario = from_table(table).replace({"probe": [0.0, 2.0], "plant.mean": [1.0, -1.0]})
    runs = [netkf.simulate(scenario, 5, k).x[0] for k in range(3)]
    np.testing.assert_array_equal(start_states(scenario, 5, 3), runs)


NOISE = "noises of the sensors have their covariance"
WRONG = {
    "Noisier": (SLOTS, "plant", "the plant's noise has its covariance"),
    "Faster": (SLOTS, "plant", "the plant's noise is white"),
    "Elsewhere": (SLOTS, "plant", "the state starts with its covariance"),
    "Biased": (SLOTS, "sensors[0]", "readings have no bias"),
    "Louder": (SLOTS, "sensors[0]", "noises of the sensors have their covariance"),
    "Coloured": (SLOTS, "sensors[0]", "noises of the sensors are white and independent"),
    "Slower": (TICKS, "network.activation", "clocks tick at the rates"),
    "OneSlower": (TICKS, "network.activation", "clocks tick at the rates"),
    "Even": (TICKS, "network.activation", "gaps between ticks are"),
    "Lossier": (TICKS, "network.channel.loss", "messages are lost as often as"),
    "OneWay": (TICKS, "network.channel.loss", "messages are lost as often as"),
    "Sticky": (TICKS, "network.channel.loss", "messages are lost independently"),
    "Preferring": (SLOTS, "network.activation", "links are paired as often"),
}


def with_class(table, key, name):
    """Return the scenario of a table whose part is of a class of wrong_parts."""
    table = copy.deepcopy(table)
    part = table
    for step in key.replace("[0]", ".0").split("."):
        part = part[int(step) if step.isdigit() else step]
    part["kind"] = f"tests.checks.parts.wrong_parts:{name}"
    return from_table(table)


@pytest.mark.parametrize("name", WRONG)
def test_wrong_parts_are_found(name):
    table, key, promise = WRONG[name]
    rows = verdicts(with_class(table, key, name), 100)
    assert any(one.startswith(promise) for one in broken(rows))


def test_uniform_gaps_are_uniform_however_short_the_run():
    # Given the number of ticks, gaps of a Poisson clock as numbers in [0, 1) are uniform exactly.
    random, counts = np.random.default_rng(3), np.zeros(CELLS)
    products = np.zeros(3)
    for _ in range(4000):
        ticks = np.cumsum(random.standard_exponential(30) / 1.3)
        ticks = ticks[ticks < 3.0]
        cells, more = _sort_gaps(ticks, np.zeros(len(ticks), int), np.array([len(ticks)]), 3.0)
        counts += cells
        products += more
    assert scipy.stats.chisquare(counts).pvalue > 1e-3
    assert abs(products[0]) < 4.0 * math.sqrt(products[2])
    assert abs(products[1] / products[2] - 1.0) < 0.06


def test_whitening_gives_the_identity_and_drops_certain_directions():
    root = np.random.default_rng(1).standard_normal((4, 2))
    white = whitening_matrix(root @ root.T)
    assert white.shape == (2, 4)
    assert np.allclose(white @ root @ root.T @ white.T, np.eye(2))


LABELS = ["a", "b", "c"]
TESTS = {
    "variances": lambda found, level: compare_variances(found, LABELS, level, "values"),
    "means": lambda found, level: compare_means(found, LABELS, level),
    "correlations": lambda found, level: compare_correlations(found, LABELS, level),
}


@pytest.mark.parametrize("name", TESTS)
def test_moments_keep_their_level(name):
    random, wrong, trials, level = np.random.default_rng(7), 0, 1500, 0.05
    for _ in range(trials):
        found = TESTS[name](moments(random.standard_normal((200, 3))), level)
        wrong += found.margin[2] < 0.0
    low = probability_interval(wrong, trials, 0.001).low
    assert low <= level


@pytest.mark.parametrize("name", TESTS)
def test_moments_find_what_they_say(name):
    # An error of the size that a row calls detectable is found with probability 0.9.
    random, count, level = np.random.default_rng(8), 2000, 0.01
    size = TESTS[name](moments(random.standard_normal((count, 3))), level).detectable
    found, trials = 0, 300
    for _ in range(trials):
        z = random.standard_normal((count, 3))
        if name == "variances":
            z *= math.sqrt(1.0 + size)
        elif name == "means":
            z[:, 1] += size
        else:
            z[:, 2] = size * z[:, 0] + math.sqrt(1.0 - size**2) * z[:, 2]
        found += TESTS[name](moments(z), level).margin[2] < 0.0
    assert probability_interval(found, trials, 0.001).high >= 0.9
    assert found >= 0.8 * trials


@pytest.mark.parametrize("q", [0.03, 0.1, 0.5])
def test_correlations_of_rare_losses_keep_their_level(q):
    """With few joint losses, or none, the spread between runs says little about chance."""
    random, level, runs = np.random.default_rng(5), 0.05, 30
    accused, studies, directions, messages = 0, 400, 4, 12
    probability = np.full(directions, q)
    for _ in range(studies):
        lost = random.random((runs, directions, messages)) < q
        both = (lost[..., 1:] & lost[..., :-1]).sum(axis=2)
        count = np.full((runs, directions), messages - 1)
        found = _correlation_of_runs(
            both - count * q**2,
            count,
            probability * (1.0 - probability),
            _neighbours_variance(probability),
            level,
        )
        accused += found.low > 0.0
    assert accused <= scipy.stats.binom.ppf(0.999, studies, level)


@pytest.mark.parametrize("freedom", [10.0, 200.0, 1e4])
def test_the_detectable_scale_is_found_nine_times_of_ten(freedom):
    level = 1e-3
    size = scale_interval(freedom, freedom, level).detectable
    law, upper = scipy.stats.chi2(freedom), scipy.stats.chi2(freedom).isf(level / 2.0)
    lower = law.ppf(level / 2.0)
    up, down = law.sf(upper / (1.0 + size)), law.cdf(lower / (1.0 - size)) if size < 1.0 else 1.0
    assert min(up, down) == pytest.approx(0.9, abs=1e-6)


def test_probabilities_find_what_they_say():
    n, p, level = 5000, 0.3, 1e-3
    size = probability_interval(int(n * p), n, level).detectable
    for shifted in (p + size, p - size):
        lost = np.random.default_rng(4).binomial(n, shifted, 2000)
        out = [probability_interval(int(k), n, level) for k in lost]
        found = np.mean([not one.low <= p <= one.high for one in out])
        assert found == pytest.approx(0.9, abs=0.04)
