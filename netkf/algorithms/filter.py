"""The contract of node algorithms: one for every model of time.

A filter is a frozen dataclass of parameters with pure functions on an immutable state (a NamedTuple
of arrays that nothing changes in place). The engine calls ``predict`` for the time that passes,
``update`` with the readings of the node, ``emit`` when the node may transmit and ``absorb`` with
everything that arrived at one instant. In slots (discrete time) the engine follows ``schedule``;
under clocks (continuous time) it calls the same methods whenever something happens. Covariances are
carried as roots, ``P = root root'``, so that wide and narrow directions keep their digits.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np

from netkf.algorithms import single
from netkf.algorithms.models import first_root, sample_update
from netkf.algorithms.records import Kernels
from netkf.algorithms.traits import CLOCKS, Analysis, Needs, Timing, Weights
from netkf.core.errors import ScenarioError
from netkf.core.fields import Component, Rule, stated
from netkf.core.places import Key
from netkf.linalg.arrays import FloatArray


class Model(Protocol):
    """The plant and its own sensors as one node assumes them (algorithms.models)."""

    @property
    def information(self) -> FloatArray:
        """The information ``H' R^-1 H`` (n, n) that the node's sensors give, per second or per
        slot.
        """

    def predict(
        self, xhat: FloatArray, root: FloatArray, gap: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return estimate (n,) and root (n, n) of its covariance ``gap`` seconds later, from
        ``xhat`` (n,) and ``root`` (n, n) now. With increment sensors the root counts the readings
        of the gap already.
        """

    def extrapolate(
        self, xhat: FloatArray, root: FloatArray, age: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return estimate (n,) and root (n, n) ``age`` seconds after a received estimate ``xhat``
        (n,) with its ``root`` (n, n), without readings.
        """

    def gain_update(
        self, xhat: FloatArray, root: FloatArray, moments: FloatArray, gap: float
    ) -> FloatArray:
        """Return the estimate (n,) after the increments of the last ``gap`` seconds with these
        ``moments`` (2 p,), from the prediction ``xhat`` (n,) and the ``root`` (n, n) at the end of
        the gap.
        """

    def max_interval(self, root: FloatArray) -> float:
        """Return the seconds of increments that may be used at once if the covariance has this root
        (n, n).
        """


class NetworkInfo(NamedTuple):
    """The whole network of N nodes, for filters whose gains are computed before a run.

    information : (N, n, n), H' R^-1 H of each node's sensors, with the R that filters believe
    heard : for each node the indices, from 0 in the order of ids, of the nodes that it can hear
    """

    information: FloatArray
    heard: tuple[tuple[int, ...], ...]


UNKNOWN = 2**31
"""``NodeInfo.instants`` where nothing is known."""


class NodeInfo(NamedTuple):
    """Facts that a node may know about itself and the network at time 0.

    node : its id
    degree : number of nodes that it can hear when no link fails
    receivers : number of nodes that can hear it
    nodes : number of all nodes
    own_weight : weight that it gives to itself when the messages of all neighbours arrive
    information : (n, n), sum of H' R^-1 H over all sensors, with the R that filters believe
    max_delay : longest time that a message may take, seconds (inf if unbounded)
    place : its index in the order of ids, from 0
    senders : ids of the nodes that it can hear, sorted
    network : the whole network, if ``Needs.network`` of the filter says so
    rows : the most rows that a reading of any node has
    blocks : its blocks of ``[[plants]]`` at their places in its own state (plants.blocks.Place)
    whole : all blocks at their places in the whole state, if ``Needs.coupled`` says so
    alone : no other node estimates one of these
    heard : the blocks of each of ``senders``, at their places in its own state
    forgets : it may go down and begin again with what it knew at time 0 (network.lives)
    numbers : a number for each block that a node estimates, by name and owner (id)
    instants : how many instants with readings a run has at most, as far as is known
    most_pairs : how many readings of pairs an instant has at most, at any node, and their rows
    sampled : H (p, n) and R (p, p) of its sensors that take samples (in slots: of all) together, as
              the node believes them, where they are fixed; p = 0 without such sensors
    """

    node: int
    degree: int
    receivers: int
    nodes: int
    own_weight: float
    information: FloatArray
    max_delay: float = 0.0
    place: int = 0
    senders: tuple[int, ...] = ()
    network: NetworkInfo | None = None
    rows: int = 1
    sampled: tuple[FloatArray, FloatArray] = (np.zeros((0, 0)), np.zeros((0, 0)))
    blocks: tuple[Any, ...] = ()
    alone: bool = True
    whole: tuple[Any, ...] = ()
    heard: tuple[tuple[Any, ...], ...] = ()
    forgets: bool = False
    numbers: Mapping[Key, int] = {}
    instants: int = UNKNOWN
    most_pairs: tuple[int, int] = (1, 1)

    def own_states(self, n: int) -> int:
        """Return how many of its n states are of its own blocks, which come first."""
        return sum(place.n for place in self.blocks) or n

    def is_own(self, H: FloatArray) -> np.ndarray:
        """Return the rows (p,) of H (p, n) that depend on blocks of the node alone."""
        return np.asarray(~H[:, self.own_states(H.shape[1]) :].any(axis=1))


class Exchange(NamedTuple):
    """The circumstances of ``emit`` or ``absorb``.

    time : simulated seconds
    phase, step : number of the exchange in its slot, and of its repetition, from 0; -1 under clocks
    slot : number of the slot, from 0; -1 under clocks
    receivers : under clocks, for ``emit``, the ids of the nodes that may hear
    uniform : in slots, for ``emit`` of a ``randomised`` filter, a uniform draw in [0, 1) from the
              node's own stream
    """

    time: float = 0.0
    phase: int = -1
    step: int = -1
    slot: int = -1
    receivers: tuple[int, ...] = ()
    uniform: float = 0.0


class Message(NamedTuple):
    """A message that arrived: its sender, the weight it is given, its payload, and its age in
    seconds.
    """

    sender: int
    weight: float
    payload: Any
    age: float


class PairReading(NamedTuple):
    """A reading of a block that the node estimates and of one that it does not.

    other : name and owner (id) of the latter, -1 if all share it
    y, R : values (p,), and their noise covariance (p, p)
    H : ``H(x, x_other)`` returns y linearised at the estimates x (n,) of the node and x_other (n',)
        of the other block: z (p,), and H (p, n) and H_other (p, n') with ``z = H x + H_other
        x_other + v``
    """

    other: Key
    y: FloatArray
    R: FloatArray
    H: Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray, FloatArray]]


class Reading(NamedTuple):
    """A sample ``y = H x + v``, cov(v) = R.

    y : values (p,); p may be 0
    H, R : (p, n) and (p, p) as the node believes them
    time : when it was taken, in seconds
    pairs : readings of this instant that also depend on blocks which the node does not estimate,
            for filters that say so (``Needs.blocks``)
    """

    y: FloatArray
    H: FloatArray
    R: FloatArray
    time: float = math.nan
    pairs: tuple[PairReading, ...] = ()


class Increments(NamedTuple):
    """Increments of sensors (p rows in all) over the last ``gap`` seconds, from time a on:
    ``moments`` (2 p,) are ``int dy`` and then ``int (2 (s - a) / gap - 1) dy`` over the times s in
    the gap, see linalg/legendre.
    """

    moments: FloatArray
    gap: float


class State(NamedTuple):
    """Estimate ``xhat`` (n,), ``root`` (n, n) of its covariance, and the model they move by."""

    xhat: FloatArray
    root: FloatArray
    model: Any

    @property
    def P(self) -> FloatArray:
        """The covariance ``root root'`` (n, n) of the estimate."""
        return self.root @ self.root.T


class Estimate(NamedTuple):
    """The usual payload: the sender's estimate ``xhat`` (n,) and the ``root`` (n, n) of its
    covariance.
    """

    xhat: FloatArray
    root: FloatArray

    @property
    def P(self) -> FloatArray:
        """The covariance ``root root'`` (n, n) of the estimate."""
        return self.root @ self.root.T


STEPS = ("init", "predict", "update", "emit", "absorb", "estimate")
"""The methods that define a filter."""


PHASES = ("predict", "sense", "exchange")


def _sound_timing(timing: Any) -> Timing:
    """Return a Timing; raises TypeError for others, and ScenarioError for a wrong value in it."""
    if not isinstance(timing, Timing):
        raise TypeError
    schedule, clocks, first, age = (
        getattr(timing, name) for name in ("schedule", "clocks", "first_slot", "max_age")
    )
    phases, names = (", ".join(f'"{name}"' for name in listed) for listed in (PHASES, CLOCKS))
    is_schedule = schedule is None or (isinstance(schedule, tuple) and set(schedule) <= {*PHASES})
    are_clocks = isinstance(clocks, tuple) and set(clocks) <= {*CLOCKS}
    is_slot = first is None or (isinstance(first, int) and first >= 0)
    exchanges = schedule.count("exchange") if is_schedule and schedule else 0
    steps: list[Any] = [timing.steps(phase) for phase in range(exchanges)]
    are_steps = all(isinstance(count, int | np.integer) and count >= 0 for count in steps)
    for name, holds, rule in (
        ("schedule", is_schedule, f"must be None or a tuple of {phases}"),
        ("clocks", are_clocks, f"must be a tuple of {names}"),
        ("first_slot", is_slot, "must be a whole number of at least 0"),
        ("steps", are_steps, "must return a whole number of at least 0 for each exchange"),
        ("max_age", isinstance(age, Real) and float(age) >= 0.0, "must be a number of at least 0"),
    ):
        if not holds:
            raise ScenarioError(name, rule, steps if name == "steps" else getattr(timing, name))
    return timing


@dataclass(frozen=True, eq=False)
class Filter(Component):
    """The contract of node algorithms: how readings and messages change a node's state.

    The base class is a Kalman filter on the node's own readings; a filter that talks defines at
    least ``absorb``. What it says of itself beside its methods stands in values
    (``algorithms.traits``), each a class variable, or a property where it depends on settings:
    ``timing``, ``needs``, ``link_weights`` and ``analysis``; ``kernels`` are its compiled form.
    """

    kernels: ClassVar[Kernels | None] = None
    _called_if = MappingProxyType({"emit": "timing.talks", "absorb": "timing.talks"})
    _values = MappingProxyType(
        {
            "timing": Rule("must be Timing", _sound_timing, "see netkf.parts"),
            "needs": stated(Needs),
            "link_weights": stated(Weights),
            "analysis": stated(Analysis),
            "kernels": stated(Kernels, optional=True),
        }
    )

    @property
    def timing(self) -> Timing:
        """When it reads, predicts and exchanges."""
        return Timing()

    @property
    def needs(self) -> Needs:
        """Its demands on a scenario; by default none. A class may set it as a variable."""
        return Needs()

    @property
    def link_weights(self) -> Weights:
        """The weights of messages; by default Metropolis'. A class may set it as a variable."""
        return Weights()

    @property
    def analysis(self) -> Analysis:
        """Facts for theory, checks and comparisons; by default none."""
        return Analysis()

    def init(self, model: Any, mean: FloatArray, cov: FloatArray, node: NodeInfo) -> Any:
        """Return the state at time 0 from ``mean`` (n,) and ``cov`` (n, n), with the ``model`` of
        plant and sensors; ``node`` is what the node knows about itself and the network.
        """
        if self.kernels is not None:
            return single.begin_node(self, model, mean, cov, node)
        return State(mean, first_root(cov), model)

    def predict(self, state: Any, gap: float) -> Any:
        """Return the state ``gap`` > 0 seconds later (in slots a period). If the node has increment
        sensors, its covariance counts their readings already, its estimate does not yet.
        """
        if self.kernels is not None:
            return single.predict(state, gap)
        xhat, root = state.model.predict(state.xhat, state.root, gap)
        return state._replace(xhat=xhat, root=root)

    def update(self, state: Any, reading: Any) -> Any:
        """Return the state after a reading: a sample at this instant (``Reading``; in slots every
        node gets one a slot, without rows if it has no sensor), or the increments of the interval
        that just passed (``Increments``).
        """
        if self.kernels is not None:
            return single.update(state, reading)
        if isinstance(reading, Increments):
            return state._replace(
                xhat=state.model.gain_update(state.xhat, state.root, reading.moments, reading.gap)
            )
        # In slots a node without a sensor gets readings without rows.
        if not len(reading.y):
            return state
        xhat, root = sample_update(state.xhat, state.root, reading.y, reading.H, reading.R)
        return state._replace(xhat=xhat, root=root)

    def emit(self, state: Any, exchange: Exchange) -> tuple[Any, Any]:
        """Return the state after sending and the payload for all ``exchange.receivers`` (in slots:
        of this step); a payload of None sends nothing. By default the payload is ``xhat`` (n,) and
        ``root`` (n, n).
        """
        if self.kernels is not None:
            return single.emit(state, exchange)
        return state, Estimate(state.xhat, state.root)

    def absorb(self, state: Any, messages: Sequence[Message], exchange: Exchange) -> Any:
        """Return the state after all messages of this instant, sorted by sender, are used together.
        In slots it is called for every node when the inbox of a step closes, even without
        messages. Payloads must not be changed.
        """
        if self.kernels is None:
            raise NotImplementedError(f"{type(self).__name__} must define absorb")
        return single.absorb(state, messages, exchange)

    def estimate(self, state: Any) -> tuple[FloatArray, FloatArray | None]:
        """Return the estimate ``xhat`` (n,) and its covariance ``P`` (n, n) now; P is None if the
        filter has none.
        """
        return state.xhat, state.root @ state.root.T

    def shift(self, state: Any, offset: FloatArray) -> Any:
        """Return a state, or a payload under way, with ``offset`` (n,) added to the estimate and to
        everything like one.

        Engines call it when they move the origin of coordinates near to the true state, so that
        errors on unstable plants keep their digits; of a payload ``offset`` is the move at the time
        of sending. That needs a filter that commutes with such a shift (``commutes``), as those
        that are affine in readings and payloads do. A class that defines one of STEPS itself says
        so by defining ``shift`` too.
        """
        if self.kernels is not None:
            return single.shift(state, offset)
        return state._replace(xhat=state.xhat + offset)


def interval_rule(algorithm: Filter) -> Callable[[Any], float]:
    """Return a function of a state: the seconds of increments that ``update`` may use at once from
    it on, by ``Timing.interval``, or else by the kernels or the model.
    """
    given = algorithm.timing.interval
    if given is not None:
        return given
    if algorithm.kernels is not None:
        return single.interval
    return lambda state: float(state.model.max_interval(state.root))


def may_be_silent(algorithm: Filter) -> bool:
    """Return True if nodes may decide in slots to send nothing."""
    kernels = algorithm.kernels
    return algorithm.timing.decides or (kernels is not None and kernels.decides)


def commutes(algorithm: Filter) -> bool:
    """Return True if the class of the filter ``algorithm`` declares that it commutes with a shift
    of the truth: it gives shifted estimates for shifted readings.

    It declares so if ``shift`` is defined by the class that defines the last of its STEPS, or by
    one derived from that; a filter that it runs has to declare so, too.
    """
    wrapped = algorithm.analysis.wrapped
    if wrapped is not None and not commutes(wrapped):
        return False
    # A class that redefines a step without ``shift`` may no longer commute.
    return _is_about_steps(algorithm, "shift")


def _is_about_steps(algorithm: Filter, attribute: str) -> bool:
    order = type(algorithm).__mro__

    def owner(name: str) -> int:
        """Return the position in the method resolution order of the class that defines ``name``."""
        return next((k for k, cls in enumerate(order) if name in cls.__dict__), len(order))

    return owner(attribute) <= min(owner(name) for name in STEPS)


def takes_columns(algorithm: Filter) -> bool:
    """Return True if verbs in Python take estimates of several columns, ``Analysis.affine``, by the
    class that defines the last of its STEPS.
    """
    affine = algorithm.analysis.affine and _is_about_steps(algorithm, "analysis")
    return affine and commutes(algorithm)


def compiled_kernels(algorithm: Filter, clocked: bool) -> Kernels | None:
    """Return the kernels of a filter under clocks or in slots; None if it has none, or if its class
    defines one of STEPS in Python after them, or an interval, so that they do not say what it does.
    """
    kernels = algorithm.kernels
    if kernels is None:
        return None
    order = type(algorithm).__mro__
    first = next((k for k, cls in enumerate(order) if "kernels" in vars(cls)), len(order))
    if any(name in vars(cls) for cls in order[:first] for name in STEPS):
        return None
    if clocked and algorithm.timing.interval is not None:
        return None
    return kernels.of(clocked)
