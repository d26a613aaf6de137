"""Which stations may replicate to this central server: a TOML file of token hashes.

Contract: the file holds SHA-256 hashes, never tokens; a token is shown once, when it is made.
"""

import os
import secrets
import tomllib
from pathlib import Path

from events import station_name
from sync.grants import Grants, token_hash
from vian.errors import WorldFailed, WrongUsage

_TOKEN_BYTES = 32


def read_grants(path: Path) -> Grants:
    """The stations of the file.

    Raises:
        WrongUsage: The file cannot be read, or is not `[stations]` with `name = "SHA-256"` lines.
    """
    return Grants(_read(path))


def add_station(path: Path, station: str) -> str:
    """Enter a station with a new token into the file, made if need be; the token.

    Raises:
        WrongUsage: The station is there already, or the file is not right.
        WorldFailed: The file cannot be written.
    """
    name = station_name(station)
    hashes = _read(path) if path.exists() else {}
    if name in hashes:
        raise WrongUsage(
            f"station {name} is in {path} already. Next: to give it a new token, delete its line and run this again"
        )
    token = secrets.token_urlsafe(_TOKEN_BYTES)
    hashes[name] = token_hash(token)
    lines = [f'"{known}" = "{digest}"\n' for known, digest in sorted(hashes.items())]
    write_private(path, "[stations]\n" + "".join(lines))
    return token


def write_private(path: Path, text: str) -> None:
    """Write a file that only its owner may read.

    Raises:
        WorldFailed: It cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "w", encoding="utf-8") as file:
            file.write(text)
    except OSError as error:
        raise WorldFailed(f"{path} cannot be written: {error.strerror}") from error


def read_token(path: Path) -> str:
    """The token that the file holds.

    Raises:
        WrongUsage: The file cannot be read or is empty.
    """
    try:
        token = path.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise WrongUsage(
            f"the token file {path} cannot be read: {error}. Next: vian station add, on central"
        ) from error
    if not token:
        raise WrongUsage(f"the token file {path} is empty. Next: vian station add, on central")
    return token


def _read(path: Path) -> dict[str, str]:
    try:
        stations = tomllib.loads(path.read_text(encoding="utf-8")).get("stations", {})
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise WrongUsage(
            f"the stations file {path} cannot be read: {error}. Next: vian station add NAME --stations-file {path}"
        ) from error
    if not (isinstance(stations, dict) and all(isinstance(digest, str) for digest in stations.values())):
        raise WrongUsage(f'{path}: [stations] must have lines name = "SHA-256 of its token"')
    return dict(stations)
