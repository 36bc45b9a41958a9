"""``netkf export --to log``: a run as a packet log, which ``netkf import`` replays to the bit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from netkf.core.errors import ScenarioError
from netkf.core.fields import as_path
from netkf.logs.importing import write_files
from netkf.logs.recorded_network import Files
from netkf.network.clocks import LinkClock
from netkf.scenario.scenario import Scenario
from netkf.scenario.tables import source_files
from netkf.scenario.writing import resolve_defaults, to_toml
from netkf.trace.messages import LOST, UNDER_WAY, join_messages
from netkf.trace.run import Run
from netkf.trace.schema import CODES


def export_log(run: Run, out: str | Path) -> tuple[Path, ...]:
    """Write a run as a packet log into the new folder ``out``; return the paths.

    ``packets.csv`` has a row for each message: t, sender, receiver, number (of its direction),
    heard (0 or 1) and t_heard, which is inf for a message under way at the end. ``scenario.toml``
    and its tables are those of the run; ``ticks.csv`` are the ticks of its clocks.
    ``netkf.import_log(out, "csv", ...)`` makes of it a scenario whose run with the same seed and
    replica has the same events and states.

    Raises ScenarioError for a run without a scenario or messages, and WriteError.
    """
    folder, scenario = as_path("out", out), run.scenario
    if not isinstance(scenario, Scenario):
        raise ScenarioError("run", "must have its scenario", None, "take what simulate returns")
    if folder.exists() and any(folder.iterdir() if folder.is_dir() else [folder]):
        rule = "must be a new or empty folder"
        raise ScenarioError(str(folder), rule, None, "choose another folder")
    messages = join_messages(run.log)
    if not len(messages):
        raise ScenarioError("run", "has no messages", None, "only runs with a network are logs")
    messages = messages[np.argsort(messages["sent_row"], kind="stable")]
    names = {int(node): str(node) for node in scenario.nodes}
    outcome = messages["outcome"]
    arrivals = np.where(outcome == UNDER_WAY, np.inf, messages["ended"])
    table = pd.DataFrame(
        {
            "t": messages["sent"],
            "sender": [names[i] for i in messages["sender"].tolist()],
            "receiver": [names[i] for i in messages["receiver"].tolist()],
            "number": messages["number"],
            "heard": (outcome != LOST).astype(int),
            "t_heard": [
                "" if lost else repr(t)
                for lost, t in zip(outcome == LOST, arrivals.tolist(), strict=True)
            ],
        }
    )
    source = f"# netkf: seed {run.seed}, replica {run.replica}, engine {run.engine}\n"
    files: Files = {"packets.csv": source + table.to_csv(index=False)}
    activation = scenario.network.activation
    if isinstance(activation, LinkClock) and activation.at != "readings":
        rows = run.log[run.log["kind"] == CODES["tick"]]
        ticks = pd.DataFrame({"t": rows["t"], "node": [names[i] for i in rows["node"].tolist()]})
        if activation.at != "nodes":
            ticks["peer"] = [names[i] for i in rows["peer"].tolist()]
        files["ticks.csv"] = ticks.to_csv(index=False)
    files |= {source.name: source.full for source in source_files(scenario)}
    resolved = resolve_defaults(scenario)
    files["scenario.toml"] = to_toml({**resolved, "seed": run.seed})
    write_files(folder, files)
    return tuple(folder / name for name in files)
