"""Signatures from the settings: the station's key, signing now and then, and what was verified before."""

import os
import threading
from collections.abc import Callable
from pathlib import Path
from time import monotonic

import structlog

from events import CheckpointSigned
from store import BadProof, Log, SignedCheckpoint, Signer, StationKey, Verified, known_keys, load_key, make_key
from store.keys import keep_public
from store.signing import newest_checkpoint
from vian.clock import utc_now
from vian.errors import WrongUsage
from vian.parts import Part, stepping
from vian.settings import Settings

logger = structlog.get_logger()

KEY_NAME = "station.key"
_PAUSE_SECONDS = 1.0


def key_path(settings: Settings) -> Path:
    """Where the station's key is, or will be."""
    return settings.key_file or settings.data_dir / KEY_NAME


def has_key(settings: Settings) -> bool:
    """Whether there is a key, of whatever kind."""
    return key_path(settings).exists()


def signing_station(log: Log, settings: Settings) -> str:
    """The station that signs this log: the one that was set, else the only one that recorded in it.

    Raises:
        WrongUsage: Several did, and none was set.
    """
    stations = sorted({str(head.stream.station) for head in log.streams()})
    if "station" in settings.model_fields_set or settings.station in stations or not stations:
        return settings.station
    if len(stations) == 1:
        return stations[0]
    raise WrongUsage(f"which station signs? This log has {', '.join(stations)}. Next: give --station NAME")


def own_station(log: Log, settings: Settings) -> str | None:
    """The station whose log this is, as far as its checkpoints tell: by name, else by a key that lies here."""
    heads = log.streams()
    signing = {str(each.stream.station) for each in heads if each.stream.type == CheckpointSigned.type_name}
    if settings.station in signing:
        return settings.station
    own = known_keys(key_path(settings))
    for station in sorted(signing):
        try:
            found = newest_checkpoint(log, station)
        except BadProof:
            continue  # verification comes by and says so
        if found is not None and found[1].statement.public_key in own.values():
            return station
    return None


def signer_for(log: Log, settings: Settings) -> Signer:
    """A signer of this log with the station's key."""
    path = key_path(settings)
    return Signer(log, signing_station(log, settings), lambda: load_key(path), utc_now)


def rotate(log: Log, settings: Settings) -> tuple[SignedCheckpoint | None, StationKey]:
    """Replace the station's key by a new one, which the old one names; interrupted, it goes on when run again.

    Raises:
        BadProof: There is no key to replace, or the log cannot be signed.
    """
    path = key_path(settings)
    load_key(path)
    coming = path.with_name(f"{path.name}.next")
    new = make_key(coming)
    signed = signer_for(log, settings).sign(successor=new.public)
    coming.replace(path)
    keep_public(path, new.public)
    return signed, new


def signing_part(log: Log, settings: Settings) -> Part:
    """Signs the log every few minutes or segments, where events came."""
    step = PeriodicSigner(log, settings, monotonic, lambda: threading.Event().wait(_PAUSE_SECONDS))
    return stepping("signer", step, log)


class PeriodicSigner:
    """One look whether a signature is due; a stretch of the log a call when it is."""

    def __init__(self, log: Log, settings: Settings, clock: Callable[[], float], pause: Callable[[], object]) -> None:
        """Build one that counts from now.

        Args:
            log: The log.
            settings: How often to sign, and with which key.
            clock: Seconds that never go back.
            pause: Called before each look.
        """
        self._log = log
        self._settings = settings
        self._clock = clock
        self._pause = pause
        self._signer: Signer | None = None
        self._signed_at = clock()
        self._signed = log.head()
        self._is_due = False

    def __call__(self) -> None:
        """Do one bounded thing."""
        if not self._is_due:
            self._pause()
            self._is_due = self._due()
            return
        try:
            self._go_on()
        except BadProof as error:
            # Recording goes on: an unsigned event is better than none. Verification and the log say so.
            logger.error("nothing was signed", part="signer", error=str(error))
            self._rest()

    def _due(self) -> bool:
        segments = self._log.head() - self._signed
        minutes = (self._clock() - self._signed_at) / 60
        wait, most = self._settings.sign_every_min, self._settings.sign_every_segments
        return segments > 0 and ((0 < wait <= minutes) or (0 < most <= segments))

    def _go_on(self) -> None:
        self._signer = self._signer or signer_for(self._log, self._settings)
        if not self._signer.step():
            return
        signed = self._signer.sign()
        if signed is not None:
            logger.info("signed", part="signer", position=signed.statement.position, checkpoint=signed.sequence)
        self._rest()

    def _rest(self) -> None:
        self._is_due, self._signed_at, self._signed = False, self._clock(), self._log.head()


class VerifiedNote:
    """What `vian verify` found sound, in a file in the data directory: one a log."""

    def __init__(self, log: Log, settings: Settings) -> None:
        """Name the log: the cluster's and the database's own identifiers, and its life, which a restore begins."""
        with log.connection() as connection:
            row = connection.execute(
                "select system_identifier::text, d.oid::text "
                "from pg_control_system(), pg_database d where d.datname = current_database()"
            ).fetchone()
        assert row is not None, "a cluster has an identifier"
        names = (*row, str(log.epoch))
        self._name = "/".join(names)
        self.path = settings.data_dir / "verified" / f"{'-'.join(names)}.json"

    def load(self) -> Verified | None:
        """What was found sound; None where nothing was yet.

        Raises:
            BadProof: The note is damaged, or of another log.
        """
        try:
            return Verified.from_text(self.path.read_text(), self._name)
        except FileNotFoundError:
            return None
        except (BadProof, OSError, ValueError, KeyError) as error:
            raise BadProof(f"{self.path}: {error}") from error

    def save(self, verified: Verified) -> None:
        """Note what was found sound; whole or not at all.

        Raises:
            BadProof: The file cannot be written.
        """
        partial = self.path.with_name(f".{self.path.name}.{os.getpid()}")
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            partial.write_text(verified.to_text(self._name))
            partial.replace(self.path)
        except OSError as error:
            raise BadProof(f"what was verified cannot be noted in {self.path}: {error.strerror}") from error
