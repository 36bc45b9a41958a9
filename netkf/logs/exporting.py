"""``netkf export``: a run as a packet log, and as a scenario of what happened: both to the bit."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from netkf.core.errors import ScenarioError, TheoryError
from netkf.core.fields import as_path
from netkf.logs.importing import write_folder
from netkf.logs.packet_tables import EXPORTED
from netkf.logs.recorded_network import Files
from netkf.network.clocks import LinkClock
from netkf.network.lives import lifetimes
from netkf.rng.streams import Streams
from netkf.runs.files import require_trace
from netkf.scenario.positions import tick_times
from netkf.scenario.sampling import all_sample_times
from netkf.scenario.scenario import Scenario
from netkf.scenario.tables import source_files
from netkf.scenario.writing import resolve_defaults, to_toml
from netkf.theory.common.arrivals import with_last_exchanges
from netkf.trace.messages import LOST, UNDER_WAY, join_messages
from netkf.trace.run import Run
from netkf.trace.schema import rows_of


def export_recorded(run: Run, out: str | Path) -> tuple[Path, ...]:
    """Write a run as its recorded twin into the new folder ``out``; return the paths.

    ``scenario.toml`` is that of the run with what happened in place of its causes: which messages
    were lost (``losses.csv``) and how long the others took (``delays.csv``), when nodes were down
    (``lives.csv``), and where nodes were that their states placed (``positions.csv``). It has no
    radios, hops and shared losses. With the same seed and replica its events and states are those
    of the run.

    Raises ScenarioError for a run without a scenario, TheoryError where the messages of the last
    slot cannot be told, and WriteError.
    """
    folder, scenario = _new_folder(run, out)
    table: Any = {**resolve_defaults(scenario), "seed": run.seed}
    network: Any = table["network"]
    files: Files = {}
    network.pop("radio", None)
    messages = _messages_of(scenario, run, to_the_end=True)
    if len(messages):
        files |= _outcomes(scenario, messages, network.setdefault("channel", {}))
    if scenario.network.lives:
        files |= _lives(scenario, run, network)
    if scenario.links_follow_state:
        files |= _positions(scenario, run)
        network["positions"] = "positions.csv"
        for block in table.get("plants", []):
            block.pop("position", None)
    text = to_toml(table)
    given = {source.name: source for source in source_files(scenario)}
    files |= {name: source for name, source in given.items() if f'"{name}"' in text}
    files["scenario.toml"] = text
    write_folder(folder, files)
    return tuple(folder / name for name in files)


def _new_folder(run: Run, out: str | Path) -> tuple[Path, Scenario]:
    folder, scenario = as_path("out", out), require_trace(run)
    if folder.exists() and any(folder.iterdir() if folder.is_dir() else [folder]):
        rule = "must be a new or empty folder"
        raise ScenarioError(str(folder), rule, None, "choose another folder")
    return folder, scenario


def _messages_of(scenario: Scenario, run: Run, to_the_end: bool) -> np.ndarray:
    """Return the MESSAGE rows of a run; TheoryError if unknown at the horizon, ``to_the_end``."""
    # Those in slots at the horizon too: samples there use them.
    logs = [run.log]
    try:
        if scenario.slotted and (whole := with_last_exchanges(scenario, run)) is not run:
            logs.append(whole.log)
    except TheoryError:
        if to_the_end:
            raise
    found = [join_messages(log) for log in logs]
    found = [rows[np.argsort(rows["sent_row"], kind="stable")] for rows in found]
    later = [rows[rows["sent"] >= scenario.horizon] for rows in found[1:]]
    return np.concatenate([found[0], *later])


def _outcomes(scenario: Scenario, messages: np.ndarray, channel: dict[str, Any]) -> Files:
    """Return the tables of losses and delays, which the ``channel`` names from now on."""
    # What was lost on arrival took its time: its hearer was down.
    took = messages["ended"] - messages["sent"]
    arrives = (messages["outcome"] != LOST) | (took > 0.0)
    later = math.ceil(scenario.end_time) + 1.0  # whole seconds divide no grid of time
    took = np.where(messages["outcome"] == UNDER_WAY, later, took)
    rows = pd.DataFrame({name: messages[name] for name in ("sender", "receiver")})
    rows["message"] = messages["number"]
    losses = rows.assign(delivered=arrives.astype(int))
    channel.pop("channels", None)
    channel["loss"] = {"kind": "recorded", "path": "losses.csv", "after": "refuse"}
    files: Files = {"losses.csv": losses.to_csv(index=False)}
    # Without delays the twin is computed as the run was, to the bit.
    if scenario.network.channel.delay.fixed != 0.0 or took[arrives].any():
        delays = rows.assign(seconds=[repr(t) for t in took.tolist()])[arrives]
        files["delays.csv"] = delays.to_csv(index=False)
        channel["delay"] = {"kind": "recorded", "path": "delays.csv", "after": "refuse"}
    return files


def _lives(scenario: Scenario, run: Run, network: dict[str, Any]) -> Files:
    """Return the tables of lives, of nodes that keep their memory and of others."""
    words = {"crash": "down", "restart": "up", "leave": "leave", "join": "join"}
    files: Files = {}
    entries, stamp = [], scenario.time.stamps.text
    lives = lifetimes(scenario, Streams(run.seed, run.replica))
    for memory in ("kept", "lost"):
        own = {node: life for node, life in lives.items() if life.forgets == (memory == "lost")}
        rows = [(0.0, node, "down") for node, life in own.items() if not life.up]
        rows += [(c.time, node, words[c.kind]) for node, life in own.items() for c in life.changes]
        if own:
            name = f"lives_{memory}.csv"
            # pandas quotes names with commas.
            lines = [(stamp(t), str(i), w) for t, i, w in sorted(rows)]
            files[name] = pd.DataFrame(lines, columns=["t", "node", "what"]).to_csv(index=False)
            entries.append({"kind": "recorded", "nodes": list(own), "path": name, "memory": memory})
    network["lives"] = entries
    return files


def _positions(scenario: Scenario, run: Run) -> Files:
    """Return the table of where all nodes were whenever someone looked."""
    streams, positions = Streams(run.seed, run.replica), scenario.positions
    if scenario.slotted:
        truth: Any = scenario.slot_truth(streams)
        slots = range(1 + int(scenario.end_time / scenario.slot_plant.period))
        looks = [(scenario.slot_plant.slot_time(slot), slot) for slot in slots]
    else:
        truth = scenario.continuous_truth(streams)
        sampled = all_sample_times(scenario.sample_times(streams))
        times: list[Any] = [[0.0], tick_times(scenario, streams), sampled, scenario.times]
        looks = [(t, t) for t in np.unique(np.concatenate(times)).tolist()]
    lines = []
    for t, when in looks:
        x = truth.absolute(when)
        for node in scenario.nodes:
            point = positions.at(node, t, x) if positions.has(node) else ()
            if len(point) > 2:
                rule = "must place nodes by at most two coordinates, which tables have"
                raise ScenarioError("position", rule, len(point), "export --to log")
            if point:
                place = [repr(float(z)) for z in (*point, 0.0)[:2]]
                lines.append((scenario.time.stamps.text(t), str(node), *place))
    table = pd.DataFrame(lines, columns=["t", "node", "x", "y"])
    return {"positions.csv": table.to_csv(index=False)}


def export_log(run: Run, out: str | Path) -> tuple[Path, ...]:
    """Write a run as a packet log into the new folder ``out``; return the paths.

    ``packets.csv`` has a row for each message: t, sender, receiver, number (of its direction),
    heard (0 or 1) and t_heard, which is inf for a message under way at the end; one that is not
    heard has it if it came to a node that was down. ``scenario.toml`` and its tables are those of
    the run; ``ticks.csv`` are the ticks of its clocks, unless nodes have wrong ones.
    ``netkf.import_log(out, "csv", ...)`` makes of it a scenario whose run with the same seed and
    replica has the same events and states.

    Raises ScenarioError for a run without a scenario or messages, and WriteError.
    """
    folder, scenario = _new_folder(run, out)
    messages = _messages_of(scenario, run, to_the_end=False)
    if not len(messages):
        raise ScenarioError("run", "has no messages", None, "only runs with a network are logs")
    names = {int(node): str(node) for node in scenario.nodes}
    outcome = messages["outcome"]
    arrivals = np.where(outcome == UNDER_WAY, np.inf, messages["ended"])
    never = (outcome == LOST) & (messages["ended"] == messages["sent"])
    at = zip(never, arrivals.tolist(), strict=True)
    table = pd.DataFrame(
        {
            "t": messages["sent"],
            "sender": [names[i] for i in messages["sender"].tolist()],
            "receiver": [names[i] for i in messages["receiver"].tolist()],
            "number": messages["number"],
            "heard": (outcome != LOST).astype(int),
            "t_heard": ["" if lost else repr(t) for lost, t in at],
        }
    )
    source = f"{EXPORTED}seed {run.seed}, replica {run.replica}, engine {run.engine}\n"
    files: Files = {"packets.csv": source + table.to_csv(index=False)}
    activation = scenario.network.activation
    right = not scenario.network.clocks
    if right and isinstance(activation, LinkClock) and activation.at != "readings":
        rows = rows_of(run.log, "tick")
        stamps = [scenario.time.stamps.text(t) for t in rows["t"].tolist()]
        ticks = pd.DataFrame({"t": stamps, "node": [names[i] for i in rows["node"].tolist()]})
        if activation.at != "nodes":
            ticks["peer"] = [names[i] for i in rows["peer"].tolist()]
        files["ticks.csv"] = ticks.to_csv(index=False)
    files |= {source.name: source for source in source_files(scenario)}
    files["scenario.toml"] = to_toml({**resolve_defaults(scenario), "seed": run.seed})
    write_folder(folder, files)
    return tuple(folder / name for name in files)
