"""Compiled code on disk: what is damaged, foreign or another user's is compiled again, not run."""

import importlib
import json
import os
import pickle
import shutil
import subprocess
import sys
from pathlib import Path

import numba
import pytest

from netkf.linalg import code_files, compiling
from netkf.linalg.compiling import kernel
from tests.conftest import ROOT

AS_ROOT = os.name != "nt" and os.geteuid() == 0


def halved(x):
    """Return x / 2."""
    return 0.5 * x


def doubled(x):
    """Return 2 x."""
    return 2.0 * x


class Planted:
    """Leaves a file where it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder of compiled code of two functions."""
    folder = tmp_path_factory.mktemp("made")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(numba.config, "CACHE_DIR", str(folder))
        assert kernel(halved)(3.0) == 1.5
        assert kernel(doubled)(3.0) == 6.0
    return folder


@pytest.fixture
def cache(made, tmp_path, monkeypatch):
    """A copy of that folder, which kernels now use."""
    shutil.copytree(made, tmp_path / "cache")
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "cache"))
    return tmp_path / "cache"


def call(function):
    """Call a function as a new process would; return its value and the number of compilations."""
    fresh = kernel(function)
    value = fresh(3.0)
    return value, sum(fresh._python_dispatcher._cache_misses.values())


def file_of(cache, function, suffix):
    (found,) = cache.rglob(f"*.{function.__name__}-*.{suffix}")
    return found


def test_code_is_found_again(cache):
    assert call(halved) == (1.5, 0)
    assert {path.suffix for path in cache.rglob("*") if path.is_file()} >= {".nbi", ".nbc"}


SCALED = """from netkf.kernels import kernel
import units
from units import OFFSET, ROW, Gain, shifted


@kernel
def scaled(x):
    return shifted(units.FACTOR * x) + OFFSET + ROW[1] + Gain.HIGH.value
"""
UNITS = """import enum
from netkf.kernels import kernel

FACTOR, OFFSET, ROW = 2.0, 10.0, (0.0, 100.0)


class Gain(enum.IntEnum):
    HIGH = 1000


@kernel
def shifted(x):
    return x
"""


def test_code_follows_what_a_kernel_takes_from_other_modules(tmp_path, monkeypatch):
    """Imported values and kernels, and attributes of modules and enumerations."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "scaled.py").write_text(SCALED)
    changes = ("", ""), ("2.0,", "3.0,"), ("10.0", "20.0"), ("100.0)", "200.0)"), ("1000", "2000")
    found = []
    for old, new in (("", ""), *changes, ("return x", "return x + 4.0")):
        (tmp_path / "units.py").write_text(UNITS.replace(old, new))
        for name in ("scaled", "units"):
            monkeypatch.delitem(sys.modules, name, raising=False)
        importlib.invalidate_caches()
        monkeypatch.setattr(sys, "dont_write_bytecode", True)
        found.append(call(importlib.import_module("scaled").scaled.loops))
    values = 1116.0, 1119.0, 1126.0, 1216.0, 2116.0, 1120.0
    assert found == [(1116.0, 1), (1116.0, 0), *((value, 1) for value in values[1:])]


def test_code_is_that_of_the_imported_function_not_of_its_file(tmp_path, monkeypatch):
    """A file that is edited between import and first call left old code for the next process."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.syspath_prepend(tmp_path)
    text = "from netkf.kernels import kernel\n\n\n@kernel\ndef tripled(x):\n    return 3.0 * x\n"
    (tmp_path / "tripled.py").write_text(text)
    monkeypatch.delitem(sys.modules, "tripled", raising=False)
    old = importlib.import_module("tripled").tripled.loops
    (tmp_path / "tripled.py").write_text(text.replace("3.0 *", "4.0 *"))
    assert call(old) == (9.0, 1)
    monkeypatch.delitem(sys.modules, "tripled")
    assert call(importlib.import_module("tripled").tripled.loops) == (12.0, 1)


def truncate(path, planted):
    path.write_bytes(path.read_bytes()[:-7])


def half(path, planted):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def empty(path, planted):
    path.write_bytes(b"")


def lengthen(path, planted):
    path.write_bytes(path.read_bytes() + b"\0")


def flip_at(place):
    def flip(path, planted):
        data = bytearray(path.read_bytes())
        data[int(place * (len(data) - 1))] ^= 4
        path.write_bytes(data)

    return flip


def swap(path, planted):
    path.write_bytes(file_of(path.parents[2], doubled, path.suffix[1:]).read_bytes())


def plant(path, planted):
    path.write_bytes(pickle.dumps(Planted(planted)))


def plant_with_numbas_version(path, planted):
    path.write_bytes(pickle.dumps(numba.__version__) + pickle.dumps(Planted(planted)))


def directory(path, planted):
    path.unlink()
    (path / "inside").mkdir(parents=True)


def link(path, planted):
    path.rename(path.with_name("moved"))
    path.symlink_to(path.with_name("moved"))


def dangling_link(path, planted):
    path.unlink()
    path.symlink_to(path.with_name("nowhere"))


def pipe(path, planted):
    path.unlink()
    os.mkfifo(path)


def writable_by_others(path, planted):
    path.chmod(0o666)


def remove(path, planted):
    path.unlink()


def unreadable(path, planted):
    path.chmod(0)


DAMAGES = [truncate, half, empty, lengthen, *map(flip_at, (0.0, 0.3, 0.5, 0.9, 1.0)), swap, plant]
DAMAGES += [plant_with_numbas_version, directory, link, dangling_link, pipe, writable_by_others]
DAMAGES += [remove, *([] if AS_ROOT else [unreadable])]


@pytest.mark.parametrize("suffix", ["nbi", "nbc"])
def test_what_is_damaged_is_compiled_again_and_replaced(cache, tmp_path, suffix):
    for damage in DAMAGES:
        damage(file_of(cache, halved, suffix), tmp_path / "planted")
        assert call(halved) == (1.5, 1), damage
        assert call(halved) == (1.5, 0), damage
    assert call(doubled) == (6.0, 0)
    assert not (tmp_path / "planted").exists()


@pytest.mark.parametrize("version", ["numba", "python", "state"])
def test_code_of_other_versions_is_compiled_again(cache, monkeypatch, version):
    if version == "numba":
        monkeypatch.setattr(numba, "__version__", "0.1")
    elif version == "python":
        monkeypatch.setattr(sys, "version", "4.0")
    else:
        (old,) = cache.glob("netkf-*")
        monkeypatch.setattr(compiling, "source_digest", lambda *rooms: "f" * 16)
        compiling._cache_folder.cache_clear()
        shutil.copytree(old, cache / f"netkf-{'f' * 16}")
    try:
        assert call(halved) == (1.5, 1)
        assert call(halved) == (1.5, 0)
    finally:
        compiling._cache_folder.cache_clear()


def test_what_cannot_be_written_is_no_error(cache, monkeypatch):
    def full(path, content):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(code_files, "_replace", full)
    file_of(cache, halved, "nbc").write_bytes(b"")
    assert call(halved) == (1.5, 1)
    assert call(halved) == (1.5, 1)


@pytest.mark.skipif(AS_ROOT or os.name == "nt", reason="root may write everywhere")
def test_a_folder_that_cannot_be_written_is_left_as_it_is(cache):
    folder = file_of(cache, halved, "nbc").parent
    folder.chmod(0o500)
    file_of(cache, halved, "nbc").write_bytes(b"")
    assert call(halved) == (1.5, 1)
    folder.chmod(0o700)


@pytest.mark.skipif(os.name == "nt", reason="other owners")
def test_only_absolute_folders_that_nobody_else_can_write_are_used(tmp_path, monkeypatch):
    folder = tmp_path / "ours"
    assert code_files.make_own_folder(folder)
    assert not code_files.make_own_folder(Path("ours"))
    folder.chmod(0o777)
    assert not code_files.make_own_folder(folder)
    assert not code_files.make_own_folder(folder / "in")
    folder.chmod(0o1777)
    assert code_files.make_own_folder(folder / "in")
    folder.chmod(0o770)
    private = code_files._is_private(folder.stat().st_gid)
    assert code_files.make_own_folder(folder) == private
    folder.chmod(0o700)
    monkeypatch.setattr(os, "geteuid", lambda: folder.stat().st_uid + 1)
    assert not code_files.make_own_folder(folder)


@pytest.mark.skipif(os.name == "nt", reason="other folders")
@pytest.mark.parametrize(
    "given",
    [
        {"HOME": None, "XDG_CACHE_HOME": "cache"},
        {"HOME": "", "XDG_CACHE_HOME": "cache"},
        {"HOME": "home"},
        {"NUMBA_CACHE_DIR": "cache"},
    ],
)
def test_nothing_is_read_from_or_written_to_the_current_folder(tmp_path, monkeypatch, given):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    # As for a user whom the system does not know, say the number that a container was given.
    monkeypatch.setattr("pwd.getpwuid", lambda uid: {}[uid])
    for name, value in given.items():
        if value is None:
            monkeypatch.delenv(name, raising=False)
        else:
            monkeypatch.setenv(name, value)
    (tmp_path / "file").touch()
    found = compiling._first_writable(os.environ.get("NUMBA_CACHE_DIR", ""), tmp_path / "file")
    assert found.is_absolute()
    assert not found.is_relative_to(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_settings_of_the_current_folder_are_not_read(tmp_path):
    (tmp_path / ".numba_config.yaml").write_text("cache_dir: here\ndisable_jit: 1\n")
    code = (
        "from netkf.linalg.compiling import require_numba; config = require_numba().config; "
        "config.reload_config(); print([config.CACHE_DIR, config.DISABLE_JIT])"
    )
    environment = {name: text for name, text in os.environ.items() if "NUMBA" not in name}
    environment["PYTHONPATH"] = os.pathsep.join([str(ROOT), *filter(None, sys.path)])
    done = subprocess.run(
        [sys.executable, "-c", code],
        check=True,
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
    )
    assert (done.stdout, done.stderr) == ("['', 0]\n", "")


def test_old_code_is_removed_and_nothing_else(tmp_path):
    names = [f"netkf-{k:016x}" for k in range(6)]
    for k, name in enumerate(names):
        (tmp_path / name / "sub").mkdir(parents=True)
        (tmp_path / name / "sub" / "f.nbi").touch()
        os.utime(tmp_path / name, (k, k))
    kept = ["netkf-paper", "netkf-0123456789abcdef"]
    for name in kept:
        (tmp_path / name).mkdir()
        (tmp_path / name / "results.json").write_text(json.dumps({}))
        os.utime(tmp_path / name, (0, 0))
    compiling._remove_old_folders(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {*kept, *names[-3:]}


LOAD = """
import sys
from tests.linalg.test_code_files import call, halved
print(call(halved), *({"numba.np.linalg", "scipy.linalg"} & {*sys.modules}))
"""


def test_loading_imports_nothing_that_only_compiling_needs(made):
    there = os.environ | {"NUMBA_CACHE_DIR": str(made), "PYTHONPATH": str(ROOT)}
    words = [sys.executable, "-c", LOAD]
    assert subprocess.check_output(words, env=there, text=True) == "(1.5, 0)\n"
