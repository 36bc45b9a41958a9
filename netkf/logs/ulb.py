"""``netkf import --kind ulb``: the library deployments of the Universite Libre de Bruxelles.

Once a minute a mote reads its sensors, broadcasts, and reports whom it has heard since its last
report: readings.csv (t_s, node, values) and heard.csv (t_s, receiver, sender, lqi).
"""

from __future__ import annotations

from decimal import Decimal
from pathlib import Path

import numpy as np
import pandas as pd

from netkf.core.errors import ScenarioError
from netkf.core.printable import count_phrase
from netkf.logs import packets
from netkf.logs.packet_tables import find_column, find_extra, read_log_positions, read_readings

MINUTE = 60.0
EARLY = 10.0
"""A minute's reports begin up to so many seconds before it."""


def read_ulb(log: Path) -> packets.PacketLog:
    """Return the packet log of a folder with readings.csv and heard.csv; raises ScenarioError."""
    paths = {}
    for name in ("readings", "heard"):
        path = next((p for p in [log / f"{name}.csv", log / f"{name}.csv.gz"] if p.is_file()), None)
        if path is None:
            rule = "must be a folder with readings.csv and heard.csv or heard.csv.gz"
            raise ScenarioError(str(log), rule, None, "check the path")
        paths[name] = path
    notes: list[str] = []
    raw = _read_named(paths["heard"], ("t", "sender", "receiver"))
    stamps = packets.parse_stamps(paths["heard"], raw, find_column(raw, "t"))
    texts = _read_named(paths["readings"], ("t", "node"))
    read_stamps = packets.parse_stamps(paths["readings"], texts, find_column(texts, "t"))
    first = min(*stamps, *read_stamps)
    origin = Decimal(int(first // 60) * 60)  # minutes stay those of the stamps
    readings = read_readings(paths["readings"], origin, notes)
    lqi = find_column(raw, "rssi")
    reports = pd.DataFrame(
        {
            "t": [float(stamp - origin) for stamp in stamps],
            "sender": raw[find_column(raw, "sender")],
            "receiver": raw[find_column(raw, "receiver")],
            "rssi": packets.parse_numbers(paths["heard"], raw, lqi, gaps=True) if lqi else np.nan,
        }
    )
    reports["minute"] = ((reports["t"] + EARLY) // MINUTE).astype(int) - 1
    notes.append(
        f"used: {count_phrase(len(readings), 'reading')} (each one broadcast) and "
        f"{count_phrase(len(reports), 'row')} of reports, which tell of the minute before"
    )
    kept = reports.drop_duplicates(["sender", "receiver", "minute"])
    kept = kept[kept["sender"] != kept["receiver"]]
    text = "merged: {} of reports that name a sender again, or the mote itself"
    packets.note_count(notes, len(reports) - len(kept), "row", text)
    sends = _broadcasts(readings, kept, notes)
    packets.spread_equal(sends, packets.find_resolution(read_stamps), notes)
    sends = sends.sort_values("t", kind="stable").reset_index(drop=True)
    outcomes = _outcomes(sends, kept, notes)
    sends = sends[["sender", "t", "channel", "to", "sent", "logged"]]
    resolution = packets.find_resolution([*stamps, *read_stamps])
    result = packets.PacketLog(sends, outcomes, origin, resolution, "unknown", notes)
    result.readings = readings
    places = find_extra(log, "positions")
    if places is not None:
        result.positions = read_log_positions(places, origin, notes)
    return result


def _read_named(path: Path, names: tuple[str, ...]) -> pd.DataFrame:
    """Return a table of texts that has the columns ``names``, motes among them in every row."""
    table = packets.read_text_rows(path)
    for name in names:
        column = find_column(table, name)
        if not column:
            rule = f"must have a column {name}"
            raise ScenarioError(str(path), rule, list(table.columns), "check the file")
        blank, rule = (table[column] == "") & (name != "t"), f"must name a {name}"
        packets.refuse_rows(path, table[column], blank, rule, "correct the row", quoted=False)
    return table


def _broadcasts(readings: pd.DataFrame, reports: pd.DataFrame, notes: list[str]) -> pd.DataFrame:
    """Return a broadcast for each reading, and for minutes that name a mote without a reading."""
    minute = (readings["t"] // MINUTE).astype(int)
    sends = pd.DataFrame({"sender": readings["node"], "t": readings["t"], "minute": minute})
    sends = sends.drop_duplicates(["sender", "minute"])
    usual = (sends["t"] - MINUTE * sends["minute"]).groupby(sends["sender"]).median()
    named = reports[["sender", "minute"]].drop_duplicates()
    named = named[(named["minute"] >= 0) & named["sender"].isin(usual.index)]
    named = named.merge(sends[["sender", "minute"]], how="left", indicator=True)
    extra = named[named["_merge"] == "left_only"][["sender", "minute"]]
    extra["t"] = (MINUTE * extra["minute"] + extra["sender"].map(usual).astype(float)).round(3)
    text = "used: {} without a reading, which reports name, at the usual second of the mote"
    packets.note_count(notes, len(extra), "broadcast", text)
    again = len(readings) - len(sends)
    packets.note_count(notes, again, "reading", "merged: {} in a minute that has one already")
    both = pd.concat([sends, extra], ignore_index=True)
    at_zero = both["t"] == 0.0
    if at_zero.any():
        both.loc[at_zero, "t"] = 1e-3
        notes.append(f"moved: {int(at_zero.sum())} at the first instant, to 0.001 s after it")
    return both.assign(channel="", to="", sent=True, logged=False)


def _outcomes(sends: pd.DataFrame, reports: pd.DataFrame, notes: list[str]) -> pd.DataFrame:
    """Return outcomes of broadcasts at motes; unknown without the report of that minute."""
    pairs = reports[["sender", "receiver"]].drop_duplicates()
    whole = sends[["sender", "minute"]].rename_axis("send").reset_index().merge(pairs, on="sender")
    heard = reports[["sender", "receiver", "minute", "rssi"]].assign(heard=1.0)
    whole = whole.merge(heard, on=["sender", "receiver", "minute"], how="left")
    told = pd.MultiIndex.from_frame(reports[["receiver", "minute"]].drop_duplicates())
    is_told = pd.MultiIndex.from_frame(whole[["receiver", "minute"]]).isin(told)
    whole["heard"] = np.where(is_told, whole["heard"].fillna(0.0), np.nan)
    text = "not known: {} in minutes of which the receiver's report is missing"
    packets.note_count(notes, whole["heard"].isna().sum(), "outcome", text)
    unused = len(reports) - int((whole["heard"] == 1.0).sum())
    text = "dropped: {} of reports on motes or minutes without a broadcast"
    packets.note_count(notes, unused, "row", text)
    return whole[["send", "receiver", "heard", "rssi"]].assign(delay=np.nan)
