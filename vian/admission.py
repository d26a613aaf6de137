"""Who may speak to this central server: registry, certificate and refusals from the settings."""

import threading
from datetime import datetime, timedelta
from time import monotonic

import structlog

from events import Station, station_name
from store import Log, LogUnavailable, known_keys, make_key
from sync.central.access import Access
from sync.central.refusals import Refusals
from sync.central.registry import Registry
from sync.protocol.enrolment import Code, code_text, new_secret
from vian.clock import utc_now
from vian.errors import WrongUsage
from vian.parts import Part, stepping
from vian.settings import Settings
from vian.signatures import key_path
from vian.tls import CERTIFICATE_NAME, Certificate, given_certificate, own_certificate

logger = structlog.get_logger()

_PAUSE_SECONDS = 1.0


def access_for(log: Log, settings: Settings) -> Access:
    """Who may speak to this central server, whose key is made if there is none."""
    path = key_path(settings)
    key = make_key(path)
    access = Access(
        log,
        station_name(settings.station),
        key,
        own_keys=known_keys(path),
        now=utc_now,
        token_minutes=settings.token_minutes,
    )
    access.registry.recover()
    return access


def registry_for(log: Log, settings: Settings) -> Registry:
    """The stations of this central server."""
    registry = Registry(log, station_name(settings.station), utc_now)
    registry.recover()
    return registry


def refusals_for(log: Log, settings: Settings) -> Refusals:
    """Counts what this central server refuses."""
    return Refusals(log, station_name(settings.station), utc_now, monotonic)


def refusals_part(log: Log, refusals: Refusals) -> Part:
    """Records refusals minute by minute, and the rest at the end; each is told in the program's log."""

    def step() -> None:
        _record(refusals, is_all=False)
        threading.Event().wait(_PAUSE_SECONDS)

    def close() -> None:
        try:
            _record(refusals, is_all=True)
        except LogUnavailable as error:
            logger.error("the last refusals are not recorded", counts=_counts(refusals), error=str(error))

    return stepping("refusals", step, log, close)


def _record(refusals: Refusals, *, is_all: bool) -> None:
    for event in refusals.record(is_all=is_all):
        logger.warning(
            "refused",
            station=event.claimed,
            endpoint=event.endpoint,
            code=event.code,
            got=event.got,
            address=event.address,
            count=event.count,
        )


def _counts(refusals: Refusals) -> dict[str, int]:
    return {f"{endpoint}: {code}": count for (endpoint, code), count in refusals.counts().items()}


def certificate_of(settings: Settings) -> Certificate | None:
    """The certificate that this central server shows; None where it serves plain http.

    Raises:
        WrongUsage: It cannot be used, or two were asked for.
        WorldFailed: One cannot be made.
    """
    if settings.tls_certificate is not None or settings.tls_key is not None:
        if settings.tls == "generate":
            raise WrongUsage("two certificates: give either --tls-certificate FILE or --tls generate")
        return given_certificate(settings.tls_certificate, settings.tls_key)
    return own_certificate(settings.data_dir) if settings.tls == "generate" else None


def invited(
    registry: Registry, settings: Settings, name: Station, operations: list[str], reads: list[str]
) -> tuple[str, datetime]:
    """A new one-time code for the station, and when it ends."""
    secret = new_secret()
    expires_at = utc_now() + timedelta(hours=settings.invite_hours)
    registry.invite(name, secret, operations, reads, expires_at)
    return code_text(Code(secret, _pin(settings))), expires_at


def _pin(settings: Settings) -> bytes | None:
    """The pin of the certificate that this central made itself, if that is the one it shows."""
    is_made = (settings.data_dir / CERTIFICATE_NAME).exists() or settings.tls == "generate"
    if settings.tls_certificate is not None or not is_made:
        return None
    return own_certificate(settings.data_dir).pin
