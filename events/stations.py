"""Stations: what replicates where."""

from events.model import EventType, JsonText


class SyncPlanned(EventType, type="sync_planned", version=1):
    """A station decided which streams to replicate, in which order."""

    central: str
    """address of the central server"""
    plan: JsonText
    """the whole plan: ordered entries"""
    plan_hash: str
    """SHA-256 of the plan's canonical form, in hexadecimal"""
