"""What an enrolled station knows of its central: a private file beside its key.

Contract: written whole or not at all, mode 0600. It holds no secret but is believed: whoever may write it may
send this station's events elsewhere.
"""

from ipaddress import ip_address
from pathlib import Path
from typing import Annotated

import httpx
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from store import BadProof, StationKey, key_id, load_key
from sync.protocol.signing import RequestSigner
from sync.protocol.wire import PATH, HashText, StationText
from vian.errors import WrongUsage
from vian.settings import Settings
from vian.signatures import key_path
from vian.stations import write_private

MEMBERSHIP_NAME = "central.json"


class Membership(BaseModel):
    """The central that a station was taken in by."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    address: str
    station: StationText
    central: StationText
    """central's own name"""
    public_key: HashText
    """central's key"""
    certificate: str | None = None
    """central's certificate as PEM, where it made it itself"""
    operations: tuple[str, ...] = ()
    reads: tuple[str, ...] = ()
    key_id: Annotated[str, Field(max_length=64)] = ""
    """id of the station's key that central took in"""

    @property
    def central_key(self) -> bytes:
        """Central's public key, raw."""
        return bytes.fromhex(self.public_key)

    def signer(self, key: StationKey) -> RequestSigner:
        """What signs the station's requests to this central."""
        return RequestSigner(key, self.station, key_id(self.central_key), PATH)


def membership_path(settings: Settings) -> Path:
    """Where the station's membership is, or will be."""
    return key_path(settings).parent / MEMBERSHIP_NAME


def load_membership(settings: Settings, *, is_any: bool = False) -> Membership | None:
    """The station's membership; None where it was never enrolled.

    Args:
        settings: Where it is, and the station's name.
        is_any: Whether it may be that of a station of another name than the settings give.

    Raises:
        WrongUsage: The file cannot be read, or is another station's.
    """
    path = membership_path(settings)
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        return None
    except OSError as error:
        raise WrongUsage(f"{path} cannot be read: {error.strerror}. Next: run as the user who enrolled") from error
    try:
        found = Membership.model_validate_json(text)
    except ValidationError as error:
        raise WrongUsage(
            f"{path} does not say which central this station belongs to: {error.errors()[0]['msg']}. "
            "Next: vian station enrol CODE --central URL"
        ) from error
    if found.station != settings.station and not is_any:
        raise WrongUsage(
            f"central knows this station as {found.station}, and --station is {settings.station}. "
            f"Next: give --station {found.station}, or enrol as {settings.station}: vian station enrol CODE"
        )
    return found


def save_membership(settings: Settings, membership: Membership) -> Path:
    """Write the station's membership; where it lies.

    Raises:
        WorldFailed: It cannot be written.
    """
    path = membership_path(settings)
    write_private(path, membership.model_dump_json(indent=2) + "\n")
    return path


def station_key(settings: Settings) -> StationKey:
    """The key that signs the station's requests.

    Raises:
        WrongUsage: There is none, or it cannot be used.
    """
    try:
        return load_key(key_path(settings))
    except BadProof as error:
        raise WrongUsage(str(error)) from error


def check_address(address: str) -> httpx.URL:
    """The address of a central server: https, or http to this machine itself.

    Raises:
        WrongUsage: It is none, or would send in the clear what others can read on the way.
    """
    try:
        url = httpx.URL(address)
    except httpx.InvalidURL:
        url = httpx.URL("")
    if url.scheme not in ("http", "https") or not url.host:
        raise WrongUsage(f"central must be an address such as https://central.example:8470, got {address!r}")
    if url.scheme == "http" and not _is_loopback(url.host):
        raise WrongUsage(
            f"central must be reached over https, got {address}: over http anybody on the way reads and changes what "
            "is sent. Next: give central a certificate (vian serve --role central --tls generate makes one), and the "
            f"address https://{url.netloc.decode()}"
        )
    return url


def _is_loopback(host: str) -> bool:
    try:
        return host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        return False
