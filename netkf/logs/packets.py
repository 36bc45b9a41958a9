"""Packet logs: who sent when, who could hear it, and what became of it; and their tables.

An outcome is heard, lost, or unknown: a lost report is no lost packet. Every kind of log becomes
two tables, of transmissions and of outcomes, which ``settle`` completes so that for each sender and
hearer sent = heard + lost + unknown.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from decimal import Decimal
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from netkf.core.csv_files import is_number_text, open_table
from netkf.core.errors import ScenarioError
from netkf.core.fields import MAX_MAGNITUDE, SourceFile
from netkf.core.printable import count_phrase
from netkf.core.stamps import UNITS, TimeBase
from netkf.linalg.arrays import FloatArray

HOLE = 30.0
"""Packets that a silent receiver would have heard, after which its log has a hole."""
USUAL = 0.1
"""The smallest delivery of a sender whose silence says something."""
MODULI = sorted([*(2**k for k in (*range(4, 17), 24, 32)), 100, 1000, 10_000])
"""Lengths after which counters of packets begin again."""
MAX_SKIP = 1000
"""Numbers skipped at once beyond which a counter began again."""
TOLD, UNREPORTED = "no report tells", "nobody reported it"
NOT_LOGGED = "its sender logs what it sends, and not this"
"""Reasons for which outcomes are not known."""
RESTART = -1
"""What stands for a number of cycles where a counter began anew at any number."""
LATE = 2
"""A number may be that much smaller than the one before because reports are out of order."""
MAX_SECONDS = 1e11
"""Stamps from here on are hardly seconds: these would be of the year 5138."""
YEAR_1990, YEAR_2100 = 6.3e8, 4.1e9
"""In seconds since 1970."""
_ZONE = re.compile(r"[Tt ]\S+([Zz]|[+-]\d\d:?\d*)$")
_DATE = re.compile(r"(\d{4}-\d\d-\d\d)_(\d\d)[.:](\d\d)[.:](\d\d)")


@dataclass
class PacketLog:
    """A log as it was read; ``notes`` say what was used, merged, dropped and not known.

    sends    : sender, t (seconds from ``origin``), channel, to (the one receiver of a message, or
               empty for a broadcast), sent (False: inferred, not reported), logged (by the sender
               itself); in the order of t
    outcomes : send (row of ``sends``), receiver, heard (1, 0, nan for unknown), delay (s), rssi
    absent   : what a transmission without a row at a hearer is: "lost", "unknown", or "unsent"
    resolution : seconds of the last digit of stamps
    positions : node, x, y, and readings: t, node, y0; empty if there are none
    is_run   : times are simulated, those of a run, whose clocks have the table ``ticks``
    """

    sends: pd.DataFrame
    outcomes: pd.DataFrame
    origin: Decimal
    resolution: float
    absent: str = "lost"
    notes: list[str] = field(default_factory=list)
    positions: pd.DataFrame = field(default_factory=pd.DataFrame)
    readings: pd.DataFrame = field(default_factory=pd.DataFrame)
    is_run: bool = False
    ticks: Path | None = None


def read_text_rows(path: Path, source: SourceFile | None = None) -> pd.DataFrame:
    """Return a table as texts by line number, names in lower case; raises ScenarioError."""
    rows: list[list[str]] = []
    lines: list[int] = []
    try:
        with open_table(source or SourceFile(path.name, path.parent)) as sheet:
            header, separator = [name.lower() for name in sheet.header], sheet.separator
            for line, row in sheet.rows:
                if len(row) != len(header):
                    rule = f"line {line} must have {len(header)} entries"
                    raise ScenarioError(str(path), rule, row, "correct the row")
                rows.append([entry.strip() for entry in row])
                lines.append(line)
    except ScenarioError as error:
        if error.key != "path":
            raise
        raise ScenarioError(str(path), error.rule, error.value, error.remedy) from None
    for wrong, rule, remedy in (
        (len(header) == 1, "must have several columns", "separate them by comma, semicolon or tab"),
        (all(map(is_number_text, header)), "must name its columns", "write their names in line 1"),
    ):
        if wrong:
            raise ScenarioError(str(path), rule, header, remedy)
    for name in header:
        if header.count(name) > 1:
            raise ScenarioError(str(path), "must not repeat a column", name, "rename one of them")
    if not rows:
        raise ScenarioError(str(path), "has no rows", None, "check the file")
    table = pd.DataFrame(rows, columns=header, index=lines)
    return table if separator == "," else table.apply(_with_points)


def _with_points(column: pd.Series) -> pd.Series:
    is_decimal = column.str.fullmatch(r"([+-]?\d+(,\d+)?)?|nan").fillna(False).all()
    return column.str.replace(",", ".") if is_decimal else column


def parse_numbers(path: Path, table: pd.DataFrame, name: str, gaps: bool = False) -> FloatArray:
    """Return a column as numbers (K,), nan in ``gaps``; raises ScenarioError with the line."""
    texts = table[name]
    values = np.asarray(pd.to_numeric(texts, errors="coerce"), dtype=float)
    is_gap = np.asarray(texts.str.lower().isin(["", "nan", "none", "na"])) & gaps
    wrong, rule = ~np.isfinite(values) & ~is_gap, f"{name} must be a number"
    refuse_rows(path, texts, wrong, rule, "correct the entry")
    return values


def refuse_rows(
    path: Path, entries: pd.Series, wrong: Any, rule: str, remedy: str, quoted: bool = True
) -> None:
    """Raise ScenarioError with the line, and the entry if ``quoted``, of the first wrong row."""
    for k in np.flatnonzero(wrong)[:1]:
        value = entries.iloc[k] if quoted else None
        raise ScenarioError(str(path), f"line {entries.index[k]}: {rule}", value, remedy)


def _find_unit(path: Path, table: pd.DataFrame, name: str, notes: list[str] | None) -> str:
    """Return the unit that ends the name of stamps, else s, or what their size tells."""
    unit, first = name.rpartition("_")[2], str(next(iter(table[name]), ""))
    size = abs(float(first)) if re.fullmatch(r"[+-]?\d{12,}(\.\d*)?", first) else 0.0
    if unit in UNITS or size < MAX_SECONDS:
        return unit if unit in UNITS else "s"
    fits = [u for u, power in UNITS.items() if YEAR_1990 <= size * 10.0**power <= YEAR_2100]
    if not fits:
        remedy = f"say the unit of the column: --columns t_ns={name} (s, ms, us, ns)"
        rule = f"line {table.index[0]}: {name} is too large for seconds"
        raise ScenarioError(str(path), rule, first, remedy)
    if notes is not None:
        notes.append(f"used: {path.name}: {name} is in {fits[0]} since 1970, by its size")
    return fits[0]


def parse_stamps(
    path: Path, table: pd.DataFrame, name: str, notes: list[str] | None = None
) -> list[Decimal]:
    """Return a column of stamps as exact seconds (K,): numbers in the unit of ``_find_unit``, ISO
    8601 times, or 2014-09-07_22.41.23. Raises ScenarioError.
    """
    base = TimeBase(_find_unit(path, table, name, notes))
    stamps: list[Decimal] = []
    kinds: dict[tuple[bool, bool], int] = {}
    for line, text in zip(table.index, table[name], strict=True):
        try:
            stamps.append(base.exact(_DATE.sub(r"\1T\2:\3:\4", text)))
        except ValueError:
            rule = f"line {line}: {name} must be a number or an ISO 8601 time"
            raise ScenarioError(str(path), rule, text, "correct the entry") from None
        if abs(stamps[-1]) > MAX_MAGNITUDE:
            rule = f"line {line}: {name} must be at most {MAX_MAGNITUDE:g} s in size"
            raise ScenarioError(str(path), rule, text, "correct the entry")
        kinds.setdefault((":" in text, bool(_ZONE.search(text))), line)
    if len(kinds) > 1 and notes is not None:
        where = " and ".join(map(str, [*kinds.values()][:2]))
        notes.append(
            f"used: {path.name}: {name} in lines {where} is of two kinds: a number counts from "
            "1970, and a time without a zone is one of UTC"
        )
    return stamps


def find_resolution(stamps: list[Decimal]) -> float:
    """Return the seconds of the last digit that any of the stamps uses, at most 1."""
    exponents = {stamp.normalize().as_tuple().exponent for stamp in stamps}
    return 10.0 ** min([0, *(e for e in exponents if isinstance(e, int))])


def choose_origin(stamps: list[Decimal], resolution: float) -> Decimal:
    """Return the stamp of simulated 0: 0 if the log begins soon after it, else a whole second
    before the first. Nothing can be sent at 0 itself.
    """
    first, last = min(stamps), max(stamps)
    if 0 < first <= max((last - first) / 10, Decimal(1)):
        return Decimal(0)
    whole = Decimal(int(first // 1))
    return whole if first - whole >= Decimal(resolution) else whole - 1


def find_lead(numbers: FloatArray, times: FloatArray, who: np.ndarray) -> FloatArray:
    """Return how far the stamps (K,) of a sender's packets, by time, are ahead of those by reporter
    0, by what two say of one number; 0 if that is less than half of what lies between packets.
    """
    order = np.lexsort((times, numbers))
    t, same, by = times[order], np.diff(numbers[order]) == 0, who[order]
    # Rows of one number after a wrap are further apart, one of one reporter by a cycle.
    cycles = pd.Series(times).groupby([numbers, who]).diff()
    cycle = float(cycles[cycles > 0.0].quantile(0.1)) if (cycles > 0.0).any() else np.inf
    gaps = np.diff(t)
    chosen = same & (by[1:] != by[:-1]) & (gaps < 0.5 * cycle)
    low, high = np.minimum(by[1:], by[:-1])[chosen], np.maximum(by[1:], by[:-1])[chosen]
    apart = pd.Series(np.where(by[1:] > by[:-1], 1.0, -1.0)[chosen] * gaps[chosen])
    found = apart.groupby([low, high]).agg(["median", "size"])
    first, second = np.array([*found.index], dtype=int).reshape(-1, 2).T
    weights, ends = np.sqrt(found["size"].to_numpy()), np.eye(who.max() + 1)
    design = (weights[:, None] * (ends[second] - ends[first]))[:, 1:]
    lead = np.linalg.lstsq(design, weights * found["median"].to_numpy(), rcond=None)[0]
    lead, most = np.append(0.0, lead), np.flatnonzero(who == np.bincount(who).argmax())
    interval, steps = _find_interval(numbers[most], times[most]), np.diff(times)
    is_large = 0.0 < 0.5 * interval < np.ptp(lead) >= steps.min(initial=np.inf, where=steps > 0.0)
    return lead[who] if is_large else np.zeros(len(times))


def _find_interval(numbers: FloatArray, times: FloatArray) -> float:
    """Return the usual time between two packets, by the first of each stamp and number; 0 if none
    follow.
    """
    is_new = np.diff(numbers, prepend=-1) != 0
    first = np.flatnonzero(is_new & (np.diff(times, prepend=-np.inf) > 0.0))
    steps, gaps = np.diff(numbers[first]), np.diff(times[first])
    forward = (steps > 0) & (steps < MAX_SKIP)
    if not forward.any():
        return 0.0
    gaps, steps = gaps[forward], steps[forward]
    # Without pauses; a median alone would be a multiple of what stamps resolve.
    usual = gaps <= 2.0 * np.median(gaps / steps) * steps
    return float(gaps[usual].sum() / steps[usual].sum())


class _Counting(NamedTuple):
    """How a sender counts: ``modulus``, ``cycle`` (the same if it wraps, else 0), ``late`` (how far
    numbers fall out of order), ``slack`` (packets that one stamp may hide).
    """

    modulus: int
    cycle: int
    late: int
    slack: float


def unwrap(numbers: np.ndarray, times: FloatArray) -> tuple[np.ndarray, int, int, int]:
    """Return counters (K,) of one sender, by ``times``, that grow on where ``numbers`` begin again;
    how often they wrapped, by which modulus, and how often they restarted.

    A number that falls, with successors that stay down, wrapped if the skipped numbers fit the time
    passed, and else restarted; one that falls alone, in less time, is out of order. In a hole whole
    cycles may pass, unless the very next number follows: then the sender paused. Of one stamp those
    come first that go on from the last.
    """
    modulus = next((m for m in MODULI if m > numbers.max(initial=0)), 0)
    interval, gaps = _find_interval(numbers, times), np.diff(times)
    # Where one stamp has several packets, more may have been sent since than it shows.
    coarse = bool(((gaps == 0.0) & (np.diff(numbers) != 0)).any()) and bool((gaps > 0.0).any())
    grain = float(gaps[gaps > 0.0].min()) if coarse else 0.0
    cycle = modulus if (np.diff(numbers) < -0.5 * modulus).any() else 0
    late = _find_late(numbers, times, modulus) if coarse else LATE
    counting = _Counting(modulus, cycle, late, grain / interval if interval else 0.0)
    ends, numbers = np.searchsorted(times, times, "right"), numbers.copy()
    place: list[int] = []
    counters = np.empty(len(numbers), dtype=np.int64)
    offset = wraps = restarts = top = last = 0
    top_time = 0.0
    for k, time in enumerate(times.tolist()):
        if k == len(place):
            turn = _begin_at(numbers[k : ends[k]], last - late if k else None, modulus)
            place += (k + turn).tolist()
            numbers[k : ends[k]] = numbers[k : ends[k]][turn]
        number = int(numbers[k])
        expected = (time + grain - top_time) / interval if interval and k else 0.0
        coming = numbers[k : k + 8]
        begun = _cycles_begun(coming, last, expected, counting, wraps > 0) if k else 0
        if begun == RESTART:
            offset, restarts = top + 1 - number, restarts + 1
        else:
            offset, wraps = offset + begun * modulus, wraps + begun
        # One of before the wrap may come late, but not after as much time as it is ahead.
        is_late = k and cycle and not begun and number - last > max(0.5 * modulus, 2.0 * expected)
        counter = number + offset - (modulus if is_late else 0)
        counters[place[k]] = counter
        if not k or counter > top:
            top, top_time, last = counter, time, number
    return counters, wraps, modulus, restarts


def _find_late(numbers: np.ndarray, times: FloatArray, modulus: int) -> int:
    """Return how far numbers may fall from one coarse stamp to the next, where the clocks of those
    who report them differ: twice as far as usual, if they fall often.
    """
    first = np.flatnonzero(np.diff(times, prepend=-np.inf) > 0.0)
    falls = np.maximum.reduceat(numbers, first)[:-1] - np.minimum.reduceat(numbers, first)[1:]
    falls = falls[(falls > 0) & (falls < 0.25 * modulus)]
    return max(LATE, int(2 * np.median(falls))) if 10 * len(falls) > len(first) else LATE


def _cycles_begun(
    coming: np.ndarray, last: int, expected: float, counting: _Counting, wrapped: bool
) -> int:
    """Return how many cycles began between ``last`` and ``coming``; RESTART if it began anew."""
    number, modulus, least = int(coming[0]), counting.modulus, last - counting.late
    skipped = number + modulus - last
    turns = _whole_turns(skipped, expected, counting)
    is_due = modulus > 0 and (turns or abs(skipped - expected) <= 1.0 + 0.25 * expected)
    # After a whole cycle nothing is late any more.
    is_due |= expected > counting.cycle > 0
    falls = number < least and np.median(coming) < least
    if falls or (number <= last and is_due):
        return 1 + turns if modulus and skipped <= 2.0 * expected + 3.0 else RESTART
    if MAX_SKIP < number - last > 10.0 * expected and not wrapped:
        return RESTART
    return _whole_turns(number - last, expected, counting) if number > last + 1 else 0


def _whole_turns(step: int, expected: float, counting: _Counting) -> int:
    """Return how many cycles beside ``step`` packets fit a time of ``expected`` ones well."""
    cycle, slack, middle = counting.cycle, counting.slack, expected - counting.slack
    turns = round((middle - step) / cycle) if cycle else 0
    off = abs(step + turns * cycle - middle)
    return max(turns, 0) if off <= min(1.0 + slack + 0.05 * middle, 0.25 * cycle) else 0


def _begin_at(numbers: np.ndarray, first: int | None, modulus: int) -> np.ndarray:
    """Return the order of rising ``numbers`` on a circle, from ``first`` or the widest gap on."""
    if len(numbers) == 1 or not modulus:
        return np.arange(len(numbers))
    if first is None:
        widest = int(np.argmax(np.diff(numbers, append=numbers[0] + modulus)))
        first = int(numbers[(widest + 1) % len(numbers)])
    return np.argsort((numbers - first) % modulus, kind="stable")


def note_count(notes: list[str], count: float, what: str, text: str) -> None:
    """Add a note: ``text`` with a count of ``what`` in place of {}, unless it is 0."""
    if count:
        notes.append(text.replace("{}", count_phrase(int(count), what), 1))


def _time_to_next(t: pd.Series) -> Any:
    stamps = np.append(np.unique(t), np.inf)
    return stamps[np.searchsorted(stamps, t, "right")] - t


def spread_equal(sends: pd.DataFrame, resolution: float, notes: list[str]) -> None:
    """Move transmissions of a sender with one stamp apart, within ``resolution`` (s)."""
    key = [sends["sender"], sends["to"], sends["t"]]
    rank, size = sends.groupby(key).cumcount(), sends.groupby(key)["t"].transform("size")
    moved = int((rank > 0).sum())
    if moved:
        # Where clocks were aligned, the next stamp may be nearer than the resolution.
        room = sends.groupby(["sender", "to"])["t"].transform(_time_to_next)
        sends["t"] += (rank / size * np.fmin(room, resolution)).round(9)
        notes.append(
            f"moved: {count_phrase(moved, 'transmission')} that had the stamp of another one of "
            f"the sender, by less than the resolution of {resolution:g} s, in their order"
        )


def settle(log: PacketLog, hole: float, unreported: str) -> pd.DataFrame:
    """Return the outcome of each transmission at each node that could hear it, by time: columns
    send, receiver, heard (1, 0, nan), delay, rssi, why (it is not known).

    Without a row it is lost, or unknown: where ``log.absent`` says so, in a hole of the receiver's
    log (after ``hole`` packets), and unreported ones if ``unreported`` is "unknown".
    """
    sends, told = log.sends, log.outcomes
    pairs = told.assign(sender=sends["sender"].to_numpy()[told["send"]])
    pairs = pairs[["sender", "receiver"]].drop_duplicates()
    whole = sends[["sender", "to"]].rename_axis("send").reset_index().merge(pairs, on="sender")
    whole = whole[(whole["to"] == "") | (whole["to"] == whole["receiver"])]
    whole = whole.merge(told.assign(told=True), on=["send", "receiver"], how="left")
    if log.absent == "unsent":
        whole = whole[whole["told"].notna()].reset_index(drop=True)
    missing, send = whole["told"].isna().to_numpy(), whole["send"].to_numpy()
    why = np.where(whole["heard"].isna(), TOLD, "").astype(object)
    if log.absent == "lost":
        why[missing] = ""
        silent = missing & ~sends["sent"].to_numpy(dtype=bool)[send]
        if unreported == "unknown":
            # Of senders that logged all that anybody heard.
            known = sends[sends["sent"].astype(bool)].groupby("sender")["logged"].all()
            logs_all = sends["sender"].map(known).fillna(False).to_numpy(dtype=bool)
            why[silent] = np.where(logs_all[send[silent]], NOT_LOGGED, UNREPORTED)
        text = "not known: {} of transmissions that nobody reported, of which only their numbers "
        note_count(log.notes, silent.sum(), "outcome", f"{text}tell; taken as {unreported}")
        why[_in_holes(log, whole, hole)] = "the receiver's log has a hole"
    whole["heard"] = np.where(missing, 0.0, whole["heard"].to_numpy(dtype=float))
    whole.loc[why != "", "heard"] = np.nan
    whole["why"] = why
    columns = ["send", "receiver", "heard", "delay", "rssi", "why"]
    return whole.sort_values(["send"], kind="stable")[columns].reset_index(drop=True)


def _in_holes(log: PacketLog, whole: pd.DataFrame, hole: float) -> np.ndarray:
    """Return flags of outcomes in a hole of a log, that would have heard ``hole`` packets."""
    # It reports nothing of two senders or more, while another receiver reports something.
    sends = log.sends.iloc[whole["send"]]
    rows = pd.DataFrame({"receiver": whole["receiver"], "missing": whole["told"].isna()})
    rows["t"], rows["sender"] = sends["t"].to_numpy(), sends["sender"].to_numpy()
    rows["heard"] = (whole["heard"] == 1.0).astype(float)
    context = ["receiver", "sender", sends["channel"].to_numpy()]
    rows["usual"] = rows.groupby(context)["heard"].transform("mean")
    logged, flags = log.sends[log.sends["logged"].astype(bool)], np.zeros(len(rows), dtype=bool)
    reported = rows[rows["heard"] == 1.0]
    for receiver, own in rows.groupby("receiver"):
        signs = own["t"][~own["missing"]].tolist()
        signs += logged["t"][logged["sender"] == receiver].tolist()
        missing = own[own["missing"] & (own["usual"] >= USUAL)]
        stretches = missing.groupby(np.searchsorted(np.sort(signs), missing["t"], side="right"))
        is_long = (stretches["usual"].sum() >= hole) & (stretches["sender"].nunique() >= 2)
        others = np.sort(reported["t"][reported["receiver"] != receiver])
        for k in is_long.index[is_long]:
            part = stretches.get_group(k)
            low, high = float(part["t"].min()), float(part["t"].max())
            if np.diff(np.searchsorted(others, [low, high]))[0] == 0:
                continue  # nobody hears anything: that is the network
            inside = (own["missing"] & own["t"].between(low, high)).to_numpy()
            flags[own.index[inside]] = True
            log.notes.append(
                f"not known: {receiver} reports nothing from {low:g} to {high:g} s, of which "
                f"it would usually have heard {part['usual'].sum():.0f} packets: a hole in its "
                f"log, or it was down; {count_phrase(int(inside.sum()), 'outcome')}"
            )
    return flags


def accounts(sends: pd.DataFrame, outcomes: pd.DataFrame) -> pd.DataFrame:
    """Return a row for each sender and receiver: sent = heard + lost + unknown."""
    sender = sends["sender"].to_numpy()[outcomes["send"]]
    heard = outcomes["heard"].to_numpy(dtype=float)
    table = pd.DataFrame(
        {
            "sender": sender,
            "receiver": outcomes["receiver"],
            "sent": 1,
            "heard": (heard == 1.0).astype(int),
            "lost": (heard == 0.0).astype(int),
            "unknown": np.isnan(heard).astype(int),
        }
    )
    return table.groupby(["sender", "receiver"], as_index=False, sort=True).sum()
