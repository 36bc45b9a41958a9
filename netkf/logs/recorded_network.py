"""A packet log as a recorded network: its tables, the scenario that replays it, and the report."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from netkf.core.csv_files import is_number_text
from netkf.core.errors import ScenarioError
from netkf.core.fields import SourceFile
from netkf.core.printable import MAX_NAME, count_phrase
from netkf.core.stamps import TimeBase
from netkf.logs.packets import PacketLog, accounts, note_count, settle
from netkf.network.clocks import LinkClock, OnReadings
from netkf.network.matchings import Matching
from netkf.scenario.scenario import Scenario
from netkf.scenario.tables import source_files
from netkf.scenario.writing import resolve_defaults, to_toml, toml_text

LAG = 10
"""Readings between the two of a pair whose differences tell how the state moves."""
TABLES = ("outcomes.csv", "unknown.csv", "accounts.csv", "delays.csv")
Files = dict[str, str | Path | SourceFile]
"""Texts, or files to copy, by name."""

HEAD = """\
# Made by netkf import of {log}: {told}.
# The network is the log's: choose plant, sensors and filter to go with it.
format = 1
name = "{name}"
claim = "the packets of a log, replayed"
horizon = {horizon}
probe = {probe}
seed = 1
"""
SIMULATED = """
[plant]     # simulated: a random walk that moves by about 1 while a node sends ten times
kind = "diffusion"
A = [[0.0]]
B = [[{B}]]
mean = [0.0]
cov = [[1.0]]

[[sensors]]    # every node reads it with noise of variance 1, about as often as it sends
nodes = {nodes}
H = [[1.0]]
R = [[1.0]]
sampling = {{ kind = "periodic", period = {period}, phase = "random" }}
"""
READINGS = """
[plant]     # a random walk, by how much readings change; no ground truth
kind = "unknown"
A = [[0.0]]
B = [[{B}]]
mean = [{mean}]
cov = [[{cov}]]

[[sensors]]    # R is what neighbouring readings differ by, and nodes from each other
kind = "recorded"
path = "readings.csv"
nodes = {nodes}
H = [[1.0]]
R = [[{R}]]
"""
NETWORK = """
[network]
graph = {{ kind = "csv", path = "links.csv", directed = true }}
activation = {{ kind = "recorded", at = "{at}", path = "transmissions.csv" }}
"""

FILTER = """
[filter]
kind = "diffusion"
"""


def write_network(
    log: PacketLog, name: str, hole: float, unreported: str, like: Scenario | None
) -> tuple[Files, tuple[str, ...]]:
    """Return the files of a log called ``name``, and notes; see ``settle`` for ``hole`` and
    ``unreported``, ``like`` replaces plant, sensors and filter. Raises ScenarioError.
    """
    rename_nodes(log, {str(node) for node in like.nodes} if like else set())
    if like is not None:
        _begin_with(like, log)
    outcomes = log.outcomes if log.outcomes.empty else settle(log, hole, unreported)
    if outcomes.empty:
        rule = "must have packets that somebody heard: a sender and one receiver a row"
        raise ScenarioError(name, rule, None, "name its column: --columns receiver=COLUMN")
    account = accounts(log.sends, outcomes)
    if like is not None and like.network.lives:
        # What comes to a node that is down is lost by its life, at that instant.
        came = (outcomes["heard"] == 0.0) & outcomes["delay"].notna()
        outcomes = outcomes.assign(heard=outcomes["heard"].mask(came, 1.0))
    table, unknown = _outcome_tables(log, outcomes)
    files: Files = {
        "outcomes.csv": table.to_csv(index=False),
        "accounts.csv": account.to_csv(index=False),
    }
    if len(unknown):
        files["unknown.csv"] = unknown.to_csv(index=False)
    channel: dict[str, Any] = {
        "loss": {"kind": "recorded", "path": "outcomes.csv", "after": "lose"},
        "symmetric": False,
    }
    delays = table[(table["delay"] > 0.0) & (table["delivered"] == 1)][
        ["sender", "receiver", "message", "delay"]
    ]
    if len(delays):
        files["delays.csv"] = delays.rename(columns={"delay": "seconds"}).to_csv(index=False)
        channel["delay"] = {"kind": "recorded", "path": "delays.csv"}
    if like is None:
        files["links.csv"] = account[["sender", "receiver"]].to_csv(index=False)
        files |= _own_scenario(log, name, account, channel)
    else:
        files |= _scenario_like(like, log, table, channel)
        if len(log.positions) or len(log.readings):
            log.notes.append(
                "not used: positions and readings beside the log; the scenario's count"
            )
    _note_totals(log, account)
    log.notes.insert(0, f"origin: simulated 0 is {log.origin} in the log")
    log.notes.insert(1, f"resolution: stamps are multiples of {log.resolution:g} s")
    files["report.txt"] = "\n".join([*log.notes, "", account.to_string(index=False), ""])
    return files, tuple(log.notes)


def _note_totals(log: PacketLog, account: pd.DataFrame) -> None:
    """Note how many links and outcomes the ``account`` of a log has."""
    nodes = len({*account["sender"], *account["receiver"]})
    apart = nodes * (nodes - 1) - len(account)
    note_count(log.notes, apart, "pair", "used: {} that never heard each other: no link")
    total = account[["sent", "heard", "lost", "unknown"]].sum()
    log.notes.append(
        f"outcomes: {total['sent']:,} = {total['heard']:,} heard + {total['lost']:,} lost + "
        f"{total['unknown']:,} unknown, on {count_phrase(len(account), 'link')}; accounts.csv has "
        "each"
    )
    if total["unknown"]:
        log.notes.append(
            "replay: outcomes that are not known (unknown.csv) count as lost; "
            'network.channel.loss.after = "deliver" makes them heard'
        )


def rename_nodes(log: PacketLog, known: set[str]) -> None:
    """Give nodes but those ``known`` names that tables can hold: no blanks, quotes or #."""
    nodes = sorted({*log.sends["sender"], *log.outcomes["receiver"]})
    names = {node: re.sub(r"[^\w.:+-]", "_", node) for node in nodes}
    if all(re.fullmatch(r"\d{1,15}", node) for node in nodes):
        names = {node: str(int(node)) for node in nodes}  # as tables write 01
    else:
        names = {n: f"n{name}" if is_number_text(name) else name for n, name in names.items()}
    if len(set(names.values())) < len(nodes) or max(map(len, names.values())) > MAX_NAME:
        names = {node: f"n{k}" for k, node in enumerate(nodes)}
    # A row that begins with # is a comment; of other names tables hold all.
    kept = {name for name in known if not name.startswith("#")}
    changed = {a: b for a, b in names.items() if a != b and a not in kept}
    if not changed:
        return
    listed = ", ".join(f"{a} is {b}" for a, b in changed.items())
    log.notes.append(f"used: nodes have other names here: {listed}")
    log.sends[["sender", "to"]] = log.sends[["sender", "to"]].replace(changed)
    log.outcomes["receiver"] = log.outcomes["receiver"].replace(changed)
    for table in (log.positions, log.readings):
        if len(table):
            table["node"] = table["node"].replace(changed)


def _outcome_tables(log: PacketLog, outcomes: pd.DataFrame) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return the known outcomes, numbered by direction, and the others with the reason."""
    sends = log.sends.iloc[outcomes["send"]].reset_index(drop=True)
    table = pd.DataFrame({"sender": sends["sender"], "receiver": outcomes["receiver"]})
    table["message"] = table.groupby(["sender", "receiver"]).cumcount()
    table["delivered"] = outcomes["heard"]
    table["t"], table["transmission"] = sends["t"], outcomes["send"]
    table["channel"], table["rssi"] = sends["channel"], outcomes["rssi"]
    # A message that is heard after the end of the log is never heard in a run. Whole seconds divide
    # no grid of time.
    delay = outcomes["delay"].replace(np.inf, 2.0 * math.ceil(log.sends["t"].max()) + 1.0)
    table["delay"], table["why"] = delay, outcomes["why"]
    is_known = table["delivered"].notna()
    unknown = table[~is_known].drop(columns=["delivered", "rssi", "delay"])
    table = table[is_known].drop(columns="why").astype({"delivered": int})
    untold = [c for c in ("rssi", "channel") if not (table[c].notna() & (table[c] != "")).any()]
    return table.drop(columns=untold), unknown.drop(columns=[c for c in untold if c == "channel"])


def _own_scenario(
    log: PacketLog, name: str, account: pd.DataFrame, channel: dict[str, Any]
) -> Files:
    """Return a scenario with a plant and a filter to begin with, and the tables that it names."""
    sends, nodes = log.sends, sorted({*account["sender"], *account["receiver"]})
    ids: list[Any] = [int(node) for node in nodes] if is_number_text(nodes[0]) else nodes
    ids = sorted(ids)
    sends = _sends_of(log, set(nodes), "that nobody ever heard")
    directed = bool((sends["to"] != "").any())
    ticks = sends[["t", "sender", "to"]].set_axis(["t", "node", "peer"], axis=1)
    ticks = ticks if directed else ticks[["t", "node"]]
    files: Files = {"transmissions.csv": ticks.to_csv(index=False)}
    rate = len(sends) / sends["sender"].nunique() / max(float(sends["t"].max()), 1e-9)
    arrivals = log.sends["t"].to_numpy()[log.outcomes["send"]] + log.outcomes["delay"]
    times = [sends["t"], arrivals[np.isfinite(arrivals)]]
    times += [log.readings["t"]] if len(log.readings) else []
    horizon = float(math.floor(float(pd.concat(times).max())) + 1)
    keys: dict[str, Any] = {"log": name, "name": name, "horizon": horizon}
    keys["probe"] = _round_number(horizon / 200.0)
    keys["nodes"] = toml_text(ids)
    readings = _of_network(log, log.readings, nodes, "reading")
    if len(readings):
        readings = readings.sort_values("t", kind="stable")
        files["readings.csv"] = readings.to_csv(index=False)
        own = {*readings["node"]}
        keys["nodes"] = toml_text([node for node in ids if str(node) in own])
        plant = READINGS.format(**keys, **_fit_walk(readings))
    else:
        period = _round_number(1.0 / rate)
        plant = SIMULATED.format(**keys, period=period, B=f"{math.sqrt(0.1 * rate):.3g}")
    told = f"{len(sends):,} transmissions of {len(nodes)} nodes"
    network = NETWORK.format(at="directions" if directed else "nodes")
    network += f"channel = {toml_text(channel)}\n"
    if len(log.positions):
        placed = _of_network(log, log.positions, nodes, "position")
        found = placed["node"].nunique()
        if found == len(nodes):
            files["positions.csv"] = placed.to_csv(index=False)
            network += 'positions = "positions.csv"\n'
        else:
            log.notes.append(f"dropped: positions, of {found} of {len(nodes)} nodes only")
    files["scenario.toml"] = HEAD.format(**keys, told=told) + plant + network + FILTER
    return files


def _sends_of(log: PacketLog, nodes: set[str], which: str) -> pd.DataFrame:
    """Return the transmissions of ``nodes``, those of others, ``which``, being noted."""
    silent = ~log.sends["sender"].isin(nodes)
    names = ", ".join(sorted(set(log.sends["sender"][silent])))
    text = "dropped: {} of nodes " + f"{which}: {names}"
    note_count(log.notes, silent.sum(), "transmission", text)
    return log.sends[~silent].copy()


def _of_network(log: PacketLog, table: pd.DataFrame, nodes: list[str], what: str) -> pd.DataFrame:
    """Return the rows of ``nodes``, the others being noted."""
    own = table[table["node"].isin(nodes)] if len(table) else table
    left_out, text = len(table) - len(own), "dropped: {} of nodes that are not in the network"
    note_count(log.notes, left_out, what, text)
    return own


def _round_number(value: float) -> float:
    """Return the nearest of 1, 2 and 5 times a power of ten that is no larger."""
    power = 10.0 ** math.floor(math.log10(value))
    step = max(k for k in (1, 2, 5) if k * power <= value * (1.0 + 1e-9))
    return float(f"{step * power:.1e}")


def _fit_walk(readings: pd.DataFrame) -> dict[str, str]:
    """Return B and R of a random walk by moments of differences, and mean and cov of its start."""
    # Terms are sorted, so that no digit depends on the names of nodes.
    near: list[tuple[float, float]] = []
    far: list[tuple[float, float]] = []
    for _, rows in readings.groupby("node"):
        t, y = rows["t"].to_numpy(), rows["y0"].to_numpy()
        for lag, found in ((1, near), (LAG, far)):
            found += list(zip(t[lag:] - t[:-lag], (y[lag:] - y[:-lag]) ** 2, strict=True))
    moments = [np.mean(sorted(found), axis=0) if found else np.zeros(2) for found in (near, far)]
    gap, change = moments[1] - moments[0]
    rate = max(change / gap, 0.0) if gap > 0.0 else 0.0
    noise = max(0.5 * (moments[0][1] - rate * moments[0][0]), 0.0)
    means = readings.groupby("node")["y0"].mean().sort_values()
    between = float(means.var(ddof=0)) if len(means) > 1 else 0.0
    first = readings.groupby("node")["y0"].first().sort_values()
    R = max(noise + between, 1e-9)
    values = {"B": max(math.sqrt(rate), 1e-6), "R": R, "mean": first.mean()}
    values["cov"] = max(float(first.var(ddof=0)), R)
    return {key: repr(float(f"{value:.4g}")) for key, value in values.items()}


def _scenario_like(
    scenario: Scenario, log: PacketLog, table: pd.DataFrame, channel: dict[str, Any]
) -> Files:
    """Return a ``scenario`` over the network of the log; its graph must have the log's links."""
    known = {(str(i), str(j)) for i, j in scenario.topology.directions}
    for sender, receiver in table[["sender", "receiver"]].drop_duplicates().itertuples(index=False):
        if (sender, receiver) not in known:
            rule = "the scenario must have the links of the log"
            remedy = "correct its graph, or import without --like"
            raise ScenarioError("network.graph", rule, [sender, receiver], remedy)
    resolved = resolve_defaults(scenario)
    network = resolved["network"]
    network["channel"] = {**channel, "symmetric": scenario.network.channel.symmetric}
    timed = {"bits_per_second", "queue"}.intersection(network.get("radio", ()))
    if "delay" in channel and timed:
        # Frames may be counted all the same, as packets of so many joules.
        network["radio"] = {k: v for k, v in network["radio"].items() if k not in timed}
        log.notes.append("not used: the rate of network.radio: times of arrival in the log have it")
    activation, files = scenario.network.activation, Files()
    replaced = source_files(scenario.network.channel)
    found = _recorded_activation(scenario, log)
    if found is not None:
        network["activation"], files["transmissions.csv"] = found
        replaced += source_files(activation)
    else:
        log.notes.append(
            f"used: nodes send when the scenario says ({network['activation']['kind']}); outcomes "
            "are those of the log, message by message"
        )
    if scenario.network.lives and not log.is_run:
        log.notes.append(
            "used: a node that is down does not send what it sent in the log; its later messages "
            "have the fates of earlier ones, number by number"
        )
    for source in source_files(scenario):
        if source not in replaced:
            if source.name in TABLES or files.get(source.name, source) != source:
                rule = "the scenario names a table as import does"
                raise ScenarioError("path", rule, source.name, "rename the table")
            files[source.name] = source
    files["scenario.toml"] = to_toml(resolved)
    return files


def _begin_with(scenario: Scenario, log: PacketLog) -> None:
    """Count times from [time] origin, and drop what was sent before; raises ScenarioError."""
    if scenario.time.origin is None or log.is_run:
        return
    origin, sends = scenario.time.stamps.origin, log.sends
    t = sends["t"] + float(log.origin - origin)
    kept = (t > 0.0).to_numpy()
    if not (kept & (t <= scenario.horizon).to_numpy()).any():
        rule = f"must begin before the end of the log, whose packets are from {log.origin} on"
        raise ScenarioError("time.origin", rule, str(origin), "correct it, or the unit of stamps")
    rows = log.outcomes[kept[log.outcomes["send"]]].reset_index(drop=True)
    log.outcomes = rows.assign(send=np.cumsum(kept)[rows["send"]] - 1)
    log.sends = sends.assign(t=t.round(9))[kept].reset_index(drop=True)
    log.origin = origin
    if not kept.all():
        log.notes.append(f"dropped: sent by [time] origin of the scenario: {(~kept).sum():,}")


def _recorded_activation(
    scenario: Scenario, log: PacketLog
) -> tuple[dict[str, Any], str | Path] | None:
    """Return the table network.activation that sends as in the log, and its file, if needed."""
    activation = scenario.network.activation
    pairing = activation if isinstance(activation, Matching) else None
    if isinstance(activation, OnReadings) or not isinstance(activation, Matching | LinkClock):
        return None
    if log.is_run and scenario.network.clocks:
        return None  # It ticks again by the clocks of its nodes.
    table: dict[str, Any] = {"kind": "recorded", "path": "transmissions.csv"}
    at = activation.at if isinstance(activation, LinkClock) else "links"
    if log.ticks is not None:
        return {**table, "at": at}, log.ticks
    sends = _sends_of(log, {str(node) for node in scenario.nodes}, "that the scenario has not")
    if at != "nodes":
        _name_only_receivers(sends, log)
    needed = "nodes" if (sends["to"] == "").any() else "directions" if at == "nodes" else at
    if needed not in (("links",) if pairing else scenario.node_filter.timing.clocks):
        told = "broadcasts" if needed == "nodes" else "messages to one receiver"
        rule = (
            f"must be one under which nodes send {told}, as in the log, and the filter knows none"
        )
        raise ScenarioError("network.activation", rule, at, "choose another filter")
    if needed != at:
        log.notes.append(f'used: clocks at = "{needed}", by what the log says of packets')
    if pairing:
        sends["t"] = np.floor(sends["t"] / scenario.slot_plant.period + 1e-9).astype(int)
    if needed == "links":
        _note_pairs(sends, log.notes, "slot" if pairing else "stamp")
    if not pairing:
        return {**table, "at": needed}, _clock_rows(sends, needed, scenario.time.stamps)
    ids = {str(node): int(node) for node in scenario.nodes}
    for name in ("sender", "to"):  # replace would warn of its types in pandas 2
        sends[name] = [ids.get(node, node) for node in sends[name]]
    rows = _pairs(sends).rename(columns={"t": "slot"})
    table |= {} if pairing.phase is None else {"phase": pairing.phase}
    return table, rows.drop_duplicates().to_csv(index=False)


def _name_only_receivers(sends: pd.DataFrame, log: PacketLog) -> None:
    """Name the receiver of broadcasts of senders that have one hearer each, if all have."""
    pairs = pd.DataFrame({"to": log.outcomes["receiver"]})
    pairs["sender"] = log.sends["sender"].to_numpy()[log.outcomes["send"]]
    only = pairs.drop_duplicates().set_index("sender")["to"]
    if only.index.is_unique and sends["sender"].isin(only.index).all():
        sends["to"] = sends["to"].mask(sends["to"] == "", sends["sender"].map(only))


def _note_pairs(sends: pd.DataFrame, notes: list[str], what: str) -> None:
    """Note where what links send, both ways at once, is not what the log says."""
    apart = sends[["t", "sender", "to"]].drop_duplicates()
    more = 2 * len(_pairs(apart).drop_duplicates()) - len(apart)
    text = "sent beside the log: {} the other way, as links exchange; message k of a direction has"
    note_count(notes, more, "message", f"{text} the fate of its message k in the log")
    text = "merged: {} with another one of its direction and " + what
    note_count(notes, len(sends) - len(apart), "message", text)


def _pairs(sends: pd.DataFrame) -> pd.DataFrame:
    """Return the columns t, node, peer, the lower of which comes first."""
    ends = np.sort(sends[["sender", "to"]].to_numpy(), axis=1)
    return pd.DataFrame({"t": sends["t"].to_numpy(), "node": ends[:, 0], "peer": ends[:, 1]})


def _clock_rows(sends: pd.DataFrame, at: str, stamps: TimeBase) -> str:
    """Return the ticks of clocks ``at`` nodes, directions or links, in ``stamps``, that send so."""
    sends = sends.assign(t=[stamps.text(t) for t in sends["t"].tolist()])
    rows = sends[["t", "sender", "to"]].set_axis(["t", "node", "peer"], axis=1)
    if at == "nodes":
        rows = rows[["t", "node"]]
    if at == "links":
        rows = _pairs(sends)
    return rows.drop_duplicates().to_csv(index=False)
