"""The matcher over integers: `patterns.engine.matcher` for many rules at once, compiled.

The same algorithm, with the same contract, for the machines that `patterns.engine.packed` can express.
Rules are tables of integers, rows are records of integers, and what partitions remember lives in
pools of records that refer to each other by number; -1 is none. It differs from the general matcher
in one thing that no match shows: a row that only the next row can make the beginning of a match is
kept as the last row of its partition, not as a partial match.

The functions are compiled once and kept in numba's cache. None of them allocates: who calls them
gives pools with room, and when there is too little, they stop before a row and say so.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from patterns.engine.jit import compiled, compiled_with_memory, inlined

Integers = NDArray[np.int64]

# A row: time, sequence, stream, which slots are NULL; then its words of bits; then its slots.
R_TIME, R_SEQUENCE, R_STREAM, R_NULLS, R_BITS = 0, 1, 2, 3, 4

# A rule.
(U_START, U_WITHIN, U_SKIP, U_SKIP_VARIABLES, U_MERGES, U_REGISTERS, U_NULLS, U_UNSET, U_THREADS_MOST,
 U_PAIRS, U_PAIRS_END, U_LOOKS_BACK, U_IS_STRICT, U_BASE) = range(14)  # fmt: skip
U_WIDTH = 14
SKIP_PAST_LAST_ROW, SKIP_TO_NEXT_ROW, SKIP_TO_FIRST, SKIP_TO_LAST = 0, 1, 2, 3

# A position.
P_ACCEPTS, P_VARIABLE, P_GUARD, P_GUARD_END, P_UPDATES, P_UPDATES_END, P_LIVE, P_LIVE_END, P_IS_EARLY = range(9)
P_WIDTH = 9

# How a register takes a row.
FIRST, LAST, ROWS, VALUES, SUM, MIN, MAX, F_SUM, F_MIN, F_MAX = range(10)

# What a partition remembers of one rule.
C_RULE, C_PARTITION, C_NEXT, C_FIRST, C_LAST, C_RESUME, C_THREADS, C_ATTEMPTS = range(8)
C_WIDTH = 8
# The matches that begin at one row; E_ is the best match so far.
A_NEXT, A_ORDINAL, A_STREAM, A_SEQUENCE, A_TIME, A_THREAD, E_THREAD, E_STREAM, E_SEQUENCE, E_TIME, E_ORDINAL, A_END = (
    range(12)
)
A_WIDTH = 12
# A partial match, or a match; its registers stand in a table of their own at the same number.
T_NEXT, T_POSITION, T_TRACE, T_NULLS, T_UNSET = range(5)
T_WIDTH = 5
# A run of rows of one variable and one stream.
X_PARENT, X_VARIABLE, X_STREAM, X_FIRST, X_LAST, X_ORDINAL, X_ROWS, X_REFERENCES = range(8)
X_WIDTH = 8
# A final match, or what a limit cost.
(F_RULE, F_PARTITION, F_STREAM, F_SEQUENCE, F_TIME, F_THREAD, F_END_STREAM, F_END_SEQUENCE, F_END_TIME,
 F_END_ORDINAL, F_HOW, F_DECIDED_TIME, F_DECIDED_STREAM, F_DECIDED_SEQUENCE) = range(14)  # fmt: skip
F_WIDTH = 14
BY_ROW, BY_TIME, BY_END, GIVEN_UP = 0, 1, 2, 3

# Where free records begin, and how many there are.
FREE_CELL, FREE_ATTEMPT, FREE_THREAD, FREE_TRACE, CELLS, ATTEMPTS, THREADS, TRACES, FOUND, DUE = range(10)
# How many have to be free, where there was too little room.
NEED_CELLS, NEED_ATTEMPTS, NEED_THREADS, NEED_TRACES, NEED_FOUND = range(10, 15)
CONTROLS = 15

BITS = 64
"""bits a word"""
ALONE, FOLLOWED = 0, 1
"""A match may begin because of a row by itself, or because of the row and the next."""
FINE, GROW = 0, 1
"""A step is done; or it needs more room and is to be called again."""
SKIP_NOWHERE, SKIP_FOR_EVER, TOO_MANY_THREADS = 1, 2, 3
"""Why a rule was set aside."""

NEVER = np.int64(2**62)
_STAMP, _ROW_STAMP, _ENTRIES, _MEMO = 0, 1, 2, 3


class Tables(NamedTuple):
    """The rules, as integers; positions are numbered through all rules."""

    rules: Integers
    positions: Integers
    follow_at: Integers
    follow: Integers
    masks: Integers
    code: Integers
    updates: Integers
    live: Integers
    pairs: Integers
    """for each beginning: where its next masks begin and end; equal: no next row is needed"""
    first_masks: Integers
    next_masks: Integers
    watched: Integers
    """(2, words + 1): for beginnings `ALONE` and `FOLLOWED` the bits that name some in `watch`; the last is no bit"""
    watch_at: Integers
    """where what a bit names begins in `watch`, first for `ALONE`, then for `FOLLOWED`"""
    watch: Integers
    """a rule, its beginning in `pairs`, and one of its next masks, or -1"""
    fan: Integers
    """in its one place, the longest list in `follow`"""


class State(NamedTuple):
    """What is remembered: pools, and by partition its last row, that row's number, and its first cell."""

    controls: Integers
    cells: Integers
    attempts: Integers
    threads: Integers
    registers: Integers
    traces: Integers
    found: Integers
    last_rows: Integers
    last_ordinals: Integers
    first_cells: Integers
    failures: Integers
    """by rule: 0, or why it was set aside"""


class Scratch(NamedTuple):
    """Room to work in; nothing in it outlives a call."""

    controls: Integers
    position_stamps: Integers
    position_safe: Integers
    hash_stamps: Integers
    hash_positions: Integers
    hash_threads: Integers
    hash_safe: Integers
    started: Integers
    starts: Integers
    other_starts: Integers
    memo: Integers
    stack: Integers
    stack_nulls: Integers
    work: Integers
    """by rule, how much was done for it since this was last taken: places tried, and instructions of guards"""


# Guards: a postfix program over words of 64 bits, which are integers or the bits of floats.
(OP_CONST, OP_NULL, OP_SLOT, OP_REGISTER, OP_AND, OP_OR, OP_NOT, OP_IS_NULL, OP_COALESCE, OP_CASE,
 OP_EQ, OP_NE, OP_LT, OP_LE, OP_GT, OP_GE, OP_ADD, OP_SUB, OP_MUL, OP_DIV, OP_MOD, OP_NEG, OP_ABS,
 OP_LEAST, OP_GREATEST,
 OP_F_EQ, OP_F_NE, OP_F_LT, OP_F_LE, OP_F_GT, OP_F_GE, OP_F_ADD, OP_F_SUB, OP_F_MUL, OP_F_DIV, OP_F_NEG, OP_F_ABS,
 OP_F_LEAST, OP_F_GREATEST, OP_FLOAT, OP_SQRT, OP_SCALE, OP_SHRINK, OP_RATIO) = range(44)  # fmt: skip
STACK = 64
_BEYOND = 2.0**63


@compiled
def _compared(op, left, right):
    if op == OP_EQ:
        return left == right
    if op == OP_NE:
        return left != right
    if op == OP_LT:
        return left < right
    if op == OP_LE:
        return left <= right
    if op == OP_GT:
        return left > right
    return left >= right


@compiled
def _quotient(left, right):
    """Truncated towards zero; `right` is not zero."""
    if right == -1:
        return -left
    quotient = left // right
    if quotient < 0 and quotient * right != left:
        quotient += 1
    return quotient


@compiled
def _strict(op, at, stack, floats, nulls):
    """Operators of two operands, neither NULL; their value replaces the first."""
    if OP_EQ <= op <= OP_GE:
        stack[at] = _compared(op, stack[at], stack[at + 1])
    elif OP_F_EQ <= op <= OP_F_GE:
        stack[at] = _compared(op - OP_F_EQ + OP_EQ, floats[at], floats[at + 1])
    elif op == OP_ADD:
        stack[at] += stack[at + 1]
    elif op == OP_SUB:
        stack[at] -= stack[at + 1]
    elif op == OP_MUL:
        stack[at] *= stack[at + 1]
    elif OP_DIV <= op <= OP_MOD:
        if stack[at + 1] == 0:
            nulls[at] = 1
        else:
            quotient = _quotient(stack[at], stack[at + 1])
            stack[at] = quotient if op == OP_DIV else stack[at] - quotient * stack[at + 1]
    elif op == OP_LEAST:
        stack[at] = min(stack[at], stack[at + 1])
    elif op == OP_GREATEST:
        stack[at] = max(stack[at], stack[at + 1])
    elif op == OP_F_ADD:
        floats[at] += floats[at + 1]
    elif op == OP_F_SUB:
        floats[at] -= floats[at + 1]
    elif op == OP_F_MUL:
        floats[at] *= floats[at + 1]
    elif op == OP_F_LEAST:
        floats[at] = floats[at] if floats[at] <= floats[at + 1] else floats[at + 1]
    elif op == OP_F_GREATEST:
        floats[at] = floats[at] if floats[at] >= floats[at + 1] else floats[at + 1]
    elif op == OP_SCALE:
        _round(float(stack[at]) * floats[at + 1], at, stack, nulls)
    elif op == OP_SHRINK and floats[at + 1] != 0.0:
        _round(float(stack[at]) / floats[at + 1], at, stack, nulls)
    elif op == OP_F_DIV and floats[at + 1] != 0.0:
        floats[at] /= floats[at + 1]
    elif op == OP_RATIO and stack[at + 1] != 0:
        floats[at] = float(stack[at]) / float(stack[at + 1])
    else:
        nulls[at] = 1


@compiled
def _round(microseconds, at, stack, nulls):
    if abs(microseconds) < _BEYOND:
        stack[at] = np.int64(np.rint(microseconds))
    else:
        nulls[at] = 1


@compiled
def _unary(op, at, stack, floats, nulls):
    if op == OP_NOT:
        stack[at] = 1 - stack[at]
    elif op == OP_NEG:
        stack[at] = -stack[at]
    elif op == OP_ABS:
        stack[at] = abs(stack[at])
    elif op == OP_F_NEG:
        floats[at] = -floats[at]
    elif op == OP_F_ABS:
        floats[at] = abs(floats[at])
    elif op == OP_FLOAT:
        floats[at] = float(stack[at])
    elif floats[at] < 0.0:
        nulls[at] = 1
    else:
        floats[at] = np.sqrt(floats[at])


@compiled
def _is_true(tables, state, scratch, begin, end, rows, row, slots_at, thread):
    """Whether the guard of these instructions is true; neither false nor NULL."""
    stack, nulls = scratch.stack, scratch.stack_nulls
    floats = stack.view(np.float64)
    top = -1
    for at in range(begin, end):
        op, argument = tables.code[at, 0], tables.code[at, 1]
        if op == OP_SLOT:
            top += 1
            stack[top] = rows[row, slots_at + argument]
            nulls[top] = (rows[row, R_NULLS] >> argument) & 1
        elif op == OP_REGISTER:
            top += 1
            stack[top] = state.registers[thread, argument]
            nulls[top] = (state.threads[thread, T_NULLS] >> argument) & 1
        elif op == OP_CONST:
            top += 1
            stack[top] = argument
            nulls[top] = 0
        elif op == OP_NULL:
            top += 1
            stack[top] = 0
            nulls[top] = 1
        elif op == OP_AND:
            top -= 1
            is_false = (nulls[top] == 0 and stack[top] == 0) or (nulls[top + 1] == 0 and stack[top + 1] == 0)
            nulls[top] = 0 if is_false else nulls[top] | nulls[top + 1]
            stack[top] = 0 if is_false else 1
        elif op == OP_OR:
            top -= 1
            is_true = (nulls[top] == 0 and stack[top] != 0) or (nulls[top + 1] == 0 and stack[top + 1] != 0)
            nulls[top] = 0 if is_true else nulls[top] | nulls[top + 1]
            stack[top] = 1 if is_true else 0
        elif op == OP_IS_NULL:
            stack[top] = nulls[top]
            nulls[top] = 0
        elif op == OP_COALESCE:
            top -= 1
            if nulls[top] != 0:
                stack[top], nulls[top] = stack[top + 1], nulls[top + 1]
        elif op == OP_CASE:
            top -= 2
            chosen = top + 1 if nulls[top] == 0 and stack[top] != 0 else top + 2
            stack[top], nulls[top] = stack[chosen], nulls[chosen]
        elif op == OP_NOT or OP_NEG <= op <= OP_ABS or OP_F_NEG <= op <= OP_F_ABS or OP_FLOAT <= op <= OP_SQRT:
            if nulls[top] == 0:
                _unary(op, top, stack, floats, nulls)
        else:
            top -= 1
            if nulls[top] == 0 and nulls[top + 1] == 0:
                _strict(op, top, stack, floats, nulls)
            else:
                nulls[top] = 1
    return nulls[0] == 0 and stack[0] != 0


# Records.


@inlined
def _release(state, trace):
    """One reference to the trace less; what nothing refers to any more is free."""
    traces, controls = state.traces, state.controls
    while trace >= 0:
        traces[trace, X_REFERENCES] -= 1
        if traces[trace, X_REFERENCES] > 0:
            return
        parent = traces[trace, X_PARENT]
        traces[trace, X_PARENT] = controls[FREE_TRACE]
        controls[FREE_TRACE] = trace
        controls[TRACES] += 1
        trace = parent


@inlined
def _extended(state, trace, variable, rows, row, ordinal):
    """The trace with one row more, as a new record."""
    traces, controls = state.traces, state.controls
    new = controls[FREE_TRACE]
    controls[FREE_TRACE] = traces[new, X_PARENT]
    controls[TRACES] -= 1
    stream, sequence = rows[row, R_STREAM], rows[row, R_SEQUENCE]
    traces[new, X_VARIABLE] = variable
    traces[new, X_STREAM] = stream
    traces[new, X_LAST] = sequence
    traces[new, X_REFERENCES] = 1
    goes_on = (
        trace >= 0
        and traces[trace, X_VARIABLE] == variable
        and traces[trace, X_STREAM] == stream
        and traces[trace, X_LAST] < sequence
    )
    if goes_on:
        parent = traces[trace, X_PARENT]
        traces[new, X_FIRST] = traces[trace, X_FIRST]
        traces[new, X_ORDINAL] = traces[trace, X_ORDINAL]
        traces[new, X_ROWS] = traces[trace, X_ROWS] + 1
    else:
        parent = trace
        traces[new, X_FIRST] = sequence
        traces[new, X_ORDINAL] = ordinal
        traces[new, X_ROWS] = 1
    traces[new, X_PARENT] = parent
    if parent >= 0:
        traces[parent, X_REFERENCES] += 1
    return new


@inlined
def _lengthened(state, trace, variable, rows, row, ordinal):
    """The trace with one row more, for who gives up the trace as it was."""
    traces = state.traces
    if (
        trace >= 0
        and traces[trace, X_REFERENCES] == 1
        and traces[trace, X_VARIABLE] == variable
        and traces[trace, X_STREAM] == rows[row, R_STREAM]
        and traces[trace, X_LAST] < rows[row, R_SEQUENCE]
    ):
        traces[trace, X_LAST] = rows[row, R_SEQUENCE]
        traces[trace, X_ROWS] += 1
        return trace
    longer = _extended(state, trace, variable, rows, row, ordinal)
    _release(state, trace)
    return longer


@inlined
def _take_thread(state):
    new = state.controls[FREE_THREAD]
    state.controls[FREE_THREAD] = state.threads[new, T_NEXT]
    state.controls[THREADS] -= 1
    return new


@inlined
def _free_thread(state, thread):
    _release(state, state.threads[thread, T_TRACE])
    state.threads[thread, T_TRACE] = -1
    state.threads[thread, T_NEXT] = state.controls[FREE_THREAD]
    state.controls[FREE_THREAD] = thread
    state.controls[THREADS] += 1


@inlined
def _copy(state, source, target, registers):
    for at in range(registers):
        state.registers[target, at] = state.registers[source, at]
    state.threads[target, T_NULLS] = state.threads[source, T_NULLS]
    state.threads[target, T_UNSET] = state.threads[source, T_UNSET]


@compiled
def _free_threads(state, attempt):
    thread = state.attempts[attempt, A_THREAD]
    while thread >= 0:
        following = state.threads[thread, T_NEXT]
        _free_thread(state, thread)
        thread = following
    state.attempts[attempt, A_THREAD] = -1


@compiled
def _free_attempt(state, attempt):
    """The attempt's records are free again; a match that was handed on is not among them."""
    _free_threads(state, attempt)
    if state.attempts[attempt, E_THREAD] >= 0:
        _free_thread(state, state.attempts[attempt, E_THREAD])
        state.attempts[attempt, E_THREAD] = -1
    state.attempts[attempt, A_NEXT] = state.controls[FREE_ATTEMPT]
    state.controls[FREE_ATTEMPT] = attempt
    state.controls[ATTEMPTS] += 1


@compiled
def _clear_cell(state, cell):
    """All attempts of the cell are gone."""
    attempt = state.cells[cell, C_FIRST]
    while attempt >= 0:
        following = state.attempts[attempt, A_NEXT]
        _free_attempt(state, attempt)
        attempt = following
    state.cells[cell, C_FIRST] = state.cells[cell, C_LAST] = -1
    state.cells[cell, C_THREADS] = state.cells[cell, C_ATTEMPTS] = 0


@compiled
def _new_cell(state, rule, partition):
    cells, controls = state.cells, state.controls
    cell = controls[FREE_CELL]
    controls[FREE_CELL] = cells[cell, C_NEXT]
    controls[CELLS] -= 1
    cells[cell, C_RULE], cells[cell, C_PARTITION] = rule, partition
    cells[cell, C_NEXT] = state.first_cells[partition]
    cells[cell, C_FIRST] = cells[cell, C_LAST] = -1
    cells[cell, C_RESUME] = cells[cell, C_THREADS] = cells[cell, C_ATTEMPTS] = 0
    state.first_cells[partition] = cell
    return cell


@compiled
def _free_cell(state, cell, before):
    """The cell is free and no longer in its partition's list, where it stood after `before`."""
    cells, controls = state.cells, state.controls
    _clear_cell(state, cell)
    following = cells[cell, C_NEXT]
    if before >= 0:
        cells[before, C_NEXT] = following
    else:
        state.first_cells[cells[cell, C_PARTITION]] = following
    cells[cell, C_RULE] = -1
    cells[cell, C_NEXT] = controls[FREE_CELL]
    controls[FREE_CELL] = cell
    controls[CELLS] += 1


@compiled
def _remove_attempts(state, cell, after, from_ordinal, below_ordinal):
    """Removes attempts behind `after` (-1: from the first on) with `from <= ordinal < below`; those failed too."""
    cells, attempts = state.cells, state.attempts
    attempt = cells[cell, C_FIRST] if after < 0 else attempts[after, A_NEXT]
    kept = after
    while attempt >= 0:
        following = attempts[attempt, A_NEXT]
        ordinal = attempts[attempt, A_ORDINAL]
        has_failed = attempts[attempt, A_THREAD] < 0 and attempts[attempt, E_THREAD] < 0
        if has_failed or from_ordinal <= ordinal < below_ordinal:
            _free_attempt(state, attempt)
            cells[cell, C_ATTEMPTS] -= 1
            if kept < 0:
                cells[cell, C_FIRST] = following
            else:
                attempts[kept, A_NEXT] = following
        else:
            kept = attempt
        attempt = following
    cells[cell, C_LAST] = kept


# One row.


@inlined
def _has(rows, row, masks, mask, words):
    for word in range(words):
        wanted = masks[mask, word]
        if rows[row, R_BITS + word] & wanted != wanted:
            return False
    return True


@inlined
def _update(tables, state, position, rows, row, slots_at, thread):
    registers, threads = state.registers, state.threads
    for at in range(tables.positions[position, P_UPDATES], tables.positions[position, P_UPDATES_END]):
        register, how, slot = tables.updates[at, 0], tables.updates[at, 1], tables.updates[at, 2]
        bit = np.int64(1) << register
        if how == ROWS:
            registers[thread, register] += 1
            continue
        is_null = (rows[row, R_NULLS] >> slot) & 1
        if how == VALUES:
            registers[thread, register] += 1 - is_null
            continue
        if how == FIRST and threads[thread, T_UNSET] & bit == 0:
            continue
        if how >= SUM:
            if not is_null:
                _combine(registers, thread, register, how, rows, row, slots_at + slot, threads[thread, T_NULLS] & bit)
                threads[thread, T_NULLS] &= ~bit
            continue
        registers[thread, register] = 0 if is_null else rows[row, slots_at + slot]
        threads[thread, T_UNSET] &= ~bit
        threads[thread, T_NULLS] = threads[thread, T_NULLS] | bit if is_null else threads[thread, T_NULLS] & ~bit


@compiled
def _combine(registers, thread, register, how, rows, row, column, holds_nothing):
    """A sum or an extreme takes one value more."""
    if holds_nothing:
        registers[thread, register] = rows[row, column]
    elif how == SUM:
        registers[thread, register] += rows[row, column]
    elif how == MIN:
        registers[thread, register] = min(registers[thread, register], rows[row, column])
    elif how == MAX:
        registers[thread, register] = max(registers[thread, register], rows[row, column])
    else:
        floats = registers.view(np.float64)
        held, value = floats[thread, register], rows.view(np.float64)[row, column]
        if how == F_SUM:
            floats[thread, register] = held + value
        elif how == F_MIN:
            floats[thread, register] = held if held <= value else value
        else:
            floats[thread, register] = held if held >= value else value


@inlined
def _is_new(tables, state, scratch, position, thread, start, safe_until):
    """Whether no thread before has this position and these live registers and stands for this start too."""
    stamp = scratch.controls[_STAMP]
    begin, end = tables.positions[position, P_LIVE], tables.positions[position, P_LIVE_END]
    if begin == end:
        if scratch.position_stamps[position] == stamp and scratch.position_safe[position] >= start:
            return False
        scratch.position_stamps[position] = stamp
        scratch.position_safe[position] = safe_until
        return True
    hashed = position
    for at in range(begin, end):
        hashed = (hashed ^ state.registers[thread, tables.live[at]]) * np.int64(-7046029254386353131)
        hashed ^= hashed >> 29
    most = len(scratch.hash_stamps) - 1
    at = hashed & most
    while scratch.hash_stamps[at] == stamp:
        if scratch.hash_positions[at] == position and _same(
            tables, state, begin, end, scratch.hash_threads[at], thread
        ):
            if scratch.hash_safe[at] >= start:
                return False
            break
        at = (at + 1) & most
    if scratch.hash_stamps[at] != stamp:
        scratch.controls[_ENTRIES] += 1
    scratch.hash_stamps[at] = stamp
    scratch.hash_positions[at] = position
    scratch.hash_threads[at] = thread
    scratch.hash_safe[at] = safe_until
    return True


@compiled
def _same(tables, state, begin, end, one, other):
    registers, threads = state.registers, state.threads
    differ = (threads[one, T_NULLS] ^ threads[other, T_NULLS]) | (threads[one, T_UNSET] ^ threads[other, T_UNSET])
    for at in range(begin, end):
        register = tables.live[at]
        if registers[one, register] != registers[other, register] or (differ >> register) & 1:
            return False
    return True


@inlined
def _passes(tables, state, scratch, position, rows, row, slots_at, thread):
    begin, end = tables.positions[position, P_GUARD], tables.positions[position, P_GUARD_END]
    return begin == end or _is_true(tables, state, scratch, begin, end, rows, row, slots_at, thread)


@inlined
def _settle(state, attempt, thread, rows, row, ordinal):
    """This thread is the attempt's best match so far."""
    attempts = state.attempts
    if attempts[attempt, E_THREAD] >= 0:
        _free_thread(state, attempts[attempt, E_THREAD])
    attempts[attempt, E_THREAD] = thread
    attempts[attempt, E_STREAM] = rows[row, R_STREAM]
    attempts[attempt, E_SEQUENCE] = rows[row, R_SEQUENCE]
    attempts[attempt, E_TIME] = rows[row, R_TIME]
    attempts[attempt, E_ORDINAL] = ordinal


@inlined
def _advance(tables, state, scratch, rule, attempt, rows, row, ordinal, safe_until, most, words):
    """Every thread of the attempt takes the row, or dies; how many there are then, at most one more than `most`."""
    threads, attempts, positions = state.threads, state.attempts, tables.positions
    start = attempts[attempt, A_ORDINAL]
    registers, base = tables.rules[rule, U_REGISTERS], tables.rules[rule, U_BASE]
    merges = tables.rules[rule, U_MERGES] != 0
    slots_at = R_BITS + words
    thread = attempts[attempt, A_THREAD]
    attempts[attempt, A_THREAD] = -1
    tail, count, is_settled, work = -1, 0, False, 0
    while thread >= 0:
        following, is_free = threads[thread, T_NEXT], True
        if not is_settled and count <= most:
            position = base + threads[thread, T_POSITION]
            last = tables.follow_at[position + 1] - 1
            for at in range(tables.follow_at[position], last + 1):
                target = tables.follow[at]
                work += 1
                if not _has(rows, row, tables.masks, target, words):
                    continue
                work += 8 + positions[target, P_GUARD_END] - positions[target, P_GUARD]
                is_early = positions[target, P_IS_EARLY] != 0
                if is_early and not _passes(tables, state, scratch, target, rows, row, slots_at, thread):
                    continue
                # What goes the last way that there is goes as it is.
                is_same = at == last
                new = thread if is_same else state.controls[FREE_THREAD]
                if not is_same:
                    _copy(state, thread, new, registers)
                _update(tables, state, target, rows, row, slots_at, new)
                if not is_early and not _passes(tables, state, scratch, target, rows, row, slots_at, new):
                    continue
                is_only = is_same and following < 0 and count == 0 and not merges
                if not is_only and not _is_new(tables, state, scratch, target, new, start, safe_until):
                    continue
                variable = positions[target, P_VARIABLE]
                if is_same:
                    is_free = False
                    threads[new, T_TRACE] = _lengthened(state, threads[new, T_TRACE], variable, rows, row, ordinal)
                else:
                    _take_thread(state)
                    threads[new, T_TRACE] = _extended(state, threads[thread, T_TRACE], variable, rows, row, ordinal)
                threads[new, T_POSITION] = target - base
                threads[new, T_NEXT] = -1
                goes_on = tables.follow_at[target] < tables.follow_at[target + 1]
                if goes_on:
                    if tail < 0:
                        attempts[attempt, A_THREAD] = new
                    else:
                        threads[tail, T_NEXT] = new
                    tail = new
                    count += 1
                if positions[target, P_ACCEPTS]:
                    ending = new
                    if goes_on:
                        ending = _take_thread(state)
                        _copy(state, new, ending, registers)
                        threads[ending, T_POSITION] = target - base
                        threads[ending, T_TRACE] = threads[new, T_TRACE]
                        state.traces[threads[new, T_TRACE], X_REFERENCES] += 1
                    threads[ending, T_NEXT] = -1
                    _settle(state, attempt, ending, rows, row, ordinal)
                    is_settled = True
                    break
                if count > most:
                    break
        if is_free:
            _free_thread(state, thread)
        thread = following
    scratch.work[rule] += work
    return count


@inlined
def _begin(tables, state, cell, rule, rows, row, ordinal):
    """A match may begin at this row."""
    cells, attempts, controls = state.cells, state.attempts, state.controls
    attempt = controls[FREE_ATTEMPT]
    controls[FREE_ATTEMPT] = attempts[attempt, A_NEXT]
    controls[ATTEMPTS] -= 1
    attempts[attempt, A_NEXT] = -1
    attempts[attempt, A_ORDINAL] = ordinal
    attempts[attempt, A_STREAM] = rows[row, R_STREAM]
    attempts[attempt, A_SEQUENCE] = rows[row, R_SEQUENCE]
    attempts[attempt, A_TIME] = rows[row, R_TIME]
    attempts[attempt, E_THREAD] = -1
    thread = _take_thread(state)
    attempts[attempt, A_THREAD] = thread
    state.threads[thread, T_NEXT] = state.threads[thread, T_TRACE] = -1
    state.threads[thread, T_POSITION] = tables.rules[rule, U_START] - tables.rules[rule, U_BASE]
    state.threads[thread, T_NULLS] = tables.rules[rule, U_NULLS]
    state.threads[thread, T_UNSET] = tables.rules[rule, U_UNSET]
    for at in range(tables.rules[rule, U_REGISTERS]):
        state.registers[thread, at] = 0
    if cells[cell, C_LAST] < 0:
        cells[cell, C_FIRST] = attempt
    else:
        attempts[cells[cell, C_LAST], A_NEXT] = attempt
    cells[cell, C_LAST] = attempt
    cells[cell, C_ATTEMPTS] += 1
    within = tables.rules[rule, U_WITHIN]
    if within >= 0:
        controls[DUE] = min(controls[DUE], rows[row, R_TIME] + within)
    return attempt


@inlined
def _step(tables, state, scratch, cell, rule, rows, row, ordinal, words):
    """Every thread of every attempt takes the row, or dies; whether there are no more than the limit."""
    cells, attempts = state.cells, state.attempts
    merges = tables.rules[rule, U_MERGES] != 0
    most = tables.rules[rule, U_THREADS_MOST]
    scratch.controls[_STAMP] += 1
    scratch.controls[_ENTRIES] = 0
    threads, are_ends = 0, False
    attempt = cells[cell, C_FIRST]
    while attempt >= 0:
        safe_until = NEVER
        if not merges:
            scratch.controls[_STAMP] += 1
        elif are_ends:
            safe_until = _nearest_end(state, cells[cell, C_FIRST], attempt)
        attempts[attempt, A_END] = -1
        if attempts[attempt, E_THREAD] >= 0:
            attempts[attempt, A_END] = attempts[attempt, E_ORDINAL]
            are_ends = True
        if attempts[attempt, A_THREAD] >= 0:
            threads += _advance(
                tables, state, scratch, rule, attempt, rows, row, ordinal, safe_until, most - threads, words
            )
            if threads > most:
                cells[cell, C_THREADS] = threads
                return False
        attempt = attempts[attempt, A_NEXT]
    cells[cell, C_THREADS] = threads
    return True


@compiled
def _nearest_end(state, attempt, until):
    """Of the matches that earlier attempts had before this row, the first end at or after the start of `until`."""
    attempts = state.attempts
    start, nearest = attempts[until, A_ORDINAL], NEVER
    while attempt != until:
        if attempts[attempt, A_END] >= start:
            nearest = min(nearest, attempts[attempt, A_END])
        attempt = attempts[attempt, A_NEXT]
    return nearest


@compiled
def _resolve(tables, state, cell, rule, how, time, stream, sequence):
    """Hands on the matches that nothing earlier or more preferred can still replace; 0, or why that failed."""
    cells, attempts = state.cells, state.attempts
    first = cells[cell, C_FIRST]
    if first < 0:
        return 0
    if (
        how == BY_ROW
        and tables.rules[rule, U_SKIP] == SKIP_PAST_LAST_ROW
        and attempts[first, E_THREAD] >= 0
        and attempts[first, A_NEXT] >= 0
    ):
        _remove_attempts(state, cell, first, 0, attempts[first, E_ORDINAL] + 1)
    _remove_attempts(state, cell, -1, 0, 0)
    first = cells[cell, C_FIRST]
    while first >= 0 and attempts[first, A_THREAD] < 0:
        resume = _resume(tables, state, rule, first)
        _hand_on(state, cell, first, how, time, stream, sequence)
        if resume < 0:
            # The match tells where; the attempt has it no longer.
            attempts[first, E_THREAD] = -1
            return -resume
        cells[cell, C_RESUME] = max(cells[cell, C_RESUME], resume)
        # The match is no longer the attempt's, which so counts as failed and goes.
        attempts[first, E_THREAD] = -1
        _remove_attempts(state, cell, -1, 0, resume)
        first = cells[cell, C_FIRST]
    return 0


@compiled
def _resume(tables, state, rule, attempt):
    """The number of the row where the search goes on after the attempt's match; negative: why nowhere."""
    skip = tables.rules[rule, U_SKIP]
    if skip == SKIP_PAST_LAST_ROW:
        return state.attempts[attempt, E_ORDINAL] + 1
    if skip == SKIP_TO_NEXT_ROW:
        return state.attempts[attempt, A_ORDINAL] + 1
    traces, target = state.traces, np.int64(-1)
    trace = state.threads[state.attempts[attempt, E_THREAD], T_TRACE]
    while trace >= 0:
        if (tables.rules[rule, U_SKIP_VARIABLES] >> traces[trace, X_VARIABLE]) & 1:
            if skip == SKIP_TO_LAST:
                target = traces[trace, X_ORDINAL] + traces[trace, X_ROWS] - 1
                break
            target = traces[trace, X_ORDINAL]
        trace = traces[trace, X_PARENT]
    if target < 0:
        return -SKIP_NOWHERE
    return -SKIP_FOR_EVER if target == state.attempts[attempt, A_ORDINAL] else target


@compiled
def _hand_on(state, cell, attempt, how, time, stream, sequence):
    found, attempts = state.found, state.attempts
    at = state.controls[FOUND]
    state.controls[FOUND] += 1
    found[at, F_RULE] = state.cells[cell, C_RULE]
    found[at, F_PARTITION] = state.cells[cell, C_PARTITION]
    found[at, F_STREAM] = attempts[attempt, A_STREAM]
    found[at, F_SEQUENCE] = attempts[attempt, A_SEQUENCE]
    found[at, F_TIME] = attempts[attempt, A_TIME]
    found[at, F_THREAD] = attempts[attempt, E_THREAD]
    found[at, F_END_STREAM] = attempts[attempt, E_STREAM]
    found[at, F_END_SEQUENCE] = attempts[attempt, E_SEQUENCE]
    found[at, F_END_TIME] = attempts[attempt, E_TIME]
    found[at, F_END_ORDINAL] = attempts[attempt, E_ORDINAL]
    found[at, F_HOW] = how
    found[at, F_DECIDED_TIME] = time
    found[at, F_DECIDED_STREAM] = stream
    found[at, F_DECIDED_SEQUENCE] = sequence


@compiled
def _give_up(tables, state, cell, rule):
    """What the limit `threads` ends: the rule where it is strict, else the partial matches of this partition."""
    cells = state.cells
    if tables.rules[rule, U_IS_STRICT]:
        state.failures[rule] = TOO_MANY_THREADS
    else:
        at = state.controls[FOUND]
        state.controls[FOUND] += 1
        state.found[at, :] = 0
        state.found[at, F_RULE] = rule
        state.found[at, F_PARTITION] = cells[cell, C_PARTITION]
        state.found[at, F_TIME] = state.attempts[cells[cell, C_FIRST], A_TIME]
        state.found[at, F_THREAD] = -1
        state.found[at, F_HOW] = GIVEN_UP
        state.found[at, F_END_ORDINAL] = cells[cell, C_THREADS]
    _clear_cell(state, cell)


@compiled
def _expire(tables, state, cell, rule, until):
    """Ends the cell's attempts that no row from `until` on can belong to."""
    within = tables.rules[rule, U_WITHIN]
    attempts, cells = state.attempts, state.cells
    while within >= 0 and cells[cell, C_FIRST] >= 0:
        first = cells[cell, C_FIRST]
        deadline = attempts[first, A_TIME] + within
        if deadline > until:
            return
        _free_threads(state, first)
        failure = _resolve(tables, state, cell, rule, BY_TIME, deadline, 0, 0)
        if failure:
            state.failures[rule] = failure
            return


@inlined
def _take(tables, state, scratch, cell, rule, rows, row, ordinal, words):
    """The cell's attempts take the row, and what is final is handed on."""
    if not _step(tables, state, scratch, cell, rule, rows, row, ordinal, words):
        _give_up(tables, state, cell, rule)
        return
    failure = _resolve(tables, state, cell, rule, BY_ROW, rows[row, R_TIME], rows[row, R_STREAM], rows[row, R_SEQUENCE])
    if failure:
        state.failures[rule] = failure


# Where matches may begin.


@inlined
def _bit_of(power):
    """The number of the only bit that is set."""
    bit = 0
    if power & 0xFFFFFFFF == 0:
        bit += 32
        power >>= 32
    if power & 0xFFFF == 0:
        bit += 16
        power >>= 16
    if power & 0xFF == 0:
        bit += 8
        power >>= 8
    if power & 0xF == 0:
        bit += 4
        power >>= 4
    if power & 0x3 == 0:
        bit += 2
        power >>= 2
    return bit + 1 if power & 1 == 0 else bit


@compiled
def _candidates(tables, state, scratch, how, rows, row, next_rows, next_row, words, starts, count):
    """Adds the rules that may begin in this way and are not marked; only those are looked at that a set bit names."""
    stamp = scratch.controls[_ROW_STAMP]
    for word in range(words + 1):
        bits = tables.watched[how, word]
        if word < words:
            bits &= next_rows[next_row, R_BITS + word]
        while bits != 0:
            low = bits & -bits
            bits ^= low
            named = how * (BITS * words + 1) + BITS * word + _bit_of(low)
            for at in range(tables.watch_at[named], tables.watch_at[named + 1]):
                rule, pair, mask = tables.watch[at, 0], tables.watch[at, 1], tables.watch[at, 2]
                if scratch.started[rule] == stamp or state.failures[rule]:
                    continue
                if not _has(rows, row, tables.first_masks, pair, words):
                    continue
                if mask < 0 or _has(next_rows, next_row, tables.next_masks, mask, words):
                    scratch.started[rule] = stamp
                    starts[count] = rule
                    count += 1
    return count


@inlined
def _starts(tables, state, scratch, rows, row, next_rows, next_row, words, alone, followed, starts):
    """Writes the rules of which a match may begin at the row, and returns how many there are.

    `alone`: because of the row by itself; `followed`: because of the next, and not by itself.
    """
    scratch.controls[_ROW_STAMP] += 1
    count = _candidates(tables, state, scratch, ALONE, rows, row, rows, row, words, starts, 0)
    if not alone:
        count = 0
    if followed:
        count = _candidates(tables, state, scratch, FOLLOWED, rows, row, next_rows, next_row, words, starts, count)
    return count


@inlined
def _known_starts(tables, state, scratch, rows, row, next_row, words):
    """The same as `_starts` for a row and its next in `rows`; remembers the answer for rows of the same bits."""
    memo = scratch.memo
    is_known = memo[0] >= 0
    if is_known:
        for word in range(words):
            if memo[1 + word] != rows[row, R_BITS + word] or memo[1 + words + word] != rows[next_row, R_BITS + word]:
                is_known = False
                break
    if not is_known:
        memo[0] = _starts(tables, state, scratch, rows, row, rows, next_row, words, True, True, scratch.starts)
        for word in range(words):
            memo[1 + word] = rows[row, R_BITS + word]
            memo[1 + words + word] = rows[next_row, R_BITS + word]
    return memo[0]


# Many rows.


@inlined
def _has_room(tables, state, partition):
    cells, controls, rules = state.cells, state.controls, len(tables.rules)
    threads, attempts, count, most = 0, 0, 0, 0
    cell = state.first_cells[partition]
    while cell >= 0:
        threads += cells[cell, C_THREADS]
        attempts += cells[cell, C_ATTEMPTS]
        most = max(most, tables.rules[cells[cell, C_RULE], U_THREADS_MOST])
        count += 1
        cell = cells[cell, C_NEXT]
    needed = (threads + attempts + 2 * rules + 2) * (tables.fan[0] + 2)
    if count and needed > 4096:
        needed = min(needed, (count + 2 * rules) * (most + 4) + 2 * attempts + 4096)
    controls[NEED_THREADS] = controls[NEED_TRACES] = needed
    controls[NEED_ATTEMPTS] = controls[NEED_CELLS] = 2 * rules + 1
    controls[NEED_FOUND] = attempts + count + 3 * rules + 1
    return (
        controls[THREADS] >= needed
        and controls[TRACES] >= needed
        and controls[ATTEMPTS] > 2 * rules
        and controls[CELLS] > 2 * rules
        and len(state.found) - controls[FOUND] > attempts + count + 3 * rules
    )


@inlined
def _cell_of(state, rule, partition):
    cell = state.first_cells[partition]
    while cell >= 0 and state.cells[cell, C_RULE] != rule:
        cell = state.cells[cell, C_NEXT]
    return cell


@compiled
def _begin_before(tables, state, scratch, partition, rows, row, words):
    """Begins matches at the partition's last row, which this first new row shows to be possible."""
    last_rows = state.last_rows
    starts = scratch.other_starts
    count = _starts(tables, state, scratch, last_rows, partition, rows, row, words, False, True, starts)
    ordinal = state.last_ordinals[partition]
    for at in range(count):
        rule = starts[at]
        cell = _cell_of(state, rule, partition)
        if cell < 0:
            cell = _new_cell(state, rule, partition)
        elif state.cells[cell, C_RESUME] > ordinal:
            continue
        attempt = _begin(tables, state, cell, rule, last_rows, partition, ordinal)
        scratch.controls[_STAMP] += 1
        scratch.controls[_ENTRIES] = 0
        most = tables.rules[rule, U_THREADS_MOST]
        state.cells[cell, C_THREADS] += _advance(
            tables, state, scratch, rule, attempt, last_rows, partition, ordinal, NEVER, most, words
        )


@inlined
def _run_row(tables, state, scratch, partition, rows, row, ordinal, starts, count, words):
    cells = state.cells
    scratch.controls[_ROW_STAMP] += 1
    stamp = scratch.controls[_ROW_STAMP]
    for at in range(count):
        scratch.started[starts[at]] = stamp
    before, cell = np.int64(-1), state.first_cells[partition]
    while cell >= 0:
        following, rule = cells[cell, C_NEXT], cells[cell, C_RULE]
        if state.failures[rule] == 0:
            _expire(tables, state, cell, rule, rows[row, R_TIME])
            if scratch.started[rule] == stamp:
                scratch.started[rule] = 0
                _begin(tables, state, cell, rule, rows, row, ordinal)
            if cells[cell, C_FIRST] >= 0 and state.failures[rule] == 0:
                _take(tables, state, scratch, cell, rule, rows, row, ordinal, words)
        if state.failures[rule] or (cells[cell, C_FIRST] < 0 and cells[cell, C_RESUME] <= ordinal):
            _free_cell(state, cell, before)
        else:
            before = cell
        cell = following
    for at in range(count):
        rule = starts[at]
        if scratch.started[rule] == stamp and state.failures[rule] == 0:
            cell = _new_cell(state, rule, partition)
            _begin(tables, state, cell, rule, rows, row, ordinal)
            _take(tables, state, scratch, cell, rule, rows, row, ordinal, words)
            if cells[cell, C_FIRST] < 0 and cells[cell, C_RESUME] <= ordinal:
                _free_cell(state, cell, np.int64(-1))


@compiled
def run(tables, state, scratch, rows, order, partitions, bounds, cursor, words):
    """Runs all rules over rows of many partitions, each partition's next in their order.

    Args:
        tables: The rules.
        state: What is remembered; changed.
        scratch: Room to work in.
        rows: Records of rows.
        order: The numbers of the rows, group after group, in order.
        partitions: For each group its partition.
        bounds: Where each group begins in `order`, and the end.
        cursor: Where to go on: the group, and the place in `order` (-1: the group's begin); changed.
        words: How many words of bits a row has.

    Returns:
        FINE, or GROW: call again with more room.
    """
    for group in range(cursor[0], len(partitions)):
        partition = partitions[group]
        begin, end = bounds[group], bounds[group + 1]
        first = cursor[1] if cursor[1] >= 0 else begin
        base = state.last_ordinals[partition] + 1 - begin
        for at in range(first, end):
            row = order[at]
            if not _has_room(tables, state, partition):
                cursor[0], cursor[1] = group, at
                return GROW
            if at == begin and base + begin > 0:
                _begin_before(tables, state, scratch, partition, rows, row, words)
            starts = scratch.starts
            if at + 1 < end:
                count = _known_starts(tables, state, scratch, rows, row, order[at + 1], words)
            else:
                starts = scratch.other_starts
                count = _starts(tables, state, scratch, rows, row, rows, row, words, True, False, starts)
            if count > 0 or state.first_cells[partition] >= 0:
                _run_row(tables, state, scratch, partition, rows, row, base + at, starts, count, words)
        cursor[1] = -1
        last = order[end - 1]
        for column in range(rows.shape[1]):
            state.last_rows[partition, column] = rows[last, column]
        state.last_ordinals[partition] = base + end - 1
    cursor[0] = len(partitions)
    return FINE


@compiled
def expire(tables, state, until, is_end, cursor):
    """Ends what no row from `until` on can belong to; with `is_end`, everything.

    Args:
        tables: The rules.
        state: What is remembered; changed.
        until: A time.
        is_end: Whether there are no more rows at all.
        cursor: The cell to go on at; changed.

    Returns:
        FINE, or GROW: call again with more room.
    """
    cells, attempts = state.cells, state.attempts
    if cursor[0] == 0:
        if state.controls[DUE] > until and not is_end:
            return FINE
        state.controls[DUE] = NEVER
    for cell in range(cursor[0], len(cells)):
        rule = cells[cell, C_RULE]
        if rule < 0 or cells[cell, C_FIRST] < 0:
            continue
        if len(state.found) - state.controls[FOUND] <= cells[cell, C_ATTEMPTS]:
            cursor[0] = cell
            state.controls[NEED_FOUND] = cells[cell, C_ATTEMPTS] + 1
            return GROW
        if state.failures[rule] == 0:
            _expire(tables, state, cell, rule, until)
            if is_end:
                _end(tables, state, cell, rule)
        partition = cells[cell, C_PARTITION]
        if state.failures[rule] or (
            cells[cell, C_FIRST] < 0 and cells[cell, C_RESUME] <= state.last_ordinals[partition]
        ):
            _free_cell(state, cell, _before(state, cell))
        elif cells[cell, C_FIRST] >= 0 and tables.rules[rule, U_WITHIN] >= 0:
            due = attempts[cells[cell, C_FIRST], A_TIME] + tables.rules[rule, U_WITHIN]
            state.controls[DUE] = min(state.controls[DUE], due)
    cursor[0] = len(cells)
    return FINE


@compiled
def _end(tables, state, cell, rule):
    """Ends the cell's attempts because there are no more rows."""
    within = tables.rules[rule, U_WITHIN]
    while state.cells[cell, C_FIRST] >= 0 and state.failures[rule] == 0:
        first = state.cells[cell, C_FIRST]
        _free_threads(state, first)
        how = BY_TIME if within >= 0 else BY_END
        deadline = state.attempts[first, A_TIME] + within
        state.failures[rule] = _resolve(tables, state, cell, rule, how, deadline, 0, 0)


@compiled
def _before(state, cell):
    """The cell before this one in their partition's list; -1: it is the first."""
    before, at = np.int64(-1), state.first_cells[state.cells[cell, C_PARTITION]]
    while at != cell:
        before, at = at, state.cells[at, C_NEXT]
    return before


@compiled
def drop_rule(state, rule):
    """Forgets all that is remembered of a rule."""
    for cell in range(len(state.cells)):
        if state.cells[cell, C_RULE] == rule:
            _free_cell(state, cell, _before(state, cell))


@compiled
def drop_partition(state, partition):
    """Forgets all that is remembered of a partition."""
    while state.first_cells[partition] >= 0:
        _free_cell(state, state.first_cells[partition], np.int64(-1))


@compiled
def drop_partitions(state, partitions):
    """Forgets all that is remembered of these partitions."""
    for at in range(len(partitions)):
        drop_partition(state, partitions[at])


@compiled
def wanted(tables, state, partitions, watermark, words, is_wanted):
    """Marks the partitions of which anything has to be remembered; what is left over of the others is freed."""
    for partition in range(partitions):
        is_wanted[partition] = _is_wanted(tables, state, partition, watermark, words, 0, len(tables.rules))
        if not is_wanted[partition]:
            drop_partition(state, partition)


@compiled
def _is_wanted(tables, state, partition, watermark, words, first_rule, end_rule):
    """Whether the rules from the first to the end one have anything to remember of the partition."""
    if state.last_ordinals[partition] < 0:
        return False
    cell = state.first_cells[partition]
    while cell >= 0:
        rule = state.cells[cell, C_RULE]
        if first_rule <= rule < end_rule and state.cells[cell, C_FIRST] >= 0 and not state.failures[rule]:
            return True
        cell = state.cells[cell, C_NEXT]
    for rule in range(first_rule, end_rule):
        if state.failures[rule]:
            continue
        if tables.rules[rule, U_LOOKS_BACK]:
            return True
        within = tables.rules[rule, U_WITHIN]
        if within >= 0 and state.last_rows[partition, R_TIME] + within <= watermark:
            continue
        for pair in range(tables.rules[rule, U_PAIRS], tables.rules[rule, U_PAIRS_END]):
            needs_next = tables.pairs[pair, 0] < tables.pairs[pair, 1]
            if needs_next and _has(state.last_rows, partition, tables.first_masks, pair, words):
                return True
    return False


@compiled
def runs_of(state, count, runs, ends):
    """Copies the runs of the found matches' traces, each from its first row to its last.

    Args:
        state: What is remembered.
        count: How many are found.
        runs: Room for them: variable, stream, first and last sequence, ordinal, rows.
        ends: For each match where its runs end; changed.

    Returns:
        How many runs there are; nothing is copied beyond the room.
    """
    total = 0
    for at in range(count):
        length, thread = 0, state.found[at, F_THREAD]
        trace = state.threads[thread, T_TRACE] if thread >= 0 else np.int64(-1)
        first = trace
        while trace >= 0:
            length += 1
            trace = state.traces[trace, X_PARENT]
        total += length
        ends[at] = total
        place, trace = total, first
        while trace >= 0 and total <= len(runs):
            place -= 1
            for column in range(6):
                runs[place, column] = state.traces[trace, X_VARIABLE + column]
            trace = state.traces[trace, X_PARENT]
    return total


@compiled
def clear_found(state):
    """The found matches were taken; their records are free again."""
    for at in range(state.controls[FOUND]):
        if state.found[at, F_THREAD] >= 0:
            _free_thread(state, state.found[at, F_THREAD])
    state.controls[FOUND] = 0


# Grouping.


@compiled
def intern(keys, table, slots, known, numbers):
    """Numbers the keys: equal rows of `keys`, and only these, have one number.

    Args:
        keys: A key a row.
        table: The key of each number; new ones are added, there is room.
        slots: An open hash table of numbers, -1 where empty; a power of two, less than half full afterwards.
        known: How many numbers there are.
        numbers: Where the number of each row goes.

    Returns:
        How many numbers there are now.
    """
    width, most = keys.shape[1], len(slots) - 1
    for row in range(len(keys)):
        hashed = np.int64(0)
        for column in range(width):
            hashed = (hashed ^ keys[row, column]) * np.int64(-7046029254386353131)
            hashed ^= (hashed >> 32) & np.int64(0xFFFFFFFF)
        at = hashed & most
        while True:
            number = slots[at]
            if number < 0:
                number = slots[at] = known
                for column in range(width):
                    table[known, column] = keys[row, column]
                known += 1
                break
            is_same = True
            for column in range(width):
                if table[number, column] != keys[row, column]:
                    is_same = False
                    break
            if is_same:
                break
            at = (at + 1) & most
        numbers[row] = number
    return known


@compiled_with_memory
def group(numbers, time, rank, sequence, place, partitions, bounds, order):
    """Puts rows in groups of one partition, each in the order of time, rank and sequence.

    Args:
        numbers: For each row its partition.
        time: For each row its time.
        rank: For each row the rank of its stream.
        sequence: For each row its sequence.
        place: By partition, all -1; and again so afterwards.
        partitions: Where the groups' partitions go, as many as there are rows at most.
        bounds: Where it goes where each group begins; one longer.
        order: Where the rows' numbers go.

    Returns:
        How many groups there are.
    """
    groups, rows = 0, len(numbers)
    for row in range(rows):
        number = numbers[row]
        if place[number] < 0:
            place[number] = groups
            partitions[groups] = number
            bounds[groups + 1] = 0
            groups += 1
        bounds[place[number] + 1] += 1
    bounds[0] = 0
    for at in range(groups):
        bounds[at + 1] += bounds[at]
    for row in range(rows):
        at = place[numbers[row]]
        order[bounds[at]] = row
        bounds[at] += 1
    for at in range(groups, 0, -1):
        bounds[at] = bounds[at - 1]
    bounds[0] = 0
    for at in range(groups):
        place[partitions[at]] = -1
        _sort(order, bounds[at], bounds[at + 1], time, rank, sequence)
    return groups


@compiled_with_memory
def _sort(order, begin, end, time, rank, sequence):
    """By insertion while few rows are out of order, else by merging."""
    moves, most = 0, 16 * (end - begin)
    for at in range(begin + 1, end):
        row = order[at]
        hole = at
        while hole > begin and _is_before(row, order[hole - 1], time, rank, sequence):
            order[hole] = order[hole - 1]
            hole -= 1
        order[hole] = row
        moves += at - hole
        if moves > most:
            _merge_sort(order, begin, end, time, rank, sequence)
            return


@compiled_with_memory
def _merge_sort(order, begin, end, time, rank, sequence):
    width = 1
    source = order[begin:end].copy()
    target = np.empty_like(source)
    while width < len(source):
        for left in range(0, len(source), 2 * width):
            middle, right = min(left + width, len(source)), min(left + 2 * width, len(source))
            one, other = left, middle
            for at in range(left, right):
                takes_other = other < right and (
                    one >= middle or _is_before(source[other], source[one], time, rank, sequence)
                )
                if takes_other:
                    target[at] = source[other]
                    other += 1
                else:
                    target[at] = source[one]
                    one += 1
        source, target = target, source
        width *= 2
    order[begin:end] = source


@compiled
def _is_before(one, other, time, rank, sequence):
    if time[one] != time[other]:
        return time[one] < time[other]
    if rank[one] != rank[other]:
        return rank[one] < rank[other]
    return sequence[one] < sequence[other]


@compiled
def chained(counts, bounds, order, fresh, before):
    """Writes for each row the row before it in its partition.

    Args:
        counts: For each group how many rows of it were there before; they stand first, group after group.
        bounds: Where each group begins in `order`, and the end.
        order: Numbers of new rows, which stand behind `fresh` earlier ones.
        fresh: How many earlier ones there are.
        before: Where the answer goes; -1: none.
    """
    earlier = 0
    for group in range(len(counts)):
        last = -1
        for row in range(earlier, earlier + counts[group]):
            before[row] = last
            last = row
        earlier += counts[group]
        for at in range(bounds[group], bounds[group + 1]):
            before[fresh + order[at]] = last
            last = fresh + order[at]


@compiled
def open_partitions(tables, state, partitions, watermark, words, rule):
    """How many partitions have anything to remember for the rule."""
    count = 0
    for partition in range(partitions):
        if _is_wanted(tables, state, partition, watermark, words, rule, rule + 1):
            count += 1
    return count


@compiled
def mark_rule(state, rule, cells, attempts, threads, traces):
    """Marks the records that hold what is remembered of a rule."""
    for cell in range(len(state.cells)):
        if state.cells[cell, C_RULE] != rule:
            continue
        is_empty = state.cells[cell, C_FIRST] < 0
        if is_empty and state.cells[cell, C_RESUME] <= state.last_ordinals[state.cells[cell, C_PARTITION]]:
            continue
        cells[cell] = True
        attempt = state.cells[cell, C_FIRST]
        while attempt >= 0:
            attempts[attempt] = True
            thread = state.attempts[attempt, A_THREAD]
            while thread >= 0:
                _mark_thread(state, thread, threads, traces)
                thread = state.threads[thread, T_NEXT]
            if state.attempts[attempt, E_THREAD] >= 0:
                _mark_thread(state, state.attempts[attempt, E_THREAD], threads, traces)
            attempt = state.attempts[attempt, A_NEXT]


@compiled
def _mark_thread(state, thread, threads, traces):
    threads[thread] = True
    trace = state.threads[thread, T_TRACE]
    while trace >= 0 and not traces[trace]:
        traces[trace] = True
        trace = state.traces[trace, X_PARENT]


@compiled
def wanted_by(tables, state, partitions, watermark, words, rule, is_wanted):
    """Marks the partitions of which anything has to be remembered for the rule."""
    for partition in range(partitions):
        is_wanted[partition] = _is_wanted(tables, state, partition, watermark, words, rule, rule + 1)
