"""The variables that a pattern names."""

from patterns.language.syntax import (
    Alternation,
    Anchor,
    Concatenation,
    Exclusion,
    Identifier,
    Pattern,
    Permutation,
    Repetition,
    Variable,
)


def pattern_variables(pattern: Pattern) -> list[Identifier]:
    """The variables in the order in which they are written, repeats included."""
    match pattern:
        case Variable(name):
            return [name]
        case Concatenation(parts) | Alternation(parts) | Permutation(parts):
            return [name for part in parts for name in pattern_variables(part)]
        case Repetition(body) | Exclusion(body):
            return pattern_variables(body)
        case Anchor():
            return []
