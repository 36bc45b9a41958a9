"""How worker processes start: without this one's threads, memory and script, and early.

Knows no numerics, so that a command can start them before it loads its own.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

ONE_THREAD = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "BLIS_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
)
PRELOADED = ["netkf.ensembles.statistics"]


def context() -> Any:
    """Return a multiprocessing context whose processes do not inherit this one's threads and
    memory: forkserver, which starts quickly, where it exists, else spawn.
    """
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    forkserver = multiprocessing.get_context("forkserver")
    forkserver.set_forkserver_preload(PRELOADED)
    return forkserver


def start_server() -> None:
    """Start the process that workers are forked from, if there is one and it does not run yet. It
    loads what they need while this process goes on.

    It and the workers never see Ctrl-C or SIGTERM, which reach all processes of a terminal or a
    job: this process alone decides what they mean, and kills the workers.
    """
    if context().get_start_method() != "forkserver":
        return
    from multiprocessing import forkserver, resource_tracker

    # Started first, because its start unblocks the signals again.
    resource_tracker.ensure_running()
    with one_blas_thread(), signals_blocked():
        forkserver.ensure_running()


def kill_server() -> None:
    """Kill the process that workers are forked from, if this one has started it.

    It would end by itself, but only once it has imported what workers need.
    """
    module = sys.modules.get("multiprocessing.forkserver")
    number = getattr(getattr(module, "_forkserver", None), "_forkserver_pid", None)
    if number is not None:
        with suppress(OSError):
            os.kill(number, signal.SIGKILL)


@contextmanager
def signals_blocked() -> Iterator[None]:
    """Block Ctrl-C and SIGTERM for processes that are started meanwhile, which inherit this.

    Signals for this process wait until the block is left.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    old_mask = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGTERM))
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, old_mask)


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Set the variables that numerical libraries read when a process loads them."""
    old_values = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    try:
        yield
    finally:
        for name, value in old_values.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@contextmanager
def main_hidden(hide: bool) -> Iterator[None]:
    """Keep new processes from running the user's script once more."""
    main = sys.modules["__main__"]
    attributes = {
        name: main.__dict__[name] for name in ("__file__", "__spec__") if name in main.__dict__
    }
    if not hide:
        attributes = {}
    for name in attributes:
        setattr(main, name, None)
    try:
        yield
    finally:
        for name, value in attributes.items():
            setattr(main, name, value)
