"""From a station's log to central's: segments verbatim over HTTPS, each exactly once in effect.

A station's `Daemon` sends what its `Plan` names; central's `router` takes it for the stations in its
`Grants`. The protocol is docs/reference/sync.md.
"""

from sync.central.router import Limits, router
from sync.errors import (
    BadAnswer,
    CentralError,
    CentralFailed,
    CentralUnreachable,
    Damaged,
    FilterFailed,
    GrantError,
    HeadsDisagree,
    NotAuthorised,
    PlanError,
    ProtocolMismatch,
    Refusal,
    Refused,
    SegmentRefused,
    SessionOver,
    StreamStopped,
    SyncError,
    WireError,
)
from sync.plans.plan import LANES, Entry, Plan
from sync.protocol.grants import Grants, token_hash
from sync.protocol.reports import Pace, Status, Step, StreamStatus
from sync.station.daemon import Daemon

__all__ = [
    "LANES",
    "BadAnswer",
    "CentralError",
    "CentralFailed",
    "CentralUnreachable",
    "Daemon",
    "Damaged",
    "Entry",
    "FilterFailed",
    "GrantError",
    "Grants",
    "HeadsDisagree",
    "Limits",
    "NotAuthorised",
    "Pace",
    "Plan",
    "PlanError",
    "ProtocolMismatch",
    "Refusal",
    "Refused",
    "SegmentRefused",
    "SessionOver",
    "Status",
    "Step",
    "StreamStatus",
    "StreamStopped",
    "SyncError",
    "WireError",
    "router",
    "token_hash",
]
