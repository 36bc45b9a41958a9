"""Kernels in few lines of LLVM's language: numba's own are several times as many.

Reading these lines and simplifying them takes LLVM longer than all that follows. numba keeps
variables that several blocks use in memory, arrays with all their ten fields; it asks after each
call whether there was an error; and it writes what nobody reads. Here a variable that is assigned
once, before all of its uses, is a value; what was inserted into a structure is taken from there;
functions that never fail are not asked; and lines without readers go. LLVM makes the same machine
code of both.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from llvmlite.ir import instructions
from numba import types
from numba.core import cgutils
from numba.core import ir as numba_ir
from numba.core.analysis import compute_cfg_from_blocks
from numba.core.compiler_machinery import register_pass
from numba.core.lowering import Lower
from numba.core.typed_passes import NativeLowering

I64 = ir.IntType(64)
ZERO, ONE = ir.Constant(I64, 0), ir.Constant(I64, 1)
# Fields of numba's array structure, see tests/linalg/test_structs.py.
MEMINFO, PARENT, ITEMS, ITEMSIZE, DATA, SHAPE, STRIDES = range(7)

WITHOUT_EFFECT = {
    instructions.Instruction,  # arithmetic
    instructions.CastInstr,
    instructions.ExtractValue,
    instructions.FCMPInstr,
    instructions.GEPInstr,
    instructions.ICMPInstr,
    instructions.InsertValue,
    instructions.LoadInstr,
    instructions.SelectInstr,
}
"""Instructions that may go where nobody reads their result."""

_NEVER_FAIL: set[str] = set()
"""Names of compiled functions that return no error."""


def inserted_value(aggregate: Any, place: list[int]) -> tuple[Any, list[int]]:
    """Return a value and a place in it (empty: the value itself) that hold what is at ``place`` of
    an aggregate, found among what was inserted there.
    """
    while place and isinstance(aggregate, instructions.InsertValue):
        known = list(aggregate.indices)
        if known == place[: len(known)]:
            aggregate, place = aggregate.value, place[len(known) :]
        elif place == known[: len(place)]:
            # Only a part of the entry was inserted here.
            break
        else:
            aggregate = aggregate.aggregate
    return aggregate, place


class ValueBuilder(ir.IRBuilder):
    """Takes entries of structures from where they were inserted."""

    def extract_value(self, agg: Any, idx: Any, name: str = "") -> Any:
        """Return entry ``idx`` of an aggregate."""
        places = list(idx) if isinstance(idx, list | tuple) else [idx]
        # An entry of an entry.
        if isinstance(agg, instructions.ExtractValue):
            agg, places = agg.aggregate, [*agg.indices, *places]
        value, rest = inserted_value(agg, places)
        return super().extract_value(value, rest, name) if rest else value


class ValueLower(Lower):
    """Writes the code of kernels in few lines."""

    def setup_function(self, fndesc: Any) -> None:
        """Begin the function."""
        super().setup_function(fndesc)
        self.builder = ValueBuilder(self.entry_block)
        self.call_helper = self.call_conv.init_call_helper(self.builder)

    def lower_normal_function(self, fndesc: Any) -> None:
        """Write the function."""
        super().lower_normal_function(fndesc)
        remove_unread(self.function)
        if never_fails(self.function):
            _NEVER_FAIL.add(self.function.name)

    def lower_inst(self, inst: Any) -> None:
        """Write a statement."""
        # numba describes each in words first, for its own developers.
        if isinstance(inst, numba_ir.Assign) and not self.context.enable_nrt:
            target = inst.target.name
            self.storevar(self.lower_assign(self.typeof(target), inst), target)
        else:
            super().lower_inst(inst)

    # Variables.

    def storevar(self, value: Any, name: str, argidx: int | None = None) -> None:
        """Give a variable a value."""
        # numba reads the value before, to count its references.
        if self.context.enable_nrt or name in self._singly_assigned_vars:
            super().storevar(value, name, argidx)
        else:
            self._alloca_var(name, self.typeof(name))
            self.builder.store(value, self.getvar(name))

    def _find_singly_assigned_variable(self) -> None:
        """Find the variables that are values."""
        # Where references are counted, variables end with their blocks.
        if self.context.enable_nrt or self.func_ir.func_id.is_generator:
            super()._find_singly_assigned_variable()
            return
        self._singly_assigned_vars = self._assigned_before_use()
        self._blk_local_varmap: dict[str, Any] = {}

    def _assigned_before_use(self) -> set[str]:
        """Return the names of variables with one assignment, which comes before all uses, on each
        way and in the order in which blocks are written.
        """
        count: dict[str, int] = defaultdict(int)
        home: dict[str, int] = {}
        early: set[str] = set()
        users: dict[str, set[int]] = defaultdict(set)
        for offset, block in sorted(self.blocks.items()):
            for statement in block.body:
                used = statement.value if isinstance(statement, numba_ir.Assign) else statement
                read = used.list_vars() if isinstance(used, numba_ir.Inst) else [used]
                for name in [each.name for each in read if isinstance(each, numba_ir.Var)]:
                    if name not in home:
                        early.add(name)
                    elif home[name] != offset:
                        users[name].add(offset)
                if used is not statement:
                    count[statement.target.name] += 1
                    home[statement.target.name] = offset
        found = {name for name, times in count.items() if times == 1 and name not in early}
        others = [name for name in found if home[name] != self.firstblk and name in users]
        if others:
            above = compute_cfg_from_blocks(self.blocks).dominators()
            found -= {
                name for name in others if any(home[name] not in above[at] for at in users[name])
            }
        return found

    # Loops.

    def lower_expr(self, resty: Any, expr: Any) -> Any:
        """Return the value of an expression."""
        made = None
        if expr.op == "getiter":
            made = self._iterator(resty, expr)
        elif expr.op == "iternext":
            made = self._next(resty, expr)
        elif expr.op in ("pair_first", "pair_second"):
            value = self.loadvar(expr.value.name)
            made = self.builder.extract_value(value, int(expr.op == "pair_second"))
            self.incref(resty, made)
        elif expr.op == "getattr" and expr.attr == "shape":
            made = self._shape(expr)
        return super().lower_expr(resty, expr) if made is None else made

    def lower_call(self, resty: Any, expr: Any) -> Any:
        """Return the value of a call."""
        signature = self.fndesc.calltypes[expr]
        called = getattr(self.typeof(expr.func.name), "typing_key", None)
        if called is len and isinstance(signature.args[0], types.Array):
            return self.builder.extract_value(self.loadvar(expr.args[0].name), [SHAPE, 0])
        if resty != types.range_state64_type or set(signature.args) != {types.int64} or expr.kws:
            return super().lower_call(resty, expr)
        places = [self._cast_var(var, types.int64) for var in expr.args]
        ranges = [ZERO, *places, ONE], [*places, ONE], places
        return self._struct(resty, *ranges[len(places) - 1])

    def _shape(self, expr: Any) -> Any:
        if not isinstance(self.typeof(expr.value.name), types.Array):
            return None
        return self.builder.extract_value(self.loadvar(expr.value.name), SHAPE)

    def _struct(self, kind: Any, *fields: Any) -> Any:
        made = ir.Constant(self.context.get_value_type(kind), ir.Undefined)
        for k, value in enumerate(fields):
            made = self.builder.insert_value(made, value, k)
        return made

    def _iterator(self, resty: Any, expr: Any) -> Any:
        if self.typeof(expr.value.name) != types.range_state64_type:
            return None
        state, builder = self.loadvar(expr.value.name), self.builder
        start, stop, step = (builder.extract_value(state, k) for k in range(3))
        # Only steps that are known: numba asks others whether they are 0.
        if not (isinstance(step, ir.Constant) and step.constant):
            return None
        following, count = (self.alloca_lltype(name, I64) for name in ("following", "count"))
        builder.store(start, following)
        self._store_count(count, builder.sub(stop, start), step)
        return self._struct(resty, following, stop, step, count)

    def _store_count(self, count: Any, difference: Any, step: Any) -> None:
        """Store the number of steps, at least 0."""
        builder = self.builder
        positive = builder.icmp_signed(">", difference, ZERO)
        away = builder.not_(positive) if step.constant > 0 else positive
        with builder.if_else(away) as (then, otherwise):
            with then:
                builder.store(ZERO, count)
            with otherwise:
                rest = builder.srem(difference, step)
                rest = builder.select(positive, rest, builder.neg(rest))
                one = builder.select(builder.icmp_signed(">", rest, ZERO), ONE, ZERO)
                builder.store(builder.add(builder.sdiv(difference, step), one), count)

    def _next(self, resty: Any, expr: Any) -> Any:
        if self.typeof(expr.value.name) != types.range_iter64_type:
            return None
        state, builder = self.loadvar(expr.value.name), self.builder
        following, step, left = (builder.extract_value(state, k) for k in (0, 2, 3))
        count = builder.load(left)
        valid = builder.icmp_signed(">", count, ZERO)
        before = builder.block
        with builder.if_then(valid):
            value = builder.load(following)
            builder.store(builder.sub(count, ONE, flags=["nsw"]), left)
            builder.store(builder.add(value, step), following)
            inside = builder.block
        found = builder.phi(I64)
        found.add_incoming(value, inside)
        found.add_incoming(ZERO, before)
        return self._struct(resty, found, valid)


@register_pass(mutates_CFG=True, analysis_only=False)
class ValueLowering(NativeLowering):
    """The last step of numba's pipeline, with ValueLower."""

    _name = "value_lowering"
    lowering_class: Any = ValueLower


# Errors.


def never_fails(function: Any) -> bool:
    """Return True if all ways out of a function of LLVM return no error."""
    ends = [block.terminator for block in function.blocks]
    returned = [end.return_value for end in ends if isinstance(end, instructions.Ret)]
    return all(isinstance(code, ir.Constant) and code.constant == 0 for code in returned)


def call_without_errors(user_function: Callable[..., Any]) -> Callable[..., Any]:
    """Return numba's ``user_function``, which writes the calls of compiled functions, for functions
    that never fail: nobody asks them.
    """

    def function(fndesc: Any, libs: Any) -> Any:
        checked = user_function(fndesc, libs)

        def call(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            plain = not isinstance(sig.return_type, types.Optional)
            if not (plain and fndesc.llvm_func_name in _NEVER_FAIL):
                return checked(context, builder, sig, args)
            convention = context.call_conv
            called = context.declare_function(builder.module, fndesc)
            kind = called.args[0].type.pointee
            # The function always writes its result, and never an error.
            result = cgutils.alloca_once(builder, kind)
            error = convention._get_excinfo_argument(builder.function)
            packed = convention._get_arg_packer(fndesc.argtypes).as_arguments(builder, args)
            builder.call(called, [result, error, *packed])
            return context.get_returned_value(builder, fndesc.restype, builder.load(result))

        call.signature, call.libs = checked.signature, checked.libs  # type: ignore[attr-defined]
        return call

    return function


# What nobody reads.


def remove_unread(function: Any) -> None:
    """Remove instructions without effect whose results nobody reads, and variables that are only
    written.
    """
    every = [each for block in function.blocks for each in block.instructions]
    readers = Counter([id(value) for each in every for value in each.operands])
    for each in every:
        if isinstance(each, instructions.PhiInstr):
            readers.update(id(value) for value, _ in each.incomings)
    unread: set[int] = set()
    # From the last to the first: what only unread ones read is unread as well.
    for each in reversed(every):
        # ``get``: a counter takes long to say that it does not have a number.
        if type(each) in WITHOUT_EFFECT and not readers.get(id(each)):
            unread.add(id(each))
            for value in each.operands:
                readers[id(value)] -= 1
    stores = [each for each in every if type(each) is instructions.StoreInstr]
    writers = Counter([id(each.operands[1]) for each in stores])
    variables = {id(each) for each in every if type(each) is instructions.AllocaInstr}
    unread |= {each for each in variables if readers.get(each) == writers.get(each)}
    unread |= {id(each) for each in stores if id(each.operands[1]) in unread & variables}
    for block in function.blocks:
        block.instructions[:] = [each for each in block.instructions if id(each) not in unread]
