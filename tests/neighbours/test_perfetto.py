"""Traces for Perfetto: what its importer of Chrome traces asks for, and that nothing is missing.

Perfetto's own trace processor (v52) read such a file with one flow for each message that arrived, a
value of each counter for each sample and node, and no errors.
"""

import json
from bisect import bisect_right
from collections import defaultdict
from itertools import pairwise

import numpy as np
import pytest

import netkf
from netkf.cli.main import main


def events_of(path):
    trace = json.loads(path.read_text(), parse_constant=pytest.fail)
    found = defaultdict(list)
    for event in trace["traceEvents"]:
        found[event["ph"]].append(event)
    names = {e["pid"]: e["args"]["name"] for e in found["M"] if e["name"] == "process_name"}
    return found, names


def slices_of(found):
    tracks = defaultdict(list)
    for one in found["X"]:
        tracks[one["pid"], one["tid"]].append((one["ts"], one["dur"], one))
    return {track: sorted(slices, key=lambda one: one[0]) for track, slices in tracks.items()}


def test_nodes_are_tracks_messages_arrows_and_samples_counters(run, tmp_path):
    (path,) = netkf.export_perfetto(run, tmp_path)
    assert path.name == "trace.json"
    found, names = events_of(path)
    assert sorted(names.values()) == ["node gate", "node lab", "node roof"]
    tracks = slices_of(found)
    for slices in tracks.values():
        for (start, length, _), (after, *_) in pairwise(slices):
            assert length > 0.0
            assert start + length <= after + 1e-3  # nanoseconds; slices that overlap are dropped
    starts, ends = ({e["id"]: e for e in found[kind]} for kind in "sf")
    came = run.events[run.events.kind.isin(["deliver", "late"])]
    assert starts.keys() == ends.keys()
    assert len(starts) == len(found["s"]) == len(found["f"]) == len(came)
    for key, end in ends.items():
        assert starts[key]["ts"] <= end["ts"]
        assert end["bp"] == "e"
        for one, word in ((starts[key], "send"), (end, "deliver")):
            slices = tracks[one["pid"], one["tid"]]
            begin, length, around = slices[bisect_right(slices, (one["ts"], np.inf)) - 1]
            assert begin <= one["ts"] < begin + length
            assert word in around["name"]
    drawn = sorted((e["ts"], names[e["pid"]]) for e in ends.values())
    labels = {int(node): f"node {node}" for node in run.nodes}
    logged = sorted((round(t * 1e6, 3), labels[i]) for t, i in zip(came.t, came.node, strict=True))
    assert drawn == logged
    traces = [e for e in found["C"] if e["name"] == "trace"]
    assert len(traces) == len(found["C"]) / 2 == len(run.states)
    for event in traces:
        k = list(names.values()).index(names[event["pid"]])
        t = np.searchsorted(run.times * 1e6, event["ts"] - 1e-3)
        assert event["args"]["P"] == np.trace(run.P[t, k])


def test_a_window_of_slots_by_the_command(slot_run, tmp_path, capsys):
    netkf.save(slot_run, slot_run.scenario, tmp_path / "run")
    command = ["export", str(tmp_path / "run"), "--to", "perfetto", "--window", "1:2"]
    assert main(command) == 0
    assert "https://ui.perfetto.dev" in capsys.readouterr().out
    found, names = events_of(tmp_path / "run" / "trace.json")
    events = slot_run.events[slot_run.events.t.between(1.0, 2.0)]
    assert len(found["f"]) == (events.kind == "deliver").sum()
    assert all(1e6 <= e["ts"] <= 2e6 for kind in "XsfC" for e in found[kind])
    assert "network" in names.values()  # rounds are events of no node
    assert main([*command, "--out", str(tmp_path / "run" / "trace.json")]) == 2
    assert "exists already" in capsys.readouterr().err


def test_a_node_without_events_is_an_empty_track(run, tmp_path):
    first = float(run.log["t"][0])
    active = run.log[run.log["t"] == first]["node"]
    assert set(run.nodes) - set(active.tolist())
    (path,) = netkf.export_perfetto(run, tmp_path, first, first)
    found, _ = events_of(path)
    assert len(found["X"]) == len(set(active.tolist()))
