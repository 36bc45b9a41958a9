"""The explanation of the estimate of a node at an instant: values, words, tables, a document."""

from __future__ import annotations

import html
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

from netkf.core.printable import count_phrase, shorten
from netkf.network.deliveries import MessageKey
from netkf.runs.files import to_json_value
from netkf.runs.outcomes import Downtime
from netkf.runs.tables import format_number, format_table, in_unit, shorten_rows
from netkf.studies.message_sets import SmallestSet

if TYPE_CHECKING:
    import pandas as pd

MAX_ROWS, MAX_LISTED = 20, 4
COUNT_WORDS = ("no", "one", "two", "three")

GOOD_ENOUGH = 0.05
"""By default a set of messages suffices if it brings the trace of P to at most 1 + GOOD_ENOUGH
times that of the run with every message delivered.
"""


class Missing(NamedTuple):
    """A message, number ``message`` from ``sender`` to ``receiver`` (ids), that was sent but not
    used: its ``outcome`` (of OUTCOMES), and when it was ``sent`` and ``arrived`` (s, or nan).
    """

    sender: int
    receiver: int
    message: int
    outcome: str
    sent: float
    arrived: float

    @property
    def key(self) -> MessageKey:
        """The identity of the message."""
        return MessageKey(self.sender, self.receiver, self.message)

    def __str__(self) -> str:
        link = f"{self.sender} -> {self.receiver} number {self.message}"
        return f"{link} ({self.outcome}, sent at {self.sent:.6g} s)"


@dataclass(frozen=True)
class InformationSource:
    """The information of one ``node``, the source, that had reached the node asked about. Times are
    in seconds, nan if unknown.

    sensor          the source has a sensor
    neighbour       the source can send to the node asked about directly
    heard, arrived  when the last used message from the source was sent, and when it arrived
    unheard         number of messages from the source sent since then and not used
    known           last time up to which information of the source can have arrived, on any path
    reading         time of its newest reading whose information can have arrived
    route           ids of the nodes on the path of its newest information, the source first
    with_more       times of its newest reading with at most 1, 2, ... missing messages delivered
    without_losses  time of its newest reading with every message delivered
    missing         the fewest missing messages that would have brought a newer reading; empty if
                    there is none, or if more would be needed than the search allowed
    """

    node: int
    sensor: bool
    neighbour: bool
    heard: float
    arrived: float
    unheard: int
    known: float
    reading: float
    route: tuple[int, ...]
    with_more: tuple[float, ...]
    without_losses: float
    missing: tuple[Missing, ...]


@dataclass(frozen=True)
class WhatIf:
    """A replay with the missing ``messages`` delivered, or all messages for None: the trace of P at
    the node, and the length of its error (nan without a known truth).
    """

    label: str
    messages: tuple[MessageKey, ...] | None
    trace: float
    error: float


@dataclass(frozen=True, eq=False, repr=False)
class Why:
    """The explanation of the estimate of ``node`` at ``at`` seconds in one run of a scenario.

    ``trace`` is that of its covariance P and ``error`` the length of its error. ``sources`` has the
    information that had reached it from each node, ``what_ifs`` P and error in replays, the run as
    it was first, and ``smallest`` the smallest set of missing messages that would have sufficed
    (None if the filter gives no P). ``missing`` has all messages that were not used, by their
    identity, ``down`` the nodes that were down at that instant, and ``notes`` sentences on the
    limits of the replays; ``unit`` is that of all states, empty where they have none or several.
    """

    scenario: str
    node: int
    at: float
    seed: int
    replica: int
    sources: tuple[InformationSource, ...]
    what_ifs: tuple[WhatIf, ...]
    smallest: SmallestSet | None
    missing: dict[MessageKey, Missing] = field(repr=False)
    down: tuple[Downtime, ...] = ()
    notes: tuple[str, ...] = ()
    unit: str = ""

    @property
    def trace(self) -> float:
        """The trace of P at the node."""
        return self.what_ifs[0].trace

    @property
    def error(self) -> float:
        """The length of x - xhat at the node, nan without a known truth."""
        return self.what_ifs[0].error

    @cached_property
    def table(self) -> pd.DataFrame:
        """A row for each other node, and the node itself if it has a sensor: ages in seconds."""
        import pandas as pd

        # Ages are also known for 1, 2, ... ``budget`` more messages delivered.
        budget = len(self.sources[0].with_more) if self.sources else 0
        rows = [
            {
                "node": s.node,
                "sensor": s.sensor,
                "neighbour": s.neighbour,
                "heard": s.heard,
                "arrived": s.arrived,
                "unheard": s.unheard,
                "known_age": self._age_at_sample(s.known),
                "reading": s.reading,
                "reading_age": self._age_at_sample(s.reading),
                "route": " -> ".join(map(str, s.route)),
                **{
                    f"age_with_{k}_more": self.at - s.with_more[k - 1] for k in range(1, budget + 1)
                },
                "age_without_losses": self.at - s.without_losses,
                "missing": "; ".join(map(str, s.missing)),
            }
            for s in self.sources
        ]
        return pd.DataFrame(rows)

    def to_dict(self) -> dict[str, Any]:
        """Return plain JSON values; what is unknown is None."""
        document: dict[str, Any] = {
            **{name: getattr(self, name) for name in ("scenario", "node", "at", "seed", "replica")},
            "trace": self.trace,
            "error": self.error,
            "sentences": self.sentences(),
            "sources": [
                {**vars(s), "missing": [m._asdict() for m in s.missing]} for s in self.sources
            ],
            "what_ifs": [{**vars(w), "messages": self._entries(w.messages)} for w in self.what_ifs],
            "smallest": None,
            "down": [one._asdict() for one in self.down],
            "notes": self.notes,
        }
        if self.smallest is not None:
            document["smallest"] = {
                **vars(self.smallest),
                "messages": self._entries(self.smallest.messages),
                "best": self._entries(self.smallest.best),
                "proven": self.smallest.proven,
            }
        plain: dict[str, Any] = to_json_value(document)
        return plain

    def _entries(self, keys: Sequence[MessageKey] | None) -> list[dict[str, Any]] | None:
        return None if keys is None else [self.missing[key]._asdict() for key in keys]

    def __repr__(self) -> str:
        at = f"node {self.node} at {self.at:g} s"
        return f"<netkf why: {at} of {self.scenario!r}, trace P {self.trace:.4g}>"

    def __str__(self) -> str:
        notes = [f"note: {note}" for note in self.notes]
        tables = ["", self._source_table(), "", self._replay_table()]
        return "\n".join([*self.sentences(), *tables, *notes])

    def _repr_html_(self) -> str:
        return f"<pre>{html.escape(str(self))}</pre>"

    def sentences(self) -> list[str]:
        """Return the explanation in sentences, one line each."""
        found = *self._state_sentences(), *self._heard_sentences(), *self._reading_sentences()
        return [*found, *self._smallest_sentences()]

    def _state_sentences(self) -> Iterator[str]:
        run = f"seed {self.seed}, replica {self.replica}"
        sentence = f"Node {self.node} at {self.at:g} s ({shorten(self.scenario, 60)}, {run})"
        if math.isfinite(self.trace):
            rms = math.sqrt(max(self.trace, 0.0))
            sentence += f": trace P is {self.trace:.4g}{in_unit(self.unit, 2)}, which claims an "
            sentence += f"RMS error of {rms:.3g}{in_unit(self.unit)}"
        else:
            sentence += ": the filter gives no covariance"
        error = ""
        if math.isfinite(self.error):
            error = f"; its error is {self.error:.3g}{in_unit(self.unit)}"
        yield f"{sentence}{error}."
        for one in self.down[:MAX_LISTED]:
            since = f"since {one.begin:.6g} s, {self.at - one.begin:.4g} s before ({one.kind})"
            subject = "It was itself" if one.node == self.node else f"Node {one.node} was"
            yield f"{subject} down {since if one.kind else 'since the beginning'}."
        if len(self.down) > MAX_LISTED:
            yield f"Down too: {count_phrase(len(self.down) - MAX_LISTED, 'other node')}."

    def _heard_sentences(self) -> Iterator[str]:
        neighbours = [s for s in self.sources if s.neighbour]
        if not neighbours:
            yield f"No other node sends to node {self.node}."
            return
        heard = sorted((s for s in neighbours if not math.isnan(s.heard)), key=lambda s: -s.heard)
        silent = [s.node for s in neighbours if math.isnan(s.heard)]
        parts = [f"node {s.node} {self._format_time_before(s.heard)}" for s in heard[:MAX_LISTED]]
        if parts:
            more = len(heard) - MAX_LISTED
            others = [f"{count_phrase(more, 'other')} before"] if more > 0 else []
            yield f"It last heard {_join_with_and([*parts, *others])} (times of sending)."
        if silent:
            yield f"It had never heard node {list_items(silent)}."
        unheard = sum(s.unheard for s in neighbours)
        if unheard:
            counts = [f"{s.unheard} of node {s.node}" for s in neighbours if s.unheard]
            verb = "message sent to it since then was"
            verb = verb if unheard == 1 else "messages sent to it since then were"
            listed = list_items(counts, "other node")
            yield f"{unheard} {verb} lost, late or not used: {listed}."

    def _reading_sentences(self) -> Iterator[str]:
        sensors = [s for s in self.sources if s.sensor and s.node != self.node]
        known = sorted((s for s in sensors if not math.isnan(s.reading)), key=lambda s: s.reading)
        without_reading = [s for s in sensors if math.isnan(s.reading)]
        if known:
            parts = [
                f"{self.at - s.reading:.4g} s old from node {s.node} ({_format_route(s)})"
                for s in known[:MAX_LISTED]
            ]
            prefix = "The oldest of its" if len(known) > MAX_LISTED else "Its"
            yield f"{prefix} newest readings are {_join_with_and(parts)}."
        if without_reading:
            nodes = list_items([s.node for s in without_reading])
            yield f"No reading of node {nodes} can have reached it."
        yield from self._missed_reading_sentences(known + without_reading)

    def _missed_reading_sentences(self, sensors: list[InformationSource]) -> Iterator[str]:
        kept_from_newer = [s for s in sensors if s.missing]
        for source in kept_from_newer[:MAX_LISTED]:
            # with_more[k - 1]: time of the newest reading with k more messages.
            newest = source.with_more[len(source.missing) - 1]
            messages = _join_with_and([str(m) for m in source.missing])
            age = f"{self.at - newest:.4g} s old"
            yield f"A newer reading of node {source.node}, {age}, would have come with {messages}."
        if len(kept_from_newer) > MAX_LISTED:
            others = count_phrase(len(kept_from_newer) - MAX_LISTED, "other node")
            yield f"Newer readings of {others} would have come too, with these or others."
        if sensors and not kept_from_newer:
            count = len(sensors[0].with_more)
            messages = "one message" if count == 1 else f"up to {COUNT_WORDS[count]} messages"
            yield f"No newer reading was kept away by {messages} that did not come."

    def _smallest_sentences(self) -> Iterator[str]:
        # The last replay is the one in which no message is missing.
        smallest, no_losses = self.smallest, self.what_ifs[-1]
        if smallest is None:
            return
        change = relative_change(no_losses.trace, self.trace)
        error = "" if math.isnan(no_losses.error) else f" and the error {no_losses.error:.4g}"
        trace = f"{no_losses.trace:.4g} ({change})"
        yield f"Had no message been missing, trace P would be {trace}{error}."
        tried, limit = _describe_search(smallest), self._format_limit(smallest)
        if smallest.messages:
            named = _join_with_and([str(self.missing[key]) for key in smallest.messages])
            subject, fewer = "One message", ""
            if len(smallest.messages) > 1:
                subject = f"{len(smallest.messages)} messages together"
                fewer = "; fewer would not" if smallest.proven else "; perhaps fewer would"
            yield (
                f"{subject} would have brought trace P to {smallest.trace:.4g} (wanted: at most "
                f"{limit}): {named}{fewer} ({tried})."
            )
        elif smallest.messages is not None:
            yield f"No message was needed: trace P as it was is already at most {limit}."
        elif smallest.proven:
            most = f"{smallest.most} messages or fewer"
            yield f"No {most} would have brought it to {limit} ({tried})."
        else:
            yield (
                f"No set of up to {smallest.most} messages brought it to {limit}, of those that "
                f"were tried ({tried}; --replays tries more)."
            )
        if smallest.messages is None and smallest.best:
            named = _join_with_and([str(self.missing[key]) for key in smallest.best])
            change = relative_change(smallest.best_trace, self.trace)
            trace = f"{smallest.best_trace:.4g} ({change})"
            yield f"The best that was tried brings it to {trace}: {named}."

    def _format_limit(self, smallest: SmallestSet) -> str:
        usual = (1.0 + GOOD_ENOUGH) * self.what_ifs[-1].trace
        where = f", {1.0 + GOOD_ENOUGH:g} times that with no message missing"
        is_default = math.isclose(smallest.limit, usual, rel_tol=1e-9)
        return f"{smallest.limit:.4g}{where if is_default else ''}"

    def _source_table(self) -> str:
        """Return the table of nodes with a sensor or a link to the node; others are counted."""
        listed = [s for s in self.sources if s.sensor or s.neighbour or s.node == self.node]
        others = len(self.sources) - len(listed)
        budget = len(listed[0].with_more) if listed else 0
        header = ["from", "last heard", "missed since", "newest reading", "age"]
        header += [f"+{k}" for k in range(1, budget + 1)] + ["none lost", "way"]
        rows = [
            [
                f"{s.node}{'' if s.sensor else ' (no sensor)'}",
                _format_time(s.heard),
                str(s.unheard) if s.neighbour else "-",
                _format_time(s.reading),
                *(format_number(self.at - t) for t in (s.reading, *s.with_more, s.without_losses)),
                _format_route(s),
            ]
            for s in listed
        ]
        text = format_table(header, shorten_rows(rows, MAX_ROWS), left_columns=1)
        other_text = f"\nwithout a sensor and a link to it: {count_phrase(others, 'node')}"
        ages = f"+1 .. +{budget}: age of the newest reading with so many more messages"
        return f"{text}\ntimes in seconds; {ages}{other_text if others else ''}"

    def _replay_table(self) -> str:
        truth = any(math.isfinite(w.error) for w in self.what_ifs)
        header = ["replayed with", "messages", "trace P" + in_unit(self.unit, 2, ", "), "change"]
        header += ["error" + in_unit(self.unit, 1, ", ")] if truth else []
        rows = [
            [
                w.label,
                "all" if w.messages is None else str(len(w.messages)),
                format_number(w.trace),
                # The first row is the run as it was, from which the others are changes.
                "" if k == 0 else relative_change(w.trace, self.trace),
                *([format_number(w.error)] if truth else []),
            ]
            for k, w in enumerate(self.what_ifs)
        ]
        return format_table(header, shorten_rows(rows, MAX_ROWS), left_columns=1)

    def _age_at_sample(self, seconds: float) -> float:
        return seconds if math.isnan(seconds) else max(0.0, self.at - seconds)

    def _format_time_before(self, seconds: float) -> str:
        """Return a time in seconds as text, with its distance from the sample."""
        # A filtered sample has the time of the beginning of its slot, before the slot's exchanges.
        since = "in this slot" if seconds > self.at else f"{self.at - seconds:.4g} s before"
        return f"at {seconds:.6g} s ({since})"


def _describe_search(smallest: SmallestSet) -> str:
    sentence = f"{smallest.candidates} messages could have mattered"
    if smallest.considered < smallest.candidates:
        if not smallest.considered:
            return f"{sentence}; all of them together change next to nothing"
        since = f"{smallest.considered} of them sent from {smallest.since:.6g} s on"
        sentence += f", {since}; all before would have changed next to nothing"
    return f"{sentence}; {smallest.replays} replays"


def relative_change(trace: float, base: float) -> str:
    """Return the relative difference of a trace from ``base`` in percent, as text."""
    if not (math.isfinite(trace) and base > 0.0):
        return "-"
    percent = round(100.0 * (trace / base - 1.0), 1) + 0.0  # no -0.0
    return f"{percent:+.1f} %"


def _format_time(seconds: float) -> str:
    return "-" if math.isnan(seconds) else f"{seconds:.6g}"


def _format_route(source: InformationSource) -> str:
    if not source.route:
        return "-"
    if len(source.route) == 1:
        return "its own"
    nodes = (
        source.route if len(source.route) <= 6 else (*source.route[:3], "..", *source.route[-2:])
    )
    return " -> ".join(map(str, nodes))


def list_items(items: Sequence[object], other: str = "other") -> str:
    """Return the first MAX_LISTED items joined, and the number of each ``other``."""
    parts = [str(item) for item in items[:MAX_LISTED]]
    more = len(items) - len(parts)
    return _join_with_and([*parts, count_phrase(more, other)] if more else parts)


def _join_with_and(parts: Sequence[str]) -> str:
    return "".join(parts) if len(parts) < 2 else f"{', '.join(parts[:-1])} and {parts[-1]}"
