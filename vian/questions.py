"""Questions of stations at this central server: what answers them, from the settings."""

import hashlib
import hmac
from time import monotonic

from events import station_name
from store import Log
from store.field import Cost
from sync.central.access import Access
from sync.central.answering import Answering, QuestionLimits
from sync.central.pages import Pages
from vian.clock import utc_now
from vian.settings import Settings

_PURPOSE = b"vian: where a question goes on"


def answering_for(log: Log, settings: Settings, access: Access) -> Answering:
    """What answers the questions of the stations that `access` lets in.

    Pages are sealed with a secret that follows from central's key, so they hold when central starts again.
    """
    secret = hmac.digest(access.key.private.private_bytes_raw(), _PURPOSE, hashlib.sha256)
    return Answering(
        log,
        station_name(settings.station),
        Pages(secret),
        limits_of(settings),
        utc_now,
        monotonic,
        access.check_again,
    )


def limits_of(settings: Settings) -> QuestionLimits:
    """What questions may cost."""
    cost = Cost(seconds=settings.question_s, memory_mb=settings.question_memory_mb, disk_mb=settings.question_disk_mb)
    answer_bytes = settings.question_answer_kb * 1024
    return QuestionLimits(
        cost=cost,
        rows_max=settings.question_rows_max,
        answer_bytes_max=answer_bytes,
        row_bytes_max=answer_bytes // 8,
        of_station_max=settings.questions_of_station_max,
        at_once_max=settings.questions_at_once_max,
    )
