"""The language: what can have happened.

Event types, their catalogue, their columns, and the segment that holds a batch of them. This
package imports none of ViAn's others, knows no database and no network.
"""

from events.camera import CameraCalibrated, SceneChanged, ZoneDefined, ZoneRemoved
from events.catalogue import SHIPPED, Catalogue, load_catalogue
from events.columns import EventBatch, batch_of, batch_of_type, events_of, schema_of, with_envelope
from events.door import Allowed, allowed
from events.errors import CorruptSegment, EventError, InvalidEvent, InvalidName, UnknownType, UpcastFailed
from events.media import VideoAdded
from events.model import (
    AtDoor,
    EventType,
    Finite32,
    Float32,
    JsonText,
    Part,
    PersonalBytes,
    PersonalJson,
    PersonalText,
    Share32,
    UtcTime,
)
from events.motion import ActivityInterval, TrackEnded, TrackEndedV1, TrackPoint
from events.names import Source, Station, StreamName, TypeName, source_name, station_name, type_name
from events.plates import PlateRead
from events.proof import CheckpointSigned, LossRecorded
from events.relations import GroupSeen, Occupancy, PairDistance, StageDeployed, Tally
from events.segment import (
    GENESIS,
    Draft,
    Header,
    Position,
    Producer,
    Segment,
    Sequence,
    chain,
    decode,
    encode,
    header_bytes,
    parse_header,
)
from events.situations import (
    MatchedRange,
    RuleDeployed,
    RuleDeployedV1,
    RuleMissed,
    RuleRetired,
    SituationDetected,
    SituationShadowed,
)
from events.stations import SyncPlanned
from events.work import ProcessFailed, ProcessFinished, ProcessProgressed, ProcessStarted

__all__ = [
    "GENESIS",
    "SHIPPED",
    "ActivityInterval",
    "Allowed",
    "AtDoor",
    "CameraCalibrated",
    "Catalogue",
    "CheckpointSigned",
    "CorruptSegment",
    "Draft",
    "EventBatch",
    "EventError",
    "EventType",
    "Finite32",
    "Float32",
    "GroupSeen",
    "Header",
    "InvalidEvent",
    "InvalidName",
    "JsonText",
    "LossRecorded",
    "MatchedRange",
    "Occupancy",
    "PairDistance",
    "Part",
    "PersonalBytes",
    "PersonalJson",
    "PersonalText",
    "PlateRead",
    "Position",
    "ProcessFailed",
    "ProcessFinished",
    "ProcessProgressed",
    "ProcessStarted",
    "Producer",
    "RuleDeployed",
    "RuleDeployedV1",
    "RuleMissed",
    "RuleRetired",
    "SceneChanged",
    "Segment",
    "Sequence",
    "Share32",
    "SituationDetected",
    "SituationShadowed",
    "Source",
    "StageDeployed",
    "Station",
    "StreamName",
    "SyncPlanned",
    "Tally",
    "TrackEnded",
    "TrackEndedV1",
    "TrackPoint",
    "TypeName",
    "UnknownType",
    "UpcastFailed",
    "UtcTime",
    "VideoAdded",
    "ZoneDefined",
    "ZoneRemoved",
    "allowed",
    "batch_of",
    "batch_of_type",
    "chain",
    "decode",
    "encode",
    "events_of",
    "header_bytes",
    "load_catalogue",
    "parse_header",
    "schema_of",
    "source_name",
    "station_name",
    "type_name",
    "with_envelope",
]
