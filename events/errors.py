"""What can go wrong with the language of events.

EventError
├── UnknownType          no such event type, or a version this program does not know
│   └── UpcastFailed     an old version is known, but a plug-in does not bring it to the newest
├── InvalidName          a station, source, type or stream name outside the grammar
├── InvalidEvent         a value that the type's definition does not allow
├── CorruptSegment       bytes that are not the segment they claim to be
└── PayloadGone          a segment's payload left the disk; its header and hashes are here
"""


class EventError(Exception):
    """Base of every error that the package `events` raises."""


class UnknownType(EventError):
    """No such event type, or a version of it that this program does not know."""


class UpcastFailed(UnknownType):
    """A stored event cannot be brought to the newest version of its type: its upcaster is at fault."""


class InvalidName(EventError):
    """A station, source, type or stream name outside the grammar."""


class InvalidEvent(EventError):
    """A value, column or batch that the type's definition does not allow."""


class CorruptSegment(EventError):
    """Bytes that are not the segment that they claim to be."""


class PayloadGone(EventError):
    """A segment's payload left the disk, pruned or lost; its header and hashes are here, its events are not."""
