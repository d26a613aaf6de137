"""Central as this station reaches it: by what enrolment left, or by a token of the stations file."""

from collections.abc import Callable
from dataclasses import dataclass

import httpx

from store import StationKey
from sync.station.client import Central, Link
from sync.station.client_v1 import CentralV1
from vian.errors import WrongUsage
from vian.membership import Membership, check_address, load_membership, station_key
from vian.settings import Settings
from vian.stations import read_token


@dataclass(frozen=True, slots=True)
class Peer:
    """Central as this station reaches it."""

    address: str
    link: Callable[[httpx.Client, str], Link]
    """speaks with it over an HTTP client; the text is what an error tells of what becomes of it all"""
    certificate: str | None = None
    """the one that it must show, as PEM; None: one of an authority that is known"""
    public_key: bytes | None = None
    """what it countersigns with; None: not known"""


def peer_by_token(address: str, token: str) -> Peer:
    """Central for a station of its stations file: protocol 1."""
    return Peer(address, lambda client, afterwards: CentralV1(client, token, afterwards=afterwards))


def peer_by_membership(membership: Membership, key: StationKey, address: str | None = None) -> Peer:
    """Central for a station that it took in: protocol 2.

    Args:
        membership: What enrolment left.
        key: The station's key.
        address: Where central is reached by now, if not where it was then.
    """
    signer = membership.signer(key)
    return Peer(
        address or membership.address,
        lambda client, afterwards: Central(client, signer, afterwards=afterwards),
        membership.certificate,
        membership.central_key,
    )


def peer_of(settings: Settings) -> Peer | None:
    """Central as the settings say: where the station is enrolled, else by its token; None where neither is said.

    Raises:
        WrongUsage: What is said will not do.
    """
    membership = load_membership(settings)
    if membership is not None:
        check_address(settings.central or membership.address)
        return peer_by_membership(membership, station_key(settings), settings.central)
    if settings.central is None:
        return None
    check_address(settings.central)
    if settings.token_file is None:
        raise WrongUsage(
            f"this station is not enrolled at {settings.central}. Next: vian station invite {settings.station} on "
            f"central, then vian station enrol CODE --central {settings.central} here"
        )
    return peer_by_token(settings.central, read_token(settings.token_file))
