"""Sessions: how central knows that a signed request is new.

Contract: a session begins with a hello over a challenge of central's, and holds a token. A challenge counts
once, for one station, and for a minute; asking for one costs central no memory and no database. A token
ends after some minutes; each number in it counts once, in any order within 64 of the greatest. No station's
clock is asked. Tokens are kept as hashes, in a table that a crash of PostgreSQL empties.

Source: RFC 4303, section 3.4.3 (the window).
"""

import base64
import hashlib
import hmac
import secrets
import struct
import threading
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime, timedelta

from events.segment import microseconds
from store import Log, StationKey
from sync.central.registry import Registered, revoked
from sync.errors import Refusal

CHALLENGE_SECONDS = 60
WINDOW = 64
"""How far behind the greatest number of a session a request may come."""
NUMBER_MAX = 2**53 - 1
TOKENS_MAX = 16
"""Sessions that a station may have at a time; with one more, its oldest ends."""

_PLACE = struct.Struct(">qq8s")
_MAC_BYTES = 16


@dataclass(frozen=True, slots=True)
class Token:
    """What a station sends in place of the challenge, until it ends."""

    text: str
    expires_s: int


class Sessions:
    """The sessions of one central server's stations.

    Args:
        log: Central's log.
        key: Central's key, from which the secret of its challenges is derived.
        now: Central's clock, aware.
        token_minutes: How long a token counts.
    """

    def __init__(self, log: Log, key: StationKey, now: Callable[[], datetime], token_minutes: float) -> None:
        self._log = log
        self._secret = hmac.digest(key.private.private_bytes_raw(), b"challenges of ViAn's sync", "sha256")
        self._now = now
        self._token_s = round(token_minutes * 60)
        self._lock = threading.Lock()
        self._number = 0

    def challenge(self, station: str) -> str:
        """A challenge for that station, whether there is one or not."""
        now = microseconds(self._now())
        with self._lock:
            # Grows with each challenge, and over restarts, as long as the clock is not set back.
            self._number = max(self._number + 1, now)
            place = _PLACE.pack(self._number, now, secrets.token_bytes(8))
        return base64.urlsafe_b64encode(place + self._mac(station, place)).decode()

    def begin(self, station: Registered, challenge: str) -> Token:
        """A new session for the station, whose signature over the challenge was found good.

        Raises:
            Refusal: The challenge is another station's, too old, or was answered before; the station was revoked.
            LogUnavailable: The database is away.
        """
        number = self._number_of(station.name, challenge)
        token = secrets.token_urlsafe(32)
        now = self._now()
        with self._log.connection() as connection, connection.transaction():
            row = connection.execute(
                "update stations set challenge_number = greatest(challenge_number, %(number)s) "
                "from (select challenge_number as before from stations where name = %(name)s for update) as old "
                "where name = %(name)s and key_id = %(key)s and revoked_at is null returning before",
                {"number": number, "name": station.name, "key": station.key_id},
            ).fetchone()
            if row is None:
                raise revoked(station.name)
            if number <= row[0]:
                self._go_beyond(row[0])
                raise _stale("a challenge that was answered before, or is older than one that was")
            connection.execute(
                "delete from sync_tokens where station = %(name)s and (expires_at <= %(now)s or token_hash not in "
                "(select token_hash from sync_tokens where station = %(name)s order by made_at desc limit %(kept)s))",
                {"name": station.name, "now": now, "kept": TOKENS_MAX - 1},
            )
            connection.execute(
                "insert into sync_tokens (token_hash, station, made_at, expires_at) values (%s, %s, %s, %s)",
                (_hash(token), station.name, now, now + timedelta(seconds=self._token_s)),
            )
        return Token(token, self._token_s)

    def admit(self, station: Registered, token: str, number: str) -> int:
        """The number of a request in its session, which now has been used.

        Raises:
            Refusal: The token is none of the station's, has ended, or a request with that number has come.
            LogUnavailable: The database is away.
        """
        value = int(number) if number.isascii() and number.isdecimal() and len(number) < 17 else 0
        if not 1 <= value <= NUMBER_MAX:
            raise _replayed(f"number {number[:20]!r}", f"a number from 1 to {NUMBER_MAX}")
        named = {"hash": _hash(token), "name": station.name, "number": value, "now": self._now(), "window": WINDOW}
        with self._log.connection() as connection:
            taken = connection.execute(_TAKE, named).fetchone()
            if taken is not None:
                return value
            found = connection.execute(
                "select newest from sync_tokens where token_hash = %(hash)s and station = %(name)s "
                "and expires_at > %(now)s",
                named,
            ).fetchone()
        if found is None:
            raise Refusal(
                401,
                "no_session",
                "the token is none of this station's, or has ended",
                "a token that does not count",
                "the token of a session",
                "say hello again",
            )
        raise _replayed(f"number {value} a second time, or {WINDOW} and more behind {found[0]}", "a number once")

    def _number_of(self, station: str, challenge: str) -> int:
        try:
            data = base64.urlsafe_b64decode(challenge.encode("ascii"))
            place, mac = data[: _PLACE.size], data[_PLACE.size :]
            number, issued, _ = _PLACE.unpack(place)
        except (ValueError, struct.error) as error:
            raise _stale("what is no challenge") from error
        if not hmac.compare_digest(mac, self._mac(station, place)):
            raise _stale("a challenge that central did not give this station")
        age_us = microseconds(self._now()) - issued
        if not 0 <= age_us <= CHALLENGE_SECONDS * 1_000_000:
            raise _stale(f"a challenge of {age_us // 1_000_000} s ago")
        return int(number)

    def _go_beyond(self, number: int) -> None:
        """Give greater numbers from now on: central's clock was set back since that one."""
        with self._lock:
            self._number = max(self._number, number)

    def _mac(self, station: str, place: bytes) -> bytes:
        return hmac.digest(self._secret, place + station.encode(), "sha256")[:_MAC_BYTES]


# One statement, and so under the row's lock: of two requests with one number, one is taken.
_TAKE = """
update sync_tokens set
  newest = greatest(newest, %(number)s),
  seen = case
    when %(number)s - newest >= %(window)s then 1
    when %(number)s > newest then (seen << (%(number)s - newest)::integer) | 1
    else seen | (1::bigint << (newest - %(number)s)::integer)
  end
where token_hash = %(hash)s and station = %(name)s and expires_at > %(now)s
  and case
    when %(number)s > newest then true
    when newest - %(number)s >= %(window)s then false
    else (seen >> (newest - %(number)s)::integer) & 1 = 0
  end
returning newest
"""


def _hash(token: str) -> bytes:
    return hashlib.sha256(token.encode()).digest()


def _stale(got: str) -> Refusal:
    return Refusal(
        401,
        "stale_challenge",
        "the hello does not answer a challenge that counts",
        got,
        f"one of the last {CHALLENGE_SECONDS} s, once",
        "ask for a challenge and say hello again",
    )


def _replayed(got: str, wanted: str) -> Refusal:
    return Refusal(
        401,
        "replayed",
        "a request with this number has come before",
        got,
        wanted,
        "say hello again; if it comes back, somebody sends this station's requests a second time",
    )
