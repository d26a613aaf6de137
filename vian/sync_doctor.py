"""What stands in the way of replication at a station: one finding a check, each with the next command.

Contract: looks, and changes nothing here. Central is asked by one signed hello, which names no streams; what lies
between is tried step by step, and the first step that fails ends the way there.
"""

import socket
import ssl
from collections.abc import Callable, Iterator, Sequence
from datetime import datetime
from urllib.request import getproxies, proxy_bypass

import httpx
from cryptography import x509

from events import Station, StreamName, station_name
from store import Log, load_key
from sync.errors import BadAnswer, CentralError, HeadsDisagree, PlanError
from sync.plans.checking import check_filters, warnings_of
from sync.plans.plan import Plan
from sync.plans.planning import planned_in
from sync.protocol.wire import HelloAnswer
from vian.epochs import CONNECT_SECONDS, compare
from vian.errors import VianError
from vian.findings import Finding, Verdict
from vian.log_checks import check_clock, check_horizon
from vian.membership import Membership, load_membership
from vian.output import counted
from vian.peers import Peer, peer_of
from vian.replication import load_plan
from vian.settings import Settings
from vian.signatures import key_path
from vian.spans import span
from vian.sync_view import StationView, station_view
from vian.tls import certificate_pin

CERTIFICATE_NOTE_DAYS = 21
CLOCK_NOTE_S = 2.0
CLOCK_BAD_S = 60.0
_SHOWN = 3


def examine(log: Log, settings: Settings, now: Callable[[], datetime]) -> Iterator[Finding]:
    """The findings, one after the other.

    Args:
        log: The station's log.
        settings: The station's settings.
        now: The station's clock.
    """
    station = station_name(settings.station)
    plan, finding = _plan(log, settings, station, now())
    yield finding
    yield check_clock(log, now)
    yield check_horizon(log, log.room.free())
    if plan is not None:
        yield _policy(plan)
        yield from _daemon(station_view(log, station, now(), plan))
    peer = None
    try:
        peer = peer_of(settings)
        yield _enrolment(settings, peer)
    except VianError as error:
        yield Finding("enrolment", Verdict.BAD, str(error))
    if peer is not None:
        yield from _central(log, station, peer, now)


def _plan(log: Log, settings: Settings, station: Station, now: datetime) -> tuple[Plan | None, Finding]:
    try:
        planned = planned_in(log, station)
        plan = planned.plan if planned is not None else load_plan(settings.plan).resolved(now)
        check_filters(plan, log.catalogue)
    except PlanError as error:
        return None, Finding("plan", Verdict.BAD, f"{error}. Next: vian sync plan set FILE with a corrected one")
    own = [head.stream for head in log.streams() if head.stream.station == station]
    return plan, _fit(plan, own)


def _fit(plan: Plan, streams: Sequence[StreamName]) -> Finding:
    sent = [stream for stream in streams if plan.entry_for(stream) is not None]
    if plan.paused:
        return Finding("plan", Verdict.NOTE, "it is paused: nothing is sent. Next: vian sync plan resume")
    if streams and not sent:
        patterns = ", ".join(entry.stream for entry in plan.entries if entry.sends) or "none"
        return Finding(
            "plan",
            Verdict.BAD,
            f"it fits none of the {len(streams)} streams here; it sends {patterns}. "
            "Next: vian streams, then vian sync plan set FILE",
        )
    if vain := warnings_of(plan):
        return Finding("plan", Verdict.NOTE, vain[0])
    return Finding("plan", Verdict.OK, f"it sends {len(sent)} of {len(streams)} streams")


def _policy(plan: Plan) -> Finding:
    if plan.give_up:
        said = ", ".join(
            f"{entry.stream} older than {span(entry.older_than.total_seconds())}" for entry in plan.give_up
        )
        return Finding("full disk", Verdict.OK, f"first goes what central holds, then {said}")
    return Finding("full disk", Verdict.NOTE, "recording stops then: the plan names nothing under give_up")


def _daemon(view: StationView) -> Iterator[Finding]:
    if view.state == "no daemon yet":
        yield Finding("daemon", Verdict.NOTE, "none ran yet. Next: vian sync, or vian serve --role station")
    elif view.state == "silent":
        yield Finding("daemon", Verdict.BAD, "it says nothing any more. Next: start vian sync or vian serve")
    elif view.failures:
        yield Finding("daemon", Verdict.BAD, f"{counted(view.failures, 'failure')} in a row: {view.last_error}")
    else:
        yield Finding("daemon", Verdict.OK, f"{view.state.replace('_', ' ')}, {view.events} events wait")
    if view.other_daemons:
        yield Finding(
            "daemon",
            Verdict.NOTE,
            f"{view.other_daemons + 1} run for this station; one is enough. Next: stop the others",
        )
    stopped = [each for each in view.streams if each.why_stopped]
    for each in stopped[:_SHOWN]:
        yield Finding("streams", Verdict.BAD, f"{each.stream}: {each.why_stopped}")
    if len(stopped) > _SHOWN:
        yield Finding("streams", Verdict.BAD, f"{len(stopped) - _SHOWN} more are stopped. Next: vian sync status")


def _enrolment(settings: Settings, peer: Peer | None) -> Finding:
    membership = load_membership(settings)
    if membership is None:
        if peer is None:
            return Finding(
                "enrolment",
                Verdict.BAD,
                f"this station is not enrolled. Next: vian station invite {settings.station} on central, then "
                "vian station enrol CODE --central URL here",
            )
        return Finding("enrolment", Verdict.NOTE, "by a token, in protocol 1: no questions, no countersignatures")
    return _membership(membership, settings, peer)


def _membership(membership: Membership, settings: Settings, peer: Peer | None) -> Finding:
    key = load_key(key_path(settings))
    if membership.key_id and key.id != membership.key_id:
        return Finding(
            "enrolment",
            Verdict.BAD,
            f"central took in the key {membership.key_id}, and {key_path(settings)} is {key.id}. Next: bring that key "
            f"back, or vian station invite {membership.station} on central, then vian station enrol CODE here",
        )
    may = ", ".join(membership.operations)
    at = peer.address if peer is not None else membership.address
    return Finding("enrolment", Verdict.OK, f"{membership.station} at central {membership.central}, {at}; may {may}")


def _central(log: Log, station: Station, peer: Peer, now: Callable[[], datetime]) -> Iterator[Finding]:
    """The way to central, and what central says."""
    url = httpx.URL(peer.address)
    proxy = _proxy(url)
    if proxy is not None:
        yield Finding("proxy", Verdict.NOTE, f"{proxy} stands between; NO_PROXY={url.host} goes past it")
    else:
        for finding in _way(url, peer):
            yield finding
            if finding.verdict is Verdict.BAD:
                return
    asked = now()
    try:
        answer, found = compare(log, station, peer, asked)
    except CentralError as error:
        yield Finding("central", Verdict.BAD, _explained(error))
        return
    yield Finding("central", Verdict.OK, f"{answer.program} answers {answer.station} in protocol {answer.protocol}")
    yield _offset((answer.time - asked).total_seconds())
    yield from _heads(log, answer, found)


def _proxy(url: httpx.URL) -> str | None:
    """The proxy that requests go through, without what it asks for; None where they go straight."""
    given = getproxies().get(url.scheme) or getproxies().get("all")
    if not given or proxy_bypass(url.host):
        return None
    return str(httpx.URL(given).copy_with(username=None, password=None))


def _way(url: httpx.URL, peer: Peer) -> Iterator[Finding]:
    port = url.port or (443 if url.scheme == "https" else 80)
    try:
        found = socket.getaddrinfo(url.host, port, type=socket.SOCK_STREAM)
    except OSError as error:
        yield Finding(
            "name",
            Verdict.BAD,
            f"{url.host} does not resolve ({error.strerror}). Next: check the address, the link and DNS: "
            f"getent hosts {url.host}",
        )
        return
    addresses = sorted({str(each[4][0]) for each in found})
    yield Finding("name", Verdict.OK, f"{url.host} is {', '.join(addresses[:_SHOWN])}")
    try:
        socket.create_connection((url.host, port), timeout=CONNECT_SECONDS).close()
    except OSError as error:
        said = error.strerror or "no answer in time"
        yield Finding(
            "route",
            Verdict.BAD,
            f"{url.host} port {port}: {said}. Next: check link and firewall, and that central runs: "
            "vian serve --role central",
        )
        return
    yield Finding("route", Verdict.OK, f"{url.host} port {port} takes connections")
    if url.scheme == "https":
        yield _certificate(url.host, port, peer)


def _certificate(host: str, port: int, peer: Peer) -> Finding:
    try:
        shown = ssl.get_server_certificate((host, port), timeout=CONNECT_SECONDS)
    except OSError as error:
        return Finding("certificate", Verdict.BAD, f"none is shown: {error}. Next: check address and port")
    if peer.certificate is not None:
        if certificate_pin(shown) != certificate_pin(peer.certificate):
            return Finding(
                "certificate",
                Verdict.BAD,
                "it has another key than the one pinned at enrolment: somebody stands between, or central made it "
                "anew. Next: ask central's operator; if so, vian station enrol CODE --central URL with a new code",
            )
        return Finding("certificate", Verdict.OK, "the one that was pinned at enrolment")
    return _lasting(x509.load_pem_x509_certificate(shown.encode("ascii")), host)


def _lasting(certificate: x509.Certificate, host: str) -> Finding:
    """How long an operator's certificate is good, by this machine's clock, and for which names."""
    end = certificate.not_valid_after_utc
    days = (end - datetime.now(end.tzinfo)).total_seconds() / 86_400
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        named = ", ".join(str(each.value) for each in list(names)[:_SHOWN])
    except x509.ExtensionNotFound:
        named = "no name"
    said = f"for {named}, until {end:%Y-%m-%d}"
    if days < 0:
        return Finding(
            "certificate",
            Verdict.BAD,
            f"it has expired: {said}. Next: renew it on central; if it is good, set this machine's clock",
        )
    if days < CERTIFICATE_NOTE_DAYS:
        return Finding(
            "certificate", Verdict.NOTE, f"{said}, {days:.0f} days from now. Next: renew it on central of {host}"
        )
    return Finding("certificate", Verdict.OK, said)


def _explained(error: CentralError) -> str:
    if isinstance(error, BadAnswer) and "text/html" in str(error):
        return (
            "a web page answers in central's place, as a hotel's or a ship's login page does, or a proxy. "
            f"Next: open any page in a browser on this network, and accept its terms. {error}"
        )
    return str(error)


def _offset(seconds: float) -> Finding:
    size, which = abs(seconds), "behind" if seconds > 0 else "ahead of"
    if size <= CLOCK_NOTE_S:
        return Finding("clock", Verdict.OK, "agrees with central's")
    said = f"this machine's is {size:.0f} s {which} central's"
    if size <= CLOCK_BAD_S:
        return Finding("clock", Verdict.NOTE, f"{said}. Next, if that matters: timedatectl set-ntp true")
    return Finding(
        "clock",
        Verdict.BAD,
        f"{said}: times of recording differ by as much; nothing else rests on it. Next: timedatectl set-ntp true",
    )


def _heads(log: Log, answer: HelloAnswer, found: Sequence[HeadsDisagree]) -> Iterator[Finding]:
    """Whether what central holds can belong to this log's history."""
    for is_past, verdict in ((False, Verdict.BAD), (True, Verdict.NOTE)):
        wrong = [error for error in found if error.is_past == is_past]
        for error in wrong[:_SHOWN]:
            yield Finding("epoch", verdict, str(error))
        if len(wrong) > _SHOWN:
            yield Finding("epoch", verdict, f"the same of {len(wrong) - _SHOWN} more streams")
    if not found:
        yield Finding("epoch", Verdict.OK, f"epoch {log.epoch}; what central holds is of {_lives(log, answer)}")


def _lives(log: Log, answer: HelloAnswer) -> str:
    has_earlier = any(cursor.epoch < log.epoch for cursor in answer.cursors)
    return "this log, or of epochs before it" if has_earlier else "this log"
