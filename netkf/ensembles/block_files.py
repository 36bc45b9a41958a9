"""Results of finished blocks on disk: ``000000064-16.npz`` has the runs 64 to 79 of an ensemble.

Each is a node of the binary tree over replicas. A block is used only if its last line is the digest
of all bytes before it, and the identity inside (run, replicas, installation) is that of the run.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import shutil
import threading
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from netkf.core.errors import EngineError
from netkf.ensembles.merge_tree import Merge, MergeTree
from netkf.ensembles.pool import MAX_BLOCK
from netkf.ensembles.replicas import Node
from netkf.runs.documents import MAX_COUNT, DamagedError, reading_file
from netkf.runs.files import this_process, write_atomically, writing_file
from netkf.runs.provenance import machine, versions

MARK = b"\nsha256 "  # begins the last line of a block's file
SEAL_BYTES = len(MARK) + 64  # length of that line, with the SHA-256 in hexadecimal
CHUNK = 1 << 20  # bytes hashed at once
MAX_TRACED_BLOCK = 8
"""Largest number of runs in a block where all runs leave a trace: their events are in memory."""
TRACED = {"full": MAX_COUNT, "first": 1, "none": 0}
"""Number of the first runs that leave a trace, by the option ``trace``."""
FIRST_WRITE, WRITE_SHARE = 10.0, 0.2
"""Results wait in memory to be merged. They are written after so many seconds of CPU time of all
workers together, and then whenever a further share of the CPU time until then was spent: a command
that is killed loses no more, and the blocks that were under way.
"""


@dataclass(frozen=True)
class RunIdentity:
    """The values that blocks must share to be merged.

    scenario : digest of the resolved scenario with its files
    seed, runs : seed and number of runs
    trace, engine : options of the command
    first : number of the first replica; blocks count from it
    """

    scenario: str
    seed: int
    runs: int
    trace: str
    engine: str
    first: int = 0

    @property
    def traces(self) -> int:
        """Number of replicas that leave a trace."""
        return min(self.runs, TRACED[self.trace])

    @property
    def max_block(self) -> int:
        """Largest number of replicas in a block."""
        return MAX_TRACED_BLOCK if self.trace == "full" else MAX_BLOCK

    def runs_of(self, node: Node) -> int:
        """Return the number of replicas in a node; the last may have fewer than its size."""
        return min(sum(node), self.runs) - node[0]

    def of(self, node: Node) -> dict[str, Any]:
        """Return the identity of the block of a node, if its runs are simulated here."""
        names = {"start": node[0], "size": node[1]}
        return {**asdict(self), **names, "versions": versions(), "machine": machine()}


class BlockFiles(ABC):
    """Results of the finished blocks of an ensemble in a ``folder``, one file each, written
    atomically; ``merge`` joins those of neighbours.
    """

    def __init__(self, folder: Path, merge: Merge) -> None:
        self._folder, self._merge = folder, merge
        self._nodes: set[Node] = set()
        self._own: set[Node] = set()  # those of them that this installation made
        self._pending = MergeTree(merge)
        self._lock = threading.RLock()  # another thread may write as the process ends
        self._spent = self._written = 0.0  # CPU seconds of all results, and of those written
        self.installations: list[dict[str, Any]] = []  # of the nodes that were found
        self._remedy = "go on with --resume, which does it again"

    @property
    def nodes(self) -> list[Node]:
        """The largest nodes that are stored, in order."""
        return list(outermost(self._nodes))

    @abstractmethod
    def pack(self, value: Any) -> dict[str, Any]:
        """Return the result of a block as arrays by name."""

    @abstractmethod
    def unpack(self, arrays: Any) -> Any:
        """Return the result of a block from its arrays; may raise anything if they do not fit."""

    @abstractmethod
    def require_fit(self, arrays: Any, stored: dict[str, Any]) -> int:
        """Return the number of runs of ``arrays``; raises DamagedError if ``stored`` misfits."""

    def find(
        self, identity: RunIdentity, any_installation: bool = False, within: range | None = None
    ) -> tuple[list[Node], list[str]]:
        """Return the largest nodes (replicas start, ..., ``size`` of them) that are stored of the
        runs with this ``identity``, in order, and lines for the user about files that are
        unreadable or belong to other runs, which are removed.

        With ``any_installation`` blocks may come from other versions and machines, and no file is
        removed: workers may be at work there. Only those with replicas ``within`` a range are read.
        """
        if any_installation:
            self._remedy = "another worker may have merged it: give the same command again"
        bad: list[tuple[str, str]] = []
        found: dict[Node, dict[str, Any]] = {}
        here = {"versions": versions(), "machine": machine()}
        expected: dict[str, Any] = {} if any_installation else dict(here)
        for file in self.paths():
            try:
                node = node_of(file)
                if within is not None and not (node[0] < within.stop and sum(node) > within.start):
                    continue
                expected |= {**asdict(identity), "start": node[0], "size": node[1]}
                stored = self.check(file, expected)
                found[node] = {key: stored.get(key) for key in here}
            except DamagedError as error:
                if any_installation and not file.exists():
                    continue  # its writer has replaced it
                bad.append((file.name, str(error)))
                if not any_installation:
                    with contextlib.suppress(OSError):
                        file.unlink()
        for node in outermost(found):
            self._nodes.add(node)
            if found[node] == here:
                self._own.add(node)
            if found[node] not in self.installations:
                self.installations.append(found[node])
        return self.nodes, _describe(bad)

    def add(self, node: Node, value: Any, identity: RunIdentity, seconds: float) -> Any:
        """Take the result of a block that took so many ``seconds`` of CPU time, to be merged with
        those of its neighbours and written now or later; return it.
        """
        start, size = node
        with self._lock:
            self._pending.add(start // size, value, size.bit_length() - 1)
            self._spent += seconds
            # Traces fill the memory; other results wait to be merged, as a file takes as much for
            # many runs as for one.
            patience = max(FIRST_WRITE, WRITE_SHARE * self._written)
            if identity.trace == "full" or self._spent - self._written >= patience:
                self.write(identity)
        return value

    def write(self, identity: RunIdentity) -> None:
        """Write the results that ``add`` took and that are not written yet, merged with those of
        neighbours that are stored already; raises WriteError.
        """
        with self._lock:
            for level, k, value in self._pending.nodes():
                node = k << level, 1 << level
                if identity.trace == "full":
                    self.save(node, value, identity)
                else:
                    self._save_merged(node, value, identity)
            self._pending = MergeTree(self._merge)
            self._written = self._spent

    def _save_merged(self, node: Node, value: Any, identity: RunIdentity) -> None:
        """Write a result merged with those of neighbours that were written here, in one file."""
        inner = []
        while (other := _neighbour(node)) in self._own:
            try:
                with open_block(self._path(other), verified=False) as arrays:
                    stored = self.unpack(arrays)
            except DamagedError:
                break  # another worker has merged it, or it is done again
            value = self._merge(stored, value) if other < node else self._merge(value, stored)
            node = min(node[0], other[0]), 2 * node[1]
            inner.append(other)
        self.save(node, value, identity)
        for other in inner:  # which the file of the larger block contains
            self._nodes.discard(other)
            self._own.discard(other)
            with contextlib.suppress(OSError):
                self._path(other).unlink()

    def save(self, node: Node, value: Any, identity: RunIdentity) -> None:
        """Write the file of the block of a node, with the result of its runs; raises WriteError.

        ``identity`` is that of the scenario and its runs, by which a resumed run knows its blocks.
        """
        with writing_file(self._folder):
            self._folder.mkdir(parents=True, exist_ok=True)
        # In memory first: on a full disk some versions of numpy leave their file open.
        block = io.BytesIO()
        arrays = {**self.pack(value), "identity": np.array(json.dumps(identity.of(node)))}
        np.savez(block, **arrays)
        block.write(MARK + digest_of(block, block.tell()))
        # Another worker may write the same block: the one who renames last wins, with the same.
        with write_atomically(self._path(node), this_process()) as part:
            part.write_bytes(block.getvalue())
        self._nodes.add(node)
        self._own.add(node)

    def load(self, node: Node) -> Any:
        """Return the result of a node's block; raises EngineError if it was damaged meanwhile."""
        with self._expect_block(node), open_block(self._path(node)) as arrays:
            return self.unpack(arrays)

    def remove(self) -> None:
        """Delete all blocks."""
        shutil.rmtree(self._folder, ignore_errors=True)

    def paths(self) -> list[Path]:
        """Return the files of all blocks, in order."""
        with contextlib.suppress(FileNotFoundError, NotADirectoryError):
            return sorted(file for file in self._folder.iterdir() if file.suffix == ".npz")
        return []

    def check(self, file: Path, identity: dict[str, Any]) -> dict[str, Any]:
        """Return the stored identity of a block; raises DamagedError unless its file is intact."""
        with open_block(file, verified=False) as arrays:
            stored = json.loads(str(arrays["identity"]))
            if not isinstance(stored, dict):
                raise DamagedError("does not say of which runs it is")
            for key, value in identity.items():
                if stored.get(key) != value:
                    name = "installation" if key in ("versions", "machine") else key
                    raise DamagedError(f"is of another {name}")
            start, size, runs = (int(stored[key]) for key in ("start", "size", "runs"))
            if self.require_fit(arrays, stored) != min(size, runs - start):
                raise DamagedError("has another number of runs than it says")
            return stored

    def _path(self, node: Node) -> Path:
        return self._folder / _name_of(node)

    @contextlib.contextmanager
    def _expect_block(self, node: Node) -> Iterator[None]:
        """Turn a DamagedError about the block of a node into an EngineError, and remove it."""
        try:
            yield
        except DamagedError as error:
            with contextlib.suppress(OSError):
                self._path(node).unlink()
            raise EngineError(f"{self._path(node)} {error}; {self._remedy}") from None


def _neighbour(node: Node) -> Node:
    """Return the node with which a node of the tree over replicas is merged."""
    return node[0] ^ node[1], node[1]


def _name_of(node: Node) -> str:
    return f"{node[0]:09d}-{node[1]}.npz"


def node_of(file: Path) -> Node:
    """Return the node whose name a block's file has; raises DamagedError if there is none."""
    start, _, size = file.stem.partition("-")
    if start.isdecimal() and size.isdecimal() and len(start) < 16 and len(size) < 16:
        node = int(start), int(size)
        is_node = node[1] > 0 and node[1] & (node[1] - 1) == 0 and node[0] % node[1] == 0
        if is_node and file.name == _name_of(node):
            return node
    raise DamagedError("has a name that no block has")


def outermost(nodes: Iterable[Node]) -> Iterator[Node]:
    """Yield the nodes that are in no other one, in order: nodes that overlap contain each other."""
    end = 0
    for node in sorted(nodes, key=lambda node: (node[0], -node[1])):
        if node[0] >= end:
            yield node
            end = sum(node)


def _describe(bad: list[tuple[str, str]]) -> list[str]:
    """Return a line for the user about ``bad`` files of blocks, whose runs are simulated again."""
    if not bad:
        return []
    listed = ", ".join(f"{name} {reason}" for name, reason in bad[:3])
    more = f" and {len(bad) - 3} more" if len(bad) > 3 else ""
    return [f"kept blocks that are not those of this run are done again: {listed}{more}"]


def verify(file: Path) -> None:
    """Raise DamagedError unless the file ends with the digest of all bytes before it."""
    with reading_file(file), file.open("rb") as opened:
        length = max(0, opened.seek(0, os.SEEK_END) - SEAL_BYTES)
        opened.seek(length)
        if opened.read() != MARK + digest_of(opened, length):
            raise DamagedError("was changed since it was written")


def digest_of(file: BinaryIO, length: int) -> bytes:
    """Return the SHA-256 of the first ``length`` bytes, in hexadecimal; leaves the file at them."""
    digest, remaining = hashlib.sha256(), length
    file.seek(0)
    while remaining > 0 and (chunk := file.read(min(CHUNK, remaining))):
        digest.update(chunk)
        remaining -= len(chunk)
    file.seek(length)
    return digest.hexdigest().encode()


@contextlib.contextmanager
def open_block(file: Path, verified: bool = True) -> Iterator[Any]:
    """Yield a block's arrays by name; DamagedError if the digest, unless ``verified``, is wrong."""
    try:
        if not verified:
            verify(file)
        with np.load(file, allow_pickle=False) as arrays:
            yield arrays
    except (DamagedError, EngineError, KeyboardInterrupt, GeneratorExit):
        raise  # not about the file's bytes, or explained already
    except Exception as error:  # of zipfile, zlib, numpy and json, whatever the bytes are
        raise DamagedError(f"cannot be read ({type(error).__name__})") from None
