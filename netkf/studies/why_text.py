"""An explanation in words, as tables, and as a JSON document."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from netkf.core.printable import shorten
from netkf.network.deliveries import MessageKey
from netkf.runs.files import to_json_value
from netkf.runs.tables import format_number, format_table, shorten_rows
from netkf.studies.explanation import GOOD_ENOUGH, Explanation, InformationSource, WhatIf
from netkf.studies.message_sets import SmallestSet

if TYPE_CHECKING:
    import pandas as pd

MAX_ROWS, MAX_LISTED = 20, 4
COUNT_WORDS = ("no", "one", "two", "three")


def source_table(explanation: Explanation) -> pd.DataFrame:
    """Return a row for each source: times and ages in seconds, nan if unknown."""
    import pandas as pd

    # Ages are also known for 1, 2, ... ``budget`` more messages delivered.
    budget = len(explanation.sources[0].with_more) if explanation.sources else 0
    rows = [
        {
            "node": s.node,
            "sensor": s.sensor,
            "neighbour": s.neighbour,
            "heard": s.heard,
            "arrived": s.arrived,
            "unheard": s.unheard,
            "known_age": _age_at_sample(explanation, s.known),
            "reading": s.reading,
            "reading_age": _age_at_sample(explanation, s.reading),
            "route": " -> ".join(map(str, s.route)),
            **{
                f"age_with_{k}_more": explanation.at - s.with_more[k - 1]
                for k in range(1, budget + 1)
            },
            "age_without_losses": explanation.at - s.without_losses,
            "missing": "; ".join(map(str, s.missing)),
        }
        for s in explanation.sources
    ]
    return pd.DataFrame(rows)


def why_document(explanation: Explanation) -> dict[str, Any]:
    """Return an explanation as plain JSON values; what is unknown is None."""
    smallest = explanation.smallest
    document: dict[str, Any] = {
        "scenario": explanation.scenario,
        "node": explanation.node,
        "at": explanation.at,
        "seed": explanation.seed,
        "replica": explanation.replica,
        "trace": explanation.trace,
        "error": explanation.error,
        "sentences": write_sentences(explanation),
        "sources": [
            {**vars(s), "missing": [_message_entry(explanation, m.key) for m in s.missing]}
            for s in explanation.sources
        ],
        "what_ifs": [
            {
                "label": w.label,
                "messages": _message_entries(explanation, w.messages),
                "trace": w.trace,
                "error": w.error,
            }
            for w in explanation.what_ifs
        ],
        "smallest": None,
        "notes": explanation.notes,
    }
    if smallest is not None:
        messages = _message_entries(explanation, smallest.messages)
        document["smallest"] = {
            **vars(smallest),
            "messages": messages,
            "best": _message_entries(explanation, smallest.best),
            "proven": smallest.proven,
        }
    plain: dict[str, Any] = to_json_value(document)
    return plain


def _message_entries(
    explanation: Explanation, keys: Sequence[MessageKey] | None
) -> list[dict[str, Any]] | None:
    """Return the messages ``keys`` as entries of the document, in their order; None for None."""
    return None if keys is None else [_message_entry(explanation, key) for key in keys]


def _message_entry(explanation: Explanation, key: MessageKey) -> dict[str, Any]:
    missing = explanation.missing[key]
    return {
        "sender": key.sender,
        "receiver": key.receiver,
        "message": key.number,
        "outcome": missing.outcome,
        "sent": missing.sent,
        "arrived": missing.arrived,
    }


def format_why(explanation: Explanation) -> str:
    """Return an explanation for a terminal: sentences, sources and replays."""
    lines = [
        *write_sentences(explanation),
        "",
        _source_table(explanation),
        "",
        _replay_table(explanation),
    ]
    lines += [f"note: {note}" for note in explanation.notes]
    return "\n".join(lines)


def write_sentences(explanation: Explanation) -> list[str]:
    """Return an explanation in sentences, one line each."""
    return [
        *_state_sentences(explanation),
        *_heard_sentences(explanation),
        *_reading_sentences(explanation),
        *_smallest_sentences(explanation),
    ]


def _state_sentences(explanation: Explanation) -> Iterator[str]:
    run = f"seed {explanation.seed}, replica {explanation.replica}"
    scenario = shorten(explanation.scenario, 60)
    sentence = f"Node {explanation.node} at {explanation.at:g} s ({scenario}, {run})"
    if math.isfinite(explanation.trace):
        rms = math.sqrt(max(explanation.trace, 0.0))
        sentence += f": trace P is {explanation.trace:.4g}, which claims an RMS error of {rms:.3g}"
    else:
        sentence += ": the filter gives no covariance"
    error = f"; its error is {explanation.error:.3g}" if math.isfinite(explanation.error) else ""
    yield f"{sentence}{error}."


def _heard_sentences(explanation: Explanation) -> Iterator[str]:
    neighbours = [s for s in explanation.sources if s.neighbour]
    if not neighbours:
        yield f"No other node sends to node {explanation.node}."
        return
    heard = sorted((s for s in neighbours if not math.isnan(s.heard)), key=lambda s: -s.heard)
    silent = [s.node for s in neighbours if math.isnan(s.heard)]
    parts = [
        f"node {s.node} {_format_time_before(explanation, s.heard)}" for s in heard[:MAX_LISTED]
    ]
    if parts:
        others = f" and {len(heard) - MAX_LISTED} others before" if len(heard) > MAX_LISTED else ""
        yield f"It last heard {_join_with_and(parts)}{others} (times of sending)."
    if silent:
        yield f"It had never heard node {_list_items(silent)}."
    if any(s.unheard for s in neighbours):
        yield _unheard_sentence(neighbours)


def _unheard_sentence(neighbours: list[InformationSource]) -> str:
    unheard = sum(s.unheard for s in neighbours)
    counts = [f"{s.unheard} of node {s.node}" for s in neighbours if s.unheard]
    noun = "message" if unheard == 1 else "messages"
    verb = "was" if unheard == 1 else "were"
    return (
        f"{unheard} {noun} sent to it since then {verb} lost, late or not used: "
        f"{_list_items(counts, 'other nodes')}."
    )


def _reading_sentences(explanation: Explanation) -> Iterator[str]:
    sensors = [s for s in explanation.sources if s.sensor and s.node != explanation.node]
    with_reading = sorted(
        (s for s in sensors if not math.isnan(s.reading)), key=lambda s: s.reading
    )
    without_reading = [s for s in sensors if math.isnan(s.reading)]
    if with_reading:
        oldest = with_reading[:MAX_LISTED]
        parts = [
            f"{explanation.at - s.reading:.4g} s old from node {s.node} ({_format_route(s)})"
            for s in oldest
        ]
        prefix = "The oldest of its" if len(with_reading) > MAX_LISTED else "Its"
        yield f"{prefix} newest readings are {_join_with_and(parts)}."
    if without_reading:
        nodes = _list_items([s.node for s in without_reading])
        yield f"No reading of node {nodes} can have reached it."
    yield from _missed_reading_sentences(explanation, with_reading + without_reading)


def _missed_reading_sentences(
    explanation: Explanation, sensors: list[InformationSource]
) -> Iterator[str]:
    kept_from_newer = [s for s in sensors if s.missing]
    for source in kept_from_newer[:MAX_LISTED]:
        # with_more[k - 1]: time of the newest reading with k more messages.
        newest = source.with_more[len(source.missing) - 1]
        messages = _join_with_and([str(m) for m in source.missing])
        age = f"{explanation.at - newest:.4g} s old"
        yield f"A newer reading of node {source.node}, {age}, would have come with {messages}."
    if len(kept_from_newer) > MAX_LISTED:
        others = len(kept_from_newer) - MAX_LISTED
        yield f"Newer readings of {others} other nodes would have come too, with these or others."
    if sensors and not kept_from_newer:
        count = len(sensors[0].with_more)
        messages = "one message" if count == 1 else f"up to {COUNT_WORDS[count]} messages"
        yield f"No newer reading was kept away by {messages} that did not come."


def _smallest_sentences(explanation: Explanation) -> Iterator[str]:
    """Yield the sentences on the smallest set of missing messages; none without P."""
    # The last replay is the one in which no message is missing.
    smallest, no_losses = explanation.smallest, explanation.what_ifs[-1]
    if smallest is None:
        return
    change = relative_change(no_losses.trace, explanation.trace)
    error = "" if math.isnan(no_losses.error) else f" and the error {no_losses.error:.4g}"
    yield f"Had no message been missing, trace P would be {no_losses.trace:.4g} ({change}){error}."
    if smallest.messages == ():
        limit = _format_limit(explanation, smallest)
        yield f"No message had to come: trace P as it was is at most {limit}."
        return
    tried = _describe_search(smallest)
    if smallest.messages is not None:
        named = _join_with_and([str(explanation.missing[key]) for key in smallest.messages])
        is_single = len(smallest.messages) == 1
        subject = (
            "One message would"
            if is_single
            else f"{len(smallest.messages)} messages together would"
        )
        fewer = (
            ""
            if is_single
            else ("; fewer would not" if smallest.proven else "; perhaps fewer would")
        )
        yield (
            f"{subject} have brought trace P to {smallest.trace:.4g} (wanted: at most "
            f"{_format_limit(explanation, smallest)}): {named}{fewer} ({tried})."
        )
        return
    limit = _format_limit(explanation, smallest)
    if smallest.proven:
        yield f"No {smallest.most} messages or fewer would have brought it to {limit} ({tried})."
    else:
        yield (
            f"No set of up to {smallest.most} messages brought it to {limit}, of those that were "
            f"tried ({tried}; --replays tries more)."
        )
    if smallest.best:
        named = _join_with_and([str(explanation.missing[key]) for key in smallest.best])
        change = relative_change(smallest.best_trace, explanation.trace)
        yield f"The best that was tried brings it to {smallest.best_trace:.4g} ({change}): {named}."


def _format_limit(explanation: Explanation, smallest: SmallestSet) -> str:
    usual = (1.0 + GOOD_ENOUGH) * explanation.what_ifs[-1].trace
    where = f", {1.0 + GOOD_ENOUGH:g} times that with no message missing"
    is_default = math.isclose(smallest.limit, usual, rel_tol=1e-9)
    return f"{smallest.limit:.4g}{where if is_default else ''}"


def _describe_search(smallest: SmallestSet) -> str:
    sentence = f"{smallest.candidates} messages could have mattered"
    if smallest.considered < smallest.candidates:
        if not smallest.considered:
            return f"{sentence}; all of them together change next to nothing"
        since = f"{smallest.considered} of them sent from {smallest.since:.6g} s on"
        sentence += f", {since}; all before would have changed next to nothing"
    return f"{sentence}; {smallest.replays} replays"


def _source_table(explanation: Explanation) -> str:
    """Return the table of nodes with a sensor or a link to the node; others are counted."""
    listed = [
        s for s in explanation.sources if s.sensor or s.neighbour or s.node == explanation.node
    ]
    others = len(explanation.sources) - len(listed)
    budget = len(listed[0].with_more) if listed else 0
    header = ["from", "last heard", "missed since", "newest reading", "age"]
    header += [f"+{k}" for k in range(1, budget + 1)] + ["none lost", "way"]
    rows = [
        [
            f"{s.node}{'' if s.sensor else ' (no sensor)'}",
            _format_time(s.heard),
            str(s.unheard) if s.neighbour else "-",
            _format_time(s.reading),
            *(
                format_number(explanation.at - t)
                for t in (s.reading, *s.with_more, s.without_losses)
            ),
            _format_route(s),
        ]
        for s in listed
    ]
    text = format_table(header, shorten_rows(rows, MAX_ROWS), left_columns=1)
    other_text = f"\n{others} other nodes have no sensor and no link to it." if others else ""
    explained = (
        f"times in seconds; +1 .. +{budget}: age of the newest reading with so many more messages"
    )
    return f"{text}\n{explained}{other_text}"


def _replay_table(explanation: Explanation) -> str:
    truth = any(math.isfinite(w.error) for w in explanation.what_ifs)
    header = ["replayed with", "messages", "trace P", "change", *(["error"] if truth else [])]
    rows = [
        [
            w.label,
            _count_messages(w),
            format_number(w.trace),
            # The first row is the run as it was, from which the others are changes.
            "" if k == 0 else relative_change(w.trace, explanation.trace),
            *([format_number(w.error)] if truth else []),
        ]
        for k, w in enumerate(explanation.what_ifs)
    ]
    return format_table(header, shorten_rows(rows, MAX_ROWS), left_columns=1)


def _count_messages(what_if: WhatIf) -> str:
    return "all" if what_if.messages is None else str(len(what_if.messages))


def relative_change(trace: float, base: float) -> str:
    """Return the relative difference of a trace from ``base`` in percent, as text."""
    if not (math.isfinite(trace) and base > 0.0):
        return "-"
    percent = round(100.0 * (trace / base - 1.0), 1) + 0.0  # no -0.0
    return f"{percent:+.1f} %"


def _format_time(seconds: float) -> str:
    """Return seconds as text, "-" for nan."""
    return "-" if math.isnan(seconds) else f"{seconds:.6g}"


def _age_at_sample(explanation: Explanation, seconds: float) -> float:
    """Return the age in seconds of something at the time of the sample."""
    return seconds if math.isnan(seconds) else max(0.0, explanation.at - seconds)


def _format_time_before(explanation: Explanation, seconds: float) -> str:
    """Return a time in seconds as text, with its distance from the sample."""
    # A filtered sample has the time of the beginning of its slot, before the slot's exchanges.
    since = (
        "in this slot" if seconds > explanation.at else f"{explanation.at - seconds:.4g} s before"
    )
    return f"at {seconds:.6g} s ({since})"


def _format_route(source: InformationSource) -> str:
    if not source.route:
        return "-"
    if len(source.route) == 1:
        return "its own"
    nodes = (
        source.route if len(source.route) <= 6 else (*source.route[:3], "..", *source.route[-2:])
    )
    return " -> ".join(map(str, nodes))


def _list_items(items: Sequence[object], others: str = "others") -> str:
    """Return the first MAX_LISTED items joined, and the number of the ``others``."""
    parts = [str(item) for item in items[:MAX_LISTED]]
    more = len(items) - len(parts)
    return _join_with_and([*parts, f"{more} {others}"] if more else parts)


def _join_with_and(parts: Sequence[str]) -> str:
    """Return parts joined by commas and "and"."""
    if len(parts) < 2:
        return "".join(parts)
    return f"{', '.join(parts[:-1])} and {parts[-1]}"
