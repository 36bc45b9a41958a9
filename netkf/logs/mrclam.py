"""The UTIAS multi-robot cooperative localisation and mapping data sets (MR.CLAM).

Leung, Halpern, Barfoot and Liu, "The UTIAS multi-robot cooperative localization and mapping
dataset", International Journal of Robotics Research 30(8), 2011. Robots are the subjects of which
there is odometry; readings name the barcodes of what a robot saw, another robot or a landmark.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from netkf.core.errors import ScenarioError
from netkf.core.fields import MAX_MAGNITUDE
from netkf.core.printable import count_phrase, list_some
from netkf.linalg.arrays import FloatArray

HOLE = 0.5  # seconds without a row of odometry, or of true poses, that a note tells
SPREAD = 1.4826  # standard deviations of a Gaussian in its median deviation
LEAST = (0.01, 0.005)  # metres and radians: of readings, so that R is not 0 where they are few
STRANGE = {"distances (m)": 1.0, "directions (rad)": 0.5}
"""How far off half of a robot's readings are that are no readings of what it saw."""
COLUMNS = {
    "Odometry": ("t", "u0", "u1"),
    "Groundtruth": ("t", "x0", "x1", "x2"),
    "Measurement": ("t", "barcode", "y0", "y1"),
}
"""Of each file of a robot: forward and angular velocity; x, y and heading; range and bearing."""

SCENARIO = """\
# Made by netkf import of {log}: robots that know their odometry, and read distance and
# direction of each other and of landmarks. True poses come from the log.
format = 1
name = "{log}"
claim = "robots that read each other know their poses better than by odometry and landmarks alone"
horizon = {horizon}.0
probe = 1.0

[time]
origin = {origin}    # the first instant at which all true poses are known

[[plants]]
name = "pose"
nodes = {nodes}
kind = "recorded"
f = "unicycle"
path = "truth.csv"
interpolate = "linear"
input = {{ kind = "recorded", path = "odometry.csv" }}
# How far odometry is off after a second, in metres and radians: choose your own.
B = [[0.05, 0.0, 0.0], [0.0, 0.05, 0.0], [0.0, 0.0, 0.05]]
step = 0.1
means = {means}
cov = [[0.01, 0.0, 0.0], [0.0, 0.01, 0.0], [0.0, 0.0, 0.0025]]
position = [0, 1]
"""
SENSOR = """
[[sensors]]    # R is what these readings differ by from the true poses
kind = "{kind}"
of = "pose"
path = "{path}"
heading = 2
R = [[{R[0]}, 0.0], [0.0, {R[1]}]]
"""
NETWORK = """
[network]      # a robot that has read something tells all others; the log knows of no losses
graph = {{ kind = "edges", {nodes}edges = {edges} }}
activation = {{ kind = "readings" }}

[filter]
kind = "block-intersection"
estimates = "own"
"""


def read_mrclam(folder: Path) -> tuple[dict[str, str], tuple[str, ...]]:
    """Return the scenario and tables of a data set, as texts by the names of their files, and
    notes. Raises ScenarioError, with the line.
    """
    found = [re.fullmatch(r"Robot(\d+)_Odometry\.dat", path.name) for path in folder.glob("*")]
    nodes = sorted(int(match.group(1)) for match in found if match)
    if not nodes:
        rule, remedy = "must be a folder with Robot1_Odometry.dat and others", "check the path"
        raise ScenarioError(str(folder), rule, None, remedy)
    codes = _read_by_key(folder / "Barcodes.dat", ("subject", "barcode"), "barcode")
    columns = ("subject", "x", "y", "x std-dev", "y std-dev")
    marks = _read_by_key(folder / "Landmark_Groundtruth.dat", columns, "subject")
    points = {int(subject): row[1:3] for subject, row in marks.items()}
    notes: list[str] = []
    files = {name: _read_robots(folder, name, nodes, notes) for name in COLUMNS}
    subjects = {code: int(row[0]) for code, row in codes.items()}
    readings = _name_subjects(files["Measurement"], subjects, {*nodes, *points}, notes)
    tables = {"odometry.csv": files["Odometry"], "truth.csv": files["Groundtruth"]}
    poses = {node: rows for node, rows in tables["truth.csv"].groupby("node")}  # noqa: C416
    origin, horizon = _span_of_all(folder, poses)
    start = np.array([float(origin)])
    means = [np.round(_poses_at(poses[node], start)[0], 6).tolist() for node in nodes]
    log = re.sub(r"[^\w.-]", "_", folder.resolve().name)
    keys = {"log": log, "horizon": horizon, "nodes": nodes, "means": means}
    parts = [SCENARIO.format(**keys, origin=f"{Decimal(origin):f}")]
    is_mark = readings["to"].isin(points)
    for path, rows, kind in (
        ("landmarks.csv", readings[is_mark], "range-bearing"),
        ("robots.csv", readings[~is_mark], "relative-range-bearing"),
    ):
        if len(rows):
            tables[path] = rows
            R = _noise(path, rows, poses, points, notes)
            parts.append(SENSOR.format(kind=kind, path=path, R=R))
    if is_mark.any():
        listed = [points[i] for i in sorted(set(readings["to"][is_mark]))]
        parts.insert(2, f"positions = {listed}\n")
    edges = [[i, j] for i in nodes for j in nodes if i < j]
    # Edges name the nodes, if there are any.
    parts.append(NETWORK.format(edges=edges, nodes="" if edges else f"nodes = {nodes}, "))
    # The numbers stay as they are written in the log.
    texts = {path: _by_time(table).to_csv(index=False) for path, table in tables.items()}
    return {"scenario.toml": "".join(parts), **texts}, tuple(notes)


def _span_of_all(folder: Path, poses: dict[Any, pd.DataFrame]) -> tuple[str, int]:
    """Return the stamp from which on poses of all robots are known, and for how many seconds."""
    last = max(poses, key=lambda node: float(poses[node]["t"].iloc[0]))
    first = min(poses, key=lambda node: float(poses[node]["t"].iloc[-1]))
    origin, end = poses[last]["t"].iloc[0], poses[first]["t"].iloc[-1]
    horizon = int(float(end) - float(origin))
    if horizon < 1:
        rule = "must have true poses of all robots for a second or longer"
        got = f"robot {last} from {origin} on, robot {first} until {end}"
        remedy = "check the stamps, or leave a robot's files out"
        raise ScenarioError(str(folder), rule, got, remedy)
    return origin, horizon


def _read(path: Path, columns: Sequence[str]) -> pd.DataFrame:
    rows = dict[int, list[str]]()
    try:
        with path.open(encoding="utf-8-sig") as file:
            for line, text in enumerate(file, 1):
                entries = text.partition("#")[0].split()
                if entries and (len(entries) != len(columns) or not all(map(_is_number, entries))):
                    rule = f"line {line} must have {len(columns)} numbers"
                    raise ScenarioError(str(path), rule, text.strip(), "correct the line")
                if entries:
                    rows[line] = entries
    except (OSError, UnicodeDecodeError) as error:
        rule = f"cannot be read ({getattr(error, 'strerror', None) or error})"
        remedy = "check the folder"
        if re.fullmatch(r"Robot\d+_Groundtruth.dat", path.name):
            remedy += ', or write [[plants]] with kind = "unknown" for a log without true poses'
        raise ScenarioError(str(path), rule, None, remedy) from None
    if not rows and columns is not COLUMNS["Measurement"]:  # a robot may see nothing
        raise ScenarioError(str(path), "has no rows", None, "check the folder")
    return pd.DataFrame.from_dict(rows, orient="index", columns=list(columns))


def _is_number(text: str) -> bool:
    try:
        return "_" not in text and abs(float(text)) <= MAX_MAGNITUDE
    except ValueError:
        return False


def _read_by_key(path: Path, columns: Sequence[str], key: str) -> dict[float, list[float]]:
    table = _read(path, columns).astype(float)
    again = table.index[table[key].duplicated()]
    if len(again):
        value = float(table[key][again[0]])
        raise ScenarioError(str(path), f"line {again[0]} repeats a {key}", value, "correct it")
    return dict(zip(table[key].tolist(), table.to_numpy().tolist(), strict=True))


def _read_robots(folder: Path, name: str, nodes: list[int], notes: list[str]) -> pd.DataFrame:
    """Return the rows of one file of all robots by time, without rows that repeat others."""
    tables, is_reading = [], name == "Measurement"
    for node in nodes:
        file = f"Robot{node}_{name}.dat"
        table = _read(folder / file, COLUMNS[name])
        late = int((table["t"].astype(float).diff() < 0.0).sum())
        if late:
            notes.append(f"{file}: rows that are earlier than the one before were sorted: {late}")
        key = [*COLUMNS[name]] if is_reading else ["t"]
        kept = _by_time(table[~table[key].astype(float).duplicated(keep="last")])
        if len(kept) < len(table):
            what = "repeat a reading" if is_reading else "repeat a time, whose last row counts"
            notes.append(f"{file}: rows that {what}: {len(table) - len(kept)}")
        gaps = np.diff(kept["t"].astype(float))
        if not is_reading and (gaps > HOLE).any():
            longest = f"{gaps.max():.3g} s after t = {kept['t'].iloc[int(gaps.argmax())]}"
            count = int((gaps > HOLE).sum())
            notes.append(f"{file}: gaps of more than {HOLE:g} s: {count}, the longest {longest}")
        kept.insert(1, "node", node)
        tables.append(kept)
    return pd.concat(tables)


def _name_subjects(
    rows: pd.DataFrame, subjects: dict[float, int], known: set[int], notes: list[str]
) -> pd.DataFrame:
    """Return readings with the subject ``to`` in place of their barcode, of ``known`` ones."""
    to = rows["barcode"].astype(float).map(subjects).fillna(-1).astype(int)
    usable = to.isin(known) & (to != rows["node"])
    unknown = rows[~usable].groupby("barcode").size()
    if len(unknown):
        listed = ", ".join(f"{code} ({count_phrase(n, 'row')})" for code, n in unknown.items())
        notes.append(f"readings of barcodes of no other robot or landmark are left out: {listed}")
    return rows.assign(barcode=to)[usable].rename(columns={"barcode": "to"})


def _by_time(table: pd.DataFrame) -> pd.DataFrame:
    return table.iloc[np.argsort(table["t"].astype(float), kind="stable")]


def _numbers(table: pd.DataFrame, *names: str) -> FloatArray:
    return np.asarray(table[[*names]].astype(float)).T


def _poses_at(poses: pd.DataFrame, times: FloatArray) -> FloatArray:
    """Return true poses (K, 3) at ``times`` (K,), whose headings count whole turns."""
    t, x, y, heading = _numbers(poses, *COLUMNS["Groundtruth"])
    return np.stack([np.interp(times, t, z) for z in (x, y, np.unwrap(heading))], axis=1)


def _noise(
    path: str,
    rows: pd.DataFrame,
    poses: dict[Any, pd.DataFrame],
    points: dict[int, list[float]],
    notes: list[str],
) -> list[float]:
    """Return the variances of the middle half of what readings differ by from true poses; tell of
    robots whose readings have nothing to do with them.
    """
    off: dict[Any, list[FloatArray]] = {}
    for (node, to), own in rows.groupby(["node", "to"]):
        t, distance, angle = _numbers(own, "t", "y0", "y1")
        pose = _poses_at(poses[node], t)
        other = np.array(points[to]) if to in points else _poses_at(poses[to], t)[:, :2]
        d = other - pose[:, :2]
        turn = angle - np.arctan2(d[:, 1], d[:, 0]) + pose[:, 2]
        turn = (turn + np.pi) % (2.0 * np.pi) - np.pi
        off.setdefault(node, []).append(np.stack([distance - np.hypot(*d.T), turn]))
    apart = {node: np.concatenate(some, axis=1) for node, some in off.items()}
    medians = {node: np.median(np.abs(some), axis=1).tolist() for node, some in apart.items()}
    for k, (what, limit) in enumerate(STRANGE.items()):
        strange = {node: value[k] for node, value in medians.items() if value[k] > limit}
        if strange:
            text = (
                f"{path}: {what} by robot {list_some(list(strange), 5)} differ from the true poses"
            )
            least = f"by {min(strange.values()):.3g} or more in the median"
            notes.append(f"{text} {least}: check their units, and those of stamps and poses")
    spread = SPREAD * np.median(np.abs(np.concatenate([*apart.values()], axis=1)), axis=1)
    return [round(max(s, least) ** 2, 6) for s, least in zip(spread.tolist(), LEAST, strict=True)]
