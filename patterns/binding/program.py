"""A pattern as a program, and the program as tables.

The program is what one reads: instructions in order of preference. The tables
are what runs: for each position (an instruction that takes a row) the
positions that may take the next one, preferred first. Neither knows what a
variable means.

A repetition's iteration beyond the minimum that takes no row ends the
repetition, so no pattern loops for ever.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations
from math import factorial

from patterns.language.syntax import (
    Alternation,
    Anchor,
    Concatenation,
    Exclusion,
    Pattern,
    Permutation,
    Repetition,
    Variable,
)


class ProgramTooLarge(Exception):
    """The pattern needs more than the limit allows."""


@dataclass(frozen=True, slots=True)
class Row:
    """Take a row for this variable (its index); `excluded`: inside `{- -}`."""

    variable: int
    excluded: bool = False


@dataclass(frozen=True, slots=True)
class Split:
    """Go on at `first`; failing that, at `second`."""

    first: int
    second: int


@dataclass(frozen=True, slots=True)
class Jump:
    """Go on there."""

    target: int


@dataclass(frozen=True, slots=True)
class Mark:
    """An iteration of this loop begins here."""

    loop: int


@dataclass(frozen=True, slots=True)
class Check:
    """An iteration of this loop ends here; if it took no row, go on at `exit`."""

    loop: int
    exit: int


@dataclass(frozen=True, slots=True)
class Assert:
    """Go on only before the partition's first row, or only after its last."""

    is_start: bool


@dataclass(frozen=True, slots=True)
class Accept:
    """The rows taken so far are a match."""


Instruction = Row | Split | Jump | Mark | Check | Assert | Accept


@dataclass(frozen=True, slots=True)
class Tables:
    """The program's positions, in the program's order.

    After the positions, two more places say how a match begins: `start`, and `first_start` at the
    partition's first row, where `^` is true.

    Attributes:
        variables: For each position, the index of its variable.
        follow: For each place, the positions that may take the next row, preferred first. What is
            less preferred than a match is left out.
        accepts: For each place, whether the rows taken so far can be a match; of the two starts,
            whether no row at all is one, preferred to what `follow` leaves out.
        accepts_end: For each place, whether they are one if the last of them is the partition's last.
        excluded: For each position, whether it lies in `{- -}`.
    """

    variables: tuple[int, ...]
    follow: tuple[tuple[int, ...], ...]
    accepts: tuple[bool, ...]
    accepts_end: tuple[bool, ...]
    excluded: tuple[bool, ...]

    @property
    def start(self) -> int:
        """The place in `follow` from where a match begins that does not begin at the partition's first row."""
        return len(self.variables)

    @property
    def first_start(self) -> int:
        """The place in `follow` from where a match begins at the partition's first row."""
        return len(self.variables) + 1

    @property
    def has_start_anchor(self) -> bool:
        """Whether it matters if a row is the partition's first."""
        start, first = self.start, self.first_start
        return (self.follow[start], self.accepts[start]) != (self.follow[first], self.accepts[first])

    def starting(self, is_first: bool) -> int:
        """The place from where a match begins at the partition's first row, or at another."""
        return self.first_start if is_first else self.start

    def firsts(self) -> tuple[int, ...]:
        """The positions that can take a match's first row."""
        return tuple(dict.fromkeys((*self.follow[self.start], *self.follow[self.first_start])))


@dataclass(frozen=True, slots=True)
class _Closure:
    """What can come after a place without taking a row."""

    rows: tuple[int, ...]
    accepts: bool
    accepts_end: bool


def compile_pattern(pattern: Pattern, variables: Sequence[str], limit: int) -> tuple[Instruction, ...]:
    """The program of the pattern; `variables` are the compared names, whose order gives their indices.

    Raises:
        ProgramTooLarge: More than `limit` positions.
    """
    needed = _positions_needed(pattern)
    if needed > limit:
        raise ProgramTooLarge(f"the pattern unfolds to {needed} positions; the limit `positions` is {limit}")
    writer = _Writer({name: index for index, name in enumerate(variables)})
    writer.pattern(pattern)
    writer.code.append(Accept())
    return tuple(writer.code)


def listing(program: Sequence[Instruction], variables: Sequence[str]) -> str:
    """The program as text, one instruction a line."""
    return "\n".join(f"{at:3d} {_shown(instruction, variables)}" for at, instruction in enumerate(program))


def tabulate(program: Sequence[Instruction]) -> Tables:
    """The tables of the program."""
    places = [at for at, instruction in enumerate(program) if isinstance(instruction, Row)]
    numbers = {at: number for number, at in enumerate(places)}
    closures = [_closure(program, at + 1, is_first=False) for at in places]
    closures += [_closure(program, 0, is_first=False), _closure(program, 0, is_first=True)]
    rows = [instruction for instruction in program if isinstance(instruction, Row)]
    return Tables(
        variables=tuple(row.variable for row in rows),
        follow=tuple(tuple(numbers[at] for at in closure.rows) for closure in closures),
        accepts=tuple(closure.accepts for closure in closures),
        accepts_end=tuple(closure.accepts_end for closure in closures),
        excluded=tuple(row.excluded for row in rows),
    )


def _closure(program: Sequence[Instruction], start: int, is_first: bool) -> _Closure:
    """The row instructions reached from here without taking a row, preferred first, up to the first match.

    Loops are left in the reverse order of entering, so an instruction is visited at most once for
    each loop around it. After `$` no row can come, so only a match counts there.
    """
    reached: dict[int, None] = {}
    accepts_end = False
    seen: set[tuple[int, int, bool]] = set()
    stack = [(start, 0, False)]
    while stack:
        state = stack.pop()
        if state in seen:
            continue
        seen.add(state)
        at, marked, is_last = state
        match program[at]:
            case Row():
                if not is_last:
                    reached.setdefault(at)
            case Accept():
                accepts_end = True
                if not is_last:
                    return _Closure(tuple(reached), accepts=True, accepts_end=True)
            case Assert(is_start):
                if not is_start or is_first:
                    stack.append((at + 1, marked, is_last or not is_start))
            case Split(first, second):
                stack += [(second, marked, is_last), (first, marked, is_last)]
            case Jump(target):
                stack.append((target, marked, is_last))
            case Mark(loop):
                stack.append((at + 1, marked | 1 << loop, is_last))
            case Check(loop, exit_at):
                is_empty = marked >> loop & 1
                after = (exit_at, marked & ~(1 << loop)) if is_empty else (at + 1, marked)
                stack.append((*after, is_last))
    return _Closure(tuple(reached), accepts=False, accepts_end=accepts_end)


class _Writer:
    """Writes instructions; labels are filled in once they are known."""

    def __init__(self, variables: dict[str, int]) -> None:
        self.variables = variables
        self.code: list[Instruction] = []
        self.loops = 0
        self.is_excluded = False

    def pattern(self, pattern: Pattern) -> None:
        match pattern:
            case Variable(name):
                self.code.append(Row(self.variables[name.key], self.is_excluded))
            case Concatenation(parts):
                for part in parts:
                    self.pattern(part)
            case Alternation(choices):
                self.alternation(choices)
            case Repetition():
                self.repetition(pattern)
            case Permutation(parts):
                self.permutation(parts)
            case Exclusion(body):
                around, self.is_excluded = self.is_excluded, True
                self.pattern(body)
                self.is_excluded = around
            case Anchor(is_start):
                self.code.append(Assert(is_start))

    def alternation(self, choices: tuple[Pattern, ...]) -> None:
        jumps = []
        for choice in choices[:-1]:
            split = self.reserve()
            self.pattern(choice)
            jumps.append(self.reserve())
            self.code[split] = Split(split + 1, len(self.code))
        self.pattern(choices[-1])
        for jump in jumps:
            self.code[jump] = Jump(len(self.code))

    def repetition(self, repetition: Repetition) -> None:
        for _ in range(repetition.least):
            self.pattern(repetition.body)
        if repetition.most is None:
            exits = [self.iteration(repetition.body)]
            self.code.append(Jump(exits[0][0]))
        else:
            exits = [self.iteration(repetition.body) for _ in range(repetition.most - repetition.least)]
        end = len(self.code)
        for split, check in exits:
            self.code[split] = Split(split + 1, end) if repetition.greedy else Split(end, split + 1)
            if check is not None:
                loop = self.code[split + 1]
                assert isinstance(loop, Mark)
                self.code[check] = Check(loop.loop, end)

    def iteration(self, body: Pattern) -> tuple[int, int | None]:
        """One optional iteration; where its split and, if the body can be empty, its check stand."""
        split = self.reserve()
        if not is_nullable(body):
            self.pattern(body)
            return split, None
        self.code.append(Mark(self.loops))
        self.loops += 1
        self.pattern(body)
        return split, self.reserve()

    def permutation(self, parts: tuple[Pattern, ...]) -> None:
        """One state for each set of parts that are done, so 8 parts need 1,024 copies and not 8! times 8.

        Where a part itself can go several ways, the order of the parts is preferred before its ways, so that no two
        orders can share it.
        """
        if any(has_choice(part) for part in parts):
            self.pattern(Alternation(tuple(Concatenation(order) for order in permutations(parts))))
            return
        full = (1 << len(parts)) - 1
        begins: dict[int, int] = {}
        jumps: list[tuple[int, int]] = []
        for done in sorted(range(full), key=lambda each: (each.bit_count(), each)):
            begins[done] = len(self.code)
            left = [index for index in range(len(parts)) if not done >> index & 1]
            for index in left:
                split = self.reserve() if index != left[-1] else None
                self.pattern(parts[index])
                jumps.append((self.reserve(), done | 1 << index))
                if split is not None:
                    self.code[split] = Split(split + 1, len(self.code))
        begins[full] = len(self.code)
        for jump, done in jumps:
            self.code[jump] = Jump(begins[done])

    def reserve(self) -> int:
        self.code.append(Accept())
        return len(self.code) - 1


def has_choice(pattern: Pattern) -> bool:
    """Whether one row may be followed in it by several others, of which one is preferred."""
    match pattern:
        case Variable() | Anchor():
            return False
        case Concatenation(parts):
            return any(has_choice(part) for part in parts)
        case Repetition(body, least, most):
            return least != most or has_choice(body)
        case Exclusion(body):
            return has_choice(body)
        case _:
            return True


def is_nullable(pattern: Pattern) -> bool:
    """Whether no row at all can match the pattern."""
    match pattern:
        case Variable():
            return False
        case Anchor():
            return True
        case Concatenation(parts) | Permutation(parts):
            return all(is_nullable(part) for part in parts)
        case Alternation(choices):
            return any(is_nullable(choice) for choice in choices)
        case Repetition(body, least):
            return least == 0 or is_nullable(body)
        case Exclusion(body):
            return is_nullable(body)


def _positions_needed(pattern: Pattern) -> int:
    match pattern:
        case Variable():
            return 1
        case Anchor():
            return 0
        case Concatenation(parts) | Alternation(parts):
            return sum(_positions_needed(part) for part in parts)
        case Permutation(parts):
            needed = sum(max(1, _positions_needed(part)) for part in parts)
            copies = factorial(len(parts)) if any(has_choice(part) for part in parts) else 1 << len(parts) - 1
            return needed * copies
        case Repetition(body, least, most):
            return _positions_needed(body) * (least + 1 if most is None else most)
        case Exclusion(body):
            return _positions_needed(body)


def _shown(instruction: Instruction, variables: Sequence[str]) -> str:
    match instruction:
        case Row(variable, excluded):
            return f"row {variables[variable]}{' excluded' if excluded else ''}"
        case Split(first, second):
            return f"split {first} {second}"
        case Jump(target):
            return f"jump {target}"
        case Mark(loop):
            return f"mark {loop}"
        case Check(loop, exit_at):
            return f"check {loop} else {exit_at}"
        case Assert(is_start):
            return "at the partition's start" if is_start else "at the partition's end"
        case Accept():
            return "accept"
