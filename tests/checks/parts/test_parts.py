"""Rows about the parts of a scenario: healthy ones pass, parts with one thing wrong do not."""

import copy
import math
from pathlib import Path

import numpy as np
import pytest
import scipy.special
import scipy.stats

import netkf
from netkf.checks.evidence import BROKEN, HOLDS, judge
from netkf.checks.laws import find
from netkf.checks.parts.events import _entity_indices, stack_parts, summarise_parts
from netkf.checks.parts.noises import path_law, plant_noises, start_states, whitened_starts
from netkf.checks.parts.rows import part_promises
from netkf.laws.intervals import probability_interval, scale_interval
from netkf.laws.losses import correlation_of_runs, neighbours_variance
from netkf.laws.noise import (
    compare_cells,
    compare_correlations,
    compare_means,
    compare_variances,
    noise_draws,
    whiten,
)
from netkf.laws.ticks import CELLS, ClockGroup, count_ticks
from netkf.parts import (
    ConstantDelay,
    ExponentialDelay,
    GilbertElliott,
    LognormalDelay,
    Poisson,
    Renewal,
    UniformDelay,
)
from netkf.rng.streams import Streams
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


def with_network(table, **changes):
    return {**table, "network": {**table["network"], **changes}}


GAMMAS = with_network(TICKS, activation=GAMMA)
PERIODIC = with_network(TICKS, activation={"kind": "periodic", "period": 0.4})
JITTER = {"kind": "periodic", "period": 0.3, "jitter": 0.2, "phase": "random"}
JITTERED = with_network(TICKS, activation=JITTER)
IN_BURSTS = with_network(TICKS, channel={"loss": BURSTS})
LATE = with_network(TICKS, channel={"delay": {"kind": "exponential", "mean": 0.2}})
DELAYED = with_network(TICKS, channel={"delay": {"kind": "constant", "seconds": 0.2}})
HEALTHY = {
    "slots": (SLOTS, {}),
    "one direction of some links": (READINGS_SENT, {}),
    "bursts": (SLOTS, {"network.channel.loss": BURSTS}),
    "maximal": (SLOTS, {"network.activation": {"kind": "matching", "protocol": "maximal"}}),
    "clocks": (CLOCKS, {}),
    "one fate": (TICKS, {"network.channel.symmetric": True}),
    "gamma": (TICKS, {"network.activation": GAMMA}),
    "nodes": (TICKS, {"network.activation": {"kind": "poisson", "rate": 2.0, "at": "nodes"}}),
    "late": (TICKS, {"network.channel": {"delay": {"kind": "exponential", "mean": 0.7}}}),
    "delayed": (TICKS, {"network.channel": {"delay": {"kind": "constant", "seconds": 0.3}}}),
    "delayed slots": (
        SLOTS,
        {"network.channel": {"delay": {"kind": "uniform", "low": 0.1, "high": 0.6}}},
    ),
    "periodic": (TICKS, {"network.activation": {"kind": "periodic", "period": 0.3, "jitter": 0.1}}),
    "jitter after random phases": (TICKS, {"network.activation": JITTER}),
    "random phases": (
        TICKS,
        {"network.activation": {"kind": "periodic", "period": 0.3, "phase": "random"}},
    ),
}


def from_table(table):
    return scenario_from(table, Path())


def verdicts(scenario, runs, seed=1, level=0.01):
    found = [summarise_parts(scenario, netkf.simulate(scenario, seed, k)) for k in range(runs)]
    samples = stack_parts(scenario, seed, found)
    return judge(part_promises(samples), samples, [], runs, level)


def broken(rows):
    return {row.promise for row in rows if row.verdict == BROKEN}


@pytest.mark.one_in(8)
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
    np.testing.assert_allclose(start_states(scenario, 5, 3), runs, rtol=1e-14)


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
    "Lazier": (SLOTS, "network.activation", "links are paired as often"),
    "Rarely": (TICKS, "sensors[0]", "sensors sample at the rates"),
    "Regular": (TICKS, "sensors[0]", "gaps between samples are exponential"),
    "LateFirst": (TICKS, "network.activation", "clocks tick at the rates"),
    "OtherShape": (GAMMAS, "network.activation", "ticks follow the law of their clocks"),
    "OffBeat": (PERIODIC, "network.activation", "clocks tick at the times"),
    "EarlyJitter": (JITTERED, "network.activation", "ticks follow the law of their clocks"),
    "LongerBursts": (IN_BURSTS, "network.channel.loss", "losses follow each other"),
    "FirstLost": (TICKS, "network.channel.loss", "messages are lost as often as"),
    "Slow": (LATE, "network.channel.delay", "delays of messages have the law"),
    "OneSlow": (LATE, "network.channel.delay", "delays of messages have the law"),
    "Sooner": (DELAYED, "network.channel.delay", "messages take the time"),
}


SUBTLE = {"Biased", "Louder", "Lossier", "OneWay", "Lazier", "LateFirst", "LongerBursts", "Slow",
          "EarlyJitter", "Noisier", "Rarely"}  # fmt: skip
"""Which take 60 runs to be found, the others less than 20."""


def with_class(table, key, name):
    """Return the scenario of a table whose part is of a class of wrong_parts."""
    table = copy.deepcopy(table)
    part = table
    for step in key.replace("[0]", ".0").split("."):
        part = part[int(step) if step.isdigit() else step]
    part["kind"] = f"tests.checks.parts.wrong_parts:{name}"
    return from_table(table)


@pytest.mark.one_in(16)
@pytest.mark.parametrize("name", WRONG)
def test_wrong_parts_are_found(name):
    table, key, promise = WRONG[name]
    rows = verdicts(with_class(table, key, name), 60 if name in SUBTLE else 20)
    assert any(one.startswith(promise) for one in broken(rows))


GAPS = {
    # Clocks, with gaps drawn by scipy's law and not by ours.
    "poisson": (Poisson(rate=1.3), scipy.stats.expon(scale=1.0 / 1.3)),
    "gamma": (
        Renewal(distribution="gamma", shape=2.5, mean=0.4),
        scipy.stats.gamma(2.5, scale=0.16),
    ),
    "weibull": (
        Renewal(distribution="weibull", shape=0.7, scale=0.5),
        scipy.stats.weibull_min(0.7, scale=0.5),
    ),
    "uniform": (
        Renewal(distribution="uniform", low=0.2, high=0.9),
        scipy.stats.uniform(0.2, 0.7),
    ),
}


@pytest.mark.parametrize("name", ["gamma", "weibull", "uniform"])
def test_spreads_of_gaps_are_those_of_scipy(name):
    clock, law = GAPS[name]
    assert clock.gaps.spread == pytest.approx(law.var() / law.mean() ** 2, rel=1e-12)


@pytest.mark.one_in(4)
@pytest.mark.parametrize("name", GAPS)
def test_gaps_are_uniform_numbers_however_short_the_run(name):
    (clock, law), random = GAPS[name], np.random.default_rng(3)
    cells, products, horizon = np.zeros((CELLS, 2)), np.zeros(3), 2.0
    group = ClockGroup(((0, 1),), np.array([clock.mean_rate((0, 1))]), (clock.gaps,), ("",))
    for _ in range(4000):
        ticks = np.cumsum(law.rvs(60, random_state=random))
        ticks = ticks[ticks < horizon]
        found = count_ticks(group, ticks, np.zeros(len(ticks), int), horizon)
        cells += found.cells
        products += found.products
    # Short runs do not show how long the longest gaps are: these are one part.
    shown = cells[:, 1] == cells[0, 1]
    counts, looked_at = cells[shown, 0], cells[0, 1]
    assert shown.sum() >= 11
    assert looked_at > 4000
    counts = np.append(counts, looked_at - counts.sum())
    shares = np.append(np.full(shown.sum(), 1.0), CELLS - shown.sum()) / CELLS
    assert scipy.stats.chisquare(counts[shares > 0.0], looked_at * shares[shares > 0.0])[1] > 1e-3
    assert abs(products[0]) < 4.0 * math.sqrt(products[2])


@pytest.mark.parametrize(
    ("delay", "law"),
    [
        (ExponentialDelay(mean=0.3), scipy.stats.expon(scale=0.3)),
        (UniformDelay(low=0.1, high=0.4), scipy.stats.uniform(0.1, 0.3)),
        (LognormalDelay(mean=0.3, sigma=0.5), scipy.stats.lognorm(0.5, scale=0.3 * np.exp(-0.125))),
        (ConstantDelay(seconds=0.3), None),
    ],
    ids=lambda value: type(value).__name__,
)
def test_laws_of_delays_are_those_of_scipy(delay, law):
    seconds = np.linspace(0.0, 1.0, 11)
    if law is None:
        assert delay.law is None
    else:
        assert delay.law.cdf(seconds) == pytest.approx(law.cdf(seconds), abs=1e-12)
        assert delay.law.quantile(seconds[1:-1]) == pytest.approx(law.ppf(seconds[1:-1]))
        assert delay.law.spread == pytest.approx(law.var() / law.mean() ** 2)


@pytest.mark.parametrize(("to_bad", "to_good", "good"), [(0.1, 0.3, 1.0), (0.4, 0.2, 0.8)])
def test_losses_in_a_row_are_those_of_a_simulated_chain(to_bad, to_good, good):
    chain = GilbertElliott(to_bad=to_bad, to_good=to_good, deliver_good=good, deliver_bad=0.1)
    random, bad = np.random.default_rng(2), np.zeros(200_000, dtype=bool)
    bad[0] = random.random() < to_bad / (to_bad + to_good)
    for k, u in enumerate(random.random(len(bad) - 1).tolist()):
        bad[k + 1] = u >= to_good if bad[k] else u < to_bad
    lost = random.random(len(bad)) >= np.where(bad, 0.1, good)
    assert chain.chain.lost_twice == pytest.approx((lost[1:] & lost[:-1]).mean(), abs=0.01)


def test_whitening_gives_the_identity_and_drops_certain_directions():
    root = np.random.default_rng(1).standard_normal((4, 2))
    white, null = whiten(root @ root.T)
    assert white.shape == (2, 4)
    assert np.allclose(white @ root @ root.T @ white.T, np.eye(2))
    assert np.allclose(null @ root, 0.0)


@pytest.mark.parametrize("table", [SLOTS, CLOCKS], ids=["slots", "clocks"])
def test_noise_of_a_plant_is_looked_at_in_units_of_its_states(table):
    """Noise of a state in small units was left out beside that of a large one."""
    units, plant = np.array([2.0**10, 2.0**-20]), {"mean": [0.0, 0.0]}
    of_columns = {"Q": units, "cov": units, "B": np.ones(2), "F": 1.0 / units, "A": 1.0 / units}
    for name in of_columns.keys() & table["plant"].keys():
        plant[name] = (table["plant"][name] * units[:, None] * of_columns[name]).tolist()
    sensors = [{**one, "H": (one["H"] / units).tolist()} for one in table["sensors"]]
    plain = from_table(table)
    scenario = from_table({**table, "plant": table["plant"] | plant, "sensors": sensors})
    # Rows of a factor may have either sign, which LAPACK chooses.
    factors = path_law(scenario).white * units, path_law(plain).white
    precisions = [np.swapaxes(factor, 1, 2) @ factor for factor in factors]
    np.testing.assert_allclose(*precisions, rtol=1e-9)
    assert np.isfinite(plant_noises(scenario, Streams(1, 0)).z).all()
    assert whitened_starts(scenario, start_states(scenario, 1, 3)).shape == (3, 2)
    # A mean that hides the noise of the start: x(0) is rounded.
    assert not whitened_starts(scenario.replace({"plant.mean": [1e20, 1e20]}), units[None]).size


LABELS = ["a", "b", "c"]
TESTS = {
    "variances": lambda z, level: compare_variances(z, LABELS, level, "values"),
    "means": lambda z, level: compare_means(z, LABELS, level, with_states(z)),
    "correlations": lambda z, level: compare_correlations(z, LABELS, level),
    "cells": lambda z, level: compare_cells(scipy.special.ndtr(z), LABELS, level, "values"),
}


def with_states(z, random=np.random.default_rng(12)):  # noqa: B008
    # The states of several runs, which may be much alike in one run.
    states = random.standard_normal((len(z), 1, 2, 3)).repeat(z.shape[1], axis=1)
    return np.array([noise_draws(*run).states for run in zip(z, states, strict=True)])


@pytest.mark.one_in(4)
@pytest.mark.parametrize("name", TESTS)
def test_tests_of_noise_keep_their_level(name):
    random, wrong, level = np.random.default_rng(7), 0, 0.05
    trials = 300
    for _ in range(trials):
        wrong += TESTS[name](random.standard_normal((10, 20, 3)), level).worst is not None
    low = probability_interval(wrong, trials, 0.001).low
    assert low <= level


@pytest.mark.parametrize("name", ["variances", "means", "correlations"])
def test_tests_of_noise_find_what_they_say(name):
    # An error of the size that a row calls detectable is found with probability 0.9.
    random, count, level = np.random.default_rng(8), 2000, 0.01
    overall = find(TESTS[name](random.standard_normal((1, count, 3)), level), 0.1)
    size, found, trials = overall.detectable, 0, 300
    for _ in range(trials):
        z = random.standard_normal((1, count, 3))
        if name == "variances":
            z *= math.sqrt(1.0 + size)
        elif name == "means":
            z[..., 1] += size
        else:
            z[..., 2] = size * z[..., 0] + math.sqrt(1.0 - size**2) * z[..., 2]
        found += TESTS[name](z, level).worst is not None
    assert probability_interval(found, trials, 0.001).high >= 0.9
    assert found >= 0.8 * trials


def _three_before(z, states):
    for k in range(3, len(z)):
        z[k, 1] = 0.2 * z[k - 3, 1] + math.sqrt(0.96) * z[k, 1]


def _every_other_louder(z, states):
    z *= np.sqrt(1.0 + 0.4 * (-1.0) ** np.arange(len(z)))[:, None]


def _growing(z, states):
    z *= np.sqrt(np.linspace(0.85, 1.15, len(z)))[:, None]


def _follows_the_state(z, states):
    z[:, 2] += 0.15 * states[:, 1, 2]


@pytest.mark.parametrize(
    ("change", "name", "label"),
    [
        (_three_before, "correlations", "b and itself 3 before"),
        (_every_other_louder, "correlations", "the size of"),
        (_growing, "variances", "of a run"),
        (_follows_the_state, "means", "c and state 1"),
    ],
)
def test_noises_with_the_right_covariance_that_are_not_white_are_found(change, name, label):
    random = np.random.default_rng(3)
    z, states = random.standard_normal((150, 50, 3)), random.standard_normal((150, 50, 2, 3))
    for run in zip(z, states, strict=True):
        change(*run)
    seen = np.array([noise_draws(*run).states for run in zip(z, states, strict=True)])
    test = {**TESTS, "means": lambda z, level: compare_means(z, LABELS, level, seen)}[name]
    assert label in test(z, 1e-3).worst[1]


@pytest.mark.parametrize("steps", [4, 20])
def test_correlations_within_short_runs_keep_their_level(steps):
    """Neighbours are those of one run: what their ends leave out must not look like correlation."""
    random, wrong, trials, level = np.random.default_rng(9), 0, 250, 0.05
    for _ in range(trials):
        z = random.standard_normal((240 // steps, steps, 2))
        wrong += compare_correlations(z, ["a", "b"], level).worst is not None
    assert probability_interval(wrong, trials, 0.001).low <= level


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
        found = correlation_of_runs(
            both - count * q**2,
            count,
            probability * (1.0 - probability),
            neighbours_variance(probability),
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


def test_rows_of_ids_find_their_entities():
    random = np.random.default_rng(1)
    for shift, missing in ((0, -1), (1 << 50, 7)):
        pairs = sorted({(int(i) + shift, int(j)) for i, j in random.integers(0, 9, (40, 2))})
        entities = [pairs[k] for k in random.permutation(len(pairs))]
        rows = random.integers(0, 12, (2, 500)) + np.array([[shift], [0]])
        rows[:, ::50] = missing
        known = {entity: k for k, entity in enumerate(entities)}
        expected = [known.get((int(i), int(j)), -1) for i, j in rows.T]
        np.testing.assert_array_equal(_entity_indices(entities, list(rows)), expected)
    np.testing.assert_array_equal(_entity_indices([(3,), (9,)], [np.array([9, 4, 3])]), [1, -1, 0])
