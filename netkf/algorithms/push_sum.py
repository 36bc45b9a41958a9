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
from netkf.algorithms.kernels.square_root import lower_triangular
from netkf.algorithms.kernels.stopping import RULES, stops
from netkf.algorithms.models import SlotModel, first_root
from netkf.algorithms.registry import built_in
from netkf.algorithms.running_sums import Offer, RunningSums
from netkf.core.errors import ScenarioError
from netkf.core.fields import boolean, choice, field, integer, number, positive
from netkf.linalg.arrays import FloatArray, square_root, symmetric
from netkf.linalg.compiling import compilable
from netkf.linalg.small import applied, even, product, solution

MASS, AVERAGE = 0, 1
"""The two exchanges of a slot."""

MOST_STEPS = 100_000
MOST_DOUBLINGS = 60


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

    def init(self, model: Any, mean: FloatArray, cov: FloatArray, node: NodeInfo) -> Any:
        """Step 1: the leader gets the weight; with asymptotic gains every node knows the limits."""
        if not isinstance(model, SlotModel):
            return running_sums.start(model, mean, cov, node)
        information = model.information
        weight = 1.0 if node.node == self.leader else 0.0
        mass = np.concatenate([[weight, 1.0], information.reshape(-1)])
        known = Network(information, 1.0)
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
            return state, state.xhat
        silent = self.asymptotic or (self.stop == "paper" and state.stopped)
        return state, None if silent else share(state.mass, state.degree)

    def absorb(self, state: Any, messages: Sequence[Message], exchange: Exchange) -> Any:
        """Steps 2.2 and 2.3, or step 5.2."""
        if isinstance(state, RunningSums):
            return running_sums.hear(state, messages)
        received = [message.payload for message in messages]
        if exchange.phase == AVERAGE:
            return state._replace(xhat=averaged(state.xhat, received, self.delta or math.inf))
        if self.asymptotic or (self.stop == "paper" and state.stopped):
            return state
        mass = mixed(state.mass, received, state.degree)
        whole = len(received) == state.degree
        return self._learned(state._replace(mass=mass), state.mass, whole)

    def _learned(self, state: PushSumState, before: FloatArray, whole: bool) -> PushSumState:
        """P (6) and the stop rule; ``whole``: all links of the node were up."""
        if state.stopped:
            return state
        found = network(state.mass, state.model)
        known = (*found[:2], *state.network[:2])
        rule = RULES.index(self.stop)
        stopped = stops(rule, self.tolerance, state.mass, before, whole, *known)
        return state._replace(network=found, stopped=stopped)

    def update(self, state: Any, reading: Reading) -> Any:
        """Steps 3 and 4 after the prediction, P (7) and (8)."""
        if isinstance(state, RunningSums):
            return running_sums.add_reading(state, reading)
        root = state.network.root
        if root is None:
            root = corrected_root(state.root, state.network.information)
        y, H, R = reading[:3]
        xhat = corrected(state.xhat, root, state.network.number, y, H, R)
        return state._replace(xhat=xhat, root=root)

    def stopped(self, state: Any) -> bool:
        """Whether G^(i) and N^(i) are frozen."""
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
        radius = scenario.topology.laplacian_radius
        if self.delta >= radius:
            return ()
        return (
            f"filter.delta = {self.delta:g} is below rho(L) = {radius:.6g}: averaging contracts, "
            "but P Theorems 3, 5 and 6 ask for more than rho(L)",
        )


@compilable
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
    if not len(y):
        return predicted
    gain = number * product(root, product(root.T, solution(R, H).T))
    return predicted + applied(gain, y - applied(H, predicted))


@compilable
def share(mass: FloatArray, degree: int) -> FloatArray:
    """What a node of ``degree`` neighbours sends to each of them: its mass over degree + 1."""
    return mass / (degree + 1)


def mixed(mass: FloatArray, received: Sequence[FloatArray], degree: int) -> FloatArray:
    """P (3)-(5) as they conserve mass: the shares ``received`` and the node's own, which it keeps
    once for itself and once for each link of its ``degree`` that failed.

    ``mass`` and shares (m,), or stacks of them.
    """
    own = kept(mass, len(received), degree)
    return own + sum(received) if received else own


@compilable
def kept(mass: FloatArray, received: int, degree: int) -> FloatArray:
    """The node's own share, once for itself and once for each of its links that failed."""
    return (degree + 1 - received) * share(mass, degree)


def network(mass: FloatArray, model: SlotModel) -> Network:
    """P (6): C~ / w and n~ / w, or what the node knows of itself while its weight is exactly 0."""
    return Network(*understood(mass, model.information))


@compilable
def understood(mass: FloatArray, information: FloatArray) -> tuple[FloatArray, float]:
    """P (6) from the mass and the node's own information."""
    weight, n = mass[0], len(information)
    if weight == 0.0:
        return information, 1.0
    return even(mass[2:].reshape(n, n) / weight), mass[1] / weight


@compilable
def corrected_root(root: FloatArray, information: FloatArray) -> FloatArray:
    """Root of ``(P^-1 + G)^-1 = P (I + G P)^-1``, P (7), for ``P = root root'``, possibly singular,
    and the information G (n, n).

    ``root L^-T`` with ``L L' = I + root' G root``, triangular by reflections: nothing is inverted.
    """
    n = len(root)
    work = np.empty((n, 2 * n))
    work[:, :n], work[:, n:] = product(root.T, square_root(information)), np.eye(n)
    return solution(lower_triangular(work), root.T).T.copy()


def averaged(z: FloatArray, received: Sequence[FloatArray], delta: float) -> FloatArray:
    """P (9): z plus 1 / delta of the differences to the estimates that arrived."""
    return z + sum(other - z for other in received) / delta if received else z


def asymptotic_root(F: FloatArray, Q: FloatArray, information: FloatArray) -> FloatArray | None:
    """Root of P_inf (n, n), P (12): the steady covariance of a filter that has all the
    information (n, n) in each slot, after its reading; None where there is none.

    By structure-preserving doubling: k steps give the covariance of 2^k slots (Chu, Fan, Lin and
    Wang, Int. J. Control 77, 2004).
    """
    A, G, P = F.T, information, Q
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(MOST_DOUBLINGS):
            try:
                solved = np.linalg.solve(np.eye(len(F)) + G @ P, np.concatenate([A, G], axis=1))
            except np.linalg.LinAlgError:
                return None
            left, right = solved[:, : len(F)], solved[:, len(F) :]
            following = symmetric(P + A.T @ P @ left)
            if not np.isfinite(following).all():
                return None
            A, G, step, P = A @ left, symmetric(G + A @ right @ A.T), following - P, following
            if np.abs(step).max() <= 1e-15 * np.abs(P).max():
                return corrected_root(square_root(P), information)
    return None
