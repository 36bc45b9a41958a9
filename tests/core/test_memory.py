"""Memory that is used again, and never while somebody uses it."""

import gc
import threading

from netkf.core.memory import ReusableMemory


def address(array):
    return array.__array_interface__["data"][0]


def test_memory_is_lent_again_when_the_last_part_of_it_is_gone():
    memory = ReusableMemory(8000)
    first = memory.array(1000)
    first[:] = 1.0
    # A part of a part still uses it.
    place, part = address(first), first[10:500].reshape(49, 10)[3:]
    del first
    gc.collect()
    other = memory.array(1000)
    other[:] = 2.0
    assert (part == 1.0).all()
    assert address(other) != place
    del part
    gc.collect()
    assert address(memory.array(900)) == place


def test_arrays_that_are_too_large_are_not_kept():
    memory = ReusableMemory(800)
    assert len(memory.array(101)) == 101
    small = memory.array(100)
    assert small.base is not None
    assert memory.array(0).shape == (0,)


def test_threads_have_memory_of_their_own():
    memory, places = ReusableMemory(8000), []
    mine = memory.array(1000)
    theirs = threading.Thread(target=lambda: places.append(address(memory.array(1000))))
    theirs.start()
    theirs.join()
    assert places[0] != address(mine)
    assert len(mine) == 1000
