"""The start of worker processes: early, and without the threads, memory and script of this one.

The module does not import numpy, so that a command can start the server of workers before it loads
numerical libraries itself.
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
    *("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS"),
    "VECLIB_MAXIMUM_THREADS",
)
"""Environment variables that limit the threads of numerical libraries."""
PRELOADED = ["netkf.ensembles.statistics"]
"""Modules that the server imports, so that the workers forked from it need not."""


def process_context() -> Any:
    """Return a multiprocessing context whose processes do not inherit this one's threads and
    memory: forkserver, which starts workers quickly, if the system has it, else spawn.
    """
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    forkserver = multiprocessing.get_context("forkserver")
    forkserver.set_forkserver_preload(PRELOADED)
    return forkserver


def start_server() -> None:
    """Start the server that workers are forked from, unless it runs or the system has none. It
    imports PRELOADED while this process goes on.

    Ctrl-C and SIGTERM reach all processes of a terminal or a batch job. The server and the workers
    block them: this process alone handles them, and kills the workers.
    """
    if process_context().get_start_method() != "forkserver":
        return
    from multiprocessing import forkserver, resource_tracker

    # Started first, because the start of the resource tracker unblocks the signals again.
    resource_tracker.ensure_running()
    with limit_blas_threads(), block_signals():
        forkserver.ensure_running()


def kill_server() -> None:
    """Kill the server that workers are forked from, if this process has started it.

    It would end by itself, but not before it has imported PRELOADED.
    """
    module = sys.modules.get("multiprocessing.forkserver")
    pid = getattr(getattr(module, "_forkserver", None), "_forkserver_pid", None)
    if pid is not None:
        with suppress(OSError):
            os.kill(pid, signal.SIGKILL)


@contextmanager
def block_signals() -> Iterator[None]:
    """Block Ctrl-C and SIGTERM within the block. Processes that are started in it inherit the mask
    and never receive them; signals to this process are delivered after the block.
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
def limit_blas_threads() -> Iterator[None]:
    """Limit the numerical libraries of processes that are started within the ``with`` block to one
    thread each, by environment variables that they read when they are loaded: there is one worker
    process for each core.
    """
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
def hide_main_module(hide: bool) -> Iterator[None]:
    """Keep processes that are started within the block from importing the user's script, which
    would run it again; do nothing unless ``hide``.
    """
    main = sys.modules["__main__"]
    # multiprocessing finds the script by these attributes.
    names = ("__file__", "__spec__") if hide else ()
    attributes = {name: main.__dict__[name] for name in names if name in main.__dict__}
    for name in attributes:
        setattr(main, name, None)
    try:
        yield
    finally:
        for name, value in attributes.items():
            setattr(main, name, value)
