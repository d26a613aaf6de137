"""Which variables a name stands for: those of PATTERN, and their unions by SUBSET; and that every clause names such."""

from collections.abc import Iterable

from patterns.errors import RuleError
from patterns.language.pattern_variables import pattern_variables
from patterns.language.syntax import Clause, Identifier
from patterns.language.text import did_you_mean


def frames_of(clause: Clause) -> dict[str, tuple[str, ...]]:
    """For each variable, in the order of PATTERN, and each SUBSET the variables that it means; by compared names.

    Raises:
        RuleError: SUBSET, DEFINE or AFTER MATCH SKIP names a variable that is not there, or one twice.
    """
    variables = dict.fromkeys(name.key for name in pattern_variables(clause.pattern))
    frames: dict[str, tuple[str, ...]] = {variable: (variable,) for variable in variables}
    for subset in clause.subsets:
        if subset.name.key in frames:
            raise _error(clause, f"SUBSET: {subset.name.name!r} is a pattern variable or SUBSET already", subset.name)
        for member in subset.members:
            if member.key not in variables:
                have = ", ".join(variables) + did_you_mean(member.name, variables)
                raise _error(clause, f"SUBSET: {member.name!r} is not in PATTERN; there are: {have}", member)
        frames[subset.name.key] = tuple(dict.fromkeys(member.key for member in subset.members))
    _check_defines(clause, variables)
    target = clause.skip.variable
    if target is not None and target.key not in frames:
        have = ", ".join(frames) + _meant(target, frames)
        message = f"AFTER MATCH SKIP: unknown pattern variable {target.name!r}; there are: {have}"
        raise _error(clause, message, target)
    return frames


def _meant(target: Identifier, known: Iterable[str]) -> str:
    if target.key == "NEXT":
        return "; did you mean TO NEXT ROW?"
    is_direction = target.key in ("FIRST", "LAST")
    return f"; TO {target.key} wants a variable behind it" if is_direction else did_you_mean(target.name, known)


def _check_defines(clause: Clause, variables: dict[str, None]) -> None:
    defined: set[str] = set()
    for define in clause.defines:
        if define.name.key not in variables:
            like = did_you_mean(define.name.name, variables)
            raise _error(clause, f"DEFINE: {define.name.name!r} is not in PATTERN{like}", define.name)
        if define.name.key in defined:
            raise _error(clause, f"DEFINE: {define.name.name!r} is defined twice", define.name)
        defined.add(define.name.key)


def _error(clause: Clause, message: str, name: Identifier) -> RuleError:
    return clause.passage.error(message, name.at)
