"""What a check found in a rule: what it is, where it stands, what to do."""

from dataclasses import dataclass
from typing import Literal

from patterns.errors import Place, RuleError
from patterns.files.rule import Rule


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that is wrong (`error`: the rule must not run) or looks wrong (`warning`).

    Attributes:
        severity: `error` or `warning`.
        message: What it is, and what to do.
        place: Where it stands.
        code: What kind of thing it is, for filters.
    """

    severity: Literal["error", "warning"]
    message: str
    place: Place
    code: str = "rule"

    def __str__(self) -> str:
        place = self.place
        return (
            f"{place.file}:{place.line}:{place.column}: {self.severity}: {self.message} [{self.code}]\n{place.excerpt}"
        )


def finding_of(error: RuleError) -> Finding:
    """The error as a finding."""
    return Finding("error", error.message, Place(error.file, error.line, error.column, error.excerpt))


def warning(rule: Rule, message: str, code: str, *path: str | int) -> Finding:
    """The warning that points at the value under these keys in the rule's file."""
    return Finding("warning", message, rule.passage(*path).place(0), code)
