"""What numba leaves out for kernels changes neither what they compute nor what errors say."""

import gc
import weakref

import numba
import numpy as np
import pytest
from numba.core import event
from numba.core.errors import TypingError

from netkf.linalg.compiling import kernel
from netkf.linalg.linking import linked_once
from netkf.linalg.shortcuts import MIN_FROZEN, shortcuts, without_collection


@kernel
def subtracts_a_word(x: float) -> float:
    """A kernel with an error in its second line."""
    return x - "word"


def test_errors_say_where_they_are():
    with pytest.raises(TypingError, match=r"(?s)test_shortcuts.py.*subtracts_a_word|x - \"word\""):
        subtracts_a_word(1.0)


def test_variables_of_instructions_are_those_that_numba_finds():
    """Of whole functions, before and after the patch."""

    def loops(x, n):
        total = 0.0
        for i in range(n):
            total += x[i] * (x[i - 1] if i > 0 else x[n - 1])
        return total, [total, x[0]], {"n": n}

    function = numba.core.compiler.run_frontend(loops)
    statements = [one for block in function.blocks.values() for one in block.body]
    wanted = [one.list_vars() for one in statements]
    (patch,) = [patch for owner, name, patch in shortcuts() if name == "_rec_list_vars"]
    assert sum(map(len, wanted)) > 30
    for one, variables in zip(statements, wanted, strict=True):
        assert patch(one, vars(one)) == variables


def test_whoever_listens_to_events_still_hears_them():
    with event.install_recorder("numba:compile") as heard, linked_once():
        assert numba.njit(lambda x: x + 1.0)(2.0) == 3.0
    assert heard.buffer


@pytest.mark.parametrize("frozen", [False, True])
def test_garbage_is_collected_later_and_what_was_frozen_stays(frozen):
    class Node:
        pass

    before = gc.get_freeze_count()
    gc.unfreeze()
    try:
        if frozen:
            gc.freeze()
        count = gc.get_freeze_count()
        with without_collection():
            assert not gc.isenabled()
            many = [[] for _ in range(0 if frozen else 2 * MIN_FROZEN)]
            node = Node()
            node.itself = node
            gone = weakref.ref(node)
            del node
        assert gc.isenabled()
        del many
        assert gc.get_freeze_count() == count
        assert (count > 0) == frozen
        assert gone() is not None
        gc.collect()
        assert gone() is None
    finally:
        gc.unfreeze()
        if before:  # as tests/conftest.py does
            gc.freeze()


def test_generators_are_left_to_numba():
    @numba.njit
    def squares(n):
        for i in range(n):
            yield i * i

    with linked_once():
        made = numba.njit(lambda n: sum([k for k in squares(n)]))  # noqa: C416
        assert made(4) == 14


def test_names_of_numba_are_as_expected():
    """All of them at once: where one is missing numba is left as it is, and slower."""
    names = {name for owner, name, _ in shortcuts() if name in owner.__dict__}
    assert {"_rec_list_vars", "get_abi_sizeof", "new_error_context", "start_event"} <= names
    assert len(names) == len({name for _, name, _ in shortcuts()})


def test_what_is_registered_between_two_compilations_is_known_in_the_second():
    def twice(x):
        raise NotImplementedError

    with linked_once():
        assert numba.njit(lambda x: x + 1.0)(2.0) == 3.0

    @numba.extending.overload(twice)
    def _twice(x):
        return lambda x: 2.0 * x

    with linked_once():
        assert numba.njit(lambda x: twice(x) + 1.0)(2.0) == 5.0


@kernel(allocates=True)
def sums_of_parts(n: int) -> float:
    """A kernel that makes arrays, some of them in a loop and one that is returned to another."""
    total = 0.0
    for k in range(n):
        part = np.ones(k + 1)
        part = part + 1.0
        total += part.sum()
    return total


def test_arrays_that_kernels_make_are_freed():
    memory = numba.core.runtime._nrt_python
    assert sums_of_parts(3) == 12.0
    memory.memsys_enable_stats()
    try:
        before = numba.core.runtime.rtsys.get_allocation_stats()
        assert sums_of_parts(10) == 110.0
        after = numba.core.runtime.rtsys.get_allocation_stats()
    finally:
        memory.memsys_disable_stats()
    assert after.alloc - before.alloc == after.free - before.free > 0
