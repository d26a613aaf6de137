"""The append-only log on PostgreSQL, and its projections.

`open_log` gives a `Log` on an embedded or an external PostgreSQL; append, read, subscribe,
checkpoints and verify are its methods. Rows for SQL are projections of segments: `Projector`.
"""

from store.appender import Appender
from store.errors import (
    BadRequest,
    ChainBroken,
    LogUnavailable,
    SchemaMismatch,
    SequenceConflict,
    StoreError,
    TableBusy,
    WrongMajor,
)
from store.log import Appended, Checkpoint, Log, StreamHead, Transaction, open_log
from store.projector import Projector
from store.subscription import Delivery, Subscription
from store.upkeep import RowPolicy, RowTable, Upkeep, maintain, row_tables
from store.verification import Verification, verify

__all__ = [
    "Appended",
    "Appender",
    "BadRequest",
    "ChainBroken",
    "Checkpoint",
    "Delivery",
    "Log",
    "LogUnavailable",
    "Projector",
    "RowPolicy",
    "RowTable",
    "SchemaMismatch",
    "SequenceConflict",
    "StoreError",
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
