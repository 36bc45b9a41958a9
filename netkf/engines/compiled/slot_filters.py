"""Filters in slots as records: what the loop needs, made once for R runs."""

from __future__ import annotations

import bisect
import itertools
from functools import cached_property
from typing import Any

import numpy as np

from netkf.algorithms.kernels.at_rest import run_at_rest
from netkf.algorithms.kernels.gates import gate_tables, own_sizes
from netkf.algorithms.kernels.maps import MapRun
from netkf.algorithms.kernels.pairs import Pairs, no_pairs
from netkf.algorithms.kernels.run import Estimates, SlotModelArrays, SlotRun, size_of
from netkf.algorithms.models import MapModel, changing_models
from netkf.algorithms.records import Kernels, make_records
from netkf.engines.compiled.quantiser import PayloadQuantiser
from netkf.engines.compiled.slot_loop import (
    EXCHANGE,
    PREDICT,
    SENSE,
    SlotPlan,
    SlotSamples,
    SlotVerbs,
    any_slot_run,
    slot_loop,
    slot_verbs,
)
from netkf.engines.compiled.slot_setup import SlotSetup
from netkf.linalg.addresses import NOTHING, address_of, call_kernel, viewed_as
from netkf.linalg.arrays import FloatArray
from netkf.linalg.lanes import LANES, MANY, aligned

_UNDECIDED: dict[str, Any] = {
    "refused": np.zeros((0,) * 4, dtype=np.uint8),
    "speaks": np.zeros((0,) * 5, dtype=np.uint8),
    "clipped": np.zeros((0,) * 5, dtype=np.int32),
}
"""Fields of a plan without gates whose messages are exact."""
HELD = 128
"""Numbers of P that are held until they are written together."""
_KINDS = {"predict": PREDICT, "sense": SENSE, "exchange": EXCHANGE}


class SlotFilters:
    """H filters in B blocks of L runs, whose verbs are kernels."""

    def __init__(
        self,
        setup: SlotSetup,
        kernels: Kernels,
        blocks: int,
        with_means: bool = True,
        active: int = LANES,
        pairs: Pairs | None = None,
    ) -> None:
        """Make the filters at time 0; unless ``with_means`` all estimates are zero. At most
        ``active`` lanes of a block have runs; ``pairs`` are readings of these, where there are any.
        """
        self._setup, self.kernels = setup, kernels
        H, W, n = setup.estimators, len(setup.links.sender), setup.width
        means = setup.xhat if with_means else np.zeros(setup.xhat.shape)
        self.records = make_records(
            setup.algorithm,
            list(zip(means, setup.root, strict=True)),
            setup.infos,
            changing_models(setup.model_pieces, setup.followed_slots),
            links=W,
            messages=H + W if kernels.addressed or len(setup.common) else H,
            blocks=blocks,
            lanes=LANES,
        )
        self.quantiser = PayloadQuantiser(setup.quantise, self.records)
        self._models = self._models_of(active)
        self._run = self._run_of(no_pairs() if pairs is None else pairs, active)
        words = len(self._models[0].memory)
        memories = [model.memory for model in self._models] if setup.own_models else []
        # None where the model of the run is that of all filters.
        self._memories = np.array(memories, dtype=np.int64).reshape(-1, words)
        # Small samples are written many at a time. L entries are copied at once, so that the last
        # copy may go beyond the last entry.
        room = max(1, HELD // (H * n * n))
        for_means, for_roots = room * H * n + LANES, room * H * n * n + LANES
        self.sample_scratch: dict[str, Any] = {
            "sampled_xhat": aligned((for_means, LANES)),
            "sampled_error": aligned((for_means, LANES)),
            "sampled_P": aligned((for_roots, LANES)),
            "room": room,
            "first": 0,
            "held": 0,
            "runs": np.zeros(LANES, dtype=np.int64),
        }
        self._lay_out_stages()
        if setup.forgets:
            _ = self._start

    @cached_property
    def _verbs(self) -> SlotVerbs:
        talks, linear = EXCHANGE in self._stages, len(self._run.nonlinear.kind) == 0
        return slot_verbs(self.kernels, self.records.struct, self._run, talks, linear)

    def _models_of(self, active: int) -> list[Any]:
        """Return the models of all nodes, or the one that they share."""
        setup = self._setup
        if not isinstance(setup.models[0], MapModel):
            tables = setup.tables[0]
            return [SlotModelArrays(F=F.copy(), root_Q=root_Q.copy()) for F, root_Q in tables]
        delay = 0 if setup.algorithm.timing.predicts else 1
        models = setup.models[: len(setup.tables[0])]
        return [m.tables(LANES, active, delay, setup.width) for m in models]

    def _run_of(self, pairs: Pairs, active: int) -> Any:
        """Return what surrounds the nodes, before any slot."""
        setup, n = self._setup, self._setup.width
        size = size_of(n, self.kernels.unrolled)
        cls: Any = MapRun if isinstance(setup.models[0], MapModel) else SlotRun
        cls = cls.of_size(n) if isinstance(size, tuple) else cls
        # Inbox: a node hears at most all of its links.
        most = max(1, int(np.diff(setup.links.first).max(initial=0)))
        own = {"common": setup.common, "pairs": pairs, "gap": setup.period}
        if setup.gate is not None:
            own["gate"] = gate_tables(
                setup.gate,
                n,
                (LANES, active),
                [[place for *place, _ in parts] for parts in setup.gated_parts],
                own_sizes(setup.infos, n, setup.algorithm.timing.pooled),
            )
        return cls(
            **run_at_rest(n, LANES, most) | own,
            size=size,
            lanes=MANY,
            model=self._models[0],
            first=setup.links.first,
            sender=setup.links.sender,
            opposite=setup.opposite,
            weight=setup.links.weight,
            y=np.zeros((1, 1, LANES)),
            H=np.zeros((1, 1, 1, LANES)),
            rows=setup.rows,
            matrix=np.arange(setup.estimators),
        )

    def _lay_out_stages(self) -> None:
        """Set the stages of a slot, with the phase and the number of steps of each."""
        timing = self._setup.algorithm.timing
        stages = [kind for kind in timing.schedule or () if timing.talks or kind != "exchange"]
        self._stages = np.array([_KINDS[kind] for kind in stages], dtype=np.int64)
        exchange = np.cumsum(self._stages == EXCHANGE) - 1
        self._phases = np.where(self._stages == EXCHANGE, exchange, -1)
        self._steps = np.array(
            [timing.steps(phase) if phase >= 0 else 0 for phase in self._phases.tolist()],
            dtype=np.int64,
        )

    @cached_property
    def _start(self) -> dict[str, np.ndarray]:
        return {name: array.copy() for name, array in self.records.arrays.items()}

    def restart(self, h: int, moved: FloatArray) -> None:
        """Let filter ``h`` begin again, in coordinates that have ``moved`` (n,) since slot 0."""
        for name, array in self.records.arrays.items():
            place = self.records.place(name, h, self._setup.links.first)
            array[:, place] = self._start[name][:, place]
        self.begin_elsewhere(h, 0, moved)

    def begin_elsewhere(self, h: int, lane: int, moved: FloatArray) -> None:
        """Let filter ``h`` begin ``moved`` (n,) away from its start, in a lane of block 0."""
        if moved.any():
            first = {name: array[0] for name, array in self.records.arrays.items()}
            self.records.begin_elsewhere(first, h, lane, moved)

    def observe(self) -> None:
        """Write into the record of each node of the first block what exchanges conserve, now."""
        for h in range(self._setup.estimators):
            call_kernel(self.kernels.observe, self.records.struct, h, run=self._run)

    def set_rows(self, rows: Any) -> None:
        """Let readings have nonlinear rows, ``nonlinear_rows.NonlinearRows``."""
        self._run.nonlinear = rows

    def simulate(self, y: FloatArray, H: FloatArray, samples: SlotSamples, **drawn: Any) -> None:
        """Simulate the slots of a plan, ``drawn`` by name, with whitened readings ``y`` and H."""
        self._run.y = y.reshape(-1, *y.shape[3:])
        self._run.H = H.reshape(-1, *H.shape[3:])
        plan = SlotPlan(
            stages=self._stages,
            phases=self._phases,
            steps=self._steps,
            predicts=self._setup.algorithm.timing.predicts,
            direction=self._setup.links.direction,
            varies=H.shape[0] * H.shape[1] > 1,
            models=self._memories,
            quantiser=self.quantiser.struct,
            start=0,
            end=0,
            **_UNDECIDED | drawn,
        )
        setup, record, count = self._setup, self.records.struct, len(plan.sensed)
        verbs, run = self._verbs, any_slot_run(self._run)
        if verbs.shift == NOTHING and plan.rebased.any():
            verbs.shift = address_of(self.kernels.shift, record, self._run)
        step = 1 if self.kernels.slotwise else max(1, count)
        assert setup.algorithm.kernels is not None
        prepare = setup.algorithm.kernels.prepare
        slots = [slot - plan.first for slot in setup.model_slots]
        starts = sorted({*range(0, count, step), *(slot for slot in slots if 0 < slot < count)})
        for start, end in itertools.pairwise([*starts, count]):
            piece, first = bisect.bisect_right(slots, start), plan.first + start
            if len(setup.tables) > 1:
                for model, tables in zip(self._models, setup.tables[piece], strict=True):
                    model.F[:], model.root_Q[:] = tables
            models = setup.model_pieces[piece]
            prepare(setup.algorithm, record, setup.infos, models, first, end - start)
            plan.start, plan.end = start, end
            seen = viewed_as(Estimates, record)
            slot_loop(seen, self.records.memories, run, plan, samples, verbs)
        for believed in setup.models if isinstance(setup.models[0], MapModel) else ():
            believed.raise_error()
        if setup.nonlinear is not None:
            setup.nonlinear.raise_error()
