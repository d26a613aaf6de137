"""What can go wrong with the log.

StoreError
├── LogUnavailable       the database cannot be started or reached, or went away
│   ├── WrongMajor       the data directory belongs to another major version of PostgreSQL
│   ├── DiskNearlyFull   the log's disk has less room than must stay free
│   └── ArchiveUnavailable  the place of the sealed files cannot be reached
├── DatabaseDamaged      PostgreSQL finds that its own files do not hold what it wrote
├── SchemaMismatch       the database's schema is newer than this program, or not ours
├── SequenceConflict     a stream does not stand where the writer expected
├── TableBusy            a row table cannot be changed while queries read it
├── ChainBroken          stored or received bytes do not carry the hash that they should
│   └── SealedFileDamaged   a part of a sealed file cannot be read
├── BadProof             a key, a signed checkpoint or a saved verification is not what it must be
├── BackupUnusable       a backup cannot be made there, or cannot be restored here
│   └── BackupDamaged    its files are not what its manifest says
├── QuestionFailed       a question from the field that PostgreSQL does not take, or cannot answer
├── QuestionTooDear      a question from the field that would cost more than it may
└── BadRequest           a call asked for what the log does not do
"""

from dataclasses import dataclass

from events import StreamName

UNKNOWN = StreamName.of("unknown", "unknown", "unknown")
"""The stream of a fault in something that cannot be read, so that it is not known whose it is."""


class StoreError(Exception):
    """Base of every error that the package `store` raises."""


class LogUnavailable(StoreError):
    """The database cannot be started or reached, or went away; nothing unacknowledged was stored."""


class WrongMajor(LogUnavailable):
    """The data directory belongs to another major version of PostgreSQL."""


class DiskNearlyFull(LogUnavailable):
    """The log's disk has less room than must stay free: nothing was recorded, and it goes on when there is room."""


class ArchiveUnavailable(LogUnavailable):
    """The place of the sealed files cannot be reached; what it holds is not lost by that."""


class DatabaseDamaged(StoreError):
    """PostgreSQL finds that its own files do not hold what it wrote."""


class SchemaMismatch(StoreError):
    """The database's schema is newer than this program, or not ours."""


class BadProof(StoreError):
    """A key, a signed checkpoint or a saved verification is not what it must be."""


class TableBusy(StoreError):
    """A row table cannot be changed while queries read it; nothing was changed."""


class QuestionFailed(StoreError):
    """A question from the field that PostgreSQL does not take, or cannot answer."""


class QuestionTooDear(StoreError):
    """A question from the field that would cost more time, memory or disk than it may."""

    def __init__(self, message: str, *, is_time: bool = False) -> None:
        super().__init__(message)
        self.is_time = is_time
        """Whether it is time that it would cost."""


class BadRequest(StoreError):
    """A call asked for what the log does not do."""


class BackupUnusable(StoreError):
    """A backup cannot be made in this folder, or cannot be restored into this log."""


class BackupDamaged(BackupUnusable):
    """The files of a backup are not what its manifest says."""


@dataclass(eq=False)
class SequenceConflict(StoreError):
    """A stream does not stand where the writer expected, or holds other bytes there."""

    stream: StreamName
    expected: int
    actual: int
    stored_hash: str | None = None
    sent_hash: str | None = None
    until: int | None = None
    """what was sent reaches beyond this sequence, behind which the stream is here already"""

    def __str__(self) -> str:
        if self.until is not None:
            return (
                f"stream {self.stream} is here from sequence {self.until + 1} on: "
                f"what was sent behind sequence {self.expected} reaches beyond {self.until}"
            )
        if self.stored_hash is not None:
            return (
                f"stream {self.stream} already holds other bytes after sequence {self.expected}: "
                f"stored payload {self.stored_hash}, sent payload {self.sent_hash}"
            )
        return f"stream {self.stream} stands at sequence {self.actual}, the append expected {self.expected}"


@dataclass(eq=False)
class ChainBroken(StoreError):
    """Bytes do not carry the hash that they should."""

    stream: StreamName
    position: int | None
    first_sequence: int
    reason: str

    def __str__(self) -> str:
        at = f"position {self.position}, " if self.position is not None else ""
        return (
            f"station {self.stream.station}: stream {self.stream}, {at}"
            f"from sequence {self.first_sequence}: {self.reason}"
        )


@dataclass(eq=False)
class SealedFileDamaged(ChainBroken):
    """A part of a sealed file cannot be read: it was damaged or is missing, and with it a range of positions."""

    last_position: int
    """Last position that cannot be read; `position` is the first."""

    def __str__(self) -> str:
        return f"positions {self.position} to {self.last_position}: {self.reason}"
