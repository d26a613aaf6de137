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
    WrongMajor,
)
from store.log import Appended, Checkpoint, Log, StreamHead, Transaction, open_log
from store.projector import Projector
from store.sealing import Sealer
from store.subscription import Delivery, Subscription
from store.verification import Verification, verify

__all__ = [
    "Appended",
    "Appender",
    "ArchiveUnavailable",
    "BadRequest",
    "ChainBroken",
    "Checkpoint",
    "Delivery",
    "Log",
    "LogUnavailable",
    "Projector",
    "SchemaMismatch",
    "SealedFileDamaged",
    "Sealer",
    "SequenceConflict",
    "StoreError",
    "StreamHead",
    "Subscription",
    "Transaction",
    "Verification",
    "WrongMajor",
    "open_log",
    "verify",
]
