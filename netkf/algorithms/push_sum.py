"""The push-sum filter: distributed Kalman filtering on links that fail, P Fig. 1.

A node learns the number of nodes and the information of all sensors by push-sum, one round a slot,
and its gain from them; its estimate is averaged with those of its neighbours in ``gamma`` steps.
What differs from P Fig. 1: the lost sums of (5), and of (3) and (4) under failures, are those that
keep the mass; the stop rule of step 2.3 fires when all links of a node are down and is one choice.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from netkf.algorithms import running_sums
from netkf.algorithms.filter import Exchange, Filter, Message, NodeInfo, Reading
from netkf.algorithms.kernels.mass import (
    add_gain,
    correct_root,
    keep_share,
    learn_network,
    split_mass,
)
from netkf.algorithms.kernels.root_update import lower_root, update_scratch
from netkf.algorithms.kernels.slots import (
    SlotLinks,
    SlotNodes,
    SlotPlan,
    SlotReadings,
    SlotRoom,
    SlotSamples,
    predict,
    predict_mean,
    rebase,
    show,
    whitened,
)
from netkf.algorithms.kernels.stopping import PAPER, RULES, has_stopped
from netkf.algorithms.models import SlotModel, first_root
from netkf.algorithms.registry import built_in
from netkf.algorithms.running_sums import Offer, RunningSums
from netkf.core.errors import ScenarioError
from netkf.core.fields import boolean, choice, field, integer, number, positive
from netkf.linalg.arrays import FloatArray, square_root, symmetric
from netkf.linalg.compiling import kernel

MASS, AVERAGE = 0, 1
"""The two exchanges of a slot."""

MOST_STEPS = 100_000
MOST_DOUBLINGS = 60
MAX_SPREAD = 1e14
"""The largest ``|G| |P|`` at which double precision still tells a steady covariance."""


class Network(NamedTuple):
    """What a node takes the whole network to be: ``information`` (n, n) of all sensors, G^(i) of
    P (6), the ``number`` of nodes, N^(i), and the ``root`` of P_inf where the gains are the limits.
    """

    information: FloatArray
    number: float
    root: FloatArray | None = None


class PushSumState(NamedTuple):
    """Estimate ``xhat`` (n,), z between the exchanges; ``root`` (n, n) of its covariance; ``mass``
    (2 + n^2,), the weight w, the number n~ and the information C~ of P (3)-(5); what the node makes
    of it, ``network``; whether that is frozen, ``stopped``; its nominal ``degree``.
    """

    xhat: FloatArray
    root: FloatArray
    model: Any
    mass: FloatArray
    network: Network
    stopped: bool
    degree: int

    @property
    def P(self) -> FloatArray:
        """``root root'`` (n, n)."""
        return self.root @ self.root.T


class PushSumArrays(NamedTuple):
    """Mass (R H, m) and nominal ``degree`` (H,) of the nodes; what they take the network to be,
    ``information`` (R H, n, n) and ``number`` (R H,); the information of a node ``alone``
    (H, n, n); the settings, and the root of P_inf, ``limit`` (n, n), with asymptotic gains.

    Scratch: ``share`` (H, m), ``before`` (m,), ``found`` (1, n, n), ``found_number`` (1,).
    """

    mass: FloatArray
    degree: np.ndarray
    information: FloatArray
    number: FloatArray
    alone: FloatArray
    rule: int
    tolerance: float
    delta: float
    gamma: int
    asymptotic: bool
    limit: FloatArray
    share: FloatArray
    before: FloatArray
    found: FloatArray
    found_number: FloatArray


@kernel
def push_sum_slots(
    nodes: SlotNodes,
    readings: SlotReadings,
    plan: SlotPlan,
    links: SlotLinks,
    samples: SlotSamples,
    room: SlotRoom,
    arrays: PushSumArrays,
) -> None:
    """Carry push-sum filters through the slots of a plan, P Fig. 1."""
    H = len(nodes.rows)
    for s in range(plan.up.shape[1]):
        # Step 3: with asymptotic gains the covariance is the limit, and only the mean is predicted.
        if plan.sensed[s] and not arrays.asymptotic:
            predict(nodes, room)
        for r in range(plan.up.shape[0]):
            # Step 2 before the correction, so that the gain uses what the mass of this slot says.
            if plan.exchanged[s] and not arrays.asymptotic:
                exchange_mass(arrays, plan, links, samples, room, r, s)
            if plan.sensed[s]:
                for h in range(H):
                    correct(nodes, readings, room, arrays, r, s, h)
            if plan.exchanged[s]:
                for step in range(arrays.gamma):
                    # Row 0 of ``up`` is the exchange of mass; averaging has the rows after it.
                    up = plan.up[r, s, 1 + step]
                    average(nodes.xhat, r * H, links, up, room.xhat, arrays.delta)
            if plan.sample[s] >= 0:
                # Conserved over the network: the weight sums to 1, and n~ to N.
                for h in range(H):
                    samples.conserved[r, h, 0] = arrays.mass[r * H + h, 0]
                    samples.conserved[r, h, 1] = arrays.mass[r * H + h, 1]
            show(nodes, plan, samples, r, s)
            rebase(nodes, readings, r, s)


@kernel
def exchange_mass(
    arrays: PushSumArrays,
    plan: SlotPlan,
    links: SlotLinks,
    samples: SlotSamples,
    room: SlotRoom,
    r: int,
    s: int,
) -> None:
    """One exchange of mass, P steps 2.1 to 2.3."""
    H = len(arrays.degree)
    # All shares before any mass changes: everyone sends what it had at the start of the exchange.
    for h in range(H):
        split_mass(arrays.mass, r * H + h, arrays.degree[h], arrays.share, h)
    if arrays.rule == PAPER:  # nodes that have stopped send no mass
        # The same as a link that is down, so that receivers keep the mass conserved.
        for m in range(len(links.sender)):
            if samples.stopped[r, links.sender[m]] < plan.first + s:
                plan.up[r, s, 0, links.way[m]] = 0
    for h in range(H):
        has_stopped = samples.stopped[r, h] < plan.first + s
        if has_stopped and arrays.rule == PAPER:
            # By the paper's rule a stopped node leaves the exchange altogether; its mass stays with
            # it.
            continue
        received = mix_mass(arrays, plan, links, r, s, h)
        # The safe rule goes on mixing, since other nodes still need its mass, but learns no more.
        if has_stopped:
            continue
        if learn(arrays, r * H + h, h, received == arrays.degree[h], room.moved):
            samples.stopped[r, h] = plan.first + s


@kernel
def mix_mass(
    arrays: PushSumArrays, plan: SlotPlan, links: SlotLinks, r: int, s: int, h: int
) -> int:
    """Take the mass that node ``h`` keeps and receives, P (3)-(5); return how many shares came."""
    received, k, mass, share = 0, r * len(arrays.degree) + h, arrays.mass, arrays.share
    # The mass before is kept for the stop rule.
    for i in range(mass.shape[1]):
        arrays.before[i], mass[k, i] = mass[k, i], 0.0
    for m in range(links.first[h], links.first[h + 1]):
        if plan.up[r, s, 0, links.way[m]] == 1:
            received += 1
            for i in range(mass.shape[1]):
                mass[k, i] += share[links.sender[m], i]
    # Its own share, once for itself and once for each share that did not come.
    keep_share(mass, k, share, h, arrays.degree[h] + 1 - received)
    return received


@kernel
def learn(arrays: PushSumArrays, k: int, h: int, whole: bool, work: FloatArray) -> bool:
    """P (6) for the mass of place ``k``, a node ``h`` all of whose links were up if ``whole``;
    return True if the node stops.
    """
    learn_network(arrays.mass, k, arrays.alone, h, arrays.found, arrays.found_number)
    # The stop rule compares with the former G and N, so they are replaced only afterwards.
    stops = has_stopped(
        arrays.rule,
        arrays.tolerance,
        arrays.mass,
        k,
        arrays.before,
        whole,
        arrays.found,
        arrays.found_number,
        arrays.information,
        arrays.number,
        work,
    )
    n = arrays.found.shape[1]
    for i in range(n):
        for j in range(n):
            arrays.information[k, i, j] = arrays.found[0, i, j]
    arrays.number[k] = arrays.found_number[0]
    return stops


@kernel(inlined=True)
def correct(
    nodes: SlotNodes,
    readings: SlotReadings,
    room: SlotRoom,
    arrays: PushSumArrays,
    r: int,
    s: int,
    h: int,
) -> None:
    """Step 4 after the prediction, P (7) and (8); with asymptotic gains step 3 too."""
    k, n = r * len(nodes.rows) + h, nodes.xhat.shape[1]
    if arrays.asymptotic:
        # Asymptotic gains: xhat <- F xhat, and P_inf for the root.
        predict_mean(nodes, k, room)
        for i in range(n):
            for j in range(i + 1):
                nodes.root[k, i, j] = arrays.limit[i, j]
    else:
        # P (7), from the prediction's root and what the node knows of the network.
        correct_root(nodes.root, k, arrays.information, k, room.moved, room.update)
    if nodes.rows[h] > 0:
        H = readings.H[r % readings.H.shape[0], s % readings.H.shape[1], h]
        # P (8): N^(i) times the gain of the node's own reading.
        y, number = readings.y[r, s, h], arrays.number[k]
        add_gain(nodes.xhat, nodes.root, k, number, y, H, nodes.rows[h], room.vectors)


@kernel(inlined=True)
def average(
    z: FloatArray, first: int, links: SlotLinks, up: np.ndarray, moves: FloatArray, delta: float
) -> None:
    """One averaging step of all nodes, P (9): to the places of z (K, n) from ``first`` on add
    1 / delta of the differences to the estimates that arrive; ``moves`` (H, n) is scratch.
    """
    H, n = len(links.first) - 1, z.shape[1]
    # All differences before any estimate moves: the step is simultaneous.
    for h in range(H):
        for i in range(n):
            moves[h, i] = 0.0
        for m in range(links.first[h], links.first[h + 1]):
            if up[links.way[m]] == 1:
                sender = first + links.sender[m]
                for i in range(n):
                    moves[h, i] += z[sender, i] - z[first + h, i]
    for h in range(H):
        # P (9): z <- z + (1 / delta) sum of the differences.
        for i in range(n):
            z[first + h, i] += moves[h, i] / delta


@built_in("push-sum")
@dataclass(frozen=True, eq=False)
class PushSum(Filter):
    """In slots P Fig. 1, steps 1-6, samples are filtered; under node clocks broadcast rounds by
    running sums (algorithms.running_sums), which need none of the settings.

    gamma      averaging steps a slot
    delta      the averaging gain is 1 / delta, P (9)
    leader     the node whose weight starts at 1
    asymptotic gains from the limits N and P_inf, P (12), from slot 1 on; no mass is exchanged
    links      "fresh": links fail anew in each averaging step; "held": once for all of a slot
    stop       "never"; "paper": P step 2.3, the node sends no more mass once its C~ moved by less
               than ``tolerance`` (spectral norm); "safe": it goes on exchanging but freezes G^(i)
               and N^(i) once they moved by less than ``tolerance`` (relative) while all its links
               were up and its weight positive
    """

    gamma: int = field(integer(low=1, high=MOST_STEPS), default=None)
    delta: float = field(positive, default=None)
    leader: int = field(integer(low=0), default=0)
    asymptotic: bool = field(boolean, default=False)
    links: str = field(choice("fresh", "held"), default="fresh")
    stop: str = field(choice(*RULES), default="never")
    tolerance: float = field(number(low=0.0), default=1e-6)

    paper: ClassVar[str] = "push_sum"
    combination: ClassVar[str] = "sums"
    # Until others hear of its samples, a node counts them as if all nodes had taken them.
    P_by_design: ClassVar[tuple[str, str]] = ("", "smaller")
    fixed_sensors: ClassVar[bool] = True
    schedule: ClassVar[tuple[str, ...]] = ("exchange", "predict", "sense", "exchange")
    clocks: ClassVar[tuple[str, ...]] = ("nodes",)
    first_slot: ClassVar[int] = 1
    needs_samples: ClassVar[bool] = True
    slot_kernel = staticmethod(push_sum_slots)

    def sends_in_slots(self, phase: int, has_sensor: bool) -> bool:
        """Return True unless the exchange is of mass and the gains are asymptotic."""
        # Exchange MASS carries nothing if the gains are known beforehand.
        return phase == AVERAGE or not self.asymptotic

    def slot_stopping(self) -> tuple[int, bool]:
        """Nodes stop when they have exchanged mass; by the paper's rule they send none then."""
        # Without exchanges of mass there is nothing to stop.
        stops = not self.asymptotic and self.stop != "never"
        return (MASS if stops else -1), stops and self.stop == "paper"

    def slot_arrays(
        self, states: Sequence[Any], infos: Sequence[NodeInfo], runs: int
    ) -> tuple[PushSumArrays]:
        """Return the arrays of all nodes of all runs at the start."""
        known = [state.network for state in states]
        alone = np.stack([state.model.information for state in states])
        H, n = alone.shape[:2]
        # Unused without asymptotic gains, but kernels need an array of the right shape.
        limit = np.zeros((n, n)) if known[0].root is None else known[0].root
        mass = np.stack([state.mass for state in states])
        return (
            PushSumArrays(
                mass=np.tile(mass, (runs, 1)),
                degree=np.array([state.degree for state in states], dtype=np.int64),
                information=np.tile(np.stack([k.information for k in known]), (runs, 1, 1)),
                number=np.tile(np.array([k.number for k in known], dtype=np.float64), runs),
                alone=alone,
                rule=RULES.index(self.stop),
                tolerance=self.tolerance,
                # In slots check_scenario() demands a delta.
                delta=self.delta or math.inf,
                gamma=self.steps(AVERAGE),
                asymptotic=self.asymptotic,
                limit=np.ascontiguousarray(limit),
                share=np.empty((H, mass.shape[1])),
                before=np.empty(mass.shape[1]),
                found=np.empty((1, n, n)),
                found_number=np.empty(1),
            ),
        )

    def init(self, model: Any, mean: FloatArray, cov: FloatArray, node: NodeInfo) -> Any:
        """Step 1: the leader gets the weight; with asymptotic gains every node knows the limits."""
        if not isinstance(model, SlotModel):
            # A model without slots: clocks, where running sums are kept.
            return running_sums.start(model, mean, cov, node)
        information = model.information
        # P step 1: w is 1 at the leader and 0 elsewhere, n~ = 1, C~ = the node's own information.
        weight = 1.0 if node.node == self.leader else 0.0
        mass = np.concatenate([[weight, 1.0], information.reshape(-1)])
        known = Network(information, 1.0)
        # Everyone knows the whole network from the start.
        if self.asymptotic:
            root = asymptotic_root(model.F, model.Q, node.information)
            known = Network(node.information, float(node.nodes), root)
        return PushSumState(mean, first_root(cov), model, mass, known, False, node.degree)

    def predict(self, state: Any, gap: float) -> Any:
        """Estimate, covariance and, in running sums, all information."""
        if isinstance(state, RunningSums):
            return running_sums.predict(state, gap)
        return super().predict(state, gap)

    def steps(self, phase: int) -> int:
        """One for the mass, ``gamma`` for the estimates."""
        return self.gamma or 1 if phase == AVERAGE else 1

    def redraws_links(self, phase: int, step: int) -> bool:
        """Links that are held keep the outcome of the first averaging step."""
        return self.links == "fresh" or step == 0

    def emit(self, state: Any, exchange: Exchange) -> tuple[Any, Any]:
        """Step 2.1, the node's share of its mass, or step 5.1, z."""
        if isinstance(state, RunningSums):
            return running_sums.offer(state)
        if exchange.phase == AVERAGE:
            # The average is of z, which is the corrected estimate.
            return state, state.xhat
        # None: nothing is sent, but the links draw all the same.
        silent = self.asymptotic or (self.stop == "paper" and state.stopped)
        return state, None if silent else share(state.mass, state.degree)

    def absorb(self, state: Any, messages: Sequence[Message], exchange: Exchange) -> Any:
        """Steps 2.2 and 2.3, or step 5.2."""
        if isinstance(state, RunningSums):
            return running_sums.hear(state, messages)
        received = [message.payload for message in messages]
        # P step 5.2.
        if exchange.phase == AVERAGE:
            return state._replace(xhat=averaged(state.xhat, received, self.delta or math.inf))
        if self.asymptotic or (self.stop == "paper" and state.stopped):
            return state
        # P steps 2.2, (3)-(5), and 2.3, (6) with the stop rule.
        mass = mixed(state.mass, received, state.degree)
        whole = len(received) == state.degree
        return self._learned(state._replace(mass=mass), state.mass, whole)

    def _learned(self, state: PushSumState, before: FloatArray, whole: bool) -> PushSumState:
        """P (6) and the stop rule; ``whole``: all links of the node were up."""
        # Frozen by the safe rule: the mass was mixed, but is not read any more.
        if state.stopped:
            return state
        found, former = network(state.mass, state.model), state.network
        stopped = has_stopped(
            RULES.index(self.stop),
            self.tolerance,
            state.mass[None],
            0,
            before,
            whole,
            found.information[None],
            np.array([found.number]),
            former.information[None],
            np.array([former.number]),
            np.empty(found.information.shape),
        )
        return state._replace(network=found, stopped=stopped)

    def update(self, state: Any, reading: Reading) -> Any:
        """Steps 3 and 4 after the prediction, P (7) and (8)."""
        if isinstance(state, RunningSums):
            return running_sums.add_reading(state, reading)
        root = state.network.root
        # Without asymptotic gains P (7) with the node's G; with them P_inf.
        if root is None:
            root = corrected_root(state.root, state.network.information)
        y, H, R = reading[:3]
        xhat = corrected(state.xhat, root, state.network.number, y, H, R)
        return state._replace(xhat=xhat, root=root)

    def stopped(self, state: Any) -> bool:
        """Return True if G^(i) and N^(i) are frozen."""
        return not isinstance(state, RunningSums) and bool(state.stopped)

    def conserved(self, state: Any) -> Mapping[str, float | Sequence[float]]:
        """The sum of the weights is 1, that of the numbers N."""
        if isinstance(state, RunningSums):
            return running_sums.weights(state)
        return {"weight": float(state.mass[0]), "number": float(state.mass[1])}

    def shift(self, state: Any, offset: FloatArray) -> Any:
        """Affine: averaging weights sum to one."""
        if isinstance(state, RunningSums):
            return running_sums.shift(state, offset)
        return state._replace(xhat=state.xhat + offset)

    def shift_payload(self, payload: Any, offset: FloatArray) -> Any:
        """Estimates move, mass does not."""
        if isinstance(payload, Offer):
            return running_sums.shift_offer(payload, offset)
        # A mass is longer than an estimate: 2 + n^2 > n entries.
        return payload + offset if len(payload) == len(offset) else payload

    def check_scenario(self, scenario: Any) -> None:
        """Raise ScenarioError where leader, delta or the sensors do not fit the slots."""
        if not scenario.slotted:
            return
        self._check_leader(scenario)
        for name in ("gamma", "delta"):
            if getattr(self, name) is None:
                words = "is missing for a plant in slots"
                raise ScenarioError(f"filter.{name}", words, None, f"add {name} = ...")
        self._check_gain(scenario.topology.laplacian_radius)
        for k, sensor in enumerate(scenario.sensors):
            if sensor.varying:
                raise ScenarioError(
                    f"sensors[{k}]",
                    "must have a fixed H for the push-sum filter, which adds them up beforehand",
                    None,
                    "use linear sensors or another filter",
                )
        # P (12) may have no solution, as for an unstable plant that the sensors do not see.
        F, Q = scenario.slot_belief
        if self.asymptotic and asymptotic_root(F, Q, scenario.node_infos[0].information) is None:
            raise ScenarioError(
                "filter.asymptotic",
                "needs a steady covariance of the centralised filter, and there is none",
                True,
                "add sensors, or set it to false",
            )

    def _check_leader(self, scenario: Any) -> None:
        nodes = scenario.nodes
        if self.leader not in scenario.topology.index:
            ids = ", ".join(map(str, nodes)) if len(nodes) <= 8 else f"{nodes[0]} .. {nodes[-1]}"
            words, remedy = "must be a node of the graph", f"node ids here are {ids}"
            raise ScenarioError("filter.leader", words, self.leader, remedy)

    def _check_gain(self, radius: float) -> None:
        # Averaging contracts if and only if all eigenvalues of I - L / delta but one lie inside
        # (-1, 1).
        if self.delta <= 0.5 * radius * (1.0 + 1e-12):
            raise ScenarioError(
                "filter.delta",
                f"must be above rho(L) / 2 = {0.5 * radius:.6g}, or averaging does not contract",
                self.delta,
                f"give more than rho(L) = {radius:.6g}",
            )

    def scenario_notes(self, scenario: Any) -> tuple[str, ...]:
        """One line each: delta is below rho(L); settings of slots are not used under clocks."""
        if not scenario.slotted:
            fields = dataclasses.fields(self)
            given = [f"filter.{f.name}" for f in fields if getattr(self, f.name) != f.default]
            words = "not used under clocks, where push-sum keeps running sums"
            return (f"{', '.join(given)}: {words}",) if given else ()
        # Contraction is enough to run; the theorems ask for more.
        radius = scenario.topology.laplacian_radius
        if self.delta >= radius:
            return ()
        return (
            f"filter.delta = {self.delta:g} is below rho(L) = {radius:.6g}: averaging contracts, "
            "but P Theorems 3, 5 and 6 ask for more than rho(L)",
        )


def corrected(
    predicted: FloatArray,
    root: FloatArray,
    number: float,
    y: FloatArray,
    H: FloatArray,
    R: FloatArray,
) -> FloatArray:
    """P (8): the prediction (n,) and ``number`` times the gain of the reading, which may have no
    rows.
    """
    x = predicted[None].copy()
    if len(y):
        # The kernel takes readings whose noise has variance 1.
        y, H = whitened(y, H, R)
        add_gain(x, root[None], 0, number, y, H, len(y), np.empty((2, x.shape[1])))
    return np.asarray(x[0])


def share(mass: FloatArray, degree: int) -> FloatArray:
    """Return what a node of ``degree`` neighbours sends to each: its mass / (degree + 1)."""
    part = np.empty((1, mass.size))
    split_mass(mass.reshape(1, -1), 0, degree, part, 0)
    return part.reshape(mass.shape)


def mixed(mass: FloatArray, received: Sequence[FloatArray], degree: int) -> FloatArray:
    """P (3)-(5) as they conserve mass: the shares ``received`` and the node's own, which it keeps
    once for itself and once for each link of its ``degree`` that failed.
    """
    total = np.array(sum(received, np.zeros(mass.shape))).reshape(1, -1)
    # The same kernels as in slots, on arrays of one place: both engines round alike.
    own = share(mass, degree).reshape(1, -1)
    keep_share(total, 0, own, 0, degree + 1 - len(received))
    return total.reshape(mass.shape)


def network(mass: FloatArray, model: SlotModel) -> Network:
    """P (6): C~ / w and n~ / w, or what the node knows of itself while its weight is exactly 0."""
    alone = model.information
    information, number = np.empty((1, *alone.shape)), np.empty(1)
    learn_network(mass[None], 0, alone[None], 0, information, number)
    return Network(information[0], float(number[0]))


def corrected_root(root: FloatArray, information: FloatArray) -> FloatArray:
    """Root of ``(P^-1 + G)^-1 = P (I + G P)^-1``, P (7), for the lower triangular root of P,
    possibly singular, and the information G (n, n).
    """
    result, n = root[None].copy(), len(root)
    room = update_scratch(n, 1)
    correct_root(result, 0, information[None], 0, np.empty((n, n)), room)
    return np.asarray(result[0])


def averaged(z: FloatArray, received: Sequence[FloatArray], delta: float) -> FloatArray:
    """P (9): z plus 1 / delta of the differences to the estimates that arrived."""
    # One receiver and its senders, as a star whose links are all up.
    x, count = np.stack([z, *received]), len(received)
    places = np.arange(count)
    links = SlotLinks(np.array([0, count]), places + 1, places, np.zeros(count))
    average(x, 0, links, np.ones(count, dtype=np.uint8), np.empty((1, len(z))), delta)
    return np.asarray(x[0])


def asymptotic_root(F: FloatArray, Q: FloatArray, information: FloatArray) -> FloatArray | None:
    """Root of P_inf (n, n), P (12): the steady covariance of a filter that has all the
    information (n, n) in each slot, after its reading; None if there is none.

    By structure-preserving doubling: k steps give the covariance of 2^k slots (Chu, Fan, Lin and
    Wang, Int. J. Control 77, 2004).
    """
    # The iterates of the doubling, which begin with F', the information G and P = Q.
    A, G, P = F.T, information, Q
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(MOST_DOUBLINGS):
            try:
                # One solve for (I + G P)^-1 [A, G].
                solved = np.linalg.solve(np.eye(len(F)) + G @ P, np.concatenate([A, G], axis=1))
            except np.linalg.LinAlgError:
                return None
            left, right = solved[:, : len(F)], solved[:, len(F) :]
            # P grows towards the steady predicted covariance; it overflows if there is none.
            following = symmetric(P + A.T @ P @ left)
            if not np.isfinite(following).all():
                return None
            # Rounding would make G and P unsymmetric, and doubling would amplify that.
            A, G, step, P = A @ left, symmetric(G + A @ right @ A.T), following - P, following
            if np.abs(step).max() <= 1e-15 * np.abs(P).max():
                # Without a steady state P doubles until rounding of G stops it: not a solution.
                if np.abs(G).max() * np.abs(P).max() > MAX_SPREAD:
                    return None
                # P is the predicted covariance: use the reading to get that of P (12).
                return corrected_root(lower_root(square_root(P)), information)
    return None
