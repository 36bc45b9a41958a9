"""The commands about many scenarios: sweep, size, consistency, compare."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from netkf.core.errors import ScenarioError

if TYPE_CHECKING:
    from netkf.scenario.scenario import Scenario

Command = Callable[[argparse.Namespace], int]
Add = Callable[[str, Command, str], argparse.ArgumentParser]
Load = Callable[[argparse.Namespace], "Scenario"]
NOT_KEPT = 1


def add_commands(
    commands: Any, scenario_command: Add, load: Load, count: Callable[[str], int], seed: Any
) -> None:
    """Declare the commands; ``scenario_command`` makes one that takes a scenario."""
    swept = scenario_command("sweep", partial(_sweep, load), "one row for each place of a grid")
    _vary(swept, "KEY.PATH=V1,V2,...", "values of a key, or START:STOP:COUNT; several span a grid")
    swept.add_argument("--runs", type=count, default=1, help="runs at each place (default: 1)")
    swept.add_argument("--out", type=Path, help="directory (default: runs/NAME-sweep-k)")
    swept.add_argument("--no-plot", action="store_true", help="no picture")
    sized = scenario_command("size", partial(_size, load), "the value of a key that just suffices")
    _vary(sized, "KEY.PATH=LOW:HIGH", "the key to search and its range")
    sized.add_argument(
        "--target",
        required=True,
        metavar="QUANTITY<=LIMIT",
        help="quantities: worst_rms, mean_rms, worst_trace, mean_trace, within_central",
    )
    sized.add_argument(
        "--by", choices=["theory", "simulation"], help="default: theory where it tells"
    )
    sized.add_argument(
        "--runs", type=count, default=1000, help="most runs at a value (default: 1000)"
    )
    sized.add_argument("--confidence", type=float, default=0.95, help="of all decisions together")
    words = "whether P says what the errors are: NEES and NIS, and what they should be"
    judged = scenario_command("consistency", partial(_consistency, load), words)
    judged.add_argument("--runs", type=count, default=50, help="how many runs (default: 50)")
    judged.add_argument("--confidence", type=float, default=0.95, help="of all verdicts together")
    for command in (swept, sized, judged):
        command.add_argument("--seed", type=seed, help="root seed instead of the scenario's")
        command.add_argument(
            "--engine", default="auto", choices=["auto", "simpy", "processes", "compiled"]
        )
        workers = command.add_mutually_exclusive_group()
        workers.add_argument("--workers", type=count, help="processes (default: one a core)")
        workers.add_argument(
            "--scheduler", metavar="ADDRESS", help="Dask scheduler, tcp://HOST:PORT"
        )
    words = "finished runs side by side"
    compared = commands.add_parser("compare", help=words, description=words)
    compared.add_argument("directories", type=Path, nargs="+", metavar="DIR", help="run directory")
    compared.add_argument("--confidence", type=float, default=0.95, help="of all marks together")
    compared.set_defaults(command=_compare)
    for command in (swept, sized, judged, compared):
        command.add_argument("--json", action="store_true", help="one JSON document, nothing else")


def _vary(parser: argparse.ArgumentParser, shape: str, words: str) -> None:
    parser.add_argument("--vary", action="append", required=True, metavar=shape, help=words)


def _sweep(load: Load, options: argparse.Namespace) -> int:
    from netkf.studies.parameter_grid import parse_grid
    from netkf.studies.sweep import sweep_to_directory
    from netkf.studies.tables import sweep_text

    grid, scenario = parse_grid(options.vary), load(options)
    line = _Line()
    try:
        swept = sweep_to_directory(
            scenario,
            grid,
            options.runs,
            options.out,
            options.engine,
            options.workers,
            options.scheduler,
            progress=lambda done, wanted: line(f"{done} of {wanted} places"),
            finish=None if options.no_plot else partial(_picture, scenario),
        )
    finally:
        line.close()
    if options.json:
        _print_json({"directory": str(swept.directory), "rows": swept.table.to_dict("records")})
        return 0
    print(f"{scenario.name}: {scenario.claim}" if scenario.claim else scenario.name)
    print(f"\n{sweep_text(swept.table, swept.keys)}\n")
    each = "run" if options.runs == 1 else "runs"
    print(
        f"{len(swept.table):,} places of {options.runs:,} {each} in {swept.seconds:.2f} s, all on "
        "the same draws" + ("" if options.runs == 1 else "; +- one standard error")
    )
    print(f"written to {swept.directory}")
    return 0


def _picture(scenario: Scenario, swept: Any) -> None:
    try:
        from netkf.studies.picture import sweep_picture
    except ImportError:
        print("no picture: matplotlib is missing (pip install matplotlib)", file=sys.stderr)
        return
    if not sweep_picture(scenario.name, swept):
        print("no picture: it shows one or two keys, the second of few values", file=sys.stderr)


def _size(load: Load, options: argparse.Namespace) -> int:
    from netkf.studies.parameter_grid import parse_interval
    from netkf.studies.size import size
    from netkf.studies.tables import answer, sizing_text

    if len(options.vary) > 1:
        words, remedy = "is given more than once", "size searches one key; sweep varies several"
        raise ScenarioError("--vary", words, options.vary, remedy)
    key, low, high = parse_interval(options.vary[0])
    line = _Line()
    try:
        found = size(
            load(options),
            key,
            low,
            high,
            options.target,
            options.by,
            options.runs,
            options.confidence,
            workers=options.workers,
            scheduler=options.scheduler,
            engine=options.engine,
            progress=line,
        )
    finally:
        line.close()
    if options.json:
        probes = [probe._asdict() for probe in sorted(found.probes)]
        target = found.target._asdict()
        _print_json({**vars(found), "target": target, "probes": probes, "answer": answer(found)})
    else:
        print(sizing_text(found))
    if not found:
        print(f"netkf: {answer(found)}", file=sys.stderr)
        return NOT_KEPT
    return 0


def _consistency(load: Load, options: argparse.Namespace) -> int:
    from netkf.studies.consistency import consistency
    from netkf.studies.tables import consistency_text

    found = consistency(
        load(options),
        options.runs,
        confidence=options.confidence,
        workers=options.workers,
        scheduler=options.scheduler,
        engine=options.engine,
    )
    if options.json:
        _print_json({**vars(found), "rows": [vars(row) for row in found.rows]})
    else:
        print(f"{found.scenario}\n\n{consistency_text(found)}")
    if not found:
        nodes = [str(row.node) for row in found.rows if row.verdict.startswith("BROKEN")]
        print(
            f"netkf: errors are not what they should be at node {', '.join(nodes)}", file=sys.stderr
        )
        return NOT_KEPT
    return 0


def _compare(options: argparse.Namespace) -> int:
    from netkf.studies.compare import compare
    from netkf.studies.tables import comparison_text

    found = compare(options.directories, options.confidence)
    if options.json:
        _print_json(found.document())
    else:
        print(comparison_text(found))
    return 0


def _print_json(document: Any) -> None:
    from netkf.runs.files import finite

    print(json.dumps(finite(document), indent=2))


class _Line:
    """Progress on a terminal, silence in a pipe."""

    def __init__(self) -> None:
        self._live, self._shown = sys.stderr.isatty(), False

    def __call__(self, text: str) -> None:
        if self._live:
            self._shown = True
            print(f"\r\033[K{text}", end="", file=sys.stderr, flush=True)

    def close(self) -> None:
        if self._shown:
            print("\r\033[K", end="", file=sys.stderr, flush=True)
