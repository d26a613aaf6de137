"""Who may speak for a station: registry, codes, challenges, tokens and numbers, on a real database."""

import base64
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from datetime import datetime, timedelta
from time import monotonic

import httpx
import psycopg
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from events import EventType, Station, station_name
from store import Log, StationKey
from sync.central.access import Access, Caller
from sync.central.refusals import KINDS_MAX, Kind, Refusals
from sync.central.registry import Registered, Registry
from sync.central.sessions import WINDOW
from sync.errors import GrantError, Refusal
from sync.protocol.enrolment import Attempts, Code, Enrol, code_text, new_secret, parse_code
from sync.protocol.signing import RequestSigner
from sync.protocol.wire import PATH
from tests.sync.conftest import NOON

BRNO, OSLO, CENTRAL = (station_name(name) for name in ("brno-2", "oslo-1", "central"))
KEY, OTHER_KEY, CENTRAL_KEY = (StationKey(Ed25519PrivateKey.generate()) for _ in range(3))


class Clock:
    """A clock that tests set."""

    def __init__(self) -> None:
        self.time = NOON

    def __call__(self) -> datetime:
        return self.time

    def go(self, **by: float) -> None:
        self.time += timedelta(**by)


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def access(log: Log, clock: Clock) -> Access:
    return Access(log, CENTRAL, CENTRAL_KEY, now=clock)


def enrol(access: Access, name: Station = BRNO, key: StationKey = KEY, **granted: tuple[str, ...]) -> Registered:
    secret = new_secret()
    access.registry.invite(
        name,
        secret,
        granted.get("operations", ("replicate",)),
        granted.get("reads", ()),
        NOON + timedelta(hours=1),
    )
    return access.registry.enrol(name, secret, key.public, "192.0.2.7")


class Sender:
    """A station that signs requests, which are not sent."""

    def __init__(self, access: Access, name: str = "brno-2", key: StationKey = KEY) -> None:
        self._access = access
        self._name = name
        self.signer = RequestSigner(key, name, access.key.id, PATH)

    def headers(self, endpoint: str, body: bytes = b"") -> httpx.Headers:
        return next(self.signer.auth_flow(httpx.Request("POST", f"http://x{PATH}/{endpoint}", content=body))).headers

    def hello(self) -> Caller:
        self.signer.answer(self._access.challenge(self._name).challenge)
        asked = self._access.hello(self.headers("hello"))
        assert asked.token is not None
        self.signer.use(asked.token.text)
        return asked.caller

    def ask(self, headers: httpx.Headers | None = None, operation: str = "replicate") -> Caller:
        return self._access.asked(headers or self.headers("segments"), "segments", operation).caller


@pytest.fixture
def brno(access: Access) -> Sender:
    enrol(access, operations=("replicate", "find"), reads=("brno-2", "oslo-1"))
    return Sender(access)


def refused(call: Callable[[], object]) -> str:
    with pytest.raises(Refusal) as refusal:
        call()
    assert all((refusal.value.error, refusal.value.got, refusal.value.wanted, refusal.value.next))
    return refusal.value.code


# Enrolment.


@pytest.mark.parametrize("pin", [None, bytes(range(16))])
def test_a_code_is_carried_by_people(pin: bytes | None) -> None:
    code = Code(new_secret(), pin)
    text = code_text(code)
    assert parse_code(text) == code
    assert parse_code(f"  {text.lower().replace('-', ' ')}\n") == code
    assert len(text) == (28 if pin is None else 59)


@pytest.mark.parametrize("change", [lambda t: t[:-1], lambda t: t + "A", lambda t: "", lambda t: "!" + t[1:]])
def test_a_slip_in_a_code_is_noticed(change: Callable[[str], str]) -> None:
    with pytest.raises(GrantError, match=r"not a one-time code.*Next: copy it again"):
        parse_code(change(code_text(Code(new_secret(), None))))


def test_no_two_letters_of_a_code_can_be_swapped_unnoticed() -> None:
    text = code_text(Code(bytes(range(12)), None))
    for at in range(len(text) - 1):
        if text[at] != text[at + 1] and "-" not in text[at : at + 2]:
            with pytest.raises(GrantError):
                parse_code(text[:at] + text[at + 1] + text[at] + text[at + 2 :])


def test_a_station_is_taken_in_once_by_its_code_and_an_event_says_so(access: Access, log: Log) -> None:
    taken_in = enrol(access, operations=("replicate", "find"), reads=("oslo-1",))
    assert (taken_in.key_id, taken_in.operations, taken_in.reads) == (KEY.id, ("replicate", "find"), ("oslo-1",))
    (segment,) = log.read_all(types=["station_enrolled"])
    assert str(segment.stream) == "central/sync/station_enrolled"
    assert access.registry.invitations() == []


def test_a_code_counts_once_for_its_station_and_until_it_expires(access: Access, clock: Clock) -> None:
    registry, secret = access.registry, new_secret()
    registry.invite(BRNO, secret, ("replicate",), (), NOON + timedelta(minutes=5))
    assert refused(lambda: registry.enrol("brno-2", new_secret(), KEY.public, None)) == "unknown_code"
    assert refused(lambda: registry.enrol("oslo-1", secret, KEY.public, None)) == "foreign_station"
    registry.enrol("brno-2", secret, KEY.public, None)
    assert refused(lambda: registry.enrol("brno-2", secret, OTHER_KEY.public, None)) == "used_code"
    late = new_secret()
    registry.invite(BRNO, late, ("replicate",), (), NOON + timedelta(minutes=5))
    clock.go(minutes=5)
    assert refused(lambda: registry.enrol("brno-2", late, KEY.public, None)) == "expired_code"


def test_of_two_that_use_one_code_at_once_one_is_taken_in(access: Access) -> None:
    secret = new_secret()
    access.registry.invite(BRNO, secret, ("replicate",), (), NOON + timedelta(hours=1))
    codes: list[str] = []

    def use(key: StationKey) -> None:
        try:
            codes.append(access.registry.enrol("brno-2", secret, key.public, None).key_id)
        except Refusal as refusal:
            codes.append(refusal.code)

    threads = [threading.Thread(target=use, args=(key,)) for key in (KEY, OTHER_KEY)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(codes, key=len) == ["used_code", *({KEY.id, OTHER_KEY.id} & set(codes))]


def test_central_takes_nobody_in_by_its_own_name(access: Access) -> None:
    with pytest.raises(GrantError, match="central's own name"):
        access.registry.invite(CENTRAL, new_secret(), ("replicate",), (), NOON)


def test_a_station_must_have_the_key_that_it_shows(access: Access) -> None:
    secret = new_secret()
    access.registry.invite(BRNO, secret, ("replicate",), (), NOON + timedelta(hours=1))
    body = Enrol(secret=secret.hex(), public_key=KEY.public.hex()).encoded()
    forged = Sender(access, key=OTHER_KEY).headers("enrol", body)
    assert refused(lambda: access.enrol(forged, body, None)) == "bad_signature"
    sound = Sender(access).headers("enrol", body)
    other = Enrol(secret=secret.hex(), public_key=OTHER_KEY.public.hex()).encoded()
    assert refused(lambda: access.enrol(sound, other, None)) == "bad_signature"
    assert refused(lambda: access.enrol(sound, body + b" ", None)) == "bad_signature"
    assert refused(lambda: access.enrol(sound, b"<html>", None)) == "bad_message"
    answer = access.enrol(sound, body, "192.0.2.7")
    assert (answer.station, answer.central, answer.public_key) == ("brno-2", "central", CENTRAL_KEY.public.hex())


def test_an_address_may_try_some_enrolments_a_minute_and_all_addresses_are_bounded() -> None:
    now = 0.0
    attempts = Attempts(lambda: now, per_minute=3)
    for _ in range(3):
        attempts.check("192.0.2.7")
    assert refused(lambda: attempts.check("192.0.2.7")) == "too_many_attempts"
    attempts.check("192.0.2.8")
    for number in range(10_000):
        try:
            attempts.check(str(number))
        except Refusal:
            break
    assert number == 9_998
    now = 60.0
    attempts.check("192.0.2.7")


def test_the_registry_is_made_again_of_the_events_of_a_restored_log(access: Access, log: Log) -> None:
    enrol(access)
    enrol(access, OSLO, OTHER_KEY, reads=("*",))
    access.registry.revoke("brno-2", "stolen")
    before = access.registry.stations()
    with log.transaction() as transaction:
        transaction.connection.execute("reset role")
        transaction.connection.execute("truncate stations, enrolment_codes, sync_tokens")
    assert access.registry.recover() == 2
    assert access.registry.stations() == before
    assert access.registry.recover() == 2


# Sessions.


def test_a_hello_over_a_challenge_begins_a_session(brno: Sender) -> None:
    assert brno.hello() == Caller(
        BRNO, frozenset({"replicate", "find"}), frozenset({"brno-2", "oslo-1"}), KEY.id, number=0
    )
    assert [brno.ask().number for _ in range(3)] == [1, 2, 3]


def test_a_challenge_is_answered_once(brno: Sender, access: Access) -> None:
    brno.signer.answer(access.challenge("brno-2").challenge)
    headers = brno.headers("hello")
    access.hello(headers)
    assert refused(lambda: access.hello(headers)) == "stale_challenge"
    assert refused(lambda: access.hello(brno.headers("hello"))) == "stale_challenge"


def test_a_challenge_is_one_stations_and_ends(brno: Sender, access: Access, clock: Clock) -> None:
    for foreign in (access.challenge("oslo-1").challenge, "", "x", base64.urlsafe_b64encode(bytes(40)).decode()):
        brno.signer.answer(foreign)
        assert refused(lambda: access.hello(brno.headers("hello"))) == "stale_challenge"
    brno.signer.answer(access.challenge("brno-2").challenge)
    clock.go(seconds=61)
    assert refused(lambda: access.hello(brno.headers("hello"))) == "stale_challenge"
    brno.hello()


def test_a_challenge_of_another_central_does_not_count(brno: Sender, log: Log, access: Access, clock: Clock) -> None:
    other = Access(log, CENTRAL, OTHER_KEY, now=clock)
    brno.signer.answer(other.challenge("brno-2").challenge)
    assert refused(lambda: access.hello(brno.headers("hello"))) == "stale_challenge"


def test_a_central_whose_clock_was_set_back_goes_on_with_greater_numbers(
    brno: Sender, log: Log, access: Access, clock: Clock
) -> None:
    clock.go(days=400)
    brno.hello()
    clock.go(days=-400)
    restarted = Access(log, CENTRAL, CENTRAL_KEY, now=clock)
    sender = Sender(restarted)
    assert refused(sender.hello) == "stale_challenge"
    sender.hello()
    assert sender.ask().number == 1


def test_a_number_counts_once_in_any_order_within_the_window(brno: Sender) -> None:
    brno.hello()
    sent = [brno.headers("segments") for _ in range(WINDOW + 2)]
    order = [3, 0, 1, 2, *range(4, WINDOW)]
    assert [brno.ask(sent[at]).number for at in order] == [at + 1 for at in order]
    assert {refused(lambda at=at: brno.ask(sent[at])) for at in range(WINDOW)} == {"replayed"}
    assert brno.ask(sent[WINDOW + 1]).number == WINDOW + 2
    assert brno.ask(sent[WINDOW]).number == WINDOW + 1


def test_a_number_too_far_behind_does_not_count(brno: Sender) -> None:
    brno.hello()
    sent = [brno.headers("segments") for _ in range(WINDOW + 2)]
    brno.ask(sent[WINDOW])
    assert refused(lambda: brno.ask(sent[0])) == "replayed"
    assert brno.ask(sent[1]).number == 2
    brno.ask(sent[WINDOW + 1])


def test_of_equal_requests_at_once_one_is_let_in(brno: Sender) -> None:
    brno.hello()
    headers = brno.headers("segments")
    outcomes: list[str] = []

    def send() -> None:
        try:
            brno.ask(headers)
            outcomes.append("in")
        except Refusal as refusal:
            outcomes.append(refusal.code)

    threads = [threading.Thread(target=send) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(outcomes) == ["in", *["replayed"] * 7]


@pytest.mark.parametrize("number", ["0", "-1", "1.0", "x", "", "9" * 17, "\u0661"])
def test_what_is_no_number_is_refused(brno: Sender, access: Access, number: str) -> None:
    brno.hello()
    sessions = access._sessions
    station = access.registry.station("brno-2")
    assert station is not None
    assert refused(lambda: sessions.admit(station, "any", number)) == "replayed"


def test_a_token_ends(brno: Sender, clock: Clock) -> None:
    brno.hello()
    clock.go(minutes=14, seconds=59)
    brno.ask()
    clock.go(seconds=1)
    assert refused(brno.ask) == "no_session"
    brno.hello()
    brno.ask()


def test_a_token_is_one_stations(brno: Sender, access: Access) -> None:
    enrol(access, OSLO, OTHER_KEY)
    oslo = Sender(access, "oslo-1", OTHER_KEY)
    brno.hello()
    caller = oslo.hello()
    assert caller.station == "oslo-1"
    brno.signer.use(oslo.headers("segments")["authorization"].removeprefix("Bearer "))
    assert refused(brno.ask) == "no_session"


def test_two_stations_with_one_key_stay_two(brno: Sender, access: Access) -> None:
    enrol(access, OSLO, KEY)
    oslo = Sender(access, "oslo-1", KEY)
    brno.hello()
    oslo.hello()
    assert (brno.ask().station, oslo.ask().station) == ("brno-2", "oslo-1")
    headers = brno.headers("segments")
    headers["vian-station"] = "oslo-1"
    assert refused(lambda: brno.ask(headers)) == "bad_signature"


def test_two_daemons_of_one_station_have_a_session_each_and_the_oldest_of_many_ends(
    brno: Sender, access: Access, clock: Clock
) -> None:
    first, second = Sender(access), Sender(access)
    first.hello()
    second.hello()
    assert (first.ask().number, second.ask().number) == (1, 1)
    for _ in range(15):
        clock.go(seconds=1)
        brno.hello()
    assert refused(first.ask) == "no_session"
    brno.ask()


def test_what_is_not_granted_is_refused(brno: Sender) -> None:
    brno.hello()
    assert brno.ask(operation="find").may_read("oslo-1")
    assert not brno.ask(operation="find").may_read("zlin")
    with pytest.raises(Refusal, match=r"--operations replicate,find,query") as refusal:
        brno.ask(operation="query")
    assert (refusal.value.status, refusal.value.code) == (403, "not_granted")


def test_reading_all_stations_may_be_granted(access: Access) -> None:
    enrol(access, reads=("*",))
    assert Sender(access).hello().may_read("any")


# Who does not get in.


@pytest.mark.parametrize("name", ["oslo-1", "a/b", "x" * 5000, "\u00fc", "' or 1=1"])
def test_an_unknown_station_is_told_how_to_enrol(brno: Sender, access: Access, name: str) -> None:
    headers = dict(Sender(access, "zlin").headers("hello")) | {"vian-station": name}
    assert refused(lambda: access.hello(headers)) in ("unknown_station", "not_signed")


def test_another_key_is_told_which_one_is_known(brno: Sender, access: Access) -> None:
    with pytest.raises(Refusal, match=f"got key {OTHER_KEY.id}, wanted key {KEY.id}") as refusal:
        Sender(access, key=OTHER_KEY).hello()
    assert refusal.value.code == "wrong_key"


def test_a_request_without_signature_or_with_a_forged_one_is_refused(brno: Sender, access: Access) -> None:
    brno.hello()
    headers = brno.headers("segments")
    del headers["signature"]
    assert refused(lambda: brno.ask(headers)) == "not_signed"
    forged = brno.headers("segments")
    forged["vian-number"] = "77"
    assert refused(lambda: brno.ask(forged)) == "bad_signature"
    assert brno.ask().number == 3


def test_a_request_for_another_central_is_refused_and_a_former_key_is_understood(
    brno: Sender, log: Log, clock: Clock
) -> None:
    stranger = Access(log, CENTRAL, OTHER_KEY, now=clock)
    brno.signer.answer(stranger.challenge("brno-2").challenge)
    assert refused(lambda: stranger.hello(brno.headers("hello"))) == "other_central"
    renewed = Access(log, CENTRAL, OTHER_KEY, now=clock, own_keys={CENTRAL_KEY.id})
    brno.signer.answer(renewed.challenge("brno-2").challenge)
    assert renewed.hello(brno.headers("hello")).caller.station == "brno-2"


def test_a_revoked_station_is_out_at_once_and_may_be_taken_in_again(brno: Sender, access: Access, log: Log) -> None:
    caller = brno.hello()
    caller = brno.ask()
    access.registry.revoke("brno-2", "stolen")
    assert refused(brno.ask) == "revoked"
    assert refused(brno.hello) == "revoked"
    with pytest.raises(Refusal, match="shut this station out"), log.transaction() as transaction:
        access.check_again(transaction, caller)
    with pytest.raises(GrantError, match=r"shut out already; enrolled: none"):
        access.registry.revoke("brno-2")
    enrol(access, key=OTHER_KEY)
    assert refused(brno.hello) == "wrong_key"
    Sender(access, key=OTHER_KEY).hello()
    assert [segment.stream.type for segment in log.read_all()] == [
        "station_enrolled",
        "station_revoked",
        "station_enrolled",
    ]


def test_a_revocation_waits_for_what_was_let_in_before_it(brno: Sender, access: Access, log: Log) -> None:
    brno.hello()
    caller = brno.ask()
    done = threading.Event()

    def revoke() -> None:
        access.registry.revoke("brno-2")
        done.set()

    with log.transaction() as transaction:
        access.check_again(transaction, caller)
        thread = threading.Thread(target=revoke)
        thread.start()
        waiting = "select count(*) from pg_locks where not granted"
        with psycopg.connect(log.dsn, autocommit=True) as watcher:
            deadline = monotonic() + 60
            while watcher.execute(waiting).fetchone() == (0,):
                assert not done.is_set()
                assert monotonic() < deadline
        assert not done.is_set()
    thread.join()
    assert done.is_set()


def test_open_codes_of_a_revoked_station_end(brno: Sender, access: Access) -> None:
    secret = new_secret()
    access.registry.invite(BRNO, secret, ("replicate",), (), NOON + timedelta(hours=1))
    access.registry.revoke("brno-2")
    assert refused(lambda: access.registry.enrol("brno-2", secret, KEY.public, None)) == "used_code"


def test_nobody_can_revoke_whom_central_does_not_know(access: Access) -> None:
    enrol(access)
    with pytest.raises(GrantError, match=r"oslo-1 is not enrolled; enrolled: brno-2\. Next: vian station list"):
        access.registry.revoke("oslo-1")


# Refusals.


def test_refusals_alike_within_a_minute_are_one_event(log: Log, clock: Clock) -> None:
    seconds = 0.0
    refusals = Refusals(log, CENTRAL, clock, lambda: seconds)
    kind = Kind("brno-2", "segments", "replayed", "192.0.2.7")
    for number in range(3):
        refusals.note(kind, f"number {number}\n\x1b[31m")
    refusals.note(Kind(None, "hello", "unknown_station", None), "station 'x'")
    assert refusals.counts() == {("segments", "replayed"): 3, ("hello", "unknown_station"): 1}
    assert refusals.record() == []
    seconds = 60.0
    clock.go(minutes=1)
    first, second = refusals.record()
    assert (first.claimed, first.endpoint, first.code, first.got, first.address, first.count, first.first_at) == (
        "brno-2",
        "segments",
        "replayed",
        "number 0 ?[31m",
        "192.0.2.7",
        3,
        NOON,
    )
    assert second.count == 1
    assert refusals.record(is_all=True) == []
    assert [str(head.stream) for head in log.streams()] == ["central/sync/request_refused"]


def test_a_flood_of_kinds_is_recorded_by_code_alone(log: Log, clock: Clock) -> None:
    refusals = Refusals(log, CENTRAL, clock, lambda: 0.0)
    for number in range(KINDS_MAX + 50):
        refusals.note(Kind(f"s{number}", "hello", "unknown_station", None), "x")
    events = refusals.record(is_all=True)
    assert len(events) == KINDS_MAX + 1
    assert (events[-1].claimed, events[-1].count) == (None, 50)


def test_what_cannot_be_recorded_is_kept(log: Log, clock: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    refusals = Refusals(log, CENTRAL, clock, lambda: 0.0)
    kind = Kind(None, "hello", "not_signed", None)
    refusals.note(kind, "x")

    def away(*_: object) -> None:
        refusals.note(kind, "y")
        raise ConnectionError

    with monkeypatch.context() as broken:
        broken.setattr(log, "append", away)
        with pytest.raises(ConnectionError):
            refusals.record(is_all=True)
    (event,) = refusals.record(is_all=True)
    assert (event.count, event.got) == (2, "x")


def test_a_registry_made_again_lets_nobody_in_who_was_revoked_meanwhile(log: Log, access: Access, clock: Clock) -> None:
    secret = new_secret()
    access.registry.invite(BRNO, secret, ("replicate",), (), NOON + timedelta(hours=1))
    access.registry.enrol(BRNO, secret, KEY.public, None)
    with psycopg.connect(log.dsn) as connection:
        connection.execute("delete from stations")  # as after a restore

    with ThreadPoolExecutor(1) as threads:
        revoking: list[Future[Registered]] = []

        class Slow(Registry):
            """Reads the log's events, and then another process revokes the station."""

            def _events(self, types: Sequence[str]) -> list[EventType]:
                events = list(super()._events(types))
                other = Registry(log, CENTRAL, clock)
                revoking.append(threads.submit(lambda: (other.recover(), other.revoke(BRNO))[1]))
                wait(revoking, 0.3)  # it ends, or waits for what is made here
                return events

        Slow(log, CENTRAL, clock).recover()
        revoking[0].result()
    station = access.registry.station(BRNO)
    assert station is not None
    assert station.revoked_at is not None
