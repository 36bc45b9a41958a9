"""The truth as blocks, each a plant that all nodes share or that one node owns.

The blocks together are one linear system, the *stacked* plant, whose state is that of all blocks,
one after the other: that of a scenario with ``[[plants]]`` is an ordinary plant.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np

from netkf.core.errors import ScenarioError, errors_under, quote, suggest_nearest
from netkf.core.fields import (
    Component,
    Rule,
    field,
    instance_of,
    integer,
    list_of,
    matrix,
    node_id,
    text,
    vector,
)
from netkf.core.instants import TimeGrid
from netkf.core.places import Place
from netkf.linalg.arrays import FloatArray, block_diagonal
from netkf.plants.changes import matrices_of_pieces
from netkf.plants.curves import NonlinearDiffusion
from netkf.plants.diffusion import Diffusion
from netkf.plants.dynamics import BlockPart, StackedDynamics
from netkf.plants.inputs import Exogenous, Input
from netkf.plants.linear import LinearPlant, SlotPlant
from netkf.plants.maps import NonlinearPlant
from netkf.plants.plant import Plant
from netkf.plants.recorded import RecordedDiffusion, RecordedPlant
from netkf.plants.states import StackedStates


class Coupling(NamedTuple):
    """A block is driven by others: ``A`` (n, n') times the state of each block of ``origin``, the
    name of a shared block or of the block of that name on the same node, or ids of nodes.
    """

    origin: str | tuple[int, ...]
    A: FloatArray


def _convert_coupling(value: Any) -> tuple[Coupling, ...]:
    if not isinstance(value, (list, tuple)):
        raise TypeError
    return tuple(_as_coupling(f"[{k}]", item) for k, item in enumerate(value))


def _as_coupling(key: str, value: Any) -> Coupling:
    if isinstance(value, Coupling):
        return value
    names = {"from", "A"}
    if not isinstance(value, Mapping) or not set(value) >= names:
        rule, remedy = "must be a table with the keys from and A", "write { from = ..., A = ... }"
        raise ScenarioError(key, rule, value, remedy)
    for name in set(value) - names:
        raise ScenarioError(f"{key}.{name}", "is not a key here", value[name], "keys are from, A")
    origin: Any = value["from"]
    of_nodes = text if isinstance(origin, str) else list_of(node_id(), "node ids")
    return Coupling(of_nodes(f"{key}.from", origin), matrix(f"{key}.A", value["A"]))


_couplings = Rule(
    "must be a list of tables { from = ..., A = ... }",
    _convert_coupling,
    'write coupling = [{ from = "name", A = ... }]',
    {"type": "array", "items": {"type": "object", "required": ["from", "A"]}},
)


@dataclass(frozen=True, eq=False)
class Block(Component):
    """One entry of ``[[plants]]``: a plant that all nodes share, or that each of ``nodes`` has.

    name      what sensors and results call it
    plant     its dynamics: a Diffusion, a LinearPlant or a NonlinearPlant
    nodes     the nodes of which each has one of its own, with independent noise and start; by
              default all share one
    coupling  by which other blocks it is driven: [{ from = "name" or node ids, A = ... }], the
              blocks of that name on the same node or shared, or the own blocks of these nodes;
              A (n, n') multiplies the state of each
    position  which of its entries, counted from 0, are the coordinates of its node
    means     the mean of x(0) of each of ``nodes``, where they differ
    """

    name: str = field(text)
    plant: Plant = field(instance_of(Plant))
    nodes: tuple[int, ...] | None = field(list_of(node_id(), "node ids"), default=None)
    coupling: tuple[Coupling, ...] = field(_couplings, default=())
    position: tuple[int, ...] | None = field(
        list_of(integer(low=0), "numbers of entries"), default=None
    )
    means: tuple[FloatArray, ...] | None = field(list_of(vector, "vectors"), default=None)

    @cached_property
    def copies(self) -> tuple[Any, ...]:
        """The plant of each of ``nodes``, or the one that all share."""
        plants = tuple(self.plant.owned_by(node) for node in self.nodes or (None,))
        for plant, mean in zip(plants, self.means or (), strict=self.means is not None):
            object.__setattr__(plant, "mean", mean)
        return plants

    def check_means(self) -> None:
        """Raise ScenarioError unless ``means`` has one for each of ``nodes``, in place of mean."""
        n, wanted = self.plant.n, len(self.nodes or ())
        given = [mean.shape for mean in self.means or ()]
        if self.means is not None and (given != [(n,)] * wanted or self.plant.mean is not None):
            rule = f"must be {wanted} lists of {n}, one for each of nodes, in place of mean"
            raise ScenarioError("means", rule, list(self.means), "correct them, or remove mean")

    def check_position(self) -> None:
        """Raise ScenarioError unless ``position`` names different entries of blocks of nodes."""
        if self.position is None:
            return
        n, given = self.plant.n, list(self.position)
        if self.nodes is None:
            rule = "cannot be that of a block that all nodes share"
            raise ScenarioError("position", rule, given, "add nodes = [...], one block for each")
        if max(given) >= n or len(set(given)) < len(given):
            rule = f"must be different entries of the {n} states of the block, 0 .. {n - 1}"
            raise ScenarioError("position", rule, given, "correct the numbers")


class Layout:
    """The places of all blocks in the stacked state, in the order of ``[[plants]]`` and nodes."""

    def __init__(self, blocks: Sequence[Block]) -> None:
        """Raises ScenarioError for names and nodes that occur twice."""
        self.places: tuple[Place, ...] = tuple(_lay_out(blocks))
        self.n = sum(place.n for place in self.places)
        self.names = tuple(dict.fromkeys(place.name for place in self.places))
        self._by_key = {(place.name, place.node): place for place in self.places}

    def find(self, name: str, node: int) -> Place | None:
        """Return the block ``name`` that ``node`` (id) owns or that all share, None without one."""
        return self._by_key.get((name, node), self._by_key.get((name, None)))

    def require(self, name: object, node: int, whose: str = "") -> Place:
        """Return block ``name`` of ``node``, ``whose`` in messages; ScenarioError without one."""
        if name not in self.names:
            listed = ", ".join(f'"{one}"' for one in self.names)
            remedy = f"{suggest_nearest(name, self.names)}names are {listed}"
            raise ScenarioError("", "must be the name of one of [[plants]]", name, remedy)
        place = self.find(str(name), node)
        if place is None:
            owners = [one.node for one in self.places if one.name == name]
            rule = f"must be a block that {whose or f'node {node}'} has"
            raise ScenarioError("", rule, name, f"nodes with it are {', '.join(map(str, owners))}")
        return place

    def owned(self, node: int) -> tuple[Place, ...]:
        """Return the blocks that ``node`` (id) owns."""
        return tuple(place for place in self.places if place.node == node)

    @property
    def shared(self) -> tuple[Place, ...]:
        """The blocks that all nodes share."""
        return tuple(place for place in self.places if place.node is None)

    def embed(self, parts: Iterable[tuple[Place, FloatArray]]) -> FloatArray:
        """Return the matrix (p, n) with the given (p, n') at their blocks, and zeros elsewhere."""
        parts = list(parts)
        whole = np.zeros((len(parts[0][1]), self.n))
        for place, H in parts:
            whole[:, place.entries] += H
        return whole


def _lay_out(blocks: Sequence[Block]) -> Iterator[Place]:
    first, seen = 0, set[tuple[str, int | None]]()
    names = [block.name for block in blocks]
    for k, block in enumerate(blocks):
        others = [one for one in blocks if one.name == block.name]
        if len(others) > 1 and any(one.nodes is None for one in others):
            rule = "must be unique, or all entries of that name must have nodes"
            raise ScenarioError(f"[{k}].name", rule, block.name, "give the block another name")
        for node in block.nodes or (None,):
            if (block.name, node) in seen:
                remedy = (
                    f"name it once, or give the block another name than [{names.index(block.name)}]"
                )
                rule = f"must not own two blocks {quote(block.name)}"
                raise ScenarioError(f"[{k}].nodes", rule, node, remedy)
            seen.add((block.name, node))
            yield Place(block.name, node, first, block.plant.n)
            first += block.plant.n


@dataclass(frozen=True, eq=False)
class StackedInput(Input):
    """The ``inputs`` (u_1, u_2, ...) of several blocks together; G (n, m) is that of all states,
    None if blocks are not linear.
    """

    inputs: tuple[Input, ...] = field(list_of(instance_of(Input), "inputs"))

    def on_grid(self, grid: TimeGrid) -> Self:
        """Return the input with its instants on the ``grid``."""
        stacked = super().on_grid(grid)
        object.__setattr__(stacked, "inputs", tuple(one.on_grid(grid) for one in self.inputs))
        return stacked

    @cached_property
    def exogenous(self) -> Exogenous:
        """The systems of all inputs side by side, which begins anew where any of them jumps."""
        parts = [one.exogenous for one in self.inputs]
        times = np.unique(np.concatenate([part.times for part in parts]))
        S, C = (block_diagonal([getattr(part, name) for part in parts]) for name in "SC")
        return Exogenous(times, S, C, np.concatenate([p.states(times) for p in parts], axis=1))

    def values(self, times: FloatArray) -> FloatArray:
        """Return u (K, m) at K ``times`` (K,) in seconds."""
        return np.concatenate([one.values(times) for one in self.inputs], axis=1)

    def known_to(self, model: Any) -> FloatArray:
        """Return 1 for each component that filters with the ``model`` know, else 0, (m,)."""
        return np.concatenate([one.known_to(model) for one in self.inputs])


@dataclass(frozen=True, eq=False)
class PieceNumber(Input):
    """The number of the piece that holds of a linear block whose matrices change at ``times``
    (seconds), told as an input: what integrates a plant begins anew where its input jumps.
    """

    times: FloatArray = field(vector)

    @cached_property
    def exogenous(self) -> Exogenous:
        """The system whose output is the number, which counts the changes."""
        times, one = self.time_grid.snap(self.times), np.ones((1, 1))
        return Exogenous(times, 0.0 * one, one, np.arange(1.0, len(times) + 1.0)[:, None])

    def known_to(self, model: Any) -> FloatArray:
        """Return 1 if filters with the ``model`` follow changes, else 0, (1,)."""
        return np.full(1, float(model.schedule))


def _copies(blocks: Sequence[Block]) -> list[tuple[int, Any]]:
    """Return the number of the entry of each place of a layout, and its plant."""
    return [(k, plant) for k, block in enumerate(blocks) for plant in block.copies]


def _plants(blocks: Sequence[Block]) -> list[Any]:
    return [plant for _, plant in _copies(blocks)]


def stack(blocks: Sequence[Block], layout: Layout) -> Plant:
    """Return the plant whose state is that of all ``blocks``, at the places of their ``layout``.

    Raises ScenarioError if blocks belong to different models of time, or a coupling does not fit.
    """
    slotted = isinstance(blocks[0].plant, SlotPlant)
    for k, block in enumerate(blocks):
        if not isinstance(
            block.plant, LinearPlant | NonlinearPlant | Diffusion | NonlinearDiffusion
        ):
            rule = "must be linear, nonlinear or a diffusion: other plants cannot be blocks"
            raise ScenarioError(f"[{k}].kind", rule, block.name, "give F, Q, period, or A, B")
        if isinstance(block.plant, SlotPlant) != slotted:
            rule = "must be in slots as the others are, or in continuous time"
            raise ScenarioError(f"[{k}]", rule, block.name, "give all F, Q, period, or all A, B")
        _check_shapes(k, block)
        with errors_under(f"[{k}]"):
            block.check_means()
            for plant in block.copies:
                plant.read()
            if block.plant.linear:
                _check_gains(block.copies[0])
    plants = _plants(blocks)
    is_random = all(plant.is_random for plant in plants)
    if not all(plant.linear for plant in plants):
        return _stack_nonlinear(blocks, layout)
    mean = np.concatenate([plant.start_mean for plant in plants])
    cov = block_diagonal([plant.start_cov for plant in plants])
    parts: dict[str, Any] = {
        **_stacked_matrices(blocks, layout),
        **{"mean": mean, "cov": cov, "input": _stacked_input(blocks, layout)},
        "schedule": _stacked_schedule(blocks, layout),
    }
    if not is_random:
        parts["path"] = StackedStates(plants)
    if slotted:
        parts["period"] = _one(blocks, "period")
        return LinearPlant(**parts) if is_random else RecordedPlant(**parts)
    parts["sensing_period"] = _one(blocks, "sensing_period")
    return Diffusion(**parts) if is_random else RecordedDiffusion(**parts)


def _stack_nonlinear(blocks: Sequence[Block], layout: Layout) -> Plant:
    slotted = isinstance(blocks[0].plant, SlotPlant)
    for k, block in enumerate(blocks):
        if not block.plant.linear:
            with errors_under(f"[{k}]"):
                block.copies[0].check_dynamics()
    plants = _plants(blocks)
    parts, inputs_of_parts = zip(*map(_part, plants), strict=True)
    inputs = tuple(itertools.chain(*inputs_of_parts))
    coupling = np.zeros((layout.n, layout.n))
    _add_couplings(coupling, blocks, layout)
    shared: dict[str, Any] = {
        "f": StackedDynamics(parts, coupling),
        "mean": np.concatenate([plant.start_mean for plant in plants]),
        "cov": block_diagonal([plant.start_cov for plant in plants]),
        "input": StackedInput(inputs=inputs) if inputs else None,
    }
    if not all(plant.is_random for plant in plants):
        shared["path"] = StackedStates(plants)
    name = "Q" if slotted else "B"
    noise = block_diagonal([getattr(plant, name) for plant in plants])
    starts = {change.start for plant in plants for change in plant.schedule}
    shared["schedule"] = [
        {"from": start, name: block_diagonal([_noise_at(plant, name, start) for plant in plants])}
        for start in sorted(starts)
    ]
    if slotted:
        return NonlinearPlant(Q=noise, period=_one(blocks, "period"), **shared)
    curved = [block for block in blocks if not block.plant.linear]
    return NonlinearDiffusion(B=noise, step=_one(curved, "step"), **shared)


def _part(plant: Any) -> tuple[BlockPart, list[Input]]:
    """Return the dynamics of a block beside others that are not linear, and what drives it."""
    inputs: list[Input] = [] if plant.input is None else [plant.input]
    if not plant.linear:
        return BlockPart(plant.f, plant.n, sum(u.m for u in inputs)), inputs
    gains = np.array(plant.input_gains) if inputs else None
    if len(plant.pieces) > 1:
        inputs.append(PieceNumber(times=plant.schedule_times))
    name = "F" if isinstance(plant, SlotPlant) else "A"
    matrices = np.array([getattr(piece, name) for piece in plant.pieces])
    return BlockPart(None, plant.n, sum(u.m for u in inputs), matrices, gains), inputs


def _noise_at(plant: Any, name: str, time: float) -> FloatArray:
    """Return Q or B, by ``name``, of a plant at a ``time`` (seconds)."""
    k = sum(change.start <= time for change in plant.schedule)
    noise: FloatArray = matrices_of_pieces({name: getattr(plant, name)}, plant.schedule)[k][name]
    return noise


def _stacked_matrices(blocks: Sequence[Block], layout: Layout) -> dict[str, Any]:
    """Return F and Q, or A and B, of all blocks together."""
    plants = _plants(blocks)
    names = ("F", "Q") if isinstance(plants[0], LinearPlant) else ("A", "B")
    M, noise = (block_diagonal([np.asarray(getattr(p, name)) for p in plants]) for name in names)
    _add_couplings(M, blocks, layout)
    return dict(zip(names, (M, noise), strict=True))


def _stacked_schedule(blocks: Sequence[Block], layout: Layout) -> list[dict[str, Any]]:
    plants: list[Any] = [block.plant for block in blocks]
    schedule = []
    for start in sorted({change.start for plant in plants for change in plant.schedule}):
        present = blocks_from(blocks, start)
        entry = {"from": start, **_stacked_matrices(present, layout)}
        if (stacked := _stacked_input(present, layout)) is not None:
            entry["G"] = stacked.G
        schedule.append(entry)
    return schedule


def blocks_from(blocks: Sequence[Block], time: float, **keys: Any) -> list[Block]:
    """Return linear ``blocks`` that are always as they are from ``time`` (seconds) on, their plants
    with other values of some ``keys``.
    """
    present = []
    for block in blocks:
        plant: Any = block.plant
        k = sum(change.start <= time for change in plant.schedule)
        u = plant.input
        if u is not None:
            u = dataclasses.replace(u, G=plant.input_gains[k])
        names = "FQ" if isinstance(plant, SlotPlant) else "AB"
        matrices = {name: getattr(plant.pieces[k], name) for name in names}
        piece = dataclasses.replace(plant, **matrices, **keys, input=u, schedule=())
        present.append(dataclasses.replace(block, plant=piece))
    return present


def _check_shapes(k: int, block: Block) -> None:
    plant: Any = block.plant
    n, is_slotted = plant.n, isinstance(plant, SlotPlant)
    shapes: dict[str, tuple[int, ...]] = {"mean": (n,), "cov": (n, n)}
    shapes |= {"Q": (n, n)} if is_slotted else {"B": (n, plant.B.shape[1])}
    given = [(name, name, getattr(plant, name)) for name in shapes]
    for c, change in enumerate(plant.schedule):
        given += [(f"schedule[{c}].{name}", name, one) for name, one in change.matrices.items()]
    shapes |= {"F": (n, n), "A": (n, n)}
    for key, name, value in given:
        if name == "G":
            continue  # as wide as the input, see _check_gains
        is_wide = name == "B" and plant.linear
        shape = (n, value.shape[-1]) if is_wide else shapes[name]
        if value is not None and value.shape != shape:
            wanted, actual = (" x ".join(map(str, one)) for one in (shape, value.shape))
            source = ("F" if is_slotted else "A") if plant.linear else ("Q" if is_slotted else "B")
            rule = f"must be {wanted}, not {actual}, because {source} has {n} rows"
            raise ScenarioError(f"[{k}].{key}", rule, value, "correct the shape")


def _one(blocks: Sequence[Block], key: str) -> Any:
    """Return the value of a key that all plants share, None if none of them gives it."""
    values = {getattr(block.plant, key) for block in blocks} - {None}
    if len(values) > 1:
        rule = "must be the same in all entries"
        raise ScenarioError(f"[0].{key}", rule, sorted(values), "write one value")
    return values.pop() if values else None


def _stacked_input(blocks: Sequence[Block], layout: Layout) -> StackedInput | None:
    """Return what drives all blocks; None if nothing does."""
    inputs, parts = list[Input](), list[FloatArray]()
    for place, plant in zip(layout.places, _plants(blocks), strict=True):
        one = plant.input
        if one is None:
            continue
        inputs.append(one)
        parts.append(np.zeros((layout.n, one.m)))
        parts[-1][place.entries] = one.G
    return StackedInput(inputs=tuple(inputs), G=np.concatenate(parts, axis=1)) if inputs else None


def _check_gains(plant: Any) -> None:
    """Raise ScenarioError unless each G of a linear ``plant`` is that of its input."""
    given = [(f"schedule[{c}].G", p.G) for c, p in enumerate(plant.schedule) if p.G is not None]
    if plant.input is None:
        for key, G in given:
            rule = "belongs to a plant with an input"
            raise ScenarioError(key, rule, G, "add an input to this block, or leave it out")
        return
    for key, G in [("input.G", plant.input.G), *given]:
        if G is None or G.shape != (plant.n, plant.input.m):
            rule = f"must be {plant.n} x {plant.input.m}"
            raise ScenarioError(key, rule, G, "correct the shape")


def _add_couplings(M: FloatArray, blocks: Sequence[Block], layout: Layout) -> None:
    is_drawn = dict(zip(layout.places, (p.is_random for p in _plants(blocks)), strict=True))
    for place, (k, _) in zip(layout.places, _copies(blocks), strict=True):
        for c, coupling in enumerate(blocks[k].coupling):
            key = f"[{k}].coupling[{c}]"
            for origin in _origins(f"{key}.from", coupling, place, layout):
                if is_drawn[place] and not is_drawn[origin]:
                    rule = "must be drawn as this block is, not recorded or unknown"
                    remedy = "record this block too, or draw the other"
                    raise ScenarioError(f"{key}.from", rule, coupling.origin, remedy)
                if coupling.A.shape != (place.n, origin.n):
                    rule = f"must be {place.n} x {origin.n}, from the block of {origin.n} states"
                    raise ScenarioError(f"{key}.A", rule, coupling.A, "correct the shape")
                M[place.entries, origin.entries] += coupling.A


def _origins(key: str, coupling: Coupling, place: Place, layout: Layout) -> list[Place]:
    """Return the blocks by which the block at ``place`` is driven."""
    if isinstance(coupling.origin, str):
        name = coupling.origin
        found = [one for one in layout.places if one.name == name]
        # A block of a node is driven by that of the same node, and by a shared one.
        own = [one for one in found if one.node in (place.node, None)]
        if not own:
            remedy = f"{suggest_nearest(name, layout.names)}or give ids of nodes"
            raise ScenarioError(
                key, "must be a block of the same node or a shared one", name, remedy
            )
        return own
    origins = []
    for node in coupling.origin:
        if node == place.node:
            continue
        owned = layout.owned(node)
        same = [one for one in owned if one.name == place.name] or list(owned)
        if len(same) != 1:
            rule = f"must be nodes with a block {quote(place.name)} or one block in all"
            raise ScenarioError(key, rule, node, "correct the id, or couple by name")
        origins += same
    if not origins and sum(one.name == place.name for one in layout.places) == 1:
        rule = "must be other nodes: what drives a block of its own stands in A (in slots F)"
        raise ScenarioError(key, rule, coupling.origin, "correct the ids, or change the block")
    return origins
