"""How the process of a command ends: closed streams, signals, text from files."""

import gc
import os
import pty
import re
import resource
import select
import shlex
import signal
import subprocess
import sys
import time

import pytest

from netkf.cli import process
from netkf.cli.main import main
from netkf.core.printable import one_line, printable
from tests.conftest import SCENARIOS, scenario_files, with_slow

RING = str(SCENARIOS / "poisson_ring.toml")
QUICK = shlex.quote(str(SCENARIOS / "ulb_library.toml"))
"""Its theory is known at once."""
NETKF = f"{shlex.quote(sys.executable)} -m netkf"


@pytest.mark.one_in(3)
@pytest.mark.parametrize(
    ("line", "status"),
    [
        (f"{NETKF} theory {QUICK} | head -c 0; exit ${{PIPESTATUS[0]}}", 0),
        (f"{NETKF} theory {QUICK} >&-", 0),
        (f"{NETKF} theory {QUICK} 2>&- >/dev/null", 0),
        (f"{NETKF} theory {QUICK} >&- 2>&- <&-", 0),
        (f"{NETKF} theory nowhere.toml 2>&-", 2),
        (f"{NETKF} theory nowhere.toml 2> >(exec 0<&-)", 2),
        (f"{NETKF} --help | head -c 0; exit ${{PIPESTATUS[0]}}", 0),
    ],
)
def test_closed_streams_stop_nothing(line, status):
    done = subprocess.run(["bash", "-c", line], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (status, "")


LONG = """
import argparse, sys
from netkf.cli import main
def run(options):
    print("x" * 1_000_000)
    print("more", flush=True)
    return 1
class Parser:
    def parse_args(self, arguments):
        return argparse.Namespace(run=run)
main.make_parser = Parser
main.main()
"""


def test_an_answer_of_no_stays_one_where_nobody_reads_it():
    line = '"$0" -c "$1" | head -c 0; exit ${PIPESTATUS[0]}'
    words = ["bash", "-c", line, sys.executable, LONG]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (1, "")


def test_a_run_without_streams_is_complete(tmp_path):
    """The first files that are opened would get the numbers of the closed streams."""
    out = tmp_path / "out"
    line = f"{NETKF} run {shlex.quote(RING)} --set horizon=1.0 --no-plot --out {out} >&- 2>&- <&-"
    assert subprocess.run(["bash", "-c", line], check=False).returncode == 0
    assert '"complete"' in (out / "manifest.json").read_text()


class Dropped:
    """Python drops an interrupt that comes while this is finalized."""

    def __del__(self):
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.01)


def test_an_interrupt_that_python_drops_is_raised_again():
    with process.Interruption() as interruption:
        interruption.arm()
        Dropped()
        with pytest.raises(KeyboardInterrupt):
            time.sleep(5.0)
        interruption.disarm()
    assert interruption.received


def test_a_signal_before_the_command_counts_and_later_ones_do_not():
    before = signal.getsignal(signal.SIGTERM)
    with process.Interruption() as interruption:
        os.kill(os.getpid(), signal.SIGTERM)
        with pytest.raises(KeyboardInterrupt):
            interruption.arm()
        os.kill(os.getpid(), signal.SIGTERM)
        os.kill(os.getpid(), signal.SIGINT)
    assert signal.getsignal(signal.SIGTERM) is before


def test_what_fails_because_of_an_interrupt_is_an_interrupt(monkeypatch, capsys):
    """Libraries turn an interrupt in the middle of an import into errors of their own."""

    def fail(*_):
        try:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(1.0)
        except KeyboardInterrupt:
            raise ImportError("half") from None

    monkeypatch.setattr("netkf.theory.promises.compute_promises", fail)
    assert main(["theory", RING]) == 130
    assert capsys.readouterr().err == "netkf: interrupted\n"


STUCK = """
import sys, threading
from netkf.cli import process
process.END_SECONDS = 0.2
def command(interruption):
    interruption.arm()
    while True:
        try:
            print("ready", flush=True)
            threading.Event().wait()
        except KeyboardInterrupt:
            pass
process.run_as_process(command)
"""


def test_a_command_that_does_not_end_is_ended():
    stuck = subprocess.Popen(
        [sys.executable, "-c", STUCK], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert stuck.stdout.readline() == "ready\n"
    stuck.send_signal(signal.SIGTERM)
    _, printed = stuck.communicate(timeout=10)
    assert (stuck.returncode, printed.count("\n")) == (130, 1)


def test_signals_are_handled_before_anything_large_is_imported():
    """-S: what is installed beside netkf may import it at the start of Python."""
    large = ("typing", "re", "argparse", "dataclasses", "inspect", "logging", "numpy")
    code = f"import sys, netkf.cli.main; print([name for name in {large} if name in sys.modules])"
    done = subprocess.run(
        [sys.executable, "-S", "-c", code],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "PYTHONPATH": str(SCENARIOS.parent)},
    )
    assert done.stdout == "[]\n"


SERVER = """
import sys
from netkf.cli.process import end_process
from netkf.ensembles import process_start
process_start.PRELOADED = ["slow_to_import"]
process_start.start_server()
end_process(3)
"""


def test_nothing_waits_for_the_process_that_workers_are_forked_from(tmp_path):
    """It has the standard streams of the command; who reads them waits for their end."""
    (tmp_path / "slow_to_import.py").write_text("import time; time.sleep(30)")
    path = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, "-c", SERVER],
        capture_output=True,
        check=False,
        timeout=15,
        env={**os.environ, "PYTHONPATH": path},
    )
    assert (done.returncode, done.stderr) == (3, b"")


def test_an_error_that_is_not_about_writing_is_not_called_one(monkeypatch, capsys):
    def refuse(*_):
        raise ConnectionRefusedError(111, "Connection refused")

    monkeypatch.setattr("netkf.theory.promises.compute_promises", refuse)
    assert main(["theory", RING]) == 2
    assert capsys.readouterr().err == "netkf: Connection refused\n"


HOSTILE = "a\x1b[31mb\x9bc\u202ed\u2066e\x00f\x7fg\u2028h\ud800i"


def test_no_control_character_is_printed(capsys, tmp_path, monkeypatch):
    escaped = "a\\x1b[31mb\\x9bc\\u202ed\\u2066e\\x00f\\x7fg\\u2028h\\ud800i"
    assert printable(HOSTILE) == escaped
    assert printable("é\tü\nx") == "é\tü\nx"
    assert one_line("é\tü\r\nx") == "é\\tü\\r\\nx"
    text = (SCENARIOS / "poisson_ring.toml").read_text()
    (tmp_path / "x.toml").write_text(
        text.replace('name    = "poisson-ring"', 'name = "a\\u001b[31m\\u202e\\nnetkf: kept"')
    )
    main(["theory", str(tmp_path / "x.toml")])
    monkeypatch.chdir(tmp_path)
    main(["theory", f"{HOSTILE[:-2]}\n.toml"])
    printed = capsys.readouterr()
    assert (printed.out + printed.err).replace("\n", "").isprintable()
    assert len(printed.err.splitlines()) <= 2


def test_what_a_stream_cannot_encode_is_escaped(tmp_path):
    text = (SCENARIOS / "poisson_ring.toml").read_text()
    (tmp_path / "x.toml").write_text(text.replace('"poisson-ring"', '"\u00e9\u4e2d"'), "utf-8")
    done = subprocess.run(
        [sys.executable, "-m", "netkf", "theory", str(tmp_path / "x.toml")],
        capture_output=True,
        check=False,
        env={**os.environ, "PYTHONIOENCODING": "ascii"},
    )
    assert (done.returncode, done.stderr) == (0, b"")
    assert b"\\xe9\\u4e2d" in done.stdout


def test_names_that_are_not_ascii_may_stand_on_a_machine_that_knows_no_others(tmp_path):
    """There Python has such names with surrogates, which are no text that others can encode."""
    folder = os.fsencode(tmp_path) + "/r\u00e9seau".encode()
    os.mkdir(folder)
    plain = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    netkf = [sys.executable, "-m", "netkf"]
    run = [*netkf, "run", str(RING), "--set", "horizon=1.0", "--no-plot", "--out", folder + b"/out"]
    for words in (run, [*netkf, "compare", folder + b"/out"]):
        done = subprocess.run(words, env=os.environ | plain, capture_output=True, check=False)
        assert done.returncode == 0, done.stderr
    files = set(os.listdir(folder + b"/out"))
    assert {b"events.parquet", b"states.parquet", b"manifest.json"} <= files


PROGRESS = """
import time
from netkf.cli import process, progress
progress.QUIET_SECONDS = 0.2
with process.safe_streams(), progress.ProgressLine() as line:
    update = line.make_count_update("runs")
    update(0, 10)
    time.sleep(0.1)
    update(5, 10)
    print("note", flush=True)
    time.sleep(1.0)
print("end")
"""


def test_a_terminal_shows_a_rate_and_what_is_left_and_a_pipe_nothing():
    here, there = pty.openpty()
    command = [sys.executable, "-c", PROGRESS]
    subprocess.run(command, stdin=there, stdout=there, stderr=there, check=True)
    shown = ""
    while not shown.endswith("end\r\n") and select.select([here], [], [], 10.0)[0]:
        shown += os.read(here, 10_000).decode()  # a terminal hands on part by part
    os.close(here), os.close(there)
    clear = re.escape("\r\x1b[K")
    rate = r"5 of 10 runs, [\d.e+]+ per second, about 0 s left"
    # A line of its own for the note; then the time, until the line is removed.
    begin, later = f"{clear}0 of 10 runs{clear}{rate}{clear}note\r\n", f"{clear}{rate}; 1 s so far"
    pattern = rf"{begin}({later})*{clear}end\r\n"
    assert re.fullmatch(pattern, shown), shown
    assert "so far" in shown
    piped = subprocess.run(command, capture_output=True, text=True, check=True)
    assert (piped.stdout, piped.stderr) == ("note\nend\n", "")


UNNEEDED = """
import sys, netkf.cli.main
netkf.cli.main.main(sys.argv[2:])
print(*sys.modules, file=open(sys.argv[1], "w"))
"""
GOSSIP = str(SCENARIOS / "gossip_ring.toml")
SHORT = ["run", GOSSIP, "--engine", "simpy", "--set", "horizon=10.0", "--no-plot"]
PICTURES, NUMBERS = ("matplotlib", "networkx"), ("pandas", "simpy", "scipy.stats", "scipy.sparse")


@pytest.mark.parametrize(
    ("words", "unneeded"),
    [
        (
            [*SHORT, "--out", "{out}"],
            (*PICTURES, "pandas", "scipy.linalg", "scipy.sparse", "scipy.special"),
        ),
        (["run", "nowhere.toml"], (*PICTURES, *NUMBERS, "pyarrow", "netkf.theory.common")),
        (["schema"], (*PICTURES, *NUMBERS, "pyarrow")),
    ],
)
def test_commands_import_what_they_need(words, unneeded, tmp_path):
    seen = tmp_path / "modules"
    words = [word.format(out=tmp_path / "out") for word in words]
    plain = os.environ | {"NUMBA_DISABLE_JIT": "1"}  # compiling imports what running does not need
    command = [sys.executable, "-c", UNNEEDED, seen, *words]
    subprocess.run(command, env=plain, capture_output=True, check=False)
    assert not {*unneeded} & {*seen.read_text().split()}


QUICK_IMPORTS = """
import io, sys
sys.meta_path[:0] = {finders}
import scipy.sparse, numpy
from matplotlib.figure import Figure
unused = {{"numpy.testing._private", "numpy.f2py.crackfortran"}}
seen = unused & {{*sys.modules}}, Figure.set.__doc__
numpy.testing.assert_allclose([1.0], [1.0])
with open(sys.argv[1], "wb") as file:
    figure = Figure(figsize=(2, 2), layout="constrained")
    figure.add_subplot().set(xlabel="x", title="numbers")
    figure.savefig(file)
print(seen)
"""


def test_postponed_imports_work_at_their_first_use(tmp_path):
    """The same picture, and the same functions, as without the finder."""
    printed, pictures = [], []
    for finders in ("[]", "[__import__('netkf.cli.process').cli.process.QuickImports()]"):
        file = tmp_path / f"{len(printed)}.png"
        command = [sys.executable, "-c", QUICK_IMPORTS.format(finders=finders), file]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        printed.append(done.stdout)
        pictures.append(file.read_bytes())
    assert "Properties" in printed[0]
    assert printed[1] == "(set(), None)\n"
    assert pictures[0] == pictures[1]


def test_garbage_is_collected_again_after_a_while(monkeypatch):
    monkeypatch.setattr(process, "KEEPING_SECONDS", 0.01)
    process.collect_garbage_later()
    deadline = time.monotonic() + 10.0
    while not gc.isenabled() and time.monotonic() < deadline:
        time.sleep(0.01)
    assert gc.isenabled()


PASSES = """
import sys, netkf.cli.main
from numba.core import event
with event.install_recorder("numba:run_pass") as seen:
    netkf.cli.main.main(sys.argv[2:])
print(len(seen.buffer), file=open(sys.argv[1], "w"))
"""
ALL = [file.stem for file in scenario_files()]


@pytest.mark.parametrize("name", with_slow(ALL, {*ALL} - {"threshold"}))
def test_a_second_run_compiles_nothing(name, tmp_path):
    """The compiler's passes are counted: verbs are compiled without a dispatcher's event."""
    words = ["run", str(SCENARIOS / f"{name}.toml"), "--no-plot", "--out"]
    for k in range(2):
        command = [sys.executable, "-c", PASSES, tmp_path / "seen", *words, tmp_path / f"{k}"]
        subprocess.run(command, capture_output=True, check=True)
    assert (tmp_path / "seen").read_text() == "0\n"


def cpu_seconds(*words):
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, *words], capture_output=True, check=False)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return sum(getattr(after, k) - getattr(before, k) for k in ("ru_utime", "ru_stime"))


@pytest.mark.slow
def test_a_short_run_costs_little_more_than_what_it_imports(tmp_path):
    """Ratios of CPU, not of time: the machine may be busy. The first run compiles or loads."""
    run = ["-m", "netkf", "run", RING, "--no-plot", "--out"]
    cpu_seconds(*run, tmp_path / "first")
    unit = min(cpu_seconds("-c", "import numpy, pandas") for _ in range(2))
    assert min(cpu_seconds(*run, tmp_path / f"{k}") for k in range(2)) < 2.6 * unit
    assert cpu_seconds("-m", "netkf", "run", "nowhere.toml") < 1.0 * unit


STUBBORN = """
import hashlib, sys
from netkf.cli import process
from netkf.core import interrupts

def command(interruption):
    interruption.arm()
    with interrupts.writing_at_last(lambda: print("written", flush=True)):
        begun = False
        while True:
            try:
                if not begun:
                    begun = True
                    print("begun", flush=True)
                hashlib.pbkdf2_hmac("sha256", b"", b"", 10**9)  # minutes of compiled code
            except KeyboardInterrupt:  # the signal came before
                pass

process.END_SECONDS = 0.2
process.run_as_process(command)
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_what_compiled_code_keeps_from_python(number):
    """Handlers in Python wait until it returns: a thread writes results and ends the process."""
    line = [sys.executable, "-c", STUBBORN]
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(line, text=True, **streams) as process:
        assert process.stdout.readline() == "begun\n"
        process.send_signal(number)
        out, error = process.communicate(timeout=20)
    assert (process.returncode, out) == (130, "written\n")
    assert error == "netkf: interrupted; what was finished is kept\n"
