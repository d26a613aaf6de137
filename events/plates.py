"""Plates: which number plates were read.

Pixels: origin top-left, x right, y down; boxes are `x1 y1 x2 y2`.
"""

from typing import Annotated

from pydantic import Field

from events.model import EventType, Finite32, PersonalJson, PersonalText, Share32


class PlateRead(EventType, type="plate_read", version=1, subject="plate"):
    """A number plate was read in one frame."""

    plate: PersonalText
    """the plate's text as read, without blanks"""
    confidence: Share32
    """how sure the reading is, 0 (not at all) to 1 (sure)"""
    frame: Annotated[int, Field(ge=0)]
    """number of the frame within the video, from 0"""
    x1: Finite32
    """left edge of the plate's box, px"""
    y1: Finite32
    """upper edge of the plate's box, px"""
    x2: Finite32
    """right edge of the plate's box, px"""
    y2: Finite32
    """lower edge of the plate's box, px"""
    country: str | None
    """country of registration, ISO 3166-1 alpha-2; null where unread"""
    region: str | None
    """region within the country, as the plate shows it; null where unread"""
    candidates: PersonalJson | None
    """other readings, surest first, each with plate and confidence (0 to 1); null where there are none"""
