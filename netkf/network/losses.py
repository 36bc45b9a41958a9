"""Loss models: which messages are lost."""

from __future__ import annotations

import dataclasses
import inspect
import itertools
import math
from abc import abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple

import numpy as np

from netkf.core.contracts import kernel_problem
from netkf.core.csv_files import read_columns
from netkf.core.errors import ScenarioError, quote
from netkf.core.fields import (
    Component,
    Rule,
    SourceFile,
    boolean,
    field,
    matrix,
    number,
    one_of,
    positive,
    probability,
    source_file,
    stated,
)
from netkf.core.laws import Chain
from netkf.core.repeated_rows import KeyedTable, RowUse, count_rows, first_rows
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.functions import call_function
from netkf.linalg.vector_functions import VectorFunction
from netkf.network.graphs import Link, Topology, demand_links


class Transmission(NamedTuple):
    """What a channel knows of a message when it is sent.

    link : (sender, receiver), ids of nodes
    number : number of the message on that directed link, from 0
    time : seconds
    bad : the link is in the bad one of its two states, in which losses come in bursts
    table_probability : entry of the graph's table for that direction, 1 without one
    distance : of the two nodes; nan unless the loss follows it
    hearers : ids of all nodes that the sender reaches with this transmission
    size : bytes of the payload
    frames : number of frames of the message, all of which must arrive
    conditions : what ``Loss.conditions`` has drawn for this run

    Of K messages on one link ``number``, ``time``, ``bad`` and ``distance`` are arrays (K,).
    """

    link: Link
    number: Any = 0
    time: Any = 0.0
    bad: Any = False
    table_probability: float = 1.0
    distance: Any = math.nan
    hearers: tuple[int, ...] = ()
    size: float = math.nan
    frames: int = 1
    conditions: Any = None


@dataclass(frozen=True, eq=False)
class Loss(Component):
    """The contract of a loss model.

    For each activation the engine draws one uniform number; a message is delivered when that is
    below its ``delivery_probability``. Both directions share the number when the channel is
    symmetric, and with probability ``fate_share`` all hearers of a broadcast.
    """

    _called_if = MappingProxyType({"next_state": "stateful"})
    _values = MappingProxyType(
        {
            **dict.fromkeys(("vectorised", "follows_distance", "deterministic"), boolean),
            **dict.fromkeys(("stateful", "independent"), boolean),
            "fate_share": probability,
            "state_of": one_of("link", "sender"),
            "chain": stated(Chain, optional=True),
        }
    )

    @abstractmethod
    def delivery_probability(self, sent: Transmission) -> Any:
        """Return the probability that the message ``sent`` arrives; of K messages on one link (K,)
        or a number, if the class is ``vectorised``. It may depend on nothing else.
        """
        raise NotImplementedError

    def conditions(self, random: np.random.Generator, horizon: float) -> Any:
        """Draw what many messages of a run share, from a stream of its own, before its first
        message: the weather up to the ``horizon`` in seconds, when a jammer is on, or the quality
        of each node. ``delivery_probability`` finds it as ``sent.conditions``.
        """
        return None

    @property
    def vectorised(self) -> bool:
        """True if ``delivery_probability`` takes many messages of one link at once."""
        return False

    @property
    def follows_distance(self) -> bool:
        """True if ``delivery_probability`` reads the distance."""
        return False

    @property
    def fate_share(self) -> float:
        """The probability that all hearers of a broadcast have one uniform number."""
        return 0.0

    @property
    def state_of(self) -> str:
        """Whose the two states are: each "link" has its own, or each "sender", all of whose links
        are in one state.
        """
        return "link"

    def next_state(self, link: Link, bad: bool | None, random: np.random.Generator) -> bool:
        """Return True if a directed ``link`` is in its bad state at the next activation.

        ``bad`` is its state at the last activation, None at the first.
        """
        return False

    @property
    def deterministic(self) -> bool:
        """True if every delivery probability is 0 or 1, so that nothing is drawn."""
        return False

    @property
    def stateful(self) -> bool:
        """True if ``next_state`` draws."""
        return False

    def mean_delivery(self, sent: Transmission) -> float:
        """Return the fraction of messages that arrive in the long run on the link of ``sent``, its
        message 0 at time 0, for theory and summaries; nan if it is unknown before a run. By default
        that of the ``chain``, if the class states one, else the delivery probability of that
        message, nan if those of others differ, or the class draws states or ``conditions``.
        """
        if self.chain is not None:
            return self.chain.mean_delivery
        if self.stateful or has_conditions(self):
            return math.nan
        return float(self.delivery_probability(sent))

    @property
    def independent(self) -> bool:
        """True if the outcomes of different activations are independent; by default if the class
        draws no states and no ``conditions``.
        """
        return not (self.stateful or has_conditions(self))

    @property
    def chain(self) -> Chain | None:
        """The chain of two states by which losses follow each other, if there is one."""
        return None

    def check(self, topology: Topology) -> None:
        """Raise ScenarioError if the fields do not fit the graph."""


@dataclass(frozen=True, eq=False)
class NoLoss(Loss):
    """Every message arrives."""

    deterministic = True
    vectorised = True

    def delivery_probability(self, sent: Transmission) -> Any:
        """Return 1, for any message in any state of the link."""
        return 1.0


@dataclass(frozen=True, eq=False)
class Bernoulli(Loss):
    """A message arrives with probability ``delivery``."""

    vectorised = True

    delivery: float = field(probability)

    def delivery_probability(self, sent: Transmission) -> Any:
        """Return ``delivery``, for any message in any state of the link."""
        return self.delivery


@dataclass(frozen=True, eq=False)
class SharedLoss(Loss):
    """A message arrives with probability ``delivery``; with probability ``share`` all hearers of a
    broadcast have one fate, and otherwise each of them has its own.

    With share c two hearers are both served with probability p^2 + c p (1 - p).
    """

    vectorised = True

    delivery: float = field(probability)
    share: float = field(probability)

    @property
    def fate_share(self) -> float:
        """The field ``share``."""
        return self.share

    def delivery_probability(self, sent: Transmission) -> Any:
        """Return ``delivery``, for any message in any state of the link."""
        return self.delivery


@dataclass(frozen=True, eq=False)
class PerLink(Loss):
    """A message arrives with the delivery probability that the graph's table gives its link."""

    vectorised = True

    def delivery_probability(self, sent: Transmission) -> Any:
        """Return ``table_probability``, for any message in any state of the link."""
        return sent.table_probability

    def check(self, topology: Topology) -> None:
        """Raise ScenarioError unless the graph has a table of probabilities."""
        if topology.delivery is None:
            raise ScenarioError(
                "kind",
                "per-link needs a graph with delivery probabilities",
                "per-link",
                'use graph = { kind = "csv" } with a column delivery_probability',
            )


@dataclass(frozen=True, eq=False)
class Logistic(Component):
    """The delivery probability ``1 / (1 + exp((d - half) / width))`` at the distance d: one half at
    ``half``, and 0.73 and 0.27 a ``width`` before and after it.
    """

    kind: str = field(one_of("logistic"))
    half: float = field(number(low=0.0))
    width: float = field(positive)

    def at(self, distance: Any) -> Any:
        """Return the delivery probability at a ``distance``."""
        # At exp(700) the probability is below 1e-300.
        return 1.0 / (1.0 + np.exp(np.minimum((distance - self.half) / self.width, 700.0)))


def _convert_delivery(value: Any) -> Logistic | FloatArray:
    if isinstance(value, Logistic):
        return value
    if isinstance(value, Mapping):
        for key in (f.name for f in dataclasses.fields(Logistic)):
            if key not in value:
                raise ScenarioError(key, "is missing", None, f"add {key} = ...")
        for key in value.keys() - {"kind", "half", "width"}:
            remedy = "keys are kind, half, width"
            raise ScenarioError(str(key), "is not a key here", value[key], remedy)
        return Logistic(**value)
    table: FloatArray = matrix.convert(value)
    distances, probabilities = table.T  # of two columns, else a ValueError
    if distances[0] < 0.0 or (np.diff(distances) <= 0.0).any():
        raise ScenarioError("", "must have increasing distances from 0", value, "sort the rows")
    if ((probabilities < 0.0) | (probabilities > 1.0)).any():
        raise ScenarioError("", "must have probabilities from 0 to 1", value, "correct them")
    return table


_delivery = Rule(
    "must be a table [[distance, probability], ...] or a logistic function",
    _convert_delivery,
    'write delivery = { kind = "logistic", half = ..., width = ... }',
    {
        "anyOf": [
            {
                "type": "object",
                "properties": {
                    "kind": {"const": "logistic"},
                    "half": {"type": "number", "minimum": 0},
                    "width": {"type": "number", "exclusiveMinimum": 0},
                },
                "required": ["kind", "half", "width"],
                "additionalProperties": False,
            },
            dict(matrix.schema),
        ]
    },
)


@dataclass(frozen=True, eq=False)
class DistanceLoss(Loss):
    """A message arrives with a probability that depends on how far its ends are apart when it is
    sent.

    delivery  { kind = "logistic", half = ..., width = ... }: 1 / (1 + exp((d - half) / width)) at
              the distance d; or a table [[d, p], ...], linear between its rows and constant before
              the first and after the last
    """

    follows_distance = True
    vectorised = True

    delivery: Logistic | FloatArray = field(_delivery)

    def delivery_probability(self, sent: Transmission) -> Any:
        """Return the delivery probability of a message at its distance."""
        if isinstance(self.delivery, Logistic):
            return self.delivery.at(sent.distance)
        return np.interp(sent.distance, *self.delivery.T)


_CHAIN = ("to_bad", "to_good", "deliver_good", "deliver_bad", "mean_loss", "mean_burst")


@dataclass(frozen=True, eq=False)
class GilbertElliott(Loss):
    """A two-state Markov chain that makes one step per activation.

    Give either ``to_bad``, ``to_good``, ``deliver_good`` (default 1) and ``deliver_bad`` (default
    0), or ``mean_loss`` and ``mean_burst`` (activations) for a chain that loses every message in
    its bad state. Or give these, for each directed link, as columns of a table in ``path`` that
    begins with ``sender,receiver``; links without a row have the values of the scenario. With
    ``shared`` all links of a sender are in the state of one chain, which makes a step at each of
    its transmissions; their rows then have the same transitions.
    """

    stateful = True
    vectorised = True
    _reads = "_table"

    to_bad: float | None = field(probability, default=None)
    to_good: float | None = field(number(above=0.0, high=1.0), default=None)
    deliver_good: float | None = field(probability, default=None)
    deliver_bad: float | None = field(probability, default=None)
    mean_loss: float | None = field(number(low=0.0, below=1.0), default=None)
    mean_burst: float | None = field(number(low=1.0), default=None)
    path: SourceFile | None = field(source_file, default=None)
    shared: bool = field(boolean, default=False)

    def __post_init__(self) -> None:
        """Check the fields; raises ScenarioError unless one form is given, and possible."""
        super().__post_init__()
        if self.path is not None and all(getattr(self, name) is None for name in _CHAIN):
            return
        # One of two forms, each with two required fields: transition probabilities, or means.
        chain = {name: getattr(self, name) for name in ("to_bad", "to_good")}
        means = {name: getattr(self, name) for name in ("mean_loss", "mean_burst")}
        if any(value is not None for value in means.values()):
            extra = {**chain, "deliver_good": self.deliver_good, "deliver_bad": self.deliver_bad}
            for name, value in extra.items():
                if value is not None:
                    raise ScenarioError(
                        name,
                        "cannot stand beside mean_loss and mean_burst",
                        value,
                        "keep one of the two forms",
                    )
            chain = means
        for name, value in chain.items():
            if value is None:
                raise ScenarioError(
                    name, "is missing", None, "give to_bad and to_good, or mean_loss and mean_burst"
                )
        # The means imply to_bad = mean_loss / (1 - mean_loss) / mean_burst, which may exceed 1.
        if self.transitions[0] > 1.0:
            shortest = math.ceil(1e6 * self.transitions[0] * (self.mean_burst or 0.0)) / 1e6
            raise ScenarioError(
                "mean_burst",
                "is too short for that mean_loss",
                self.mean_burst,
                f"lengthen the bursts to at least {shortest:g}, or lower the loss",
            )

    @property
    def state_of(self) -> str:
        """Whose the two states are: "sender" if they are ``shared``."""
        return "sender" if self.shared else "link"

    @cached_property
    def _table(self) -> KeyedTable[Link, GilbertElliott, Link] | None:
        """The chain of each directed link with a row, and the link of each row."""
        if self.path is None:
            return None
        table = read_columns(self.path, ("sender", "receiver"), _CHAIN)
        links = list(zip(table.integers("sender"), table.integers("receiver"), strict=True))
        columns = [name for name in _CHAIN if name in table]
        chains: dict[Link, GilbertElliott] = {}
        rows = [[float(table[name][k]) for name in columns] for k in range(len(links))]
        rule = "a direction must have one chain"
        first_row = first_rows(table, links, rows, rule)
        for link, row in first_row.items():
            try:
                values: dict[str, Any] = dict(zip(columns, rows[row], strict=True))
                chains[link] = GilbertElliott(**values, shared=self.shared)
            except ScenarioError as error:
                rule = f"{table.where(row)}: {error.key} {error.rule}"
                raise ScenarioError("path", rule, error.value, error.remedy) from None
        for first, second in itertools.pairwise(sorted(chains) if self.shared else ()):
            steps = chains[first].transitions, chains[second].transitions
            if first[0] == second[0] and steps[0] != steps[1]:
                rule = "must give all links of a sender the same transitions, if they are shared"
                lines = [table.lines[first_row[link]] for link in (first, second)]
                got = f"{list(first)} in line {lines[0]} and {list(second)} in line {lines[1]}"
                raise ScenarioError("path", rule, got, "correct the rows")
        return KeyedTable(chains, table, links)

    def use(self, end: float) -> RowUse:
        """Return the use of the rows of the table by a run to ``end`` (s)."""
        table = self._table
        assert table is not None
        return count_rows(table.columns.source.name, table.keys, lambda _: end > 0.0)

    def of(self, link: Link) -> GilbertElliott:
        """Return the chain of a directed link."""
        return self if self._table is None else self._table.of.get(link, self)

    def check(self, topology: Topology) -> None:
        """Raise ScenarioError unless every row of the table is of a link, and every link has a
        chain.
        """
        if self._table is None:
            return
        chains, table, _ = self._table
        demand_links(table, topology, "sender", "receiver")
        if all(getattr(self, name) is None for name in _CHAIN):
            for link in topology.directions:
                if link not in chains:
                    rule = f"{table.source.name} must have a row of each direction"
                    remedy = "add the row, or give mean_loss and mean_burst for all others"
                    raise ScenarioError("path", rule, f"none of {list(link)}", remedy)

    @property
    def transitions(self) -> tuple[float, float]:
        """The probabilities that an activation turns a good state bad, and a bad one good."""
        if self.mean_loss is not None and self.mean_burst is not None:
            to_good = 1.0 / self.mean_burst
            return to_good * self.mean_loss / (1.0 - self.mean_loss), to_good
        assert self.to_bad is not None
        assert self.to_good is not None
        return self.to_bad, self.to_good

    def next_state(self, link: Link, bad: bool | None, random: np.random.Generator) -> bool:
        """Return True if the chain is in its bad state after a step from ``bad``."""
        to_bad, to_good = self.of(link).transitions
        u = random.random()
        if bad is None:
            return bool(u < to_bad / (to_bad + to_good))
        return bool(u >= to_good if bad else u < to_bad)

    def delivery_probability(self, sent: Transmission) -> Any:
        """Return the delivery probability of any message in the ``bad`` or good state."""
        chain = self.of(sent.link)
        bad = 0.0 if chain.deliver_bad is None else chain.deliver_bad
        good = 1.0 if chain.deliver_good is None else chain.deliver_good
        return np.where(sent.bad, bad, good)

    def mean_delivery(self, sent: Transmission) -> float:
        """Return the mean delivery probability under the stationary law of the two states."""
        to_bad, to_good = self.of(sent.link).transitions
        bad = to_bad / (to_bad + to_good)
        good, both = (float(self.delivery_probability(sent._replace(bad=b))) for b in (False, True))
        return bad * both + (1.0 - bad) * good

    @property
    def independent(self) -> bool:
        """True only if the next state does not depend on the present one."""
        # Then both rows of the transition matrix are equal.
        return self.path is None and sum(self.transitions) == 1.0

    @property
    def chain(self) -> Chain | None:
        """The chain of the two states of a link, None if links differ."""
        if self.path is not None:
            return None
        sent = Transmission((0, 1))
        delivery = (float(self.delivery_probability(sent._replace(bad=b))) for b in (False, True))
        return Chain(*self.transitions, *delivery)


MESSAGES_ASKED = 64
"""Messages of a link for which a user's loss is asked if their probability is the same."""
MESSAGE = ("sender", "receiver", "number", "bad", "table_probability", "distance")
"""What the kernel of a KernelLoss knows of a message, see Transmission, beside its time."""


class KernelLoss(Loss):
    """A loss whose delivery probability is computed by a kernel: in both engines one code, and in
    the compiled one as fast as the built-in losses.

    ``law(message, settings, t, out)`` is marked with ``netkf.kernels.kernel``. It writes the
    probability into ``out[0]``, given the ``message``, of which it knows what MESSAGE names in this
    order, the ``settings``, and the time ``t`` in seconds at which it is sent. All are floats.
    """

    vectorised = True
    law: ClassVar[Any]

    @property
    def settings(self) -> FloatArray:
        """The numbers (K,) that the kernel gets: by default the fields, in their order."""
        return np.array([float(getattr(self, f.name)) for f in dataclasses.fields(self)])

    @cached_property
    def _function(self) -> tuple[VectorFunction, FloatArray]:
        law, settings = inspect.getattr_static(type(self), "law", None), self.settings
        law = getattr(law, "__func__", law)
        if problem := kernel_problem(law, ("message", "settings", "t", "out")):
            rule = f"{type(self).__name__}.law {problem}"
            raise ScenarioError("network.channel.loss", rule, None, "correct the class")
        shapes = (len(MESSAGE),), settings.shape, (1,)
        return VectorFunction(law, shapes, is_kernel=True), settings

    def kernel_call(self) -> tuple[int, FloatArray]:
        """Return the address of the compiled law (``linalg.functions``), and its settings."""
        return self._function[0].address, self._function[1]

    def describe(self, sent: Transmission) -> FloatArray:
        """Return what the kernel knows of K messages ``sent`` on one link, (K, len(MESSAGE))."""
        columns: tuple[Any, ...] = *sent.link, *(getattr(sent, name) for name in MESSAGE[2:])
        if np.ndim(sent.number) == 0:  # SimPy asks for one at a time
            return np.array([columns], dtype=np.float64)
        rows = np.broadcast_arrays(*(np.asarray(c, dtype=np.float64) for c in columns))
        return np.stack(rows, axis=1)

    def delivery_probability(self, sent: Transmission) -> Any:
        """Return what the kernel says of the message, or of K messages on one link (K,)."""
        messages = self.describe(sent)
        times = np.array(np.broadcast_to(sent.time, len(messages)), dtype=np.float64)
        out = np.empty((len(messages), 1))
        fill_probabilities(*self.kernel_call(), messages, times, out)
        return out[:, 0] if np.ndim(sent.number) else float(out[0, 0])


@kernel
def fill_probabilities(
    address: int, settings: FloatArray, messages: FloatArray, times: FloatArray, out: FloatArray
) -> None:
    """Write the delivery probabilities (K, 1) of ``messages`` (K, M) sent at ``times`` (K,)."""
    for k in range(len(times)):
        out[k, 0] = math.nan  # a law that writes nothing says nothing
        call_function(address, messages[k], settings, times[k], 0.0, out[k])


def law_in_kernels(loss: Loss) -> bool:
    """Return True if a kernel alone says with which probability a message arrives."""
    if not isinstance(loss, KernelLoss) or loss.stateful or has_conditions(loss):
        return False
    return type(loss).delivery_probability is KernelLoss.delivery_probability


def identical_per_link(loss: Loss) -> bool:
    """Return True if a directed link has one delivery probability while nodes stay."""
    # By exact type: a subclass may override delivery_probability.
    return type(loss) in (NoLoss, Bernoulli, SharedLoss, PerLink, DistanceLoss)


def has_conditions(loss: Loss) -> bool:
    """Return True if the class draws conditions of a run."""
    return type(loss).conditions is not Loss.conditions


def is_vectorised(part: Any, method: str) -> bool:
    """Return True if the class that defines a ``method`` says that it takes many messages."""
    ancestors = type(part).__mro__
    says, defines = (
        next(k for k, cls in enumerate(ancestors) if name in vars(cls))
        for name in ("vectorised", method)
    )
    return bool(part.vectorised) and says <= defines


def next_state(loss: Loss, link: Link, before: bool | None, random: np.random.Generator) -> bool:
    """Return ``loss.next_state``; raises ScenarioError unless it is True or False."""
    bad: Any = loss.next_state(link, before, random)
    if not isinstance(bad, bool | np.bool_):
        rule = f"{type(loss).__name__}.next_state must return True or False, not {quote(bad)}"
        raise ScenarioError("network.channel.loss", rule)
    return bool(bad)


def has_one_probability(loss: Loss, sent: Transmission, horizon: float) -> bool:
    """Return True if all messages of a link up to the ``horizon`` (s) have one probability."""
    times = np.linspace(0.0, horizon, MESSAGES_ASKED, endpoint=False)
    many = sent._replace(number=np.arange(MESSAGES_ASKED), time=times)
    return float(np.ptp(delivery_probabilities(loss, many))) == 0.0


def stated_delivery(loss: Loss, sent: Transmission, horizon: float) -> float:
    """Return ``loss.mean_delivery``, nan if a user's class leaves it to Loss and messages differ;
    raises ScenarioError unless it is a probability or nan.
    """
    mean: Any = loss.mean_delivery(sent)
    is_left = type(loss).mean_delivery is Loss.mean_delivery and not identical_per_link(loss)
    if is_left and not (math.isnan(mean) or has_one_probability(loss, sent, horizon)):
        return math.nan
    if isinstance(mean, float) and math.isnan(mean):
        return math.nan
    name = f"{type(loss).__name__}.mean_delivery"
    return float(probability(f"network.channel.loss.{name}", mean))


def delivery_probabilities(loss: Loss, sent: Transmission) -> FloatArray:
    """Return checked probabilities (K,) of messages ``sent`` on a link; raises ScenarioError."""
    if is_vectorised(loss, "delivery_probability"):
        values = demand_probability(loss, sent, loss.delivery_probability(sent))
        return np.broadcast_to(values, np.shape(sent.number))
    return np.array([checked_delivery_probability(loss, one) for one in each_message(sent)])


def each_message(sent: Transmission) -> Iterator[Transmission]:
    """Yield each of the K messages ``sent`` on a link."""
    columns = np.broadcast_arrays(sent.number, sent.time, sent.bad, sent.distance)
    for k, t, bad, distance in zip(*(c.tolist() for c in columns), strict=True):
        yield sent._replace(number=k, time=t, bad=bad, distance=distance)


def checked_delivery_probability(loss: Loss, sent: Transmission) -> float:
    """Return the probability that ``sent`` arrives; raises ScenarioError outside [0, 1]."""
    value = loss.delivery_probability(sent)
    is_right = isinstance(value, float) and 0.0 <= value <= 1.0 and not loss.deterministic
    return value if is_right else float(demand_probability(loss, sent, value))


def demand_probability(loss: Loss, sent: Transmission, given: Any) -> FloatArray:
    """Return the probabilities of messages ``sent`` on a link; raises ScenarioError unless they are
    numbers in [0, 1], and 0 or 1 if the loss is deterministic.
    """
    values = np.asarray(given)
    if values.dtype.kind not in "fiub" or values.shape not in ((), np.shape(sent.number)):
        rule = f"must return a number, not {quote(given)}"
        raise ScenarioError(
            "network.channel.loss", f"{type(loss).__name__}.delivery_probability {rule}"
        )
    is_right = (values >= 0.0) & (values <= 1.0)
    text = "in [0, 1]"
    if is_right.all() and loss.deterministic:
        is_right, text = (values == 0.0) | (values == 1.0), "0 or 1 where deterministic is True"
    if is_right.all():
        return np.asarray(values, dtype=np.float64)
    wrong = np.flatnonzero(~is_right)
    number = np.ravel(sent.number)[wrong[0]]
    rule = (
        f"{type(loss).__name__}: the delivery probability of message {number} on link "
        f"{list(sent.link)} must be {text}"
    )
    remedy = "correct delivery_probability of the class"
    if isinstance(loss, KernelLoss):
        remedy = "correct the law of the class"
    raise ScenarioError("network.channel.loss", rule, float(values.ravel()[wrong[0]]), remedy)
