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

from patterns.syntax import Alternation, Concatenation, Pattern, Repetition, Variable


class ProgramTooLarge(Exception):
    """The pattern needs more than the limit allows."""


@dataclass(frozen=True, slots=True)
class Row:
    """Take a row for this variable (its index)."""

    variable: int


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
class Accept:
    """The rows taken so far are a match."""


Instruction = Row | Split | Jump | Mark | Check | Accept


@dataclass(frozen=True, slots=True)
class Tables:
    """The program's positions, in the program's order.

    Attributes:
        variables: For each position, the index of its variable.
        follow: For each position, the positions that may take the next row, preferred first; in
            the last place those that may take the first row. What is less preferred than a
            match is left out.
        accepts: For each position, whether having taken its row can end a match; in the last
            place, whether no row at all is a match, preferred to what `follow` leaves out.
    """

    variables: tuple[int, ...]
    follow: tuple[tuple[int, ...], ...]
    accepts: tuple[bool, ...]

    @property
    def start(self) -> int:
        """The place in `follow` from where a match begins."""
        return len(self.variables)


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
    closures = [_closure(program, at + 1) for at in places]
    closures.append(_closure(program, 0))
    rows = [instruction for instruction in program if isinstance(instruction, Row)]
    return Tables(
        variables=tuple(row.variable for row in rows),
        follow=tuple(tuple(numbers[at] for at in closure[0]) for closure in closures),
        accepts=tuple(closure[1] for closure in closures),
    )


def _closure(program: Sequence[Instruction], start: int) -> tuple[list[int], bool]:
    """The row instructions reached from here without taking a row, preferred first, up to the first match.

    Loops are left in the reverse order of entering, so an instruction is visited at most once for
    each loop around it.
    """
    reached: dict[int, None] = {}
    seen: set[tuple[int, int]] = set()
    stack = [(start, 0)]
    while stack:
        at, marked = stack.pop()
        if (at, marked) in seen:
            continue
        seen.add((at, marked))
        match program[at]:
            case Row():
                reached.setdefault(at)
            case Accept():
                return list(reached), True
            case Split(first, second):
                stack += [(second, marked), (first, marked)]
            case Jump(target):
                stack.append((target, marked))
            case Mark(loop):
                stack.append((at + 1, marked | 1 << loop))
            case Check(loop, exit_at):
                is_empty = marked >> loop & 1
                stack.append((exit_at, marked & ~(1 << loop)) if is_empty else (at + 1, marked))
    return list(reached), False


class _Writer:
    """Writes instructions; labels are filled in once they are known."""

    def __init__(self, variables: dict[str, int]) -> None:
        self.variables = variables
        self.code: list[Instruction] = []
        self.loops = 0

    def pattern(self, pattern: Pattern) -> None:
        match pattern:
            case Variable(name):
                self.code.append(Row(self.variables[name.key]))
            case Concatenation(parts):
                for part in parts:
                    self.pattern(part)
            case Alternation(choices):
                self.alternation(choices)
            case Repetition():
                self.repetition(pattern)

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

    def reserve(self) -> int:
        self.code.append(Accept())
        return len(self.code) - 1


def is_nullable(pattern: Pattern) -> bool:
    """Whether no row at all can match the pattern."""
    match pattern:
        case Variable():
            return False
        case Concatenation(parts):
            return all(is_nullable(part) for part in parts)
        case Alternation(choices):
            return any(is_nullable(choice) for choice in choices)
        case Repetition(body, least):
            return least == 0 or is_nullable(body)


def _positions_needed(pattern: Pattern) -> int:
    match pattern:
        case Variable():
            return 1
        case Concatenation(parts) | Alternation(parts):
            return sum(_positions_needed(part) for part in parts)
        case Repetition(body, least, most):
            return _positions_needed(body) * (least + 1 if most is None else most)


def _shown(instruction: Instruction, variables: Sequence[str]) -> str:
    match instruction:
        case Row(variable):
            return f"row {variables[variable]}"
        case Split(first, second):
            return f"split {first} {second}"
        case Jump(target):
            return f"jump {target}"
        case Mark(loop):
            return f"mark {loop}"
        case Check(loop, exit_at):
            return f"check {loop} else {exit_at}"
        case Accept():
            return "accept"
