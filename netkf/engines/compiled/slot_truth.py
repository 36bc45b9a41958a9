"""The true states of R runs in slots: drawn by kernels, or recorded and the same in all runs."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from netkf.engines.compiled.slot_setup import SlotSetup
from netkf.linalg.arrays import FloatArray
from netkf.linalg.lanes import LANES, MANY, aligned, blocks_of, in_lanes, unset
from netkf.plants.maps import NonlinearPlant
from netkf.plants.slot_paths import MapPaths, Path, draw_map_paths, draw_paths, draw_starts
from netkf.rng.numbers import normal_ziggurat
from netkf.rng.streams import Streams
from netkf.scenario.scenario import Scenario


class SlotTruth:
    """The true states of R runs of one scenario, of some slots after the other."""

    def __init__(self, scenario: Scenario, setup: SlotSetup, streams: Streams) -> None:
        self._scenario, self._setup = scenario, setup
        self._blocks = blocks_of(streams.runs)
        plant = scenario.slot_plant
        self._recorded: Any = None
        self._path: Path | MapPaths | None = None
        self.is_drawn = bool(plant.is_random)
        if not self.is_drawn:
            # A recorded truth is the same in all runs.
            self._recorded = scenario.slot_truth(Streams(streams.seed, streams.replica))
            return
        self._streams = streams.states("plant", [()])
        x, origin = (aligned((self._blocks, setup.n, LANES)) for _ in range(2))
        # C-contiguous copies, whatever the plant gives: kernels are compiled for one memory layout.
        mean, root = (np.array(part, order="C") for part in (plant.start_mean, plant.start_root))
        scratch = np.zeros((setup.n, LANES))
        draw_starts(MANY, self._streams, normal_ziggurat(), mean, root, scratch, x)
        if isinstance(plant, NonlinearPlant):
            self._map = plant.functions[0]
            self._path = MapPaths(
                self._map.address, plant.inputs(setup.slots + 1), plant.period,
                np.stack(plant.noise_roots),
                np.array(plant.noise_slots, dtype=np.int64), x, *np.zeros((2, setup.n)),
            )  # fmt: skip
            return
        F = np.array(self._scenario.linear_plant.F, order="C")
        self._path = Path(F, np.array(plant.noise_root, order="C"), setup.frame, x, origin)
        self._changes = {
            slot: (np.array(piece.F, order="C"), np.array(piece.noise_root, order="C"))
            for slot, piece in zip(plant.change_slots, plant.pieces[1:], strict=True)
        }

    def states(self, first: int, count: int) -> tuple[FloatArray, FloatArray, np.ndarray]:
        """Return local and absolute states (B, S, n, L) of ``count`` slots from number ``first``
        on, behind the last ones, and (S,) bool: in which of them the origin moves.
        """
        setup, stop = self._setup, first + count
        slots = range(first, stop)
        rebased = np.zeros(count, dtype=bool)
        if self._path is None:
            given = [(self._recorded.local(slot), self._recorded.absolute(slot)) for slot in slots]
            local, absolute = (
                in_lanes(np.stack(part), self._blocks) for part in zip(*given, strict=True)
            )
            return local, absolute, rebased
        # At the end of a frame the origin moves to the state.
        if setup.frame:
            rebased = np.array([slot > 0 and slot % setup.frame == 0 for slot in slots])
        if isinstance(self._path, MapPaths):
            local = unset((self._blocks, count, setup.n, LANES))
            scratch = aligned((self._path.roots.shape[2], LANES))
            draw_map_paths(
                MANY, self._path, self._streams, normal_ziggurat(), first, scratch, local
            )
            self._map.raise_error()
            return local, local, rebased
        cuts = [slot for slot in self._changes if first < slot < stop]
        ends = itertools.pairwise([first, *cuts, stop])
        parts = [self._piece_of_path(*part) for part in ends]
        local, absolute = parts[0]
        # Plants that change have no frames.
        if len(parts) > 1:
            local = absolute = unset((self._blocks, count, setup.n, LANES))
            np.concatenate([part for part, _ in parts], axis=1, out=local)
        if (responses := self._scenario.input_responses) is not None:
            believed, surprise = (
                None if one is None else one.states(np.array(slots))[..., None] for one in responses
            )
            if surprise is not None:
                local += surprise
            if believed is not None:
                absolute = absolute + believed
        return local, absolute, rebased

    def _piece_of_path(self, first: int, stop: int) -> tuple[FloatArray, FloatArray]:
        """Return local and absolute states (B, S, n, L) of slots between two changes."""
        assert isinstance(self._path, Path)
        if first in self._changes:
            F, root = self._changes[first]
            self._path = self._path._replace(F=F, root=root)
        shape = self._blocks, stop - first, self._setup.n, LANES
        local: FloatArray = unset(shape)
        # Without frames both are the same array.
        absolute: FloatArray = unset(shape) if self._setup.frame else local
        draw_path(self._path, self._streams, local, absolute, first)
        return local, absolute


def draw_path(
    path: Path, streams: np.ndarray, local: FloatArray, absolute: FloatArray, first: int = 0
) -> None:
    """Draw the states (B, S, n, L) of a ``path`` in S slots from number ``first`` on."""
    scratch = aligned((2, max(path.root.shape), LANES))
    draw_paths(MANY, path, streams, normal_ziggurat(), first, scratch, local, absolute)
