"""``netkf import --kind mercator``: logs of openwsn-berkeley/mercator on the IoT-LAB testbeds.

A row is one packet that one mote received; a transmission (``transctr``) is a burst of ``txnumpk``
packets on one channel, ``txifdur`` ms apart, under stamps of whole seconds.
"""

from __future__ import annotations

from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from netkf.core.errors import ScenarioError
from netkf.core.printable import count_phrase
from netkf.linalg.arrays import FloatArray
from netkf.logs.packet_tables import find_extra, read_log_positions
from netkf.logs.packets import (
    PacketLog,
    choose_origin,
    note_count,
    parse_numbers,
    parse_stamps,
    read_text_rows,
    spread_equal,
)

NUMBERS = ("transctr", "pkctr", "txnumpk", "txifdur", "frequency")
YES = ("1", "1.0", "true")
COLUMNS = ("timestamp", "mac", "srcmac", *NUMBERS, "crc", "expected")
MAX_BURST = 100_000
"""Packets of a burst; more make no sense."""
PAUSE = 5.0
"""Seconds beyond its length after which rows of a burst's number belong to another one."""


def read_mercator(log: Path) -> PacketLog:
    """Return the packet log of a file of mercator, or of a folder of them; raises ScenarioError."""
    paths = sorted([*log.glob("*.csv"), *log.glob("*.csv.gz")]) if log.is_dir() else [log]
    places = find_extra(log, "positions")
    paths = [path for path in paths if path != places]
    if not paths:
        raise ScenarioError(str(log), "has no .csv file", None, "check the folder")
    notes: list[str] = []
    parts = [_read(path, notes) for path in paths]
    stamps = [stamp for part in parts for stamp in part[1]]
    origin = choose_origin(stamps, 1.0)
    table = pd.concat([part[0] for part in parts], ignore_index=True)
    table["t"] = [float(stamp - origin) for stamp in stamps]
    repeated = table.duplicated([*NUMBERS, "mac", "srcmac", "t"])
    note_count(notes, repeated.sum(), "row", "merged: {} that repeat a packet")
    _count_from_zero(table, notes, str(log))
    table["burst"] = _number_bursts(table, notes)
    sends, off = _transmissions(table)
    notes.append(
        f"used: {count_phrase(table['burst'].nunique(), 'burst')} of "
        f"{count_phrase(len(sends), 'packet')}; stamps are whole seconds, so that packets "
        "stand at pkctr * txifdur from a beginning of their burst that fits its stamps"
    )
    note_count(notes, off, "burst", "moved: {} whose stamps fit no beginning: the middle counts")
    spread_equal(sends, 1e-3, notes)
    sends = sends.sort_values("t", kind="stable").reset_index(drop=True)
    place = pd.Series(sends.index, index=[sends["burst"], sends["number"]])
    rows = table.drop_duplicates(["burst", "pkctr", "mac"])
    keys = pd.MultiIndex.from_arrays([rows["burst"], rows["pkctr"]])
    outcomes = pd.DataFrame({"send": place.reindex(keys).to_numpy()})
    outcomes = outcomes.assign(receiver=rows["mac"].to_numpy(), heard=1.0, delay=np.nan)
    outcomes["rssi"] = rows["rssi"].to_numpy()
    sends = sends[["sender", "t", "channel", "to", "sent", "logged"]]
    result = PacketLog(sends, outcomes, origin, 1.0, "lost", notes)
    if places is not None:
        result.positions = read_log_positions(places, origin, notes)
    return result


def _read(path: Path, notes: list[str]) -> tuple[pd.DataFrame, list[Decimal]]:
    raw = read_text_rows(path)
    missing = [name for name in COLUMNS if name not in raw.columns]
    if missing:
        rule = f"must have the columns of mercator; there is no {missing[0]}"
        raise ScenarioError(str(path), rule, list(raw.columns), "check the file, or --kind")
    # Tables that have been through pandas say True or 1.0.
    expected, right = (raw[name].str.lower().isin(YES) for name in ("expected", "crc"))
    foreign, broken, good = ~expected, expected & ~right, raw[expected & right]
    notes.append(f"used: {path.name}: {len(good):,} of {count_phrase(len(raw), 'row')}")
    note_count(notes, foreign.sum(), "row", "dropped: {} of no packet of the experiment")
    note_count(notes, broken.sum(), "row", "dropped: {} with a wrong crc")
    numbers: dict[str, Any] = {name: parse_numbers(path, good, name) for name in NUMBERS}
    numbers["rssi"] = parse_numbers(path, good, "rssi") if "rssi" in good.columns else np.nan
    table = pd.DataFrame({"mac": good["mac"], "srcmac": good["srcmac"], **numbers})
    wrong = (table["txnumpk"] < 1) | (table["pkctr"] < 0) | (table["pkctr"] > table["txnumpk"])
    wrong |= (table["txifdur"] < 0) | (table["mac"] == table["srcmac"])
    wrong |= (table["txnumpk"] > MAX_BURST) | (table["mac"] == "") | (table["srcmac"] == "")
    if wrong.any():
        lines = ", ".join(map(str, table.index[wrong][:3]))
        notes.append(
            f"dropped: {count_phrase(int(wrong.sum()), 'row')} whose entries make no sense "
            f"({path.name} line {lines}{', ...' if wrong.sum() > 3 else ''})"
        )
    good, table = good[~wrong], table[~wrong]
    if good.empty:
        raise ScenarioError(str(path), "has no packet of the experiment", None, "check the file")
    return table, parse_stamps(path, good, "timestamp")


def _count_from_zero(table: pd.DataFrame, notes: list[str], log: str) -> None:
    """Make numbers of packets in their burst begin at 0: in some logs they begin at 1."""
    first, last = table["pkctr"] == 0, table["pkctr"] == table["txnumpk"]
    if first.any() and last.any():
        rule = "numbers the packets of bursts from 0 in some rows and from 1 in others"
        raise ScenarioError(log, rule, None, "import the two parts apart")
    base = 0 if first.any() else 1
    if not (first.any() or last.any()):
        notes.append("not known: whether packets of bursts count from 0 or 1; taken as 1")
    table["pkctr"] = (table["pkctr"] - base).astype(int)


def _number_bursts(table: pd.DataFrame, notes: list[str]) -> np.ndarray:
    """Return the burst of each row: of one counter, sender and channel, and close in time."""
    key = ["srcmac", "transctr", "frequency"]
    order = table.sort_values([*key, "t"], kind="stable")
    same = (order[key] == order[key].shift()).all(axis=1)
    length = order["txnumpk"] * order["txifdur"] / 1000.0 + PAUSE
    again = same & (order["t"].diff() > length)
    if again.any():
        notes.append(f"used: numbers of bursts begin again: {int(again.sum()):,} bursts")
    numbers = sorted(set(table["transctr"].astype(int)))
    silent = numbers[-1] - numbers[0] + 1 - len(numbers)
    text = (
        "not known: {} that numbers tell of and no mote reported: who sent them, and when, is in "
        "no row, so that they are not in the replay"
    )
    note_count(notes, silent, "burst", text)
    return np.asarray((~same | again).cumsum().reindex(table.index))


def _transmissions(table: pd.DataFrame) -> tuple[pd.DataFrame, int]:
    """Return all packets of all bursts, and how many bursts have stamps that fit no beginning."""
    groups = table.groupby("burst", sort=True)
    step, count = groups["txifdur"].first() / 1000.0, groups["txnumpk"].max().astype(int)
    begins = (table["t"] - table["pkctr"] * table["txifdur"] / 1000.0).groupby(table["burst"])
    # A stamp of whole seconds says that the packet came in this second.
    low, high = begins.max(), begins.min() + 1.0
    off = int((low >= high).sum())
    begin = 0.5 * (low + high)
    order = groups[["srcmac", "t", "transctr"]].min().sort_values(["srcmac", "t", "transctr"])
    for _, own in order.groupby("srcmac"):
        place = own.index
        begin[place] = _in_turn(*(x[place].to_numpy() for x in (low, high, step * count)))
    parts = []
    for burst, rows in groups:
        numbers = np.arange(count[burst])
        t = np.round(np.round(begin[burst], 3) + numbers * step[burst], 6)
        part = {"burst": burst, "number": numbers, "t": t, "sender": rows["srcmac"].iloc[0]}
        parts.append(pd.DataFrame(part | {"channel": f"{rows['frequency'].iloc[0]:g}"}))
    return pd.concat(parts, ignore_index=True).assign(to="", sent=True, logged=False), off


def _in_turn(low: FloatArray, high: FloatArray, length: FloatArray) -> FloatArray:
    """Return the middles of where bursts of one sender can begin so that none overlap."""
    early, late = low.copy(), high.copy()
    for k in range(1, len(low)):
        early[k] = max(low[k], min(early[k - 1] + length[k - 1], high[k]))
    for k in range(len(low) - 2, -1, -1):
        late[k] = min(high[k], max(late[k + 1] - length[k], low[k]))
    return np.asarray(np.where(early <= late, early + late, low + high) / 2.0)
