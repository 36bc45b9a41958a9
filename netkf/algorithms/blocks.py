"""What kernels must know of the blocks of nodes to translate what one tells another."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from netkf.core.places import Key, Place
from netkf.linalg.arrays import IntArray
from netkf.linalg.structs import Struct


class BlockTables(Struct):
    """Where blocks are in the states of H nodes, of w components at most.

    entry : (W, w), for each directed link by receiver and component of the sender's state which
            component of the receiver's it is, -1: none
    first, theirs : (H, B) and (W, B), of each block its first component in the state of each node,
                    or of the sender of each link, -1 where that does not estimate it
    size : (B,), of each block the number of its components
    """

    entry: IntArray
    first: IntArray
    theirs: IntArray
    size: IntArray


def blocks_by_key(blocks: Sequence[Place], n: int) -> dict[Key, Place]:
    """Return the blocks of a node of n states by name and owner; one of all states without any."""
    return {place.key: place for place in blocks or (Place("", None, 0, n),)}


def block_numbers(infos: Sequence[Any]) -> Mapping[Key, int]:
    """Return a number for each block that is estimated, if the ``NodeInfo`` of nodes say so, else
    for those that these nodes or their senders estimate.
    """
    if infos[0].numbers:
        given: Mapping[Key, int] = infos[0].numbers
        return given
    seen = [places for info in infos for places in (info.blocks, *info.heard)]
    keys = [place.key for places in seen for place in places]
    return {key: number for number, key in enumerate(dict.fromkeys(keys))}


def block_tables(infos: Sequence[Any], models: Sequence[Any]) -> BlockTables:
    """Return where the blocks of nodes with these infos and models are."""
    widths = [len(models[0].information)]
    widths += [sum(p.n for p in places) for info in infos for places in info.heard]
    numbers = block_numbers(infos)
    rows, theirs, first = [], [], np.full((len(infos), max(1, len(numbers))), -1)
    size = np.zeros(first.shape[1], dtype=np.int64)
    for h, (info, model) in enumerate(zip(infos, models, strict=True)):
        own = blocks_by_key(info.blocks, len(model.information))
        for place in info.blocks:
            number = numbers[place.key]
            first[h, number], size[number] = place.first, place.n
        for k in range(max(len(info.senders), 1 if len(infos) == 1 else 0)):
            row = np.full(max(widths), -1)
            heard = info.heard[k] if k < len(info.heard) else ()
            theirs.append(np.full(len(size), -1))
            for place in heard:
                number = numbers[place.key]
                theirs[-1][number], size[number] = place.first, place.n
            for key, place in blocks_by_key(heard, len(model.information)).items():
                if key in own:
                    row[place.entries] = np.arange(place.n) + own[key].first
            rows.append(row)
    return BlockTables(
        entry=np.array(rows).reshape(-1, max(widths)),
        first=first,
        theirs=np.array(theirs).reshape(-1, len(size)),
        size=size,
    )
