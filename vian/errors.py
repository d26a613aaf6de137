"""What a command can end with, and its exit code.

0 done; 1 the world failed (database, file, network); 2 wrong usage (arguments, a file that they name and
that is not there, rules, queries).

VianError
├── WorldFailed     exit code 1
└── WrongUsage      exit code 2
"""

import sys
from enum import IntEnum


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


_LOOK_CLOSER = ". Next: vian verify, which says what is wrong with which position"
_PACKAGES = {
    "events.errors": "EventError",
    "store.errors": "StoreError",
    "extractors.errors": "ExtractorError",
    "patterns.errors": "PatternError",
    "sync.errors": "SyncError",
}
_USAGE = {
    "events.errors": ("InvalidName",),
    "store.errors": ("BadRequest",),
    "extractors.errors": ("BadAddress", "MaskUnreadable"),
    "patterns.errors": ("PatternError",),
    "sync.errors": ("PlanError", "GrantError"),
}
"""By name, because no command needs all packages, and some take long to import."""


def expected() -> tuple[type[BaseException], ...]:
    """Errors that are told in one line; any other is a defect and shows its traceback."""
    return (VianError, *(_loaded(module, name) for module, name in _PACKAGES.items() if module in sys.modules))


def told(error: BaseException) -> str:
    """What an expected error says, and the next command where it does not say one itself."""
    text = str(error)
    is_corrupt = "events.errors" in sys.modules and isinstance(error, _loaded("events.errors", "CorruptSegment"))
    return text + _LOOK_CLOSER if is_corrupt and "Next: " not in text else text


def exit_code(error: BaseException) -> ExitCode:
    """The exit code of an expected error."""
    usage = [_loaded(module, name) for module, names in _USAGE.items() if module in sys.modules for name in names]
    return ExitCode.WRONG_USAGE if isinstance(error, (WrongUsage, *usage)) else ExitCode.WORLD_FAILED


def _loaded(module: str, name: str) -> type[BaseException]:
    """The error of a module that has been imported; one that has not cannot have raised any."""
    error: type[BaseException] = getattr(sys.modules[module], name)
    return error
