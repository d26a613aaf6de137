"""The append-only log on PostgreSQL, and its projections.

`open_log` gives a `Log` on an embedded or an external PostgreSQL; append, read, subscribe,
checkpoints and verify are its methods. Rows for SQL are projections of segments: `Projector`.
"""

from store.appender import Appender
from store.backup import Backup, back_up
from store.errors import (
    BackupDamaged,
    BackupUnusable,
    BadRequest,
    ChainBroken,
    DatabaseDamaged,
    LogUnavailable,
    SchemaMismatch,
    SequenceConflict,
    StoreError,
    WrongMajor,
)
from store.journal import Journal
from store.log import Checkpoint, Log, StreamHead, Transaction, open_log
from store.projector import Projector
from store.restoring import Restore, note_restored, restore, verify_restored
from store.shared import SharedAppender, Stored
from store.subscription import Delivery, Subscription
from store.verification import Verification, verify
from store.writing import Appended

__all__ = [
    "Appended",
    "Appender",
    "Backup",
    "BackupDamaged",
    "BackupUnusable",
    "BadRequest",
    "ChainBroken",
    "Checkpoint",
    "DatabaseDamaged",
    "Delivery",
    "Journal",
    "Log",
    "LogUnavailable",
    "Projector",
    "Restore",
    "SchemaMismatch",
    "SequenceConflict",
    "SharedAppender",
    "StoreError",
    "Stored",
    "StreamHead",
    "Subscription",
    "Transaction",
    "Verification",
    "WrongMajor",
    "back_up",
    "note_restored",
    "open_log",
    "restore",
    "verify",
    "verify_restored",
]
