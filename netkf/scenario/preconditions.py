"""What filters need of times, clocks, sensors, start and network, checked before anything runs.

A filter declares its needs (``algorithms.traits.Needs``), a user's class and a built-in one alike;
here is the only place that checks them, in slots and in continuous time.
"""

from __future__ import annotations

import itertools
from bisect import bisect_right
from typing import Any

import numpy as np
import scipy

from netkf.algorithms.filter import Exchange, Filter, may_be_silent
from netkf.algorithms.translation import read_vector
from netkf.core.errors import ScenarioError
from netkf.core.fields import walk
from netkf.linalg.arrays import FloatArray, is_definite
from netkf.linalg.spectra import balance, hidden_mode, outputs_of
from netkf.network.clocks import LinkClock, OnReadings
from netkf.network.contacts import Contacts
from netkf.network.matchings import SlotActivation
from netkf.rng.streams import Streams
from netkf.scenario.derived import DerivedScenario
from netkf.scenario.model import takes_samples
from netkf.scenario.records import sensed_slots
from netkf.scenario.registry import explain_time_mismatch, kind_name, name_of

ANOTHER = 'use another filter, such as kind = "diffusion"'


def check_preconditions(scenario: DerivedScenario) -> None:
    """Raise ScenarioError at the first need of the filter that a scenario does not meet."""
    needs = scenario.node_filter.needs
    _check_one_model(scenario, needs.one_model)
    if not scenario.slotted:
        _check_one_model(scenario, needs.one_model_under_clocks)
    if scenario.views is not None:
        _check_blocks(scenario)
    if needs.own_blocks:
        _check_own_blocks(scenario)
    if not scenario.slotted:
        _check_increments(scenario)
    if needs.linear_plant and not scenario.plant.linear:
        rule = "must be a filter that uses dynamics in predictions only; "
        rule += f"the {filter_name(scenario)} computes with F"
        kind = name_of("filter", scenario.filter.algorithm)
        raise ScenarioError("filter.kind", rule, kind, f"use a linear plant, or {ANOTHER}")
    if needs.fixed_sensors:
        _check_fixed_sensors(scenario)
    if needs.every_reading and scenario.slotted:
        _check_every_reading(scenario)
    if needs.common_start:
        _check_common_start(scenario)
    if needs.inverts or (needs.inverts_under_clocks and not scenario.slotted):
        _check_invertible(scenario)
    if needs.ways_between_all and scenario.topology.directed:
        _check_ways(scenario)
    if needs.reads_what_it_sends:
        _check_heard(scenario)


def _check_one_model(scenario: DerivedScenario, reason: str) -> None:
    if reason and len(scenario.followed_changes):
        raise ScenarioError(
            "plant.schedule",
            f"cannot be followed by the {filter_name(scenario)}, {reason}",
            f"{len(scenario.followed_changes)} changes",
            f"write model = {{ schedule = false }} in [filter], or {ANOTHER}",
        )


def _check_blocks(scenario: DerivedScenario) -> None:
    name, talks = filter_name(scenario), scenario.node_filter.timing.talks
    if scenario.node_filter.timing.pooled:
        return
    needs = scenario.node_filter.needs
    knows_blocks = needs.blocks
    unread = talks and not knows_blocks and len(set(scenario.estimated)) > 1
    if unread and not _translates(scenario):
        rule = f"must be the same blocks for all nodes for the {name}, whose messages say no blocks"
        remedy = 'write "all", kind = "block-intersection", or Needs(translate=...) in a class'
        raise ScenarioError("filter.estimates", rule, scenario.filter.estimates, remedy)
    couplings = [] if needs.coupled else _couplings(scenario)
    for k, node in enumerate(scenario.nodes):
        view = scenario.view(k)
        if any(np.delete(M[view], view, axis=1).any() for M in couplings):
            rule = f"must contain all that drives the blocks of node {node}"
            remedies = ['write kind = "partition"'] if scenario.plant.linear else []
            if not needs.own_blocks:
                remedies.append('estimate the coupled blocks too, as "all" does')
            remedy = ", or ".join(remedies or [ANOTHER + ', estimates = "all"'])
            raise ScenarioError("filter.estimates", rule, scenario.filter.estimates, remedy)
        for placed in scenario.placed_sensors.get(node, ()):
            support = scenario.support(placed)
            if np.isin(support, view).all():
                continue
            key = scenario.sensor_key(placed.entry)
            if not knows_blocks or not np.isin(support, view).any():
                rule = f"must read blocks that node {node} estimates, for the {name}"
                remedy = _wider_estimates(scenario)
                raise ScenarioError(key, rule, scenario.filter.estimates, remedy)
            sensor = scenario.sensors[placed.entry]
            _check_rows(scenario, k, key, sensor)
            if not (scenario.slotted or takes_samples(sensor)):
                rule = "is missing: increments of two blocks need both estimates"
                raise ScenarioError(f"{key}.sampling", rule, None, f"add {SAMPLING}")


def _couplings(scenario: DerivedScenario) -> list[FloatArray]:
    """Return matrices (n, n) by which blocks drive each other, as filters believe."""
    plant: Any = scenario.plant
    if not plant.linear:
        return [plant.f.coupling] if plant.f.coupling.any() else []
    return [M for M, _ in scenario.believed_pieces]


def _wider_estimates(scenario: DerivedScenario) -> str:
    """Return with which estimates all sensors read blocks that their nodes estimate."""
    needs, topology, places = scenario.node_filter.needs, scenario.topology, scenario.layout.places
    if needs.own_blocks:
        return 'read blocks of the node itself, or write kind = "diffusion", estimates = "all"'
    listed = ", ".join(f'"{name}"' for name in scenario.layout.names)
    fitting = dict.fromkeys([f"[{listed}]", '"own+neighbours"'], True)
    for node, sensors in scenario.placed_sensors.items():
        linked: set[int | None] = {*topology.senders(node), *topology.receivers(node)}
        for support in map(scenario.support, sensors):
            read = {p.node for p in places if np.isin(support, np.r_[p.entries]).any()}
            for choice, nodes in zip(fitting, ({node, None}, {node, *linked}), strict=True):
                fitting[choice] &= bool(read & nodes) if needs.blocks else read <= nodes
    choices = [choice for choice in fitting if fitting[choice]][:1]
    return "write filter.estimates = " + " or ".join([*choices, '"all"'])


def _check_rows(scenario: DerivedScenario, k: int, key: str, sensor: Any) -> None:
    """Check that no row of a linear sensor of node number ``k`` reads several unknown blocks."""
    H = getattr(sensor, "H", None)
    places, known = scenario.layout.places, scenario.estimated[k]
    firsts = [place.first for place in places]
    for row in () if H is None or H.shape[1] != scenario.plant.n else H:
        used = dict.fromkeys(bisect_right(firsts, entry) - 1 for entry in np.flatnonzero(row))
        unknown = [places[number] for number in used if places[number] not in known]
        if len(unknown) > 1:
            read = [f"{place.name} of {place.node}" for place in unknown]
            rule = f"must read one block at most that node {scenario.nodes[k]} does not estimate"
            raise ScenarioError(f"{key}.H", rule, read, "split it, or estimate more blocks")


def _translates(scenario: DerivedScenario) -> bool:
    """Return True if messages between nodes that estimate different blocks can be read."""
    algorithm, node = scenario.node_filter, scenario.nodes[0]
    timing, needs = algorithm.timing, algorithm.needs
    if may_be_silent(algorithm) or timing.randomised or needs.network:
        return False
    if needs.translate is not read_vector:
        return True
    info, model = scenario.node_infos[0], scenario.model_of(0)
    start, kernels = scenario.initial_estimate(node), algorithm.kernels
    if kernels is None:
        state = algorithm.init(model, *start, info)
        payload = algorithm.emit(state, Exchange(0.0, 0, 0, 0, tuple(info.senders)))[1]
        return isinstance(payload, np.ndarray) and payload.shape == start[0].shape
    shapes = kernels.record_of(algorithm, [info], [model]).payload.values()
    kernels = kernels.of(not scenario.slotted)
    says_more = kernels.sends_readings or kernels.addressed
    return not says_more and list(shapes) == [start[0].shape]


def _check_own_blocks(scenario: DerivedScenario) -> None:
    name, estimates = filter_name(scenario), scenario.filter.estimates
    if len(scenario.nodes) > 1:
        blocks = list(itertools.chain.from_iterable(scenario.estimated)) if scenario.plants else []
        if len(set(blocks)) < max(1, len(blocks)):
            rule = f"must give each block to one node alone for the {name}"
            remedy = 'give nodes blocks in [[plants]] and write estimates = "own"'
            raise ScenarioError("filter.estimates", rule, estimates, remedy)
    cov = scenario.plant.start_cov if scenario.filter.cov is None else scenario.filter.cov
    for k, node in enumerate(scenario.nodes):
        P, view = cov[k] if isinstance(cov, tuple) else cov, scenario.view(k)
        others = np.ones(scenario.plant.n, dtype=bool)
        others[view] = False
        if P[view][:, others].any():
            rule = f"must be zero between the blocks of node {node} and others for the {name}"
            raise ScenarioError("filter.cov", rule, P, "leave it out, or write 0 there")


def _check_increments(scenario: DerivedScenario) -> None:
    name = filter_name(scenario)
    for k, sensor in enumerate(scenario.sensors):
        if scenario.node_filter.needs.samples and not takes_samples(sensor):
            rule = f"is missing, and the {name} uses samples, no continuous increments"
            raise ScenarioError(f"{scenario.sensor_key(k)}.sampling", rule, None, f"add {SAMPLING}")


def _check_fixed_sensors(scenario: DerivedScenario) -> None:
    for k, sensor in enumerate(scenario.sensors):
        if sensor.varying:
            irregular = sensor.linear and sensor.record is not None
            varies = "H or R varies, or a value is missing" if irregular else "H varies"
            rule = f"must have a fixed H for the {filter_name(scenario)}, which computes with it "
            rule += "before there are readings"
            value = f"kind {name_of('sensor', sensor)!r}, whose {varies}"
            remedy = f"use linear sensors, or {ANOTHER}"
            raise ScenarioError(scenario.sensor_key(k), rule, value, remedy)


def _check_every_reading(scenario: DerivedScenario) -> None:
    nowhere = np.full(scenario.plant.n, np.nan)
    for node, placed_sensors in scenario.placed_sensors.items():
        for placed in placed_sensors:
            sensor = scenario.sensors[placed.entry]
            if sensor.is_random:
                continue
            path = scenario.slot_path(Streams(scenario.seed, 0), node, placed)
            for slot in sensed_slots(scenario):
                reading = path.reading(slot, nowhere)
                if len(reading) != len(sensor.R) or np.isnan(reading).any():
                    seen = "several" if len(reading) > len(sensor.R) else "none"
                    raise ScenarioError(
                        f"{scenario.sensor_key(placed.entry)}.path",
                        f"must have one whole row of node {node} for each slot for the "
                        f"{filter_name(scenario)}, whose gains and P count all readings",
                        f"{seen} for slot {slot} at {slot * scenario.slot_plant.period:g} s",
                        f"give one row a slot, or {ANOTHER}",
                    )


def _check_common_start(scenario: DerivedScenario) -> None:
    starts = [scenario.initial_estimate(node) for node in scenario.nodes]
    for k, key in enumerate(("mean", "cov")):
        different = next(
            (i for i, start in enumerate(starts) if not np.array_equal(start[k], starts[0][k])), 0
        )
        if different:
            raise ScenarioError(
                f"filter.{key}",
                f"must be that of all nodes for the {filter_name(scenario)}, which computes how "
                "their errors correlate",
                f"another one for node {scenario.nodes[different]} than for {scenario.nodes[0]}",
                f"give one mean and cov, or {ANOTHER}",
            )


def _check_invertible(scenario: DerivedScenario) -> None:
    singular, linear = scenario.singular_start, scenario.plant.linear
    of_nodes = scenario.estimated_pieces
    if scenario.slotted:
        nonsingular = all(
            bool(is_definite(Q))
            or (singular is None and (not linear or np.linalg.matrix_rank(balance(F)[0]) == len(F)))
            for pieces in of_nodes
            for F, Q in pieces
        )
    elif not linear:
        nonsingular = singular is None or all(bool(is_definite(Q)) for ((_, Q), *_) in of_nodes)
    else:
        # (A, Q) is controllable if and only if (A', Q) is observable.
        nonsingular = singular is None or all(
            hidden_mode(A.T, outputs_of(Q)) is None for ((A, Q), *_) in of_nodes
        )
    if not nonsingular:
        value = "a singular F"
        if singular is not None:
            least = float(np.linalg.eigvalsh(scenario.initial_estimate(singular)[1])[0])
            value = f"a singular one at node {singular} (least eigenvalue {least:.3g})"
        noise = "a positive definite Q" if scenario.slotted else "a B that drives every state"
        rule = f"must be positive definite for the {filter_name(scenario)}, which inverts "
        rule += "covariances, where the noise does not drive every state"
        raise ScenarioError("filter.cov", rule, value, f"give filter.cov, or {noise}")


def _check_ways(scenario: DerivedScenario) -> None:
    topology, N = scenario.topology, len(scenario.nodes)
    rows, columns = topology.direction_ends.T
    links = scipy.sparse.csr_array((np.ones(len(rows)), (rows, columns)), shape=(N, N))
    # Strongly connected: node 0 reaches all, and all reach node 0.
    for one_way, text in (
        (links, "no way from node {0} to {1}"),
        (links.T, "no way from node {1} to {0}"),
    ):
        reached = scipy.sparse.csgraph.breadth_first_order(
            one_way.tocsr(), 0, return_predecessors=False
        )
        missed = np.setdiff1d(np.arange(N), reached)
        if missed.size:
            rule = f"must lead from every node to every other for the {filter_name(scenario)}, "
            rule += "whose sums otherwise gather at some nodes"
            value = text.format(scenario.nodes[0], scenario.nodes[missed[0]])
            raise ScenarioError("network.graph", rule, value, f"add edges, or {ANOTHER}")


def _check_heard(scenario: DerivedScenario) -> None:
    heard = {sender for sender, _ in scenario.topology.directions}
    for k, sensor in enumerate(scenario.sensors):
        for node in sensor.nodes:
            if node not in heard:
                rule = f"must be nodes that others hear for the {filter_name(scenario)}, whose "
                rule += "nodes use only the readings that they send"
                key, remedy = f"{scenario.sensor_key(k)}.nodes", f"add a link from it, or {ANOTHER}"
                raise ScenarioError(key, rule, node, remedy)


SAMPLING = 'sampling = { kind = "periodic", period = ... }'


def filter_name(scenario: DerivedScenario) -> str:
    """Return what messages call the filter: its kind, and that of the one that it wraps."""
    algorithm = scenario.filter.algorithm
    filters = [kind_name(part) for part in walk(algorithm) if isinstance(part, Filter)]
    return " around ".join([f"{filters[0]} filter", *filters[1:]])


def check_time(scenario: DerivedScenario) -> None:
    """Raise ScenarioError if filter or activation need slots over a diffusion, or the reverse."""
    algorithm, slotted = scenario.node_filter, scenario.slotted
    remedy = "change the plant or choose another kind"
    # A filter runs in slots if it has a ``schedule`` of their phases, and in continuous time if it
    # names ``clocks`` that may make it send, or never sends.
    if slotted:
        fits = algorithm.timing.schedule is not None
    else:
        fits = bool(algorithm.timing.clocks) or not algorithm.timing.talks
    if not fits:
        rule = explain_time_mismatch(slotted)
        raise ScenarioError("filter.kind", rule, name_of("filter", algorithm), remedy)
    activation = scenario.network.activation
    if activation is not None and isinstance(activation, SlotActivation) != slotted:
        kind = name_of("activation", activation)
        raise ScenarioError("network.activation.kind", explain_time_mismatch(slotted), kind, remedy)


def check_activation(scenario: DerivedScenario) -> None:
    """Raise ScenarioError unless clocks suit filter, graph and sensors; not in slots."""
    clock, topology = scenario.network.activation, scenario.topology
    node_filter = scenario.node_filter
    if not isinstance(clock, LinkClock) or not node_filter.timing.talks:
        return
    name = filter_name(scenario)
    if type(clock).entities not in (LinkClock.entities, OnReadings.entities):
        rule = f"{type(clock).__name__}.entities is never called: at says who has a clock"
        kind = name_of("activation", clock)
        raise ScenarioError("network.activation.kind", rule, kind, "give the others no ticks")
    if topology.directed and (clock.at == "links" or node_filter.timing.clocks == ("links",)):
        remedies = [
            f'at = "{at}"' for at in ("directions", "nodes") if at in node_filter.timing.clocks
        ]
        rule = f"must be false for the {name} at links, which work both ways"
        remedy = " or ".join(["give an undirected graph", *remedies])
        raise ScenarioError("network.graph.directed", rule, True, remedy)
    if clock.at not in node_filter.timing.clocks:
        clocks, at = node_filter.timing.clocks, clock.at
        settings = [f'at = "{one}"' for one in clocks if one != "readings"]
        if isinstance(clock, Contacts) and "nodes" in clocks:
            settings[settings.index('at = "nodes"')] += " of another kind than contacts"
        settings += ['kind = "readings"'] if "readings" in clocks else []
        key = "kind" if at == "readings" else "at"
        rule, remedy = f"must be one that the {name} runs under", "write that, or change the filter"
        listed = " or ".join(settings)
        raise ScenarioError(f"network.activation.{key}", f"{rule}: {listed}", at, remedy)
    # A filter that needs samples says so itself, of the sensors that there are.
    says_so = bool(scenario.sensors) and node_filter.needs.samples
    if clock.at == "readings" and not says_so and not any(map(takes_samples, scenario.sensors)):
        rule = "needs a sensor that takes samples, and there is none"
        remedy = f"add {SAMPLING} to a sensor, or choose clocks"
        raise ScenarioError("network.activation.kind", rule, "readings", remedy)
