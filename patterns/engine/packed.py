"""A bound rule as the tables of integers that `patterns.engine.kernel` runs.

What the kernel cannot express is refused with the reason; such a rule runs on the general matcher.
Zones and lines get names that say what they are, so that rules share what means the same.
"""

import struct
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from patterns.binding.bound import BoundRule, Register
from patterns.binding.expressions import Call, Const, Crosses, Expr, InZone, Kind, rebuilt
from patterns.binding.inputs import SITUATION
from patterns.engine import kernel as k
from patterns.engine.engine import live_registers
from patterns.engine.kernel import Integers, Tables
from patterns.language.syntax import SkipMode
from patterns.scene.geometry import Line, Zone

REGISTERS_MOST = 62
SLOTS_MOST = 62

Code = tuple[tuple[int, int], ...]


class NotPacked(Exception):
    """The kernel cannot express the rule; the message says why."""


@dataclass(frozen=True)
class Packed:
    """A rule, ready to be put among others.

    Attributes:
        bound: The rule.
        where: The filter of FROM, where its only arm is an event type.
        conditions: For each variable the row-local conditions that must all be true.
        slots: The row-local values that it reads.
        guards: For each variable its guard's program; slots are numbers in `slots`.
        zones: The zones that the expressions name.
        lines: The lines that they name.
    """

    bound: BoundRule
    where: Expr | None
    conditions: tuple[tuple[Expr, ...], ...]
    slots: tuple[Expr, ...]
    guards: tuple[Code, ...]
    zones: Mapping[str, Zone]
    lines: Mapping[str, Line]

    @property
    def predicates(self) -> tuple[Expr, ...]:
        """The row-local conditions, each once."""
        return tuple(dict.fromkeys(part for condition in self.conditions for part in condition))


def pack(bound: BoundRule) -> Packed:
    """The rule, packed.

    Raises:
        NotPacked: The kernel cannot express it.
    """
    _check(bound)
    names = _Names(bound)
    plain = bound.plain_input
    predicates = tuple(names.named(each) for each in bound.predicates)
    return Packed(
        bound=bound,
        where=None if plain is None or plain.where is None else names.named(plain.where),
        conditions=tuple(tuple(predicates[at] for at in each.predicates) for each in bound.conditions),
        slots=tuple(names.named(each) for each in bound.slots),
        guards=tuple(_guard(bound, each.guard) for each in bound.conditions),
        zones=names.zones,
        lines=names.lines,
    )


def _check(bound: BoundRule) -> None:
    tables = bound.tables
    if tables.has_start_anchor or tables.accepts != tables.accepts_end:
        raise NotPacked("anchors")
    if bound.timers or any(bound.timed):
        raise NotPacked("TIMER")
    if SITUATION in bound.types:
        raise NotPacked("situations as input")
    if len(bound.registers) > REGISTERS_MOST or len(bound.slots) > SLOTS_MOST or len(bound.variables) > REGISTERS_MOST:
        raise NotPacked(f"more than {REGISTERS_MOST} variables or remembered values")
    for register in bound.registers:
        if register.offset or register.how == "list":
            raise NotPacked(f"a remembered value of the kind {register.how}, offset {register.offset}")
    if any(bound.ahead):
        raise NotPacked("rows to come")
    if bound.is_numbered:
        raise NotPacked("the match's number")


class _Names:
    """Gives the rule's own zones and lines names that say what they are; shared ones keep theirs."""

    def __init__(self, bound: BoundRule) -> None:
        self.rule = bound.rule
        self.zones: dict[str, Zone] = {}
        self.lines: dict[str, Line] = {}

    def named(self, expr: Expr) -> Expr:
        expr = rebuilt(expr, self.named)
        if isinstance(expr, InZone) and expr.zone in self.rule.zones:
            zone = self.rule.zones[expr.zone]
            name = zone.model_dump_json()
            self.zones[name] = zone
            return replace(expr, zone=name)
        if isinstance(expr, Crosses) and expr.line in self.rule.lines:
            line = self.rule.lines[expr.line]
            name = line.model_dump_json()
            self.lines[name] = line
            return replace(expr, line=name)
        return expr


# Guards.


def _guard(bound: BoundRule, guard: Expr | None) -> Code:
    if guard is None:
        return ()
    code = tuple(_Coder(bound).code(guard))
    if len(code) > k.STACK:
        raise NotPacked("a condition of more than 64 parts")
    return code


class _Coder:
    def __init__(self, bound: BoundRule) -> None:
        self.registers = bound.register_of
        self.slots = {slot: index for index, slot in enumerate(bound.slots)}

    def code(self, expr: Expr) -> list[tuple[int, int]]:
        if expr in self.registers:
            return [(k.OP_REGISTER, self.registers[expr])]
        if expr in self.slots:
            return [(k.OP_SLOT, self.slots[expr])]
        if isinstance(expr, Const):
            return [_constant(expr)]
        if not isinstance(expr, Call):
            raise NotPacked(f"{type(expr).__name__} of what a match remembers")
        return self.call(expr)

    def call(self, expr: Call) -> list[tuple[int, int]]:
        operands = expr.operands
        if not operands or (expr.op not in _OPERATIONS and expr.op not in _FLOAT_OPERATIONS):
            raise NotPacked(f"the function {expr.op} of what a match remembers")
        if expr.op == "case":
            return self.case(operands)
        kinds = {operand.kind for operand in operands}
        if Kind.STRING in kinds and expr.op not in ("=", "<>", "is_null", "coalesce"):
            raise NotPacked("the order of texts")
        is_float = Kind.FLOAT in kinds and expr.op in _FLOAT_OPERATIONS
        operation = (_FLOAT_OPERATIONS if is_float else _OPERATIONS).get(expr.op)
        if operation is None or (is_float and kinds != {Kind.FLOAT}):
            raise NotPacked(f"{expr.op} of values of different kinds")
        code = self.code(operands[0])
        if len(operands) == 1:
            return code if expr.op in _FOLDED else [*code, (operation, 0)]
        for operand in operands[1:]:
            code += [*self.code(operand), (operation, 0)]
        return code

    def case(self, operands: Sequence[Expr]) -> list[tuple[int, int]]:
        if len(operands) == 1:
            return self.code(operands[0])
        condition, value, *others = operands
        return [*self.code(condition), *self.code(value), *self.case(others), (k.OP_CASE, 0)]


def _constant(expr: Const) -> tuple[int, int]:
    if expr.value is None:
        return (k.OP_NULL, 0)
    if isinstance(expr.value, str):
        raise NotPacked("a text beside what a match remembers")
    if isinstance(expr.value, float):
        return (k.OP_CONST, struct.unpack("<q", struct.pack("<d", expr.value))[0])
    return (k.OP_CONST, int(expr.value))


_FOLDED = frozenset({"and", "or", "coalesce", "least", "greatest"})
_OPERATIONS = {
    "and": k.OP_AND, "or": k.OP_OR, "not": k.OP_NOT, "is_null": k.OP_IS_NULL, "coalesce": k.OP_COALESCE,
    "case": k.OP_CASE, "=": k.OP_EQ, "<>": k.OP_NE, "<": k.OP_LT, "<=": k.OP_LE, ">": k.OP_GT, ">=": k.OP_GE,
    "+": k.OP_ADD, "-": k.OP_SUB, "*": k.OP_MUL, "/": k.OP_DIV, "%": k.OP_MOD, "neg": k.OP_NEG, "abs": k.OP_ABS,
    "least": k.OP_LEAST, "greatest": k.OP_GREATEST, "float": k.OP_FLOAT, "sqrt": k.OP_SQRT, "scale": k.OP_SCALE,
    "shrink": k.OP_SHRINK, "ratio": k.OP_RATIO,
}  # fmt: skip
_FLOAT_OPERATIONS = {
    "=": k.OP_F_EQ, "<>": k.OP_F_NE, "<": k.OP_F_LT, "<=": k.OP_F_LE, ">": k.OP_F_GT, ">=": k.OP_F_GE,
    "+": k.OP_F_ADD, "-": k.OP_F_SUB, "*": k.OP_F_MUL, "/": k.OP_F_DIV, "neg": k.OP_F_NEG, "abs": k.OP_F_ABS,
    "least": k.OP_F_LEAST, "greatest": k.OP_F_GREATEST,
}  # fmt: skip


# Many rules.


class Assembly:
    """Puts packed rules together.

    Args:
        bits: For each row-local condition its word and its bit there.
        slots: For each row-local value its number.
        words: How many words of bits a row has.
    """

    def __init__(self, bits: Mapping[Expr, tuple[int, int]], slots: Mapping[Expr, int], words: int) -> None:
        self.bits = bits
        self.slots = slots
        self.words = words

    def tables(self, rules: Sequence[Packed], *, is_strict: bool) -> Tables:
        """The tables of these rules, in this order; `is_strict`: a limit that is reached ends a rule."""
        self.rules: list[list[int]] = []
        self.positions: list[list[int]] = []
        self.follow_at = [0]
        self.follow: list[int] = []
        self.masks: list[list[int]] = []
        self.code: list[tuple[int, int]] = []
        self.updates: list[tuple[int, int, int]] = []
        self.live: list[int] = []
        self.pairs: list[tuple[int, int]] = []
        self.first_masks: list[list[int]] = []
        self.next_masks: list[list[int]] = []
        self.beginnings: list[tuple[int, int, int]] = []
        for number, rule in enumerate(rules):
            self._add(number, rule, is_strict)
        fan = max((end - begin for begin, end in zip(self.follow_at, self.follow_at[1:], strict=False)), default=0)
        return Tables(
            rules=_array(self.rules, k.U_WIDTH),
            positions=_array(self.positions, k.P_WIDTH),
            follow_at=np.array(self.follow_at, dtype=np.int64),
            follow=np.array(self.follow, dtype=np.int64),
            masks=_array(self.masks, self.words),
            code=_array(self.code, 2),
            updates=_array(self.updates, 3),
            live=np.array(self.live, dtype=np.int64),
            pairs=_array(self.pairs, 2),
            first_masks=_array(self.first_masks, self.words),
            next_masks=_array(self.next_masks, self.words),
            **self._watched(),
            fan=np.array([fan], dtype=np.int64),
        )

    def _watched(self) -> dict[str, Integers]:
        """The beginnings by a bit that must be set for them to be possible: the one that the fewest share."""
        ways: tuple[list[tuple[int, int, int]], ...] = ([], [])
        for each in self.beginnings:
            ways[k.ALONE if each[2] < 0 else k.FOLLOWED].append(each)
        watched, at, watch = np.zeros((2, self.words + 1), dtype=np.int64), [0], []
        for way, beginnings in enumerate(ways):
            named = self._by_bit(beginnings)
            for bit in range(k.BITS * self.words + 1):
                watch += named.get(bit, [])
                at.append(len(watch))
            for bit in named:
                watched[way, bit // k.BITS] |= np.array(1 << bit % k.BITS, dtype=np.uint64).astype(np.int64)
        return {"watched": watched, "watch_at": np.array(at, dtype=np.int64), "watch": _array(watch, 3)}

    def _by_bit(self, beginnings: Sequence[tuple[int, int, int]]) -> dict[int, list[tuple[int, int, int]]]:
        bits = [_bits(self.first_masks[pair] if mask < 0 else self.next_masks[mask]) for _, pair, mask in beginnings]
        shared = Counter(bit for each in bits for bit in each)
        named: dict[int, list[tuple[int, int, int]]] = {}
        for each, own in zip(beginnings, bits, strict=True):
            bit = min(own, key=lambda bit: (shared[bit], bit), default=k.BITS * self.words)
            named.setdefault(bit, []).append(each)
        return named

    def _add(self, number: int, rule: Packed, is_strict: bool) -> None:
        bound, tables = rule.bound, rule.bound.tables
        base = len(self.positions)
        masks = [self._mask(condition) for condition in rule.conditions]
        numbers = [self.slots[slot] for slot in rule.slots]
        guards = [self._code(guard) for guard in with_slots(rule.guards, numbers)]
        live = live_registers(bound)
        for position, variable in enumerate(tables.variables):
            self.masks.append(masks[variable])
            updates, lives = self._updates(rule, variable), self._live(live[position])
            early = int(self._is_early(guards[variable], updates))
            self.positions.append([int(tables.accepts[position]), variable, *guards[variable], *updates, *lives, early])
            self._follow(base, tables.follow[position])
        self.masks.append([0] * self.words)
        self.positions.append([0] * k.P_WIDTH)
        self._follow(base, tables.follow[tables.start])
        pairs = self._pairs(number, rule, masks)
        nulls = sum(1 << at for at, register in enumerate(bound.registers) if register.how not in ("rows", "values"))
        unset = sum(1 << at for at, register in enumerate(bound.registers) if register.how == "first")
        skip = _SKIPS[bound.skip]
        merges = bound.skip is SkipMode.PAST_LAST_ROW and bound.within_us is None
        self.rules.append([
            base + tables.start, -1 if bound.within_us is None else bound.within_us, skip,
            sum(1 << variable for variable in bound.skip_variables), int(merges), len(bound.registers), nulls, unset,
            bound.limits.threads, *pairs, int(bound.looks_back), int(is_strict), base,
        ])  # fmt: skip

    def _follow(self, base: int, positions: Sequence[int]) -> None:
        self.follow += [base + position for position in positions]
        self.follow_at.append(len(self.follow))

    def _mask(self, condition: Sequence[Expr]) -> list[int]:
        words = [0] * self.words
        for predicate in condition:
            word, bit = self.bits[predicate]
            words[word] |= 1 << bit
        return [word - (1 << 64) if word >> 63 else word for word in words]

    def _code(self, guard: Code) -> tuple[int, int]:
        begin = len(self.code)
        self.code += guard
        return begin, len(self.code)

    def _is_early(self, guard: tuple[int, int], updates: tuple[int, int]) -> bool:
        """Whether the guard reads nothing that the row changes."""
        read = {argument for op, argument in self.code[slice(*guard)] if op == k.OP_REGISTER}
        return not read & {register for register, _, _ in self.updates[slice(*updates)]}

    def _live(self, registers: Sequence[int]) -> tuple[int, int]:
        begin = len(self.live)
        self.live += registers
        return begin, len(self.live)

    def _updates(self, rule: Packed, variable: int) -> tuple[int, int]:
        begin = len(self.updates)
        for index, register in enumerate(rule.bound.registers):
            if register.takes(variable):
                slot = register.slot_for(variable)
                number = -1 if slot is None else self.slots[rule.slots[slot]]
                self.updates.append((index, how_of(rule.bound, register), number))
        return begin, len(self.updates)

    def _pairs(self, number: int, rule: Packed, masks: list[list[int]]) -> tuple[int, int]:
        """How a match may begin: the first row's bits, and those of the next row, one of which must be there."""
        tables = rule.bound.tables
        begin = len(self.pairs)
        seen = set()
        for position in tables.follow[tables.start]:
            first = tables.variables[position]
            after = () if tables.accepts[position] else tuple(
                sorted({tables.variables[each] for each in tables.follow[position]})
            )  # fmt: skip
            if (first, after) in seen or not (after or tables.accepts[position]):
                continue
            seen.add((first, after))
            self.first_masks.append(masks[first])
            next_begin = len(self.next_masks)
            self.next_masks += [masks[variable] for variable in after]
            masks_of = range(next_begin, len(self.next_masks)) or (-1,)
            self.beginnings += [(number, len(self.pairs), mask) for mask in masks_of]
            self.pairs.append((next_begin, len(self.next_masks)))
        return begin, len(self.pairs)


def with_slots(guards: Sequence[Code], numbers: Sequence[int]) -> tuple[Code, ...]:
    """The guards' programs with these numbers for the rule's own slots."""
    return tuple(
        tuple((op, numbers[argument] if op == k.OP_SLOT else argument) for op, argument in guard) for guard in guards
    )


def how_of(bound: BoundRule, register: Register) -> int:
    """How the kernel calls what the register does."""
    if register.how in ("sum", "min", "max") and register.slot is not None:
        is_float = bound.slots[register.slot].kind is Kind.FLOAT
        return _FLOAT_HOWS[register.how] if is_float else _HOWS[register.how]
    return _HOWS[register.how]


def _bits(mask: Sequence[int]) -> list[int]:
    """The numbers of the mask's bits, through all words."""
    return [k.BITS * at + bit for at, word in enumerate(mask) for bit in range(k.BITS) if word >> bit & 1]


def _array(rows: Sequence[Sequence[int]], width: int) -> Integers:
    return np.array(rows, dtype=np.int64).reshape(len(rows), width)


_HOWS = {
    "first": k.FIRST, "last": k.LAST, "rows": k.ROWS, "values": k.VALUES, "sum": k.SUM, "min": k.MIN, "max": k.MAX,
}  # fmt: skip
_FLOAT_HOWS = {"sum": k.F_SUM, "min": k.F_MIN, "max": k.F_MAX}
_SKIPS = {
    SkipMode.PAST_LAST_ROW: k.SKIP_PAST_LAST_ROW, SkipMode.TO_NEXT_ROW: k.SKIP_TO_NEXT_ROW,
    SkipMode.TO_FIRST: k.SKIP_TO_FIRST, SkipMode.TO_LAST: k.SKIP_TO_LAST,
}  # fmt: skip
