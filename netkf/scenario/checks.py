"""What the parts of a scenario owe each other; each rule raises ScenarioError in one line."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from netkf.algorithms.flow import FlowModel
from netkf.algorithms.gains import longest_interval
from netkf.algorithms.slot import Intermittent, SlotFilter
from netkf.core.arrays import FloatArray
from netkf.core.errors import ScenarioError
from netkf.network.clocks import LinkClock
from netkf.network.matchings import Matching, RecordedSlots
from netkf.plants.diffusion import Diffusion
from netkf.scenario.push_sum import check_push_sum
from netkf.scenario.records import check_records
from netkf.scenario.registry import spoken

if TYPE_CHECKING:
    from netkf.scenario.scenario import Scenario

MOST_SAMPLES = 10_000_000
MOST_STEPS = 100_000_000
MOST_TICKS = 1e9


def check(scenario: Scenario) -> None:
    """Everything that no single part can know."""
    _times(scenario)
    _plant(scenario)
    _sensors(scenario)
    _network(scenario)
    _filter(scenario)
    check_records(scenario)
    if scenario.slotted:
        _slots(scenario)
        check_push_sum(scenario)
    else:
        _sensing_period(scenario)


def _times(scenario: Scenario) -> None:
    probe, horizon = scenario.probe, scenario.horizon
    if not isinstance(probe, np.ndarray):
        if probe > horizon:
            raise ScenarioError(
                "probe", f"must be at most the horizon {horizon:g}", probe, "shorten the period"
            )
        if horizon / probe > MOST_SAMPLES:
            raise ScenarioError(
                "probe",
                f"must ask for at most {MOST_SAMPLES:,} samples",
                probe,
                "lengthen the period",
            )
        return
    outside = probe[(probe < 0.0) | (probe > horizon)]
    if outside.size:
        raise ScenarioError(
            "probe",
            f"times must lie in [0, {horizon:g}]",
            outside[0].item(),
            "leave it out or lengthen the horizon",
        )
    if (np.diff(probe) <= 0.0).any():
        raise ScenarioError("probe", "times must be strictly increasing", probe, "sort them")


def _shape(key: str, value: FloatArray, shape: tuple[int | None, ...], why: str) -> None:
    fits = len(value.shape) == len(shape) and all(
        want is None or have == want for have, want in zip(value.shape, shape, strict=True)
    )
    if not fits:
        words = " x ".join("any" if want is None else str(want) for want in shape)
        got = " x ".join(map(str, value.shape))
        raise ScenarioError(
            key, f"must be {words}, not {got}, because {why}", value, "mend the shape"
        )


def _plant(scenario: Scenario) -> None:
    plant, n = scenario.plant, scenario.plant.n
    if isinstance(plant, Diffusion):
        why = f"plant.A has {n} rows"
        _shape("plant.B", plant.B, (n, None), why)
    else:
        why = f"plant.F has {n} rows"
        _shape("plant.Q", scenario.slot_plant.Q, (n, n), why)
    if plant.mean is not None:
        _shape("plant.mean", plant.mean, (n,), why)
    if plant.cov is not None:
        _shape("plant.cov", plant.cov, (n, n), why)


def _sensors(scenario: Scenario) -> None:
    n, known = scenario.plant.n, scenario.topology.index
    for k, sensor in enumerate(scenario.sensors):
        key = f"sensors[{k}]"
        _shape(f"{key}.H", sensor.H, (None, n), f"the state has {n} components")
        p = len(sensor.H)
        _shape(f"{key}.R", sensor.R, (p, p), f"H has {p} rows")
        for place, node in enumerate(sensor.nodes):
            if node not in known:
                raise ScenarioError(
                    f"{key}.nodes[{place}]",
                    "must be a node of the graph",
                    node,
                    f"node ids here are {_ids(scenario.nodes)}",
                )
        if len(set(sensor.nodes)) < len(sensor.nodes):
            raise ScenarioError(
                f"{key}.nodes",
                "must name each node once",
                list(sensor.nodes),
                "write a second [[sensors]] entry for a second sensor",
            )


def _ids(nodes: tuple[int, ...]) -> str:
    return ", ".join(map(str, nodes)) if len(nodes) <= 8 else f"{nodes[0]} .. {nodes[-1]}"


def _network(scenario: Scenario) -> None:
    network, topology = scenario.network, scenario.topology
    algorithm = scenario.filter.algorithm
    for key, part in (
        ("network.activation", network.activation),
        ("network.channel.loss", network.channel.loss),
    ):
        if part is not None:
            try:
                part.check(topology)
            except ScenarioError as error:
                raise error.under(key) from None
    if not algorithm.talks:
        return
    name = spoken(algorithm)
    if network.activation is None:
        example = "broadcast" if scenario.slotted else "poisson"
        raise ScenarioError(
            "network.activation",
            f"is missing, and the {name} filter talks",
            None,
            f'add activation = {{ kind = "{example}", ... }}',
        )
    if not scenario.slotted:
        _ticks(scenario)
    if topology.directed:
        raise ScenarioError(
            "network.graph.directed",
            f"must be false for the {name} filter, whose links work both ways",
            True,
            "give an undirected graph",
        )
    if len(topology.components) > 1 and not isinstance(algorithm, Intermittent):
        smallest = sorted(topology.components[-1])
        raise ScenarioError(
            "network.graph",
            f"must be connected for the {name} filter",
            f"{len(topology.components)} parts, one of them {smallest}",
            "add links, or connected = true for a random graph",
        )


def _ticks(scenario: Scenario) -> None:
    clock = scenario.network.activation
    assert isinstance(clock, LinkClock)
    for link in scenario.topology.links:
        ticks = clock.mean_rate(link) * scenario.horizon
        if ticks > MOST_TICKS:
            raise ScenarioError(
                "network.activation",
                f"must make at most {MOST_TICKS:g} ticks of a link up to the horizon",
                f"{ticks:.3g} ticks of link {link}",
                "lower the rate or shorten the horizon",
            )


def _filter(scenario: Scenario) -> None:
    filtering, n = scenario.filter, scenario.plant.n
    why = f"the state has {n} components"
    for key, value, shape in (
        ("filter.mean", filtering.mean, (n,)),
        ("filter.cov", filtering.cov, (n, n)),
    ):
        if isinstance(value, tuple):
            if len(value) != len(scenario.nodes):
                raise ScenarioError(
                    key,
                    f"must have one entry for each of {len(scenario.nodes)} nodes",
                    f"{len(value)} entries",
                    "add or remove some",
                )
            if filtering.algorithm.pooled:
                raise ScenarioError(
                    key,
                    "must be one for the filter that all nodes share",
                    f"{len(value)} entries",
                    "give one",
                )
            for k, item in enumerate(value):
                _shape(f"{key}[{k}]", item, shape, why)
        elif value is not None:
            _shape(key, value, shape, why)
    model = filtering.model
    for name in "ABFQ":
        value = getattr(model, name)
        if value is None:
            continue
        if (name in "FQ") != scenario.slotted:
            raise ScenarioError(
                f"filter.model.{name}",
                "belongs to plants of the other kind of time",
                value,
                "use F and Q for linear plants, A and B for diffusions",
            )
        _shape(f"filter.model.{name}", value, (n, None if name == "B" else n), why)
    _believed_noise(scenario)
    _degrees(scenario)


def _believed_noise(scenario: Scenario) -> None:
    R, sensors = scenario.filter.model.R, scenario.sensors
    if R is None:
        return
    if isinstance(R, tuple) and len(R) != len(sensors):
        raise ScenarioError(
            "filter.model.R",
            f"must have one entry for each of {len(sensors)} [[sensors]]",
            f"{len(R)} entries",
            "add or remove some",
        )
    for k, sensor in enumerate(sensors):
        key, own = (
            ("filter.model.R", R) if not isinstance(R, tuple) else (f"filter.model.R[{k}]", R[k])
        )
        p = len(sensor.H)
        _shape(key, own, (p, p), f"sensors[{k}].H has {p} rows")


def _degrees(scenario: Scenario) -> None:
    algorithm = scenario.filter.algorithm
    if not algorithm.talks or not scenario.topology.links:
        return
    node, degree = max(scenario.topology.degrees.items(), key=lambda item: item[1])
    if degree > algorithm.largest_degree():
        raise ScenarioError(
            "filter.epsilon",
            f"must be at most 1 / {degree}, because node {node} has {degree} links",
            getattr(algorithm, "epsilon", None),
            f"give at most {1.0 / degree:.6g}",
        )


def _sensing_period(scenario: Scenario) -> None:
    period, horizon = scenario.truth.sensing_period, scenario.horizon
    assert period is not None
    if horizon / period > MOST_STEPS:
        raise ScenarioError(
            "plant.sensing_period",
            f"must make at most {MOST_STEPS:,} steps to the horizon",
            period,
            "lengthen it, shorten the horizon, or use less precise sensors",
        )
    if period > scenario.truth.longest_period * (1.0 + 1e-9):
        raise ScenarioError(
            "plant.sensing_period",
            "is too long for the plant",
            period,
            f"give at most {scenario.truth.longest_period:.3g}, or leave it out",
        )
    pooled = scenario.filter.algorithm.pooled
    models = [scenario.pooled_model] if pooled else scenario.models
    longest = min((_longest(scenario, model) for model in models if len(model.H)), default=period)
    if min(period, horizon) <= longest * (1.0 + 1e-9):
        return
    if getattr(scenario.plant, "sensing_period", None) is not None:
        raise ScenarioError(
            "plant.sensing_period",
            "is too long for the readings of the most precise node",
            period,
            f"give at most {longest:.3g}, or leave it out",
        )
    raise ScenarioError(
        "filter.model",
        f"is too far from the truth: it needs readings every {longest:.3g} s, the sensors give "
        f"one every {period:.3g} s",
        None,
        f"set plant.sensing_period to at most {longest:.3g}",
    )


def _longest(scenario: Scenario, model: FlowModel) -> float:
    return longest_interval(*scenario.belief, model.H, model.R)


def _slots(scenario: Scenario) -> None:
    plant, algorithm = scenario.slot_plant, scenario.filter.algorithm
    assert isinstance(algorithm, SlotFilter)
    off = [
        t
        for t, k in zip(scenario.times.tolist(), scenario.slots, strict=True)
        if abs(t - k * plant.period) > 1e-9 * max(plant.period, t)
    ]
    if off:
        raise ScenarioError(
            "probe",
            f"times must be multiples of the plant's period {plant.period:g}",
            off[0],
            "sample at slots only",
        )
    activation = scenario.network.activation
    if not algorithm.talks:
        return
    name = spoken(algorithm)
    pairs = isinstance(activation, Matching) or (
        isinstance(activation, RecordedSlots) and activation.matching
    )
    if pairs != algorithm.pairwise:
        raise ScenarioError(
            "network.activation.kind",
            f"must be a {'matching' if algorithm.pairwise else 'broadcast'} for the {name} filter",
            type(activation).__name__.lower(),
            "choose another activation or another filter",
        )
    exchanges = algorithm.programme.count("exchange")
    if exchanges * scenario.phase_length >= plant.period * (1.0 - 1e-9):
        raise ScenarioError(
            "network.activation.phase",
            f"must leave {exchanges} exchange(s) room within the period {plant.period:g}",
            scenario.phase_length,
            "shorten it; the steps of an exchange share it",
        )
