"""The append-only log on PostgreSQL, and its projections.

`open_log` gives a `Log` on an embedded or an external PostgreSQL; append, read, subscribe,
checkpoints and verify are its methods. Rows for SQL are projections of segments: `Projector`.
"""

from store.appender import Appender
from store.audit import Covered
from store.backup import Backup, back_up
from store.errors import (
    ArchiveUnavailable,
    BackupDamaged,
    BackupUnusable,
    BadProof,
    BadRequest,
    ChainBroken,
    DatabaseDamaged,
    DiskNearlyFull,
    LogUnavailable,
    SchemaMismatch,
    SealedFileDamaged,
    SequenceConflict,
    StoreError,
    TableBusy,
    WrongMajor,
)
from store.journal import Journal
from store.keys import StationKey, keys_of_others, known_keys, load_key, make_key
from store.log import Checkpoint, Log, Transaction, open_log
from store.projector import Projector
from store.proof import SignedCheckpoint, Statement, key_id
from store.restoring import Restore, note_restored, restore, verify_restored
from store.sealing import Sealer
from store.shared import SharedAppender, Stored
from store.signing import Signer
from store.standing import Standing, StreamHead
from store.subscription import Delivery, Subscription
from store.upkeep import RowPolicy, RowTable, Upkeep, maintain, row_tables
from store.verification import Gap, Verification, verify
from store.verified import Verified
from store.writing import Appended

__all__ = [
    "Appended",
    "Appender",
    "ArchiveUnavailable",
    "Backup",
    "BackupDamaged",
    "BackupUnusable",
    "BadProof",
    "BadRequest",
    "ChainBroken",
    "Checkpoint",
    "Covered",
    "DatabaseDamaged",
    "Delivery",
    "DiskNearlyFull",
    "Gap",
    "Journal",
    "Log",
    "LogUnavailable",
    "Projector",
    "Restore",
    "RowPolicy",
    "RowTable",
    "SchemaMismatch",
    "SealedFileDamaged",
    "Sealer",
    "SequenceConflict",
    "SharedAppender",
    "SignedCheckpoint",
    "Signer",
    "Standing",
    "Statement",
    "StationKey",
    "StoreError",
    "Stored",
    "StreamHead",
    "Subscription",
    "TableBusy",
    "Transaction",
    "Upkeep",
    "Verification",
    "Verified",
    "WrongMajor",
    "back_up",
    "key_id",
    "keys_of_others",
    "known_keys",
    "load_key",
    "maintain",
    "make_key",
    "note_restored",
    "open_log",
    "restore",
    "row_tables",
    "verify",
    "verify_restored",
]
