"""Which stations may replicate to this central server: a TOML file of token hashes.

Contract: the file holds SHA-256 hashes, never tokens; a token is shown once, when it is made.
"""

import secrets
import tempfile
import tomllib
from pathlib import Path

import structlog

from events import Station, station_name
from sync.errors import GrantError
from sync.protocol.grants import Grants, checked_token, token_hash
from vian.errors import WorldFailed, WrongUsage

logger = structlog.get_logger()

_TOKEN_BYTES = 32


def read_grants(path: Path) -> Grants:
    """The stations of the file.

    Raises:
        WrongUsage: The file cannot be read, or is not `[stations]` with `name = "SHA-256"` lines.
    """
    try:
        return Grants(_stations(_text(path), path))
    except GrantError as error:
        raise WrongUsage(f"{path}: {error}") from error


class StationsFile:
    """The stations of the file as it is now: one that is added may replicate, one whose line goes may not.

    A file that cannot be read any more changes nothing; that is logged once.

    Raises:
        WrongUsage: At the start it cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._seen = _signature(path)
        self._grants = read_grants(path)

    def station_of(self, token: str) -> Station | None:
        """The station for which the token speaks; None if there is none."""
        if (now := _signature(self._path)) != self._seen:
            self._seen = now
            self._read_again()
        return self._grants.station_of(token)

    def _read_again(self) -> None:
        try:
            self._grants = read_grants(self._path)
            logger.info("the stations file was read again", file=str(self._path))
        except WrongUsage as error:
            logger.error("the stations stay as they were", error=str(error))


def _signature(path: Path) -> tuple[int, int, int] | None:
    """What changes when the file is written; None if it cannot be looked at."""
    try:
        stat = path.stat()
    except OSError:
        return None
    return stat.st_mtime_ns, stat.st_size, stat.st_ino


def add_station(path: Path, station: str, token_file: Path | None = None) -> str:
    """Enter a station with a new token into the file, made if need be; the token.

    Args:
        path: The list of stations; other lines of it stay as they are.
        station: Name of the station.
        token_file: Where the token is written first, so that a listed token is never a lost one.

    Raises:
        WrongUsage: The station is there already, or the file is not right.
        WorldFailed: A file cannot be written.
    """
    name = station_name(station)
    text = _text(path) if path.exists() else "[stations]\n"
    hashes = _stations(text, path)
    if name in hashes:
        raise WrongUsage(
            f"station {name} is in {path} already. Next: to give it a new token, delete its line and run this again"
        )
    token = secrets.token_urlsafe(_TOKEN_BYTES)
    text = text.rstrip("\n") + f'\n"{name}" = "{token_hash(token)}"\n'
    if _stations(text, path).get(name) is None:
        raise WrongUsage(f"{path}: the file must end with its table [stations]. Next: move the table there")
    if token_file is not None:
        write_private(token_file, token + "\n")
    write_private(path, text)
    return token


def remove_station(path: Path, station: str) -> bool:
    """Take a station's line out of the file; whether it had one.

    Raises:
        WrongUsage: The file is not right, or the line cannot be told from others.
        WorldFailed: It cannot be written.
    """
    text = _text(path)
    stations = _stations(text, path)
    if station not in stations:
        return False
    kept = [line for line in text.splitlines(keepends=True) if not _is_line_of(line, station)]
    if _stations("".join(kept), path) != {name: each for name, each in stations.items() if name != station}:
        raise WrongUsage(f"{path}: the line of {station} cannot be told from others. Next: delete it by hand")
    write_private(path, "".join(kept))
    return True


def _is_line_of(line: str, station: str) -> bool:
    name, _, value = line.partition("=")
    return bool(value) and name.strip().strip("\"'") == station


def write_private(path: Path, text: str) -> None:
    """Write a file that only its owner may read, wholly or not at all.

    Raises:
        WorldFailed: It cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile("w", dir=path.parent, delete=False, encoding="utf-8") as file:
            file.write(text)
        try:
            Path(file.name).replace(path)
        except OSError:
            Path(file.name).unlink()
            raise
    except OSError as error:
        raise WorldFailed(f"{path} cannot be written: {error.strerror}") from error


def read_token(path: Path) -> str:
    """The token that the file holds.

    Raises:
        WrongUsage: The file cannot be read, is empty, or holds what cannot be a token.
    """
    carry = "Next: carry over the file that vian station add NAME --token-file FILE wrote on central"
    try:
        token = path.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise WrongUsage(f"the token file {path} cannot be read: {error}. {carry}") from error
    if not token:
        raise WrongUsage(f"the token file {path} is empty. {carry}")
    try:
        return checked_token(token)
    except GrantError as error:
        said = str(error).partition(". Next: ")[0]
        raise WrongUsage(f"the token file {path} does not hold a token: {said}. {carry}") from error


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise WrongUsage(
            f"the stations file {path} cannot be read: {error}. Next: vian station add NAME --stations-file {path}"
        ) from error


def _stations(text: str, path: Path) -> dict[str, str]:
    try:
        stations = tomllib.loads(text).get("stations")
    except tomllib.TOMLDecodeError as error:
        raise WrongUsage(f"the stations file {path} is not TOML: {error}. Next: correct that line") from error
    if not (isinstance(stations, dict) and all(isinstance(digest, str) for digest in stations.values())):
        raise WrongUsage(f'{path}: wanted a table [stations] with lines name = "SHA-256 of its token"')
    return dict(stations)
