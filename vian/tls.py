"""TLS: the certificate that central shows, and how a station knows it.

Contract: central shows an operator's certificate, which stations check as browsers do, or one that it made
itself, which stations know by its key: enrolment hands them the pin. A certificate that was made here has no
end and no name, because a pinned one needs neither, and a station's clock may be years off.
"""

import ssl
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat, PublicFormat
from cryptography.x509.oid import NameOID

from sync.protocol.enrolment import pin_of
from sync.station.unreachable import why_unreachable
from vian.errors import WorldFailed, WrongUsage
from vian.stations import write_private

CERTIFICATE_NAME = "central-tls.pem"
AGAIN = "then give the same command again"
"""What to do once central is back, where nobody waits for it."""
_NO_BEGIN = datetime(1970, 1, 1, tzinfo=UTC)
_NO_END = datetime(9999, 12, 31, 23, 59, 59, tzinfo=UTC)
"""RFC 5280, section 4.1.2.5: the time of a certificate that has no end."""


@dataclass(frozen=True, slots=True)
class Certificate:
    """What central shows, and the key behind it, both as PEM files; one file may hold both."""

    certificate: Path
    key: Path
    is_own: bool
    """made here, so that stations must pin it"""

    @property
    def pin(self) -> bytes | None:
        """What a one-time code carries of it; None for an operator's."""
        return certificate_pin(self.certificate.read_text(encoding="ascii")) if self.is_own else None


def given_certificate(certificate: Path | None, key: Path | None) -> Certificate:
    """The operator's certificate.

    Raises:
        WrongUsage: A file is missing, cannot be read, or the two do not belong together.
    """
    if certificate is None:
        raise WrongUsage("a key without its certificate. Next: give --tls-certificate FILE too")
    pair = Certificate(certificate, key or certificate, is_own=False)
    try:
        ssl.create_default_context(ssl.Purpose.CLIENT_AUTH).load_cert_chain(pair.certificate, pair.key)
    except (OSError, ValueError) as error:  # ssl.SSLError is an OSError
        raise WrongUsage(
            f"the certificate {pair.certificate} with the key {pair.key} cannot be used: {error}. "
            "Next: give the chain and its unencrypted key as PEM, --tls-certificate FILE --tls-key FILE"
        ) from error
    return pair


def own_certificate(folder: Path) -> Certificate:
    """The certificate that central made itself, made if there is none.

    Raises:
        WorldFailed: It cannot be written.
        WrongUsage: What lies there is none.
    """
    path = folder / CERTIFICATE_NAME
    if not path.exists():
        write_private(path, _made())
    pair = given_certificate(path, path)
    return Certificate(pair.certificate, pair.key, is_own=True)


def certificate_pin(pem: str) -> bytes:
    """The pin of a certificate: of its public key.

    Raises:
        ValueError: It is no certificate.
    """
    public = x509.load_pem_x509_certificate(pem.encode("ascii")).public_key()
    return pin_of(public.public_bytes(Encoding.DER, PublicFormat.SubjectPublicKeyInfo))


def fetched_certificate(host: str, port: int, pin: bytes) -> str:
    """The certificate that is shown there, as PEM, if it is the pinned one.

    Raises:
        WorldFailed: Another one is shown, or none.
    """
    try:
        pem = ssl.get_server_certificate((host, port), timeout=15.0)
    except OSError as error:
        raise WorldFailed(
            f"central at {host} port {port} shows no certificate: {why_unreachable(error, AGAIN)}"
        ) from error
    if certificate_pin(pem) != pin:
        raise WorldFailed(
            f"what answers at {host} port {port} is not the central that made the code: its certificate has another "
            "key. Next: check the address; if it is right, somebody stands between, or central made its certificate "
            "anew: ask its operator for another code"
        )
    return pem


def station_context(pinned: str | None) -> ssl.SSLContext:
    """How a station checks central: against one pinned certificate, else against the authorities that it knows.

    Args:
        pinned: A certificate as PEM.
    """
    if pinned is None:
        return ssl.create_default_context()
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False  # the key is known, under whatever name or address it is reached
    context.load_verify_locations(cadata=pinned)
    return context


def _made() -> str:
    """A new key and its certificate, as PEM."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "ViAn central")])
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(_NO_BEGIN)
        .not_valid_after(_NO_END)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .sign(key, SHA256())
    )
    private = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    return (private + certificate.public_bytes(Encoding.PEM)).decode("ascii")
