"""``netkf import --kind csv``: packet logs in tables, whatever their columns are called."""

from __future__ import annotations

from collections.abc import Mapping
from decimal import Decimal
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from netkf.core.csv_files import MAX_ID
from netkf.core.errors import ScenarioError
from netkf.core.printable import count_phrase
from netkf.linalg.arrays import FloatArray
from netkf.logs import packets

SYNONYMS = {
    "t": (
        *("time", "timestamp", "ts", "seconds", "datetime", "date", "stamp", "when", "sent_at"),
        *("time_sent", "t_sent", "send_time", "sent_time", "tx_time", "t_tx"),
        *("s", "ms", "us", "ns", "epoch"),
    ),
    "sender": ("src", "source", "from", "tx", "transmitter", "srcmac", "origin", "by"),
    "receiver": ("dst", "dest", "destination", "rx", "to", "hearer", "listener", "mac", "heard_by"),
    "number": (
        *("seq", "seqno", "seqnum", "sequence", "n", "counter"),
        *("packet", "pkt", "msg", "message"),
    ),
    "channel": ("ch", "freq", "frequency"),
    "heard": ("received", "delivered", "ok", "success", "outcome", "status"),
    "t_heard": (
        *("t_rx", "rx_time", "received_at", "arrival", "arrived", "arrival_time", "t_received"),
        *("time_received", "received_time", "receive_time", "recv_time", "t_recv"),
    ),
    "rssi": ("rssi_dbm", "lqi", "snr"),
    "event": ("kind", "type", "what", "direction"),
    "node": ("id", "mote"),
    "peer": ("neighbour", "neighbor", "other"),
}
"""Names of each column, the first of which in a table counts; in any case, with ENDINGS."""
ENDINGS = ("_id", "_no", "_number", "_s", "_ms", "_us", "_ns")
SENT = ("tx", "send", "sent", "transmit", "broadcast", "out")
HEARD = ("rx", "receive", "received", "recv", "heard", "hear", "deliver", "delivered", "in")
LOST = ("lost", "loss", "drop", "dropped", "miss", "missed")
YES = ("1", "1.0", "true", "yes", "y", "ok", *HEARD)
NO = ("0", "0.0", "false", "no", "n", "fail", "failed", *LOST)
UNKNOWN = ("", "nan", "na", "none", "unknown", "?", "-1")
RARE = 0.1  # share of packets before which a sender changes its channel now and then
MAX_CYCLE = 64  # channels over which packets of a sender hop in turn
NO_STAMP = ("", "nan", "na", "nat", "none", "null", "-1", *LOST)  # of t_heard
EXTRAS = ("positions", "readings")
EXPORTED = "# netkf: "  # the log of a run begins so


class _Rows(NamedTuple):
    """Rows with ``where`` (file, line), ``what`` ("tx", "rx", "outcome") and heard (1, 0, nan);
    ``told_by`` is the column of arrivals, "" if another one says what was heard.
    """

    table: pd.DataFrame
    stamps: list[Decimal]
    arrivals: list[Decimal | None]
    told_by: str


def read_tables(log: Path, columns: Mapping[str, str]) -> packets.PacketLog:
    """Return the packet log of a table, or of a folder: packets.csv, or all tables but EXTRAS;
    ``columns`` has names of columns by names in SYNONYMS. Raises ScenarioError.
    """
    notes: list[str] = []
    tables = _rename({path: packets.read_text_rows(path) for path in _packet_paths(log)}, columns)
    parts = [_read_rows(path, raw, notes) for path, raw in tables.items()]
    _mark_lost(parts, notes)
    stamps = [stamp for part in parts for stamp in part.stamps]
    arrivals = [arrival for part in parts for arrival in part.arrivals]
    extras = {name: find_extra(log, name) for name in EXTRAS}
    resolution = packets.find_resolution(stamps)
    # A run counts from 0.
    is_run = (log / "scenario.toml").is_file()
    origin = Decimal(0) if is_run else packets.choose_origin(stamps, resolution)
    table = pd.concat([part.table for part in parts], ignore_index=True)
    table["t"] = [float(stamp - origin) for stamp in stamps]
    falls = -np.minimum(np.diff(table["t"]), 0.0)
    if falls.any():
        count = count_phrase(int(np.count_nonzero(falls)), "time")
        notes.append(f"sorted: stamps fall from row to row {count}, by up to {falls.max():g} s")
    pairs = zip(stamps, arrivals, strict=True)
    table["delay"] = [np.nan if b is None else float(b - a) for a, b in pairs]
    early = np.flatnonzero(table["delay"] < 0.0)
    if early.size:
        where, late = table["where"].iloc[early[0]], table["delay"].iloc[early[0]]
        rule, remedy = "is heard before it is sent", "correct the stamps; lost packets have none"
        raise ScenarioError(str(log), f"{where}: {rule}", f"{late:g} s after that", remedy)
    # All messages of an exported run are there: a link that is down has none.
    is_export = is_run and _is_export(log / "packets.csv")
    sends, outcomes = _match(table, resolution, notes, str(log), is_export)
    if not is_run and (first := float(sends["t"].min())) <= 0.0:  # clocks were aligned
        sends["t"] += 1.0 - first // 1.0
        origin -= Decimal(int(1.0 - first // 1.0))
    result = packets.PacketLog(sends, outcomes, origin, resolution, "lost", notes, is_run=is_run)
    if is_run and (log / "ticks.csv").is_file():
        result.ticks = log / "ticks.csv"
    if is_export:
        result.absent = "unsent"
    elif (table["what"] == "outcome").all() and (table["heard"] == 0.0).any():
        # The log says itself what was lost.
        result.absent = "unknown"
    if extras["positions"] is not None:
        result.positions = read_log_positions(extras["positions"], origin, notes)
    if extras["readings"] is not None:
        result.readings = read_readings(extras["readings"], origin, notes)
    return result


def _is_export(path: Path) -> bool:
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(EXPORTED)) == EXPORTED.encode()


def _packet_paths(log: Path) -> list[Path]:
    if not log.is_dir():
        return [log]
    found = [p for ending in ("csv", "csv.gz", "tsv", "txt") for p in log.glob(f"*.{ending}")]
    named = [path for path in found if path.name.partition(".")[0] == "packets"]
    rest = [path for path in found if path.name.partition(".")[0] not in EXTRAS]
    if not (named or rest):
        raise ScenarioError(str(log), "has no table of packets", None, "check the folder")
    return sorted(named or rest)


def find_extra(log: Path, name: str) -> Path | None:
    """Return the table of this name in the folder of a log, or beside its file; None without."""
    folder = log if log.is_dir() else log.parent
    if (folder / "scenario.toml").is_file():
        return None  # a run: its tables are those of its scenario
    found = [folder / f"{name}.{ending}" for ending in ("csv", "csv.gz", "tsv", "txt")]
    return next((path for path in found if path.is_file() and path != log), None)


def find_column(table: pd.DataFrame, name: str) -> str:
    """Return the column of ``table`` that has this name or a synonym of it; "" without one."""
    for known in (name, *SYNONYMS.get(name, ())):
        for column in table.columns:
            if column == known or any(column == known + ending for ending in ENDINGS):
                return str(column)
    return ""


def _rename(
    tables: dict[Path, pd.DataFrame], columns: Mapping[str, str]
) -> dict[Path, pd.DataFrame]:
    """Return the tables with the names of a user's ``columns``; raises ScenarioError."""
    found = {name for table in tables.values() for name in table.columns}
    new: dict[str, str] = {}
    hidden: dict[str, str] = {}
    for name, column in columns.items():
        whole = next((n for n in SYNONYMS for e in ("", *ENDINGS) if name == n + e), None)
        if whole is None:
            rule = f"must name one of {', '.join(SYNONYMS)}"
            raise ScenarioError("columns", rule, name, "choose one of them")
        if column.lower() not in found:
            rule = f"must be columns of the log ({', '.join(sorted(found))})"
            raise ScenarioError("columns", rule, column, "choose one of them")
        new[column.lower()] = name
        # A column that had such a name is another one.
        hidden |= {whole + ending: f"{whole + ending} (of the log)" for ending in ("", *ENDINGS)}
    return {path: table.rename(columns=hidden | new) for path, table in tables.items()}


def _read_rows(path: Path, raw: pd.DataFrame, notes: list[str]) -> _Rows:
    """Return the packets of one table; notes say which columns were taken for what."""
    names = _find_columns(path, raw, notes)
    empty = pd.Series("", index=raw.index)
    table = pd.DataFrame(
        {
            "where": [f"{path.name} line {line}" for line in raw.index],
            "sender": raw[names["sender"]],
            "receiver": raw[names["receiver"]] if names["receiver"] else empty,
            "channel": raw[names["channel"]] if names["channel"] else empty,
        }
    )
    sender, remedy = table["sender"], "correct the row"
    packets.refuse_rows(path, sender, sender == "", "must name a sender", remedy, quoted=False)
    missing = np.full(len(raw), np.nan)
    for name in ("number", "rssi"):
        column = names[name]
        table[name] = packets.parse_numbers(path, raw, column, gaps=True) if column else missing
    is_count = (table["number"] % 1.0 == 0.0) & table["number"].between(0.0, MAX_ID)
    if names["number"]:
        rule, remedy = "number must be an integer from 0 to 2^53", "count from less"
        wrong = ~is_count & table["number"].notna()
        packets.refuse_rows(
            path, raw[names["number"]], wrong, rule, f"correct the entry, or {remedy}"
        )
    table["what"], table["heard"] = _read_outcomes(path, raw, names, table)
    stamps = packets.parse_stamps(path, raw, names["t"], notes)
    arrivals = _read_arrivals(path, raw, names)
    told_by = "" if names["heard"] or names["event"] else names["t_heard"]
    return _Rows(table, stamps, arrivals, told_by)


def _mark_lost(parts: list[_Rows], notes: list[str]) -> None:
    """Take rows without a time of arrival for lost messages, where any row of the log has one."""
    is_known = any(a is not None for part in parts if part.told_by for a in part.arrivals)
    for table, _, arrivals, column in parts:
        has_receiver = (table["receiver"] != "").to_numpy()
        is_lost = has_receiver & np.array([arrival is None for arrival in arrivals])
        if not column or not is_lost.any():
            continue
        if not is_known:
            notes.append(f"used: {column} is empty: it tells nothing")
            continue
        # The log has a row for each message, with a time if it arrived.
        table["what"] = np.where(has_receiver, "outcome", "tx")
        table.loc[is_lost, "heard"] = 0.0
        notes.append(f"used: rows without {column}, lost: {is_lost.sum():,}")


def _find_columns(path: Path, raw: pd.DataFrame, notes: list[str]) -> dict[str, str]:
    """Return the column of each of SYNONYMS, "" if none; a node's own log gets both ends."""
    names = {name: find_column(raw, name) for name in SYNONYMS}
    if names["node"] == "id" and names["sender"]:
        names["node"] = ""  # it counts rows
    if names["event"] and not names["sender"] and names["node"]:
        is_tx = raw[names["event"]].str.lower().isin(SENT)
        own, other = raw[names["node"]], raw[names["peer"]] if names["peer"] else ""
        raw["sender"] = own.where(is_tx, other)
        raw["receiver"] = pd.Series(other, index=raw.index).where(is_tx, own)
        names |= {"sender": "sender", "receiver": "receiver"}
    elif names["node"] and not (names["sender"] and names["receiver"]):
        # The node whose log it is: of what it sent, or of what it heard from a sender.
        if names["sender"]:
            own = raw[names["node"]]
            raw[names["node"]] = own.mask(own == raw[names["sender"]], "")
        names["receiver" if names["sender"] else "sender"] = names["node"]
    elif names["node"]:
        # Beside whose log it is the receiver is an address, such as that of all.
        own, is_own = raw[names["node"]], raw[names["node"]] == raw[names["sender"]]
        hearer = raw[names["receiver"]].where(is_own | (own == ""), own)
        told = names["event"] or names["heard"]
        raw["receiver"] = hearer if told else hearer.mask(is_own, "")
        names["receiver"] = "receiver"
    for name in ("t", "sender"):
        if not names[name]:
            rule = f"must have a column {name} ({', '.join(SYNONYMS[name])})"
            raise ScenarioError(
                str(path), rule, list(raw.columns), "name them: --columns t=COLUMN,..."
            )
    used = {name: column for name, column in names.items() if column}
    listed = ", ".join(f"{a} from {b}" if a != b else a for a, b in used.items())
    unused = [column for column in raw.columns if column and column not in used.values()]
    notes.append(
        f"used: {path.name}: {count_phrase(len(raw), 'row')}, columns {listed}"
        + (f"; not used: {', '.join(unused)}" if unused else "")
    )
    return names


def _read_arrivals(path: Path, raw: pd.DataFrame, names: dict[str, str]) -> list[Decimal | None]:
    column = names["t_heard"]
    arrivals: list[Decimal | None] = [None] * len(raw)
    if not column:
        return arrivals
    is_open = raw[column].str.lower().isin(["inf", "infinity"])
    has = ~raw[column].str.lower().isin(NO_STAMP) & ~is_open
    stamps = iter(packets.parse_stamps(path, raw[has], column))
    return [
        next(stamps) if a else Decimal("Infinity") if b else None
        for a, b in zip(has, is_open, strict=True)
    ]


def _read_outcomes(
    path: Path, raw: pd.DataFrame, names: dict[str, str], table: pd.DataFrame
) -> tuple[np.ndarray, FloatArray]:
    """Return what each row is, "tx", "rx" or "outcome", and whether it was heard."""
    what = np.where(table["receiver"] == "", "tx", "rx").astype(object)
    heard = np.where(table["receiver"] == "", np.nan, 1.0)
    for name, words in (("event", (SENT, HEARD, LOST)), ("heard", ((), YES, NO))):
        if not names[name]:
            continue
        column = raw[names[name]].str.lower()
        groups = [column.isin(group).to_numpy() for group in words]
        wrong = ~(groups[0] | groups[1] | groups[2] | column.isin(UNKNOWN).to_numpy())
        choices = "what happened (tx, rx or lost)" if name == "event" else "1 or 0"
        packets.refuse_rows(
            path, column, wrong, f"{names[name]} must say {choices}", "correct the entry"
        )
        heard = np.select([groups[1], groups[2]], [1.0, 0.0], np.nan)
        if name == "event":
            what[groups[0]] = "tx"
            what[groups[1] | groups[2]] = "rx"
        else:
            what[(table["receiver"] != "").to_numpy()] = "outcome"
    sender, receiver, remedy = table["sender"], table["receiver"], "correct the row"
    alone = (what != "tx") & (receiver == "")
    packets.refuse_rows(path, receiver, alone, "must name a receiver", remedy, quoted=False)
    packets.refuse_rows(path, sender, receiver == sender, "sender and receiver must differ", remedy)
    return what, heard


def _match(
    table: pd.DataFrame, resolution: float, notes: list[str], log: str, is_export: bool
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return transmissions and outcomes: rows that speak of one transmission are joined."""
    table["to"] = ""
    if _counts_directions(table):
        table["to"] = table["receiver"]
        notes.append("used: each row is a message of its own to one receiver, no broadcast")
    table["key"] = _by_stamps(table) if is_export else _number_transmissions(table, notes, log)
    # Of one transmission the sender's own stamp counts, else the first one.
    table["order"] = (table["what"] != "tx").astype(int)
    groups = table.sort_values(["order", "t"], kind="stable").groupby("key", sort=False)
    sends = groups[["sender", "t", "channel", "to", "counter"]].first()
    sends["row"] = table.reset_index().groupby("key", sort=False)["index"].first()
    sends["sent"], sends["logged"] = True, groups["order"].min() == 0
    spread = (groups["t"].max() - groups["t"].min())[lambda s: s > 0.0]
    if len(spread):
        notes.append(
            f"merged: stamps of {count_phrase(len(spread), 'transmission')} differ from row to "
            f"row, by {spread.max():g} s at most; the sender's or the first counts"
        )
    _order_stamps(sends, notes)
    sends = sends.sort_values(["t", "counter"], kind="stable")
    packets.spread_equal(sends, resolution, notes)
    skipped = _skipped(sends, notes)
    if len(skipped):  # an empty table has no types
        sends = pd.concat([sends, skipped])
    sends["key"] = sends.index
    sends = sends.sort_values(["t", "row"], kind="stable").reset_index(drop=True)
    place = pd.Series(sends.index, index=sends["key"])
    rows = table[table["what"] != "tx"].assign(send=lambda rows: rows["key"].map(place))
    return sends[["sender", "t", "channel", "to", "sent", "logged"]], _merge_rows(rows, notes, log)


def _counts_directions(table: pd.DataFrame) -> bool:
    """Return True if rows are single messages: of one sender to many, and never two at one time."""
    if not (table["what"] == "outcome").all():
        return False
    many = table.groupby("sender")["receiver"].nunique().max() > 1
    messages = table.drop_duplicates(["sender", "t", "receiver", "number"])
    return bool(many and not messages.duplicated(["sender", "t"]).any())


def _number_transmissions(table: pd.DataFrame, notes: list[str], log: str) -> pd.Series:
    """Return a key of each row's transmission, and add its ``counter``; raises ScenarioError."""
    keys = pd.Series(index=table.index, dtype=object)
    table["counter"] = 0
    wraps = restarts = missing = 0
    moduli, intervals, wrong = set(), [], ""
    _align_clocks(table, notes)
    for (sender, to), rows in table.groupby(["sender", "to"], sort=True):
        own = rows.sort_values(["t", "number"], kind="stable")
        known = own[own["number"].notna()]
        missing += len(own) - len(known)
        found = packets.unwrap(known["number"].to_numpy().astype(np.int64), known["t"].to_numpy())
        if found[3] > max(3, len(np.unique(found[0])) // 10):
            wrong = wrong or (
                f"numbers of {sender} begin again {found[3]} times: stamps do not fit each other"
            )
        wraps, restarts = wraps + found[1], restarts + found[3]
        moduli |= {found[2]} if found[1] else set()
        table.loc[known.index, "counter"] = found[0]
        keys[known.index] = [_key(sender, to, counter) for counter in found[0].tolist()]
        rest = own.index.difference(known.index)
        keys[rest] = [_key(sender, to, f"at {t!r}") for t in table.loc[rest, "t"].tolist()]
        intervals += np.diff(np.unique(own["t"])).tolist()
    times = table["t"].groupby(keys)
    spread = (times.max() - times.min()).quantile(0.9)
    if (table["what"] == "outcome").all() and intervals and spread > np.median(intervals):
        notes.append("used: numbers count the messages of each pair; equal stamps are one packet")
        return _by_stamps(table)
    if wrong:
        remedy = "correct those of clocks that began again, or that are a cycle of numbers apart"
        raise ScenarioError(log, wrong, None, remedy)
    if wraps:
        lengths = " or ".join(map(str, sorted(moduli)))
        notes.append(f"used: numbers wrap after {lengths}: {count_phrase(wraps, 'time')}")
    text = "used: numbers begin again {}; what was sent between is not known"
    packets.note_count(notes, restarts, "time", text)
    text = "used: {} without a number: equal stamps of a sender are one packet"
    packets.note_count(notes, missing, "row", text)
    return keys


def _by_stamps(table: pd.DataFrame) -> pd.Series:
    """Return the key where messages of one sender and stamp are one transmission."""
    # Of several at one stamp numbers tell the order, and rows that say one thing again.
    order = table["number"].fillna(pd.Series(table.index - len(table), table.index))
    groups = order.groupby([table["sender"], table["t"], table["receiver"]])
    again = (groups.rank("dense") - 1.0).astype(int)
    table["counter"] = again
    told = zip(table["sender"], table["t"].tolist(), again.tolist(), strict=True)
    return pd.Series([_key(i, t, k) for i, t, k in told], index=table.index)


def _align_clocks(table: pd.DataFrame, notes: list[str]) -> None:
    """Move reports to the sender's clock, or the latest, where numbers would seem to fall."""
    reports = table[table["number"].notna() & (table["what"] != "outcome")].sort_values("t")
    who = reports["receiver"].where(reports["what"] != "tx", "")
    moved: list[float] = []
    for _, rows in reports.groupby(["sender", "to"], sort=True):
        names, codes = np.unique(who[rows.index].astype(str), return_inverse=True)
        lead = packets.find_lead(rows["number"].to_numpy(), rows["t"].to_numpy(), codes)
        lead -= 0.0 if names[0] == "" else lead.max()
        if lead.any():
            table.loc[rows.index, "t"] = (rows["t"] - lead).round(9)
            moved.append(float(np.abs(lead).max()))
    if moved:
        notes.append(
            f"moved: reports of {count_phrase(len(moved), 'sender')} by up to {max(moved):g} s: "
            "the clocks of those who report a packet differ by so much"
        )


def _order_stamps(sends: pd.DataFrame, notes: list[str]) -> None:
    """Move transmissions whose number is lower than that of an earlier one to the stamp of it."""
    before = sends["t"].copy()
    for _, rows in sends.groupby(["sender", "to"], sort=True):
        if rows["counter"].is_unique:
            order = rows.sort_values("counter", ascending=False)
            sends.loc[order.index, "t"] = order["t"].cummin()
    moved = before - sends["t"]
    if moved.any():
        notes.append(
            f"moved: {count_phrase(int(moved.gt(0.0).sum()), 'transmission')}, by up to "
            f"{moved.max():g} s, to the stamp of the next one of their sender, which was earlier"
        )


def _key(sender: object, to: object, number: object) -> str:
    return f"{sender}\n{to}\n{number}"


def _skipped(sends: pd.DataFrame, notes: list[str]) -> pd.DataFrame:
    """Return transmissions of which only the numbers tell, at times between their neighbours."""
    found: list[dict[str, object]] = []
    left_out = 0
    for (sender, to), rows in sends.groupby(["sender", "to"], sort=True):
        own = rows.sort_values("counter")
        counters, times = own["counter"].to_numpy(), own["t"].to_numpy()
        channels = own["channel"].tolist()
        cycle = _find_cycle(counters, channels)
        # One that hops at random is on no one channel between two packets on it.
        moves = sum(a != b for a, b in pairwise(channels)) > RARE * len(channels)
        for k in np.flatnonzero(np.diff(counters) > 1).tolist():
            count = int(counters[k + 1] - counters[k])
            if count > packets.MAX_SKIP:
                left_out += count - 1
                continue
            for j in range(1, count):
                t = times[k] + (times[k + 1] - times[k]) * j / count
                counter = int(counters[k]) + j
                channel = "" if moves or channels[k] != channels[k + 1] else channels[k]
                channel = cycle[counter % len(cycle)] if cycle else channel
                row = {"sender": sender, "t": round(t, 9), "channel": channel, "to": to}
                row |= {"counter": counter, "sent": False, "logged": False}
                found.append(row)
    text = "that numbers tell of and no row does; they stand between their neighbours in time"
    packets.note_count(notes, len(found), "transmission", "not known: {} " + text)
    text = f"between numbers more than {packets.MAX_SKIP:,} apart; these are not in the replay"
    packets.note_count(notes, left_out, "transmission", "not known: {} " + text)
    columns = ["sender", "t", "channel", "to", "counter", "sent", "logged"]
    keys = [_key(row["sender"], row["to"], row["counter"]) for row in found]
    return pd.DataFrame(found, columns=columns, index=keys)


def _find_cycle(counters: np.ndarray, channels: list[str]) -> list[str]:
    """Return the channels over which packets hop in turn, by counter; empty if they do not."""
    for length in range(1, min(MAX_CYCLE, len(counters) // 3) + 1):
        found = dict(zip((counters % length).tolist(), channels, strict=True))
        if len(found) == length and channels == [found[c] for c in (counters % length).tolist()]:
            return [found[k] for k in range(length)]
    return []


def _merge_rows(rows: pd.DataFrame, notes: list[str], log: str) -> pd.DataFrame:
    """Return one outcome by transmission and receiver; raises ScenarioError if two contradict."""
    key = ["send", "receiver"]
    repeated = int(rows.duplicated(key).sum())
    kinds = rows[rows["heard"].notna()].groupby(key)["heard"].nunique()
    if (kinds > 1).any():
        send, receiver = kinds[kinds > 1].index[0]
        two = rows[(rows["send"] == send) & (rows["receiver"] == receiver)]
        lines = " and ".join(two["where"].iloc[[0, -1]])
        rule = f"{lines}: one says heard and one says lost"
        raise ScenarioError(log, rule, [str(two["sender"].iloc[0]), receiver], "correct a row")
    if repeated:
        # Far apart they are hardly one: a clock that began again.
        t = rows.groupby(key)["t"]
        apart = (t.max() - t.min()).max()
        told = f", up to {apart:g} s apart" if apart else ""
        notes.append(f"merged: {count_phrase(repeated, 'row')} of an outcome told before{told}")
    ordered = rows.sort_values(["send", "heard", "delay"], kind="stable", na_position="last")
    columns = ["send", "receiver", "heard", "delay", "rssi"]
    return ordered.drop_duplicates(key)[columns].reset_index(drop=True)


def read_log_positions(path: Path, origin: Decimal, notes: list[str]) -> pd.DataFrame:
    """Return node, x, y, or t (s from ``origin``), node, x, y where nodes move (ScenarioError)."""
    raw = packets.read_text_rows(path)
    stamp, name = find_column(raw, "t"), find_column(raw, "node") or raw.columns[0]
    columns = {}
    for axis in ("x", "y"):
        column = next((c for c in raw.columns if c in (axis, f"{axis}_m")), "")
        if not column:
            rule = f"must have a column {axis}"
            raise ScenarioError(str(path), rule, list(raw.columns), "name the columns")
        columns[axis] = packets.parse_numbers(path, raw, column)
    stamps = packets.parse_stamps(path, raw, stamp) if stamp else [origin] * len(raw)
    times = [float(s - origin) for s in stamps]
    table = pd.DataFrame({"t": times, "node": raw[name].to_numpy(), **columns}, index=raw.index)
    for (_, node), rows in table.drop_duplicates(["t", "node", "x", "y"]).groupby(["t", "node"]):
        if len(rows) > 1:
            what = "one position at a time" if stamp else "one position"
            rule = f"lines {rows.index[0]} and {rows.index[1]}: a node must have {what}"
            raise ScenarioError(str(path), rule, str(node), "correct one of the two rows")
    kept = table.drop_duplicates(["t", "node"]).sort_values(["t", "node"], kind="stable")
    packets.note_count(notes, len(table) - len(kept), "row", "merged: {} of " + path.name)
    # The first place of a node that was placed later counts from the beginning.
    late = (kept["t"] > 0.0) & ~kept.duplicated("node")
    packets.note_count(notes, late.sum(), "node", "moved: first places of {} to time 0")
    kept["t"] = kept["t"].where(~late, 0.0)
    return kept.reset_index(drop=True) if stamp else kept.drop(columns="t")


def read_readings(path: Path, origin: Decimal, notes: list[str]) -> pd.DataFrame:
    """Return t (s from ``origin``), node, y0, the first other column; raises ScenarioError."""
    raw = packets.read_text_rows(path)
    stamp, node = find_column(raw, "t"), find_column(raw, "node") or find_column(raw, "sender")
    rest = [name for name in raw.columns if name not in (stamp, node)]
    if not stamp or not node or not rest:
        rule = "must have columns t, node and y0"
        raise ScenarioError(str(path), rule, list(raw.columns), "name the columns")
    stamps, (used, *unused) = packets.parse_stamps(path, raw, stamp), rest
    table = pd.DataFrame({"t": [float(s - origin) for s in stamps], "node": raw[node].to_numpy()})
    table["y0"] = packets.parse_numbers(path, raw, used, gaps=True)
    if unused:
        notes.append(f"not used: {path.name}: columns {', '.join(unused)}, but {used} as y0")
    is_empty, is_early = table["y0"].isna(), table["t"] < 0.0
    packets.note_count(notes, is_empty.sum(), "reading", "dropped: {} without a value")
    packets.note_count(notes, (is_early & ~is_empty).sum(), "reading", "dropped: {} before time 0")
    return table[~(is_empty | is_early)].reset_index(drop=True)
