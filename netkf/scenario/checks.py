"""Checks that involve several parts of a scenario; each raises ScenarioError at the first mistake.

Rules of a single part, such as the range of a number, are checked by the part's own class.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from netkf.algorithms.filter import compiled_kernels
from netkf.algorithms.kernels.gains import longest_interval
from netkf.algorithms.kernels.run import absorb as nothing
from netkf.core.clock import stated_rate
from netkf.core.errors import ScenarioError, errors_under
from netkf.core.printable import list_some
from netkf.linalg.spectra import growth_rate
from netkf.network.clocks import LinkClock
from netkf.network.losses import GilbertElliott
from netkf.network.matchings import Matching, RecordedSlots
from netkf.plants.curves import NonlinearDiffusion
from netkf.plants.diffusion import Diffusion
from netkf.plants.inputs import Input
from netkf.plants.maps import NonlinearPlant
from netkf.plants.regressors import RegressorSensor
from netkf.scenario import shapes
from netkf.scenario.derived import DerivedScenario
from netkf.scenario.model import takes_samples
from netkf.scenario.positions import check_positions
from netkf.scenario.preconditions import (
    check_activation,
    check_preconditions,
    check_time,
    filter_name,
)
from netkf.scenario.records import check_records
from netkf.scenario.registry import explain_time_mismatch, name_of
from netkf.scenario.sampling import check_sampling, uses_grid
from netkf.scenario.time_grid import check_grid

MAX_SAMPLES = 10_000_000  # state samples of one run
MAX_ENTRIES = 100_000_000
"""Numbers in all sampled covariances of one run: 0.8 GB of memory."""
MAX_STEPS = 100_000_000  # steps of one run; more suggest a wrong unit of time
MAX_CHANGES = 10_000_000  # of nodes that go up and down, which are kept in memory: 1 GB
MAX_TICKS = 1e9  # ticks of one clock; more suggest a wrong unit of time
MAX_CONSTANTS = 1e15  # time constants of one run; more have no exact count in floating point
UNIX = "where it is a Unix time, set [time] origin and count it from there"
"""What to do where a long horizon is the time of the end of a log."""
MAX_GROWTH = 1e7  # exponent g of growth by e^g; a run needs a new frame each time g rises by seven


def check_scenario(scenario: DerivedScenario) -> None:
    """Raise ScenarioError if components do not fit together; later checks rely on earlier ones."""
    _check_times(scenario)
    _check_plant(scenario)
    _check_sensors(scenario)
    check_time(scenario)
    _check_network(scenario)
    _check_filter(scenario)
    check_records(scenario)
    check_sampling(scenario)
    check_positions(scenario, uses_grid(scenario))
    check_preconditions(scenario)
    if scenario.slotted:
        _check_slots(scenario)
    elif uses_grid(scenario):
        _check_sensing_period(scenario)
    check_grid(scenario)
    if not scenario.slotted and scenario.plant.linear:
        _check_speed(scenario)
    check = scenario.node_filter.needs.check
    if check is not None:
        check(scenario)


def _check_times(scenario: DerivedScenario) -> None:
    probe, horizon = scenario.probe, scenario.horizon
    plant = scenario.plant
    if isinstance(plant, NonlinearDiffusion) and horizon / plant.step > MAX_STEPS:
        rule, remedy = f"must make at most {MAX_STEPS:,} steps to the horizon", "lengthen it"
        raise ScenarioError("plant.step", rule, plant.step, remedy)
    if scenario.slotted and horizon / scenario.slot_plant.period > MAX_STEPS:
        rule = f"must make at most {MAX_STEPS:,} slots to the horizon"
        remedy = f"lengthen it or shorten the horizon; {UNIX}"
        raise ScenarioError("plant.period", rule, scenario.slot_plant.period, remedy)
    if not isinstance(probe, np.ndarray):
        if probe > horizon:
            remedy = "shorten the period, or list times, as probe = [0.0]"
            raise ScenarioError(
                "probe", f"must be at most the horizon {horizon:.15g}", probe, remedy
            )
        if horizon / probe > MAX_SAMPLES:
            rule = f"must ask for at most {MAX_SAMPLES:,} samples"
            remedy = f"lengthen the period or shorten the horizon; {UNIX}"
            raise ScenarioError("probe", rule, probe, remedy)
        _check_entries(scenario, horizon / probe)
        return
    outside = probe[(probe < 0.0) | (probe > horizon)]
    if outside.size:
        rule = f"times must lie in [0, {horizon:.15g}]"
        remedy = "lengthen the horizon, or leave it out"
        raise ScenarioError("probe", rule, outside[0].item(), remedy)
    if (np.diff(probe) <= 0.0).any():
        raise ScenarioError("probe", "times must be strictly increasing", probe, "sort them")
    _check_entries(scenario, len(probe))


def _check_entries(scenario: DerivedScenario, samples: float) -> None:
    nodes, n = len(scenario.nodes), scenario.width
    if samples * nodes * n * n > MAX_ENTRIES:
        raise ScenarioError(
            "probe",
            f"must ask for at most {MAX_ENTRIES:,} entries of covariances",
            f"{samples:,.0f} samples of {nodes:,} nodes with {n} x {n} entries",
            f"lengthen the period, shorten the horizon or take fewer nodes; {UNIX}",
        )


def _check_plant(scenario: DerivedScenario) -> None:
    plant, n = scenario.plant, scenario.plant.n
    for key, one in scenario.all_plants:
        with errors_under(key):
            one.check_names()
    if isinstance(plant, Diffusion):
        why = f"plant.A has {n} rows"
        shapes.require_shape("plant.B", plant.B, (n, None), why)
    elif not plant.linear:
        why = f"plant.{'Q' if scenario.slotted else 'B'} has {n} rows"
    else:
        why = f"plant.F has {n} rows"
        shapes.require_shape("plant.Q", scenario.slot_plant.Q, (n, n), why)
    shapes.check_schedule(scenario, why)
    if isinstance(plant, NonlinearPlant | NonlinearDiffusion):
        with errors_under("plant"):
            plant.check_dynamics()
    if plant.mean is not None:
        shapes.require_shape("plant.mean", plant.mean, (n,), why)
    if plant.cov is not None:
        shapes.require_shape("plant.cov", plant.cov, (n, n), why)
    if plant.input is not None and plant.linear:
        _check_input(plant.input, n)


def _check_input(u: Input, n: int) -> None:
    # On the grid of the scenario two rows of its table may be one instant.
    with errors_under("plant.input"):
        m = u.m
    if u.G is None:
        raise ScenarioError("plant.input.G", "is missing", None, f"add G = ..., {n} rows of {m}")
    parts = "components" if m > 1 else "component"
    shapes.require_shape("plant.input.G", u.G, (n, m), f"n = {n}, and u has {m} {parts}")


def _check_sensors(scenario: DerivedScenario) -> None:
    n, index_of_node = scenario.plant.n, scenario.topology.index
    for k, sensor in enumerate(scenario.sensors):
        key = scenario.sensor_key(k)
        if isinstance(sensor, RegressorSensor):
            shapes.check_regressor(scenario, key, sensor)
        elif not sensor.linear:
            with errors_under(key):
                # First as it is: a wrong field is reported before positions that the graph lacks.
                for candidate in (sensor, sensor.located(scenario.topology.positions)):
                    candidate.check_state(n)
        else:
            shapes.require_shape(f"{key}.H", sensor.H, (None, n), f"the state has {n} components")
            p = len(sensor.H)
            shapes.require_shape(f"{key}.R", sensor.R, (p, p), f"H has {p} rows")
        for position, node in enumerate(sensor.nodes):
            if node not in index_of_node:
                remedy = f"node ids here are {list_some(scenario.nodes, 8)}"
                if node in scenario.topology.left_out:
                    why = "none of its links reaches network.graph.minimum, lower that"
                    remedy = f"{why}; {remedy}"
                raise ScenarioError(
                    f"{key}.nodes[{position}]", "must be a node of the graph", node, remedy
                )
        if len(set(sensor.nodes)) < len(sensor.nodes):
            rule = "must name each node once"
            remedy = "write a second [[sensors]] entry for a second sensor"
            raise ScenarioError(f"{key}.nodes", rule, list(sensor.nodes), remedy)


def _largest_information(sensor: Any) -> float:
    """Return the largest entry of H' R^-1 H of a linear sensor."""
    # Columns of states that it does not read are left out: of many blocks most.
    H = sensor.H[:, sensor.H.any(axis=0)]
    return float(np.abs(H.T @ np.linalg.solve(sensor.R, H)).max(initial=0.0))


def _check_speed(scenario: DerivedScenario) -> None:
    delay = scenario.network.channel.delay.fixed or 0.0
    # A message with a fixed delay is predicted over the delay, which may exceed the horizon.
    longest = max(scenario.horizon, delay)
    believed = scenario.believed_pieces  # A and B B' that the filters assume
    linear_sensors = (sensor for sensor in scenario.sensors if sensor.linear)
    max_information = max(map(_largest_information, linear_sensors), default=0.0)
    filter_rate = np.sqrt(max_information * max(float(np.abs(Q).max()) for _, Q in believed))
    true = [piece.A for piece in scenario.diffusion.pieces]
    A = max(true, key=growth_rate)
    plant_rate = max(float(np.abs(M).sum(axis=0).max()) for M in (*true, *(M for M, _ in believed)))
    if (plant_rate + filter_rate) * longest > MAX_CONSTANTS:
        rule = f"must have at most {MAX_CONSTANTS:g} time constants, or its filters must, within "
        rule += f"the horizon or delay of {longest:g} s"
        raise ScenarioError("plant.A", rule, A, "shorten them, or choose another unit of time")
    if growth_rate(A) * scenario.horizon > MAX_GROWTH:
        rule = f"must grow by at most e^{MAX_GROWTH:g} up to the horizon"
        raise ScenarioError("plant.A", rule, A, "shorten the horizon")


def _check_owners(name: str, entries: Sequence[Any]) -> None:
    """Raise ScenarioError unless nodes are in one each of ``entries``."""
    owners: dict[int, int] = {}
    for k, entry in enumerate(entries):
        for node in entry.nodes:
            if owners.setdefault(node, k) != k:
                rule = f"must not have a node of network.{name}[{owners[node]}]"
                raise ScenarioError(
                    f"network.{name}[{k}].nodes", rule, node, "give each node one entry"
                )


def _check_lives(scenario: DerivedScenario) -> None:
    lives = scenario.network.lives
    _check_owners("lives", lives)
    for k, life in enumerate(lives):
        changes = life._change_rate * scenario.horizon * len(life.nodes)
        if changes > MAX_CHANGES:
            rule = f"must make nodes go up and down at most {MAX_CHANGES:,} times up to the horizon"
            remedy = "lengthen the times up and down, or shorten the horizon"
            raise ScenarioError(f"network.lives[{k}]", rule, f"{changes:.3g} times", remedy)
    clocked = compiled_kernels(scenario.node_filter, clocked=True)
    # Whether nodes of the filter can go without the increments of their sensors.
    can_pause = (clocked is None or clocked.is_kalman) and not scenario.node_filter.timing.pooled
    for k, life in enumerate(() if can_pause else lives):
        for node in life.nodes:
            if node in scenario.increment_sensors:
                rule = "cannot have a node whose sensors give increments, only one where they "
                rule += f"sample, with the {filter_name(scenario)}"
                remedy = 'write sampling = { kind = "periodic", period = ... } in its [[sensors]]'
                raise ScenarioError(f"network.lives[{k}].nodes", rule, node, remedy)
    lost = [k for k, life in enumerate(lives) if life.memory == "lost"]
    if not lost:
        return
    kernels, needs = scenario.node_filter.kernels, scenario.node_filter.needs
    changes = len(scenario.followed_changes) or not scenario.plant.linear
    remembers = kernels is not None and kernels.of(not scenario.slotted).remembers
    rule = remedy = ""
    if changes and remembers and scenario.node_filter.timing.max_age > 0.0:
        rule = "must be kept where late readings are used and the plant changes or is not linear"
        remedy = 'write "kept", or late = "drop" in [filter]'
    elif needs.memory:
        rule = f"must be kept with the {filter_name(scenario)}, {needs.memory}"
        remedy = 'write "kept", or choose another filter'
    if rule:
        raise ScenarioError(f"network.lives[{lost[0]}].memory", rule, "lost", remedy)


def _check_shared_states(scenario: DerivedScenario) -> None:
    network, topology = scenario.network, scenario.topology
    loss = network.channel.loss
    if not isinstance(loss, GilbertElliott) or not network.one_fate or topology.directed:
        return
    for i, j in topology.links:
        if loss.of((i, j)).transitions != loss.of((j, i)).transitions:
            rule = "must give both directions of a link one to_bad and one to_good, since they are "
            rule += "in one state (symmetric = true)"
            remedy = "correct the rows, or write symmetric = false in network.channel"
            raise ScenarioError("network.channel.loss.path", rule, [i, j], remedy)


def _check_clocks(scenario: DerivedScenario) -> None:
    clocks, why = scenario.network.clocks, None
    _check_owners("clocks", clocks)
    nodes = [node for entry in clocks for node in entry.nodes]
    sensors, placed, remedy = scenario.sensors, scenario.placed_sensors, "remove it"
    recorded = [i for i in nodes if any(sensors[p.entry].record for p in placed.get(i, ()))]
    if scenario.node_filter.timing.pooled:
        why = f"has no meaning for the {filter_name(scenario)}, which is in no node"
    elif scenario.slotted:
        why = "belongs to continuous time: slots begin for all nodes at once"
    elif recorded:
        why, nodes = "cannot be of nodes whose readings are recorded, with their stamps", recorded
        remedy = "leave these out, and write into their tables the stamps that filters believe"
    elif (
        scenario.has_mistimed_increments and len(scenario.followed_changes) and scenario.knows_input
    ):
        why = "cannot be of nodes whose sensors give increments, of a plant with input and changes"
    elif scenario.has_mistimed_models and scenario.node_filter.needs.blocks and scenario.plants:
        why = f"cannot stand beside inputs or changes that the {filter_name(scenario)} knows"
    if clocks and why is not None:
        raise ScenarioError("network.clocks", why, sorted(nodes), remedy)


def _check_faults(scenario: DerivedScenario) -> None:
    for k, sensor in enumerate(scenario.sensors):
        fault, key = sensor.fault, f"{scenario.sensor_key(k)}.fault"
        if fault is None:
            continue
        entry = scenario.sensor_entries[k]
        # One that says no nodes has those that read something.
        nodes = scenario.declared_sensors[entry].nodes or {
            node
            for other, of in zip(scenario.sensors, scenario.sensor_entries, strict=True)
            for node in (other.nodes if of == entry else ())
        }
        for place, node in enumerate(fault.nodes or ()):
            if node not in nodes:
                rule = "must be a node of this sensor"
                raise ScenarioError(f"{key}.nodes[{place}]", rule, node, "remove it")
        if sensor.record is not None or not (scenario.slotted or takes_samples(sensor)):
            rule = "belongs to sensors whose readings are drawn, in slots or by sampling"
            remedy = "change the table, or write sampling = { ... }"
            raise ScenarioError(key, rule, name_of("fault", fault), remedy)
        p = len(scenario.noise_covariance(k, believed=False))
        for name in ("value", "size", "rate"):
            value = getattr(fault, name, None)
            if isinstance(value, np.ndarray) and len(value) != p:
                rule = f"must have a number for each of {p} values"
                raise ScenarioError(f"{key}.{name}", rule, value, "correct it")


def _check_quantisation(scenario: DerivedScenario) -> None:
    quantise = scenario.network.quantise
    kernels = compiled_kernels(scenario.node_filter, not scenario.slotted)
    if quantise is None or kernels is None:
        return
    if kernels.sends_readings or kernels.shift_payload is nothing:
        rule = f"cannot be with the {filter_name(scenario)}, whose messages have readings or bits"
        raise ScenarioError("network.quantise", rule, quantise.bits, "remove it")


def _check_network(scenario: DerivedScenario) -> None:
    network, topology, node_filter = scenario.network, scenario.topology, scenario.node_filter
    for key, part in (
        ("network.activation", network.activation),
        ("network.channel.loss", network.channel.loss),
        ("network.channel.delay", network.channel.delay),
        ("network.channel.channels", network.channel.channels),
        *((f"network.lives[{k}]", life) for k, life in enumerate(network.lives)),
        *((f"network.clocks[{k}]", clock) for k, clock in enumerate(network.clocks)),
    ):
        if part is not None:
            with errors_under(key):
                part.check(topology)
    _check_shared_states(scenario)
    _check_lives(scenario)
    _check_clocks(scenario)
    _check_quantisation(scenario)
    _check_faults(scenario)
    if not node_filter.timing.talks:
        return
    name = filter_name(scenario)
    if network.activation is None:
        example = "broadcast" if scenario.slotted else "poisson"
        remedy = f'add activation = {{ kind = "{example}", ... }}'
        raise ScenarioError("network.activation", f"is missing, and the {name} talks", None, remedy)
    if not scenario.slotted:
        check_activation(scenario)
        _check_ticks(scenario)
    elif topology.directed and not node_filter.needs.one_way:
        rule = f"must be false for the {name}, whose links work both ways in slots"
        raise ScenarioError("network.graph.directed", rule, True, "give an undirected graph")
    if len(topology.components) > 1 and not (node_filter.needs.one_way or topology.directed):
        smallest_component = sorted(topology.components[-1])
        raise ScenarioError(
            "network.graph",
            f"must be connected for the {name}",
            f"{len(topology.components)} parts, one of them {smallest_component}",
            "add links, or connected = true for a random graph",
        )


def _check_ticks(scenario: DerivedScenario) -> None:
    clock = scenario.network.activation
    assert isinstance(clock, LinkClock)
    owner = clock.at.removesuffix("s")  # "link", "direction" or "node"
    for entity in clock.entities(scenario.topology):
        ticks = stated_rate(clock, entity, "network.activation") * scenario.horizon
        if ticks > MAX_TICKS:
            ids = entity[0] if len(entity) == 1 else entity
            raise ScenarioError(
                "network.activation",
                f"must make at most {MAX_TICKS:g} ticks of a {owner} up to the horizon",
                f"{ticks:.3g} ticks of {owner} {ids}",
                "lower the rate or shorten the horizon",
            )


def _check_filter(scenario: DerivedScenario) -> None:
    filtering, algorithm, n = scenario.filter, scenario.filter.algorithm, scenario.plant.n
    why = f"the state has {n} components"
    for key, value, shape in (
        ("filter.mean", filtering.mean, (n,)),
        ("filter.cov", filtering.cov, (n, n)),
    ):
        if isinstance(value, tuple):
            if len(value) != len(scenario.nodes):
                rule = f"must have one entry for each of {len(scenario.nodes)} nodes"
                raise ScenarioError(key, rule, f"{len(value)} entries", "add or remove some")
            if algorithm.timing.pooled:
                rule = "must be one for the filter that all nodes share"
                raise ScenarioError(key, rule, f"{len(value)} entries", "give one")
            for k, item in enumerate(value):
                shapes.require_shape(f"{key}[{k}]", item, shape, why)
        elif value is not None:
            shapes.require_shape(key, value, shape, why)
    model = filtering.model
    for name in "ABFQ":
        value = getattr(model, name)
        if value is None:
            continue
        if not scenario.plant.linear and name in "AF":
            rule = "means nothing with a nonlinear plant, whose f filters know"
            raise ScenarioError(f"filter.model.{name}", rule, value, "leave it out")
        if (name in "FQ") != scenario.slotted:
            rule = explain_time_mismatch(scenario.slotted)
            remedy = "use F and Q for linear plants, A and B for diffusions"
            raise ScenarioError(f"filter.model.{name}", rule, value, remedy)
        shapes.require_shape(f"filter.model.{name}", value, (n, None if name == "B" else n), why)
    if scenario.tells_models and algorithm.kernels is not None:
        rule = "must define shift beside its other methods, since the plant has an input and the "
        rule += "filter predicts by kernels, which do not know it"
        remedy = "write shift = Filter.shift if its estimates move with the state, or "
        remedy += "filter.model.input = false"
        raise ScenarioError("filter.kind", rule, type(algorithm).__name__, remedy)
    _check_believed_noise(scenario)
    shapes.check_weights(scenario)
    _check_degrees(scenario)


def _check_believed_noise(scenario: DerivedScenario) -> None:
    R, sensors = scenario.filter.model.R, scenario.declared_sensors
    if R is None:
        return
    if isinstance(R, tuple) and len(R) != len(sensors):
        rule = f"must have one entry for each of {len(sensors)} [[sensors]]"
        raise ScenarioError("filter.model.R", rule, f"{len(R)} entries", "add or remove some")
    for k, sensor in enumerate(sensors):
        if sensor.record is not None and sensor.record.has_noise:
            raise ScenarioError(
                "filter.model.R",
                f"must be left out, for rows of {sensor.record.path.name} bring their own noise",
                R,
                f"give another R as sensors[{k}].R in rows without noise, or rename the columns",
            )
        p = len(sensor.R)
        reason = f"a reading of sensors[{k}] has {p} components"
        if isinstance(R, tuple):
            shapes.require_shape(f"filter.model.R[{k}]", R[k], (p, p), reason)
        else:
            shapes.require_shape("filter.model.R", R, (p, p), reason)


def _check_degrees(scenario: DerivedScenario) -> None:
    algorithm = scenario.filter.algorithm
    if not algorithm.timing.talks or not scenario.topology.links:
        return
    node, degree = max(scenario.topology.degrees.items(), key=lambda item: item[1])
    if degree > algorithm.link_weights.largest_degree:
        rule = f"must be at most 1 / {degree}, because node {node} has {degree} links"
        remedy = f"give at most {1.0 / degree:.6g}"
        raise ScenarioError("filter.epsilon", rule, getattr(algorithm, "epsilon", None), remedy)


def _check_sensing_period(scenario: DerivedScenario) -> None:
    period, horizon = scenario.diffusion.sensing_period, scenario.horizon
    assert period is not None
    if horizon / period > MAX_STEPS:
        rule = f"must make at most {MAX_STEPS:,} steps to the horizon"
        remedy = "lengthen it, shorten the horizon, or use less precise sensors"
        raise ScenarioError("plant.sensing_period", rule, period, remedy)
    if period > scenario.diffusion.longest_period * (1.0 + 1e-9):
        remedy = f"give at most {scenario.diffusion.longest_period:.3g}, or leave it out"
        raise ScenarioError("plant.sensing_period", "is too long for the plant", period, remedy)
    shapes.check_changes_on_grid(scenario, period)
    distinct_models = {
        id(model): model for models in scenario.model_pieces for model in models if len(model.H)
    }.values()
    steps = (longest_interval(m.A, m.Q, m.information) for m in distinct_models)
    longest = min(steps, default=period)
    if min(period, horizon) <= longest * (1.0 + 1e-9):
        return
    if getattr(scenario.plant, "sensing_period", None) is not None:
        rule = "is too long for the readings of the most precise node"
        remedy = f"give at most {longest:.3g}, or leave it out"
        raise ScenarioError("plant.sensing_period", rule, period, remedy)
    needed = f"readings every {longest:.3g} s, the sensors give one every {period:.3g} s"
    rule = f"is too far from the truth: it needs {needed}"
    remedy = f"set plant.sensing_period to at most {longest:.3g}"
    raise ScenarioError("filter.model", rule, None, remedy)


def _check_slots(scenario: DerivedScenario) -> None:
    plant, node_filter = scenario.slot_plant, scenario.node_filter
    times_off_slots = [
        t
        for t, k in zip(scenario.times.tolist(), scenario.sampled_slots, strict=True)
        if abs(t - k * plant.period) > 1e-9 * max(plant.period, t)
    ]
    if times_off_slots:
        rule = f"times must be multiples of the plant's period {plant.period:.15g}"
        remedy = "sample at slots only, with all digits of the period"
        raise ScenarioError("probe", rule, times_off_slots[0], remedy)
    activation = scenario.network.activation
    if not node_filter.timing.talks:
        return
    recorded = activation if isinstance(activation, RecordedSlots) else None
    is_matching = isinstance(activation, Matching) or (recorded is not None and recorded.matching)
    if is_matching != node_filter.timing.pairwise:
        assert activation is not None
        form = "matching" if node_filter.timing.pairwise else "broadcast"
        given = name_of("activation", activation)
        if recorded is not None:
            what = "slot,node,peer: a matching" if recorded.matching else "phase,step: broadcasts"
            given = f"{given} ({what})"
        raise ScenarioError(
            "network.activation.kind",
            f"must be a {form} for the {filter_name(scenario)}",
            given,
            "choose another activation or another filter",
        )
    exchanges = node_filter.timing.exchanges
    if exchanges * scenario.phase_length >= plant.period * (1.0 - 1e-9):
        rule = f"must leave {exchanges} exchange(s) room within the period {plant.period:g}"
        remedy = "shorten it; the steps of an exchange share it"
        raise ScenarioError("network.activation.phase", rule, scenario.phase_length, remedy)
