"""The append-only log on PostgreSQL, and its projections.

`open_log` gives a `Log` on an embedded or an external PostgreSQL; append, read, subscribe,
checkpoints and verify are its methods. Rows for SQL are projections of segments: `Projector`.
"""

from store.appender import Appender
from store.errors import (
    ArchiveUnavailable,
    BadRequest,
    ChainBroken,
    LogUnavailable,
    SchemaMismatch,
    SealedFileDamaged,
    SequenceConflict,
    StoreError,
    TableBusy,
    WrongMajor,
)
from store.journal import Journal
from store.log import Checkpoint, Log, StreamHead, Transaction, open_log
from store.projector import Projector
from store.sealing import Sealer
from store.shared import SharedAppender, Stored
from store.subscription import Delivery, Subscription
from store.upkeep import RowPolicy, RowTable, Upkeep, maintain, row_tables
from store.verification import Verification, verify
from store.writing import Appended

__all__ = [
    "Appended",
    "Appender",
    "ArchiveUnavailable",
    "BadRequest",
    "ChainBroken",
    "Checkpoint",
    "Delivery",
    "Journal",
    "Log",
    "LogUnavailable",
    "Projector",
    "RowPolicy",
    "RowTable",
    "SchemaMismatch",
    "SealedFileDamaged",
    "Sealer",
    "SequenceConflict",
    "SharedAppender",
    "StoreError",
    "Stored",
    "StreamHead",
    "Subscription",
    "TableBusy",
    "Transaction",
    "Upkeep",
    "Verification",
    "WrongMajor",
    "maintain",
    "open_log",
    "row_tables",
    "verify",
]
