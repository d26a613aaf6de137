"""Relations: how things that move stand to each other, and how many there are; derived by stages from other events.

Pixels: origin top-left, x right, y down. Points are ground contact points, as in `track_point`. All of a
source's points of one time are one frame.
"""

from typing import Annotated

from pydantic import Field

from events.model import AtDoor, EventType, Finite32, Float32, UtcTime

Length32 = Annotated[Float32, AtDoor(0)]
"""A `Float32` of 0 or more: distances, speeds without direction."""


class PairDistance(EventType, type="pair_distance", version=1, subject="pair"):
    """Two tracked objects of a source were near each other in a frame."""

    stage: str
    """name of the stage that derived it"""
    pair: str
    """the two tracks' numbers, the lower first: `3+7`"""
    track_a: Annotated[int, AtDoor(1)]
    """number of the track with the lower number"""
    track_b: Annotated[int, AtDoor(1)]
    """number of the track with the higher number"""
    distance_px: Length32
    """distance between the two points, px"""
    closing_px_s: Finite32
    """speed at which the distance shrinks, px/s; negative where it grows"""
    speed_a_px_s: Length32
    """speed of the track with the lower number, px/s"""
    speed_b_px_s: Length32
    """speed of the track with the higher number, px/s"""
    alignment: Annotated[Float32, AtDoor(-1, 1)] | None
    """cosine of the angle between the two velocities, -1 to 1; null where one of them stands still"""
    x: Finite32
    """middle between the two points, px"""
    y: Finite32
    """middle between the two points, px"""


class Occupancy(EventType, type="occupancy", version=1, subject="zone"):
    """The number of tracked objects in a zone changed."""

    stage: str
    """name of the stage that derived it"""
    zone: str
    """name of the zone"""
    tracks: Annotated[int, Field(ge=0)]
    """how many tracks are in it from this time on"""
    tracks_before: Annotated[int, Field(ge=0)]
    """how many there were until this time"""


class GroupSeen(EventType, type="group_seen", version=1, subject="group_id"):
    """Tracked objects stood or went together for a while: a group formed, changed, went on or dissolved."""

    stage: str
    """name of the stage that derived it"""
    group_id: Annotated[int, AtDoor(1)]
    """number of the group, unique within its source and stage"""
    members: Annotated[int, Field(ge=0)]
    """how many tracks belong to it from this time on; 0: it has dissolved"""
    tracks: str
    """the members' numbers, ascending: `3+7+9`; empty where it has dissolved"""
    began_at: UtcTime
    """time from which its members have been together (UTC)"""
    x: Finite32
    """mean of the members' points, px; where it has dissolved, the last one"""
    y: Finite32
    """mean of the members' points, px; where it has dissolved, the last one"""
    radius_px: Length32
    """distance from the mean to the member furthest from it, px; where it has dissolved, the last one"""


class Tally(EventType, type="tally", version=1, subject="key"):
    """How many events there were in a window of time; its time is the window's end."""

    stage: str
    """name of the stage that derived it"""
    key: str
    """value of the column by which events are counted apart; empty where they are counted together"""
    began_at: UtcTime
    """beginning of the window, inclusive (UTC)"""
    window_s: Annotated[float, AtDoor(0)]
    """length of the window, s"""
    events: Annotated[int, Field(ge=0)]
    """how many events lie in the window"""


class StageDeployed(EventType, type="stage_deployed", version=1, subject="stage"):
    """A version of a stage was put into service."""

    stage: str
    """name of the stage"""
    stage_version: Annotated[int, Field(ge=1)]
    """version of the stage"""
    stage_hash: str
    """SHA-256 of what the stage derives from, in hexadecimal"""
    text: str
    """the stage file, whole"""
