"""The table of commands and their options."""

from __future__ import annotations

import argparse
import os
import re
from collections.abc import Mapping
from contextlib import nullcontext
from functools import partial
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple, NoReturn

from netkf.cli.options import MARGIN, load_scenario
from netkf.cli.progress import ProgressLine
from netkf.core.errors import ScenarioError, quote
from netkf.core.printable import MAX_NAME, MAX_RUNS, shorten
from netkf.figures.names import FIGURE_NAMES, FIT_FIGURES, FORMATS

ENGINES = ("auto", "simpy", "processes", "compiled")
ONE_THREAD = ("check", "work", "merge")
"""Commands whose runs have the same last digits here and in workers, whose LAPACK has one thread.
"""
SHARED = {
    "short": "compare consistency import innovations new report schema theory",
    "planned": "plan work merge",
    "studies": "sweep size compare_filters",
}
"""Modules of several commands, which have ``run_NAME``."""
BESIDE = (("tasks", "plan"), ("slurm", "plan"), ("time", "slurm"), ("most", "until"))
"""Options that mean nothing without another one, of commands that have both."""
MAX_WORKERS = max(64, 8 * (os.cpu_count() or 1))  # more processes only fill the memory


class Option(NamedTuple):
    """An argument of a command: its name, and the arguments of ``add_argument``."""

    name: str
    settings: dict[str, Any]


class Command(NamedTuple):
    """A command: its name, its help, and its options; those in a tuple exclude each other.

    The module of this package with its name has ``_run``, which runs it with the parsed options and
    returns the exit status, or that of SHARED has ``run_NAME``. Unless it ``takes_scenario``, there
    are no scenario file, ``--set`` and ``--trust``. ``unused`` are values for keys of the scenario
    that the command does not use, and that may be wrong in the file.
    """

    name: str
    help: str
    options: tuple[Option | tuple[Option, ...], ...]
    takes_scenario: bool = True
    unused: Mapping[str, Any] = MappingProxyType({})

    def add_to(self, commands: Any) -> None:
        """Add the parser of the command to ``commands``; namespaces have its function ``run``."""
        parser = commands.add_parser(self.name, help=self.help, description=self.help)
        for entry in (*(SCENARIO if self.takes_scenario else ()), *self.options):
            if isinstance(entry, Option):
                parser.add_argument(entry.name, **entry.settings)
                continue
            group = parser.add_mutually_exclusive_group()
            for name, settings in entry:
                group.add_argument(name, **settings)
        # ``executor`` is the pool of a plan, on which commands run studies.
        parser.set_defaults(run=self.run, executor=None)

    def run(self, options: argparse.Namespace) -> int:
        """Run the command with the parsed options; return the exit status."""
        for name, other in BESIDE:
            if getattr(options, name, None) and not getattr(options, other, True):
                remedy = f"add --{other}, or leave it out"
                raise ScenarioError(f"--{name}", f"means nothing without --{other}", None, remedy)
        if self.name in ONE_THREAD:
            from netkf.ensembles.process_start import limit_blas_threads

            with limit_blas_threads():
                return self._run(options)
        return self._run(options)

    def _run(self, options: argparse.Namespace) -> int:
        # Only now, so that ``netkf --help`` and usage errors do not wait for numpy and numba; and
        # before the imports of the command, for which what is refused at once need not wait.
        for path in (*getattr(options, "directories", ()), getattr(options, "directory", ".")):
            if not os.path.exists(path):
                rule, remedy = "cannot be opened: it does not exist", "check the path"
                raise ScenarioError(shorten(path), rule, None, remedy)
        if self.takes_scenario and self.name != "run":  # which has other things to begin first
            with ProgressLine():
                load_scenario(options, self.unused)
        name = self.name.replace("-", "_")
        file = next((module for module, names in SHARED.items() if name in names.split()), name)
        module: Any = import_module(f"netkf.cli.{file}")
        run = getattr(module, "_run" if file == name else f"run_{name}")
        if getattr(options, "plan", None) is not None:
            from netkf.cli.planned import plan_study

            return plan_study(run, options)
        status: int
        with nullcontext() if hasattr(module, "ProgressLine") else ProgressLine():
            status = run(options)
        return status


def _option(name: str, text: str, **settings: Any) -> Option:
    if isinstance(settings.get("default"), (int, float)):
        text = f"{text} (default: {settings['default']})"
    return Option(name, {"help": text, **settings})


def _refuse(rule: str, text: str) -> NoReturn:
    raise argparse.ArgumentTypeError(f"{rule}, got {quote(text)}")


def _integer(text: str, least: int, largest: int) -> int:
    # Twenty digits suffice to compare: Python refuses to convert texts of thousands.
    if not text.isdecimal() or not least <= int(text[:20]) <= largest:
        _refuse(f"must be an integer of at least {least} and at most {largest:,}", text)
    return int(text)


def _digits(text: str, most: int, rule: str) -> int:
    if not text.isdecimal() or len(text) > most:
        _refuse(rule, text)
    return int(text)


parse_count = partial(_integer, least=1, largest=MAX_RUNS)
parse_workers = partial(_integer, least=1, largest=MAX_WORKERS)
parse_seed = partial(_digits, most=30, rule="must be a non-negative integer of at most 30 digits")
parse_replica = partial(_digits, most=12, rule="must be an integer of at least 0")


def parse_replica_or_rank(text: str) -> int | str:
    """Return the value of ``--replica`` of a page; raises ArgumentTypeError."""
    if text in ("worst", "median"):
        return text
    if not text.isdecimal():
        _refuse("must be an integer of at least 0, worst or median", text)
    return parse_replica(text)


def parse_node(text: str) -> str:
    """Return the id or the name of a node; raises ArgumentTypeError for a text that is neither."""
    if not text.strip() or len(text) > MAX_NAME:
        _refuse(f"must be the id or the name of a node, of at most {MAX_NAME} characters", text)
    return text.strip()


def parse_part(text: str) -> tuple[int, int]:
    """Return the value i/n of ``--part``; raises ArgumentTypeError."""
    index, _, count = text.partition("/")
    if not (index.isdecimal() and count.isdecimal() and len(text) < 20) or not (
        int(index) <= int(count) > 0
    ):
        _refuse("must be i/n, part i of n, such as 3/64", text)
    return int(index), int(count)


SOME, SIXTY = "(?=.*[1-9])", r"([0-5]?\d)"
DURATIONS = {
    r"(?=\d)(?:(\d{1,6})h)?(?:(\d{1,6})m)?(?:(\d{1,9})s)?": (3600.0, 60.0, 1.0),
    # SLURM's own, but for 0, which is no limit there.
    rf"{SOME}(\d{{1,5}})-([01]?\d|2[0-3])(?::{SIXTY})?(?::{SIXTY})?": (86400.0, 3600.0, 60.0, 1.0),
    rf"{SOME}(\d{{1,6}}):{SIXTY}:{SIXTY}": (3600.0, 60.0, 1.0),
    rf"{SOME}(\d{{1,7}})(?::{SIXTY})?": (60.0, 1.0),
}
"""Forms of a duration, and the seconds of the unit of each group."""
DURATION_RULE = (
    "must be hours, minutes and seconds, such as 50m or 1h30m, or a time limit of SLURM, not 0: "
    "MINUTES, MINUTES:SECONDS, HOURS:MINUTES:SECONDS, DAYS-HOURS, DAYS-HOURS:MINUTES or "
    "DAYS-HOURS:MINUTES:SECONDS"
)


def parse_duration(text: str) -> float:
    """Return the seconds of a duration in one of the forms DURATIONS; raises ArgumentTypeError."""
    for form, units in DURATIONS.items():
        if found := re.fullmatch(form, text.strip(), re.ASCII):
            groups = found.groups(default="0")
            return sum(unit * float(group) for unit, group in zip(units, groups, strict=True))
    raise argparse.ArgumentTypeError(f"{DURATION_RULE}; got {quote(text)}")


def parse_time_limit(text: str) -> float:
    """Return the seconds of a job, more than MARGIN minutes; raises ArgumentTypeError."""
    seconds = parse_duration(text)
    if round(seconds / 60) <= MARGIN:
        rule = f"must be longer than the {MARGIN} minutes in which a job starts and ends"
        raise argparse.ArgumentTypeError(f"{rule}; got {quote(text)}")
    return seconds


def parse_columns(text: str) -> dict[str, str]:
    """Return NAME=COLUMN,... as a dictionary; raises argparse.ArgumentTypeError."""
    pairs = [pair.partition("=") for pair in text.split(",")]
    if not all(name.strip() and column.strip() for name, _, column in pairs):
        raise argparse.ArgumentTypeError(f"must be NAME=COLUMN,...; got {text!r}")
    return {name.strip(): column.strip() for name, _, column in pairs}


def _trust(folder: str) -> Option:
    text = f"import classes that the scenario names, also from {folder} or the current one"
    return _flag("--trust", text)


_flag = partial(_option, action="store_true")
_directory = partial(_option, "directory", type=Path, metavar="DIR")
_directories = partial(_option, "directories", type=Path, nargs="+", metavar="DIR")
_runs = partial(_option, "--runs", type=parse_count)
_out = partial(_option, "--out", type=Path)
_vary = partial(_option, "--vary", action="append", required=True)
_replica = partial(_option, "--replica", type=parse_replica)


def _confidence(default: float, what: str) -> Option:
    return _option("--confidence", f"probability {what}", type=float, default=default)


CHANGES = "override a key of the scenario; VALUE is written as in TOML"
UNTIL = "begin with --runs and add runs until every row is decided"
FOLDER = "folder of the files (default: the current one)"
FIGURES = f"figures to draw: {', '.join((*FIGURE_NAMES, *FIT_FIGURES))} (default: all)"
SCENARIO = (
    _option("scenario", "scenario file (TOML)", type=Path),
    _option("--set", CHANGES, action="append", default=[], metavar="KEY.PATH=VALUE"),
    _trust("its folder"),
)
SEED = _option("--seed", "root seed (default: the scenario's)", type=parse_seed)
ENGINE = _option(
    "--engine",
    "auto takes the compiled engine if it can run the scenario, else SimPy",
    default="auto",
    choices=ENGINES,
)
POOL = (
    _option("--workers", "number of processes (default: one per core)", type=parse_workers),
    _option("--scheduler", "Dask scheduler, tcp://HOST:PORT", metavar="ADDRESS"),
)
TRACE = _option(
    "--trace",
    "runs that keep tables of events and states (default: full for one run, else first)",
    choices=["full", "first", "none"],
)
ARRAY = (
    _option("--tasks", "number of jobs of the plan (default: 64)", type=parse_count),
    _flag("--slurm", "print a submission script for an array of SLURM jobs on the plan"),
    _option(
        "--time",
        "time limit of each job in that script, such as 1h or 01:00:00 (default: 1h)",
        type=parse_time_limit,
        metavar="DURATION",
    ),
)
PLAN = (
    _option(
        "--plan",
        "write a plan that netkf work and netkf merge carry out; nothing runs",
        type=Path,
        metavar="DIR",
    ),
    *ARRAY,
)
PLANNED = _directory("directory of a plan")
JSON = _flag("--json", "print one JSON document only")
ALL = _flag("--all", "show all rows with all that they say")
NO_PLOT = _flag("--no-plot", "do not draw a picture")
STUDY = SEED, ENGINE, POOL, JSON, *PLAN

COMMANDS = (
    Command(
        "run",
        "simulate a scenario and keep the results",
        (
            _runs("number of independent runs (default: 1)"),
            _replica("run this replica of an ensemble (default: 0)"),
            SEED,
            ENGINE,
            _out("directory of the run (default: runs/NAME-k)"),
            POOL,
            TRACE,
            _flag("--resume", "continue the runs of --out that were stopped"),
            NO_PLOT,
        ),
    ),
    Command(
        "plan",
        "write the directory of an ensemble that many jobs of a cluster simulate; nothing runs",
        (
            _runs("number of independent runs", required=True),
            SEED,
            ENGINE,
            _out("directory of the plan (default: runs/NAME-k)"),
            TRACE,
            *ARRAY,
        ),
    ),
    Command(
        "work",
        "simulate runs of a plan that have no result yet",
        (
            PLANNED,
            _option(
                "--part",
                "part i of n of the runs (default: that of this job of an array of SLURM, PBS, "
                "Grid Engine or LSF, else all)",
                type=parse_part,
                metavar="I/N",
            ),
            _option(
                "--for",
                "begin no run after so long, 50m or 00:50:00; the status is 1 if some are left",
                type=parse_duration,
                dest="seconds",
                metavar="DURATION",
            ),
            (_option("--workers", "number of processes (default: 1)", type=parse_workers), POOL[1]),
            _trust("DIR"),
        ),
        takes_scenario=False,
    ),
    Command(
        "merge",
        "turn the results of a plan into those of one command; the status is 1 if some miss",
        (
            PLANNED,
            _flag("--mixed", "merge results of machines of different kinds, too"),
            NO_PLOT,
            _trust("DIR"),
        ),
        takes_scenario=False,
    ),
    Command(
        "check",
        "compare simulations with theory, one row per promise",
        (
            _runs("number of runs (default: 500, fewer of more than 100 nodes)"),
            _option("--until", UNTIL, choices=["decided"]),
            _option("--most", "runs after which --until ends (default: 20000)", type=parse_count),
            SEED,
            _confidence(0.99, "with which all intervals hold together"),
            _out("directory for the verdict, its table and picture"),
            _flag("--resume", "add runs to the verdict in --out, up to --runs"),
            POOL,
            ALL,
            JSON,
            *PLAN,
            NO_PLOT,
        ),
        # Promises are checked at other times, so that probes need not fit the horizon.
        unused={"probe": [0.0]},
    ),
    Command("theory", "check assumptions and compute bounds and limits; no simulation", (JSON,)),
    Command(
        "sweep",
        "simulate every point of a grid of parameters, one row per point",
        (
            _vary(
                "values of a key, or START:STOP:COUNT; repeat it for a grid over several keys; all "
                "on one truth, or the status says another",
                metavar="KEY.PATH=V1,V2,...",
            ),
            _runs("runs at each point", default=1),
            _out("directory (default: runs/NAME-sweep-k)"),
            NO_PLOT,
            *STUDY,
        ),
    ),
    Command(
        "size",
        "find the smallest (or largest) value of a key that meets a target",
        (
            _vary("the key to search and its range", metavar="KEY.PATH=LOW:HIGH"),
            _option(
                "--target",
                "quantities: worst_rms, mean_rms, worst_trace, mean_trace, within_central, "
                "worst_instant, quantile_99, time_above, mean_age, worst_age, transmissions, "
                "bytes, joules, and time_connected>=LIMIT",
                required=True,
                metavar="QUANTITY<=LIMIT",
            ),
            _option(
                "--by",
                "decide by theory or by simulation alone (default: the exact quantity or a bound, "
                "and simulation where the bound does not reach the target)",
                choices=["theory", "simulation"],
            ),
            _runs("at most this many runs per value (default: 1,000; small networks 10,000)"),
            _confidence(0.95, "that all decisions are right"),
            *STUDY,
        ),
    ),
    Command(
        "consistency",
        "test if P describes the errors: NEES and NIS against their expected values",
        (
            _runs("number of runs", default=50),
            _confidence(0.99, "that no consistent filter is called broken"),
            SEED,
            ENGINE,
            POOL,
            ALL,
            JSON,
        ),
    ),
    Command(
        "innovations",
        "test if a run fits its model without knowing the truth: NIS, bias and whiteness by node",
        (
            _replica("run this replica of an ensemble (default: 0)"),
            _confidence(0.99, "that no node is called broken if the model is right"),
            SEED,
            ENGINE,
            ALL,
            JSON,
        ),
    ),
    Command(
        "compare",
        "compare finished runs side by side and mark significant differences",
        (_directories("run directory"), _confidence(0.95, "that all marks are right"), JSON),
        takes_scenario=False,
    ),
    Command(
        "compare-filters",
        "compare filters on one truth and one network, with intervals of their differences",
        (
            _option(
                "--filters",
                'kinds of filters, or tables such as {kind="hcmci",steps=3}; the first is compared '
                "with each of the others",
                required=True,
                metavar="F1,F2,...",
            ),
            _runs("runs of each filter", default=100),
            _confidence(0.95, "that all marks are right"),
            _out("directory for tables and a picture"),
            NO_PLOT,
            *STUDY,
        ),
    ),
    Command(
        "plot",
        "draw figures of finished runs, ensembles and sweeps",
        (
            _directories("run directory"),
            _option("--figure", FIGURES, action="append", default=[], metavar="NAME[,NAME]"),
            _out("file or directory of the figures (default: DIR/figures)"),
            _option("--format", "format of the files (default: png)", choices=FORMATS),
            _trust("DIR"),
        ),
        takes_scenario=False,
    ),
    Command(
        "report",
        "write a page with the network in motion, figures and verdicts of a run",
        (
            _directories(
                "directory of a run, an ensemble, a sweep, a verdict or compared filters; a second "
                "one to compare with, or the verdict of the first"
            ),
            _out("file of the page (default: DIR/report.html)"),
            _option(
                "--replica",
                "recorded run to show: its number, worst or median (default: the first)",
                type=parse_replica_or_rank,
                metavar="K",
            ),
            _trust("the directory"),
        ),
        takes_scenario=False,
    ),
    Command(
        "why",
        "explain the estimate of a node at a time: the messages that it received, and those "
        "missing",
        (
            _directory("run directory"),
            _option("--node", "id or name (default: the worst node)", type=parse_node, metavar="I"),
            _option("--at", "seconds (default: its worst sample)", type=float, metavar="T"),
            _replica("run of an ensemble with all traces (default: 0)"),
            _option(
                "--below",
                "trace of P that the smallest set of messages has to reach (default: 5 percent "
                "above that without losses)",
                type=float,
                metavar="X",
            ),
            _option("--most", "messages of the set", type=int, default=3, choices=(1, 2, 3)),
            _option(
                "--replays",
                "largest number of replays that search the set (default: 10 to 1000, by the events "
                "of the run)",
                type=parse_count,
            ),
            _trust("DIR"),
            _out("directory for the answer and its table"),
            JSON,
        ),
        takes_scenario=False,
    ),
    Command(
        "schema",
        "print the JSON Schema of scenario files, for editors",
        (_flag("--markdown", "print a reference of all keys instead"),),
        takes_scenario=False,
    ),
    Command(
        "import",
        "write a log, or a data set that people know, as a scenario with its tables",
        (
            _option("log", "file or folder", type=Path, metavar="LOG"),
            _option(
                "--kind",
                "csv: a table of packets, or a folder of them; ulb: folder with readings.csv and "
                "heard.csv; mercator: raw CSV of openwsn-berkeley/mercator; mrclam: folder of a "
                "UTIAS MR.CLAM set, with Robot1_Odometry.dat and the others",
                required=True,
                choices=["csv", "ulb", "mercator", "mrclam"],
            ),
            _option(
                "--like",
                "scenario whose plant, sensors and filter to use (default: one made of the log, or "
                "LOG/scenario.toml)",
                type=Path,
                metavar="SCENARIO",
            ),
            _option(
                "--columns",
                "what the tables of kind csv call their columns: t_ms=stamp,sender=origin,... "
                "(default: by their names)",
                type=parse_columns,
                default={},
                metavar="NAME=COLUMN,...",
            ),
            _option(
                "--unreported",
                "what transmissions are that nobody reported (default: unknown)",
                choices=["unknown", "lost"],
                default="unknown",
            ),
            _option(
                "--hole",
                "packets that a receiver would usually have heard, after which its silence is a "
                "hole in its log",
                type=float,
                default=30.0,
                metavar="PACKETS",
            ),
            _option("--out", "folder of the scenario", type=Path, required=True, metavar="DIR"),
            _trust("the folder of --like"),
        ),
        takes_scenario=False,
    ),
    Command(
        "fit",
        "fit laws of losses to a recorded network, and look for its replay among their runs; "
        "or the noise of plant and sensors",
        (
            _directory("folder that import wrote, or a scenario"),
            _flag("--noise", "fit the noise of plant and sensors to the readings, Q and R"),
            SCENARIO[1],
            _runs(
                "runs of each law, with parameters drawn from their posterior (default: 200, or "
                "fewer if these take minutes)"
            ),
            _flag("--no-runs", "estimates and tests only"),
            _confidence(0.95, "that all intervals of links hold, and that no test is wrong"),
            POOL[0],
            _trust("DIR"),
            JSON,
        ),
        takes_scenario=False,
    ),
    Command(
        "export",
        "write a run in another form",
        (
            _directory("run directory"),
            _option(
                "--to",
                "a packet log, or a scenario with recorded outcomes, positions and lives, which "
                "replay to the bit; a netCDF file for xarray, also of an ensemble; the network "
                "with what links carried; events and covariances for ui.perfetto.dev",
                required=True,
                choices=["log", "recorded", "netcdf", "graphml", "perfetto"],
            ),
            _option(
                "--out",
                "new folder (log, recorded), or new file (default: in DIR)",
                type=Path,
                metavar="OUT",
            ),
            _option("--window", "seconds to write (perfetto)", metavar="FROM:TO"),
            _trust("DIR"),
        ),
        takes_scenario=False,
    ),
    Command(
        "new",
        "write a commented scenario and its tests",
        (
            _option("name", "NAME.toml and test_NAME.py are written", metavar="NAME"),
            _option("--folder", FOLDER, type=Path, default=Path()),
        ),
        takes_scenario=False,
    ),
)
