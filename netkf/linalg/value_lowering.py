"""A replacement of numba's lowering (its translation to LLVM IR) that emits several times less IR.

LLVM spends most of the compile time on parsing and simplifying IR. numba's lowering keeps every
variable that several basic blocks use on the stack, arrays with all their ten fields; tests each
call for an exception; and emits values that nothing reads. Here, instead,

- a variable with one assignment that precedes all its uses becomes an SSA value,
- a field that was inserted into a structure is taken from the inserted value,
- calls of functions that never raise are not tested, and
- instructions without readers are removed.

LLVM generates the same machine code from both.
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
"""Instructions without side effects, which may be removed if nothing reads their result."""

_NEVER_FAIL: set[str] = set()
"""LLVM names of compiled functions that never raise."""


def inserted_value(aggregate: Any, indices: list[int]) -> tuple[Any, list[int]]:
    """Return (value, indices in it) for the entry at ``indices`` of an LLVM ``aggregate`` (a
    structure), as far as the chain of ``insertvalue`` instructions tells: empty indices if the
    entry is the value itself.
    """
    while indices and isinstance(aggregate, instructions.InsertValue):
        inserted_at = list(aggregate.indices)
        if inserted_at == indices[: len(inserted_at)]:
            aggregate, indices = aggregate.value, indices[len(inserted_at) :]
        elif indices == inserted_at[: len(indices)]:
            # Only a part of the entry was inserted here: the entry is no single inserted value.
            break
        else:
            aggregate = aggregate.aggregate
    return aggregate, indices


class ValueBuilder(ir.IRBuilder):
    """An IR builder that reads entries of structures from the values that were inserted."""

    def extract_value(self, agg: Any, idx: Any, name: str = "") -> Any:
        """Return the entry of an LLVM structure or array ``agg`` at ``idx``, an index or a sequence
        of nested indices; ``name`` is that of the result in the IR.

        No ``extractvalue`` instruction is emitted if the entry was inserted by an ``insertvalue``
        before: then the inserted value is returned.
        """
        indices = list(idx) if isinstance(idx, list | tuple) else [idx]
        # An entry of an entry is one extraction from the outer aggregate.
        if isinstance(agg, instructions.ExtractValue):
            agg, indices = agg.aggregate, [*agg.indices, *indices]
        value, remaining_indices = inserted_value(agg, indices)
        return super().extract_value(value, remaining_indices, name) if remaining_indices else value


def _variables_in(source: Any) -> list[str]:
    """Return the names of the variables that a statement, or the value that it assigns, uses."""
    operands = source.list_vars() if isinstance(source, numba_ir.Inst) else [source]
    return [variable.name for variable in operands if isinstance(variable, numba_ir.Var)]


class ValueLower(Lower):
    """numba's lowering of one function, with the overridden methods that the module describes."""

    def setup_function(self, fndesc: Any) -> None:
        """Set up the function with a ValueBuilder instead of numba's builder."""
        super().setup_function(fndesc)
        self.builder = ValueBuilder(self.entry_block)
        self.call_helper = self.call_conv.init_call_helper(self.builder)

    def lower_normal_function(self, fndesc: Any) -> None:
        """Lower the function, remove unread instructions, and note if it never raises."""
        super().lower_normal_function(fndesc)
        remove_unread(self.function)
        if never_fails(self.function):
            _NEVER_FAIL.add(self.function.name)

    def lower_inst(self, inst: Any) -> None:
        """Emit LLVM IR for one statement ``inst`` of numba's IR."""
        # Assignments directly: numba first formats each statement as a comment for debugging.
        if isinstance(inst, numba_ir.Assign) and not self.context.enable_nrt:
            target = inst.target.name
            self.storevar(self.lower_assign(self.typeof(target), inst), target)
        else:
            super().lower_inst(inst)

    # Variables.

    def storevar(self, value: Any, name: str, argidx: int | None = None) -> None:
        """Assign an LLVM ``value`` to the variable ``name``; ``argidx`` is its index if it is an
        argument.
        """
        # numba loads the old value first to decrease its reference count, which kernels without
        # reference counting (enable_nrt) do not need.
        if self.context.enable_nrt or name in self._singly_assigned_vars:
            super().storevar(value, name, argidx)
        else:
            self._alloca_var(name, self.typeof(name))
            self.builder.store(value, self.getvar(name))

    def _find_singly_assigned_variable(self) -> None:
        """Decide which variables become SSA values; numba's own choice is limited to one block."""
        # With reference counting numba decreases counts at the ends of blocks: keep its choice.
        if self.context.enable_nrt or self.func_ir.func_id.is_generator:
            super()._find_singly_assigned_variable()
            return
        self._singly_assigned_vars = self._assigned_before_use()
        self._blk_local_varmap: dict[str, Any] = {}

    def _assigned_before_use(self) -> set[str]:
        """Return the names of variables with a single assignment that precedes all uses: in the
        order in which blocks are lowered, and on every path (its block dominates theirs).
        """
        assignments: dict[str, int] = defaultdict(int)
        block_of: dict[str, int] = {}
        used_early: set[str] = set()
        using_blocks: dict[str, set[int]] = defaultdict(set)
        # Blocks in the order in which they are lowered: a use that comes first has no value yet.
        for offset, block in sorted(self.blocks.items()):
            for statement in block.body:
                source = statement.value if isinstance(statement, numba_ir.Assign) else statement
                for name in _variables_in(source):
                    if name not in block_of:
                        used_early.add(name)
                    elif block_of[name] != offset:
                        using_blocks[name].add(offset)
                if source is not statement:
                    assignments[statement.target.name] += 1
                    block_of[statement.target.name] = offset
        names = {
            name for name, number in assignments.items() if number == 1 and name not in used_early
        }
        return names - self._missed_on_some_path(
            names & using_blocks.keys(), block_of, using_blocks
        )

    def _missed_on_some_path(
        self, names: set[str], block_of: dict[str, int], using_blocks: dict[str, set[int]]
    ) -> set[str]:
        """Return those of ``names`` that some block uses without being dominated by the block that
        assigns them (some path to the use misses the assignment): they cannot be SSA values, and
        stay on the stack. ``block_of`` is the offset of the block that assigns each name,
        ``using_blocks`` those of the others that use it.
        """
        # The first block dominates all.
        names = {name for name in names if block_of[name] != self.firstblk}
        if not names:
            return names
        dominators = compute_cfg_from_blocks(self.blocks).dominators()
        return {
            name
            for name in names
            if any(block_of[name] not in dominators[user] for user in using_blocks[name])
        }

    # Loops.

    def lower_expr(self, resty: Any, expr: Any) -> Any:
        """Return the LLVM value of an expression ``expr`` of numba's IR, whose result has the numba
        type ``resty``: loops over ``range`` and shapes in less LLVM IR, all else as numba does.
        """
        result = None
        if expr.op == "getiter":
            result = self._iterator(resty, expr)
        elif expr.op == "iternext":
            result = self._next(resty, expr)
        elif expr.op in ("pair_first", "pair_second"):
            value = self.loadvar(expr.value.name)
            result = self.builder.extract_value(value, int(expr.op == "pair_second"))
            self.incref(resty, result)
        elif expr.op == "getattr" and expr.attr == "shape":
            result = self._shape(expr)
        return super().lower_expr(resty, expr) if result is None else result

    def lower_call(self, resty: Any, expr: Any) -> Any:
        """Return the LLVM value of a call ``expr`` in numba's IR, whose result has the numba type
        ``resty``: ``len`` of an array and ``range`` of int64 in less LLVM IR, all else as numba
        does.
        """
        signature = self.fndesc.calltypes[expr]
        callee = getattr(self.typeof(expr.func.name), "typing_key", None)
        if callee is len and isinstance(signature.args[0], types.Array):
            return self.builder.extract_value(self.loadvar(expr.args[0].name), [SHAPE, 0])
        if resty != types.range_state64_type or set(signature.args) != {types.int64} or expr.kws:
            return super().lower_call(resty, expr)
        arguments = [self._cast_var(var, types.int64) for var in expr.args]
        # (start, stop, step) of range(stop), range(start, stop) and range(start, stop, step).
        ranges = [ZERO, *arguments, ONE], [*arguments, ONE], arguments
        return self._struct(resty, *ranges[len(arguments) - 1])

    def _shape(self, expr: Any) -> Any:
        """Return the shape, an LLVM array of integers, that an expression ``expr`` =
        ``value.shape`` of numba's IR asks for; None unless the value is an array.
        """
        if not isinstance(self.typeof(expr.value.name), types.Array):
            return None
        return self.builder.extract_value(self.loadvar(expr.value.name), SHAPE)

    def _struct(self, kind: Any, *fields: Any) -> Any:
        """Return an LLVM structure of numba type ``kind`` with these fields, LLVM values."""
        struct = ir.Constant(self.context.get_value_type(kind), ir.Undefined)
        for k, value in enumerate(fields):
            struct = self.builder.insert_value(struct, value, k)
        return struct

    def _iterator(self, resty: Any, expr: Any) -> Any:
        """Return the LLVM structure of an iterator, of numba type ``resty``, over the range of
        int64 with a constant step that ``expr`` iterates over; None for other iterators.

        Its state is on the stack, as in numba: the next value and the number of steps to go.
        """
        if self.typeof(expr.value.name) != types.range_state64_type:
            return None
        state, builder = self.loadvar(expr.value.name), self.builder
        start, stop, step = (builder.extract_value(state, k) for k in range(3))
        # Other steps are left to numba, which raises an error if they are 0.
        if not (isinstance(step, ir.Constant) and step.constant):
            return None
        next_value, count = (self.alloca_lltype(name, I64) for name in ("following", "count"))
        builder.store(start, next_value)
        self._store_count(count, builder.sub(stop, start), step)
        return self._struct(resty, next_value, stop, step, count)

    def _store_count(self, count: Any, difference: Any, step: Any) -> None:
        """Store the number of steps of a range, at least 0, at the address ``count``, from
        ``difference`` = stop - start and a constant ``step``, all LLVM values.
        """
        builder = self.builder
        positive = builder.icmp_signed(">", difference, ZERO)
        is_empty = builder.not_(positive) if step.constant > 0 else positive
        with builder.if_else(is_empty) as (then, otherwise):
            with then:
                builder.store(ZERO, count)
            with otherwise:
                remainder = builder.srem(difference, step)
                remainder = builder.select(positive, remainder, builder.neg(remainder))
                extra_step = builder.select(builder.icmp_signed(">", remainder, ZERO), ONE, ZERO)
                builder.store(builder.add(builder.sdiv(difference, step), extra_step), count)

    def _next(self, resty: Any, expr: Any) -> Any:
        """Return the pair (current value, True while there are more), of numba type ``resty``, of
        the range iterator in ``expr``, and advance it; None for other iterators.
        """
        if self.typeof(expr.value.name) != types.range_iter64_type:
            return None
        state, builder = self.loadvar(expr.value.name), self.builder
        # The structure of _iterator(): next value, stop, step and number of steps to go.
        next_value, step, remaining = (builder.extract_value(state, k) for k in (0, 2, 3))
        count = builder.load(remaining)
        valid = builder.icmp_signed(">", count, ZERO)
        outside = builder.block
        with builder.if_then(valid):
            value = builder.load(next_value)
            builder.store(builder.sub(count, ONE, flags=["nsw"]), remaining)
            builder.store(builder.add(value, step), next_value)
            in_loop = builder.block
        current = builder.phi(I64)
        current.add_incoming(value, in_loop)
        current.add_incoming(ZERO, outside)
        return self._struct(resty, current, valid)


@register_pass(mutates_CFG=True, analysis_only=False)
class ValueLowering(NativeLowering):
    """numba's lowering pass with ValueLower."""

    _name = "value_lowering"
    lowering_class: Any = ValueLower


# Errors.


def never_fails(function: Any) -> bool:
    """Return True if every return of an LLVM function has the status 0 (no exception)."""
    ends = [block.terminator for block in function.blocks]
    returned = [end.return_value for end in ends if isinstance(end, instructions.Ret)]
    return all(isinstance(code, ir.Constant) and code.constant == 0 for code in returned)


def call_without_errors(user_function: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap numba's ``user_function``, which emits calls of compiled functions, so that calls of
    functions that never raise are not followed by a test of their status.
    """

    def user_function_without_errors(fndesc: Any, libs: Any) -> Any:
        """Return the emitter of calls of one compiled function, as ``user_function`` does."""
        checking_call = user_function(fndesc, libs)

        def call(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            """Emit a call, with a test of its status unless the callee never raises."""
            is_plain = not isinstance(sig.return_type, types.Optional)
            if not (is_plain and fndesc.llvm_func_name in _NEVER_FAIL):
                return checking_call(context, builder, sig, args)
            convention = context.call_conv
            callee = context.declare_function(builder.module, fndesc)
            result_type = callee.args[0].type.pointee
            # The callee always writes its result and never its error argument.
            result = cgutils.alloca_once(builder, result_type)
            error = convention._get_excinfo_argument(builder.function)
            packed_args = convention._get_arg_packer(fndesc.argtypes).as_arguments(builder, args)
            builder.call(callee, [result, error, *packed_args])
            return context.get_returned_value(builder, fndesc.restype, builder.load(result))

        call.signature, call.libs = checking_call.signature, checking_call.libs  # type: ignore[attr-defined]
        return call

    return user_function_without_errors


# Dead code.


def remove_unread(function: Any) -> None:
    """Remove instructions without side effects whose results are not read, and stack variables that
    are only written, from an LLVM function.
    """
    all_instructions = [
        instruction for block in function.blocks for instruction in block.instructions
    ]
    readers = _count_readers(all_instructions)
    unread: set[int] = set()
    # Backwards, so that an instruction read only by removed ones is removed too.
    for instruction in reversed(all_instructions):
        # ``get``, since indexing a Counter with a missing key is slow.
        if type(instruction) in WITHOUT_EFFECT and not readers.get(id(instruction)):
            unread.add(id(instruction))
            for value in instruction.operands:
                readers[id(value)] -= 1
    unread |= _written_only(all_instructions, readers)
    for block in function.blocks:
        block.instructions[:] = [
            instruction for instruction in block.instructions if id(instruction) not in unread
        ]


def _count_readers(all_instructions: list[Any]) -> Counter[int]:
    """Return how many operands of instructions each value is, by its id."""
    readers = Counter(
        [id(value) for instruction in all_instructions for value in instruction.operands]
    )
    for instruction in all_instructions:
        if isinstance(instruction, instructions.PhiInstr):
            readers.update(id(value) for value, _ in instruction.incomings)
    return readers


def _written_only(all_instructions: list[Any], readers: Counter[int]) -> set[int]:
    """Return the ids of stack variables that are only written, and of the stores to them;
    ``readers`` is how many operands each value is, by its id.
    """
    stores = [
        instruction
        for instruction in all_instructions
        if type(instruction) is instructions.StoreInstr
    ]
    # Operand 1 of a store is the address that it writes to: all readers of the variable are stores.
    writers = Counter([id(store.operands[1]) for store in stores])
    unread = {
        id(variable)
        for variable in all_instructions
        if type(variable) is instructions.AllocaInstr
        and readers.get(id(variable)) == writers.get(id(variable))
    }
    return unread | {id(store) for store in stores if id(store.operands[1]) in unread}
