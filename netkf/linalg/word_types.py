"""The numba implementation of :mod:`netkf.linalg.words`: one multiplication of 128 bits."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core.imputils import lower_builtin
from numba.core.typing.templates import AbstractTemplate, infer_global, signature

from netkf.linalg.words import high_word

I128 = ir.IntType(128)


@infer_global(high_word)
class _HighWord(AbstractTemplate):
    """The typing of ``high_word``."""

    def generic(self, _args: Any, _kws: Any) -> Any:
        """Return the signature: the upper half of the product of two 64-bit words."""
        return signature(types.uint64, types.uint64, types.uint64)


@lower_builtin(high_word, types.uint64, types.uint64)
def lower_high_word(_context: Any, builder: Any, _sig: Any, args: Any) -> Any:
    """Emit the product of both words in 128 bits, and take its upper half."""
    a, b = (builder.zext(word, I128) for word in args)
    upper = builder.lshr(builder.mul(a, b), ir.Constant(I128, 64))
    return builder.trunc(upper, ir.IntType(64))
