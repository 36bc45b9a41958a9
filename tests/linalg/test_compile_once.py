"""Compiled code on disk: of callers that need the same code one compiles it."""

import threading

import pytest

from netkf.linalg import compile_once
from netkf.linalg.compile_once import SharedCache


class Disk:
    """Stands for numba's cache: what is kept, by signature, with an index as numba keeps it."""

    def __init__(self, folder):
        self.cache_path, self.kept, self.between = str(folder), {}, lambda: None

    def load_overload(self, sig, target_context):
        return self.kept.get(sig)

    def save_overload(self, sig, data):
        read = dict(self.kept)
        self.between()
        self.kept = {**read, sig: data}


def make(disk, sig, compiled):
    """What numba does at the first call for a signature."""
    cache = SharedCache(disk, "function")
    try:
        if cache.load_overload(sig, None) is None:
            compiled(sig)
            cache.save_overload(sig, f"code for {sig}")
    finally:
        cache.release()


def start(*arguments):
    thread = threading.Thread(target=make, args=arguments, daemon=True)
    thread.start()
    return thread


def test_the_second_waits_for_the_first_and_uses_its_code(tmp_path):
    disk, done = Disk(tmp_path / "new"), []
    began, go_on = threading.Event(), threading.Event()

    def slowly(sig):
        done.append(sig)
        began.set()
        assert go_on.wait(10.0)

    first = start(disk, "float64", slowly)
    assert began.wait(10.0)
    second = start(disk, "float64", done.append)
    # Another signature has a lock of its own.
    make(disk, "int64", done.append)
    second.join(0.05)
    assert second.is_alive()
    go_on.set()
    for thread in (first, second):
        thread.join(10.0)
    assert done == ["float64", "int64"]


def test_who_was_stopped_while_it_compiled_is_not_waited_for(tmp_path, monkeypatch):
    monkeypatch.setattr(compile_once, "MAX_WAIT", 0.1)
    disk, done = Disk(tmp_path), []
    began, go_on = threading.Event(), threading.Event()

    def stopped(sig):
        began.set()
        assert go_on.wait(10.0)

    first = start(disk, "float64", stopped)
    assert began.wait(10.0)
    make(disk, "float64", done.append)
    assert done == ["float64"]
    go_on.set()
    first.join(10.0)


def test_no_entry_of_the_index_is_lost(tmp_path):
    disk = Disk(tmp_path)
    inside, go_on = threading.Event(), threading.Event()

    def wait_once():
        disk.between = lambda: None
        inside.set()
        go_on.wait(10.0)

    disk.between = wait_once
    first = start(disk, "float64", lambda sig: None)
    assert inside.wait(10.0)
    second = start(disk, "int64", lambda sig: None)
    second.join(0.05)
    go_on.set()
    for thread in (first, second):
        thread.join(10.0)
    assert disk.kept == {"float64": "code for float64", "int64": "code for int64"}


def test_an_error_in_the_compiler_leaves_no_lock(tmp_path):
    disk, done = Disk(tmp_path), []

    def fails(sig):
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        make(disk, "float64", fails)
    make(disk, "float64", done.append)
    assert done == ["float64"]


def test_a_folder_that_cannot_be_written_needs_no_lock(tmp_path):
    (tmp_path / "file").touch()
    done = []
    make(Disk(tmp_path / "file"), "float64", done.append)
    assert done == ["float64"]
