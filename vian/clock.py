"""This machine's clock, passed to those that need one."""

from datetime import UTC, datetime


def utc_now() -> datetime:
    """This machine's clock."""
    return datetime.now(UTC)
