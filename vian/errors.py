"""What a command can end with, and its exit code.

0 done; 1 the world failed (database, file, network); 2 wrong usage (arguments, rules, queries).

VianError
├── WorldFailed     exit code 1
└── WrongUsage      exit code 2
"""

from enum import IntEnum

from events import EventError, InvalidName
from extractors.errors import ExtractorError
from patterns.errors import PatternError
from store import BadRequest, StoreError
from sync.errors import GrantError, PlanError, SyncError


class ExitCode(IntEnum):
    """What a command returns to the shell."""

    DONE = 0
    WORLD_FAILED = 1
    WRONG_USAGE = 2


class VianError(Exception):
    """Base of the errors of the composition root; its text is for the user."""


class WorldFailed(VianError):
    """Something outside did not do its part."""


class WrongUsage(VianError):
    """The command was asked for something that it cannot do."""


EXPECTED = (VianError, EventError, StoreError, ExtractorError, PatternError, SyncError)
"""Errors that are told in one line; any other is a defect and shows its traceback."""

_USAGE = (WrongUsage, InvalidName, BadRequest, PatternError, PlanError, GrantError)


def exit_code(error: BaseException) -> ExitCode:
    """The exit code of an expected error."""
    return ExitCode.WRONG_USAGE if isinstance(error, _USAGE) else ExitCode.WORLD_FAILED
