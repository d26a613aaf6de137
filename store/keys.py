"""A station's key: Ed25519, in a file that only its owner can read.

Contract: the private key is PEM (PKCS #8), without a password, mode 0600; a file that others may read
is refused. Public keys, today's and former ones, lie as PEM in the folder `public-keys` beside it, named
by key id, and are never removed: they are what a station's signatures are checked against. Public keys of
other stations may be put into `public-keys/others`. A key is replaced by its successor, which the old key signs.
"""

import os
import stat
from dataclasses import dataclass, field
from pathlib import Path

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    PublicFormat,
    load_pem_private_key,
    load_pem_public_key,
)

from store.errors import BadProof
from store.proof import key_id

MODE = 0o600
FOLDER = "public-keys"
OTHERS = "others"


@dataclass(frozen=True, slots=True)
class StationKey:
    """A key that signs."""

    private: Ed25519PrivateKey = field(repr=False)

    @property
    def public(self) -> bytes:
        """The raw public key, 32 bytes."""
        return self.private.public_key().public_bytes_raw()

    @property
    def id(self) -> str:
        """The key's name."""
        return key_id(self.public)

    def sign(self, message: bytes) -> bytes:
        """The signature, 64 bytes."""
        return self.private.sign(message)


def is_signed(public_key: bytes, signature: bytes, message: bytes) -> bool:
    """Whether the signature is that key's over the message."""
    try:
        Ed25519PublicKey.from_public_bytes(public_key).verify(signature, message)
    except (InvalidSignature, ValueError):
        return False
    return True


def make_key(path: Path) -> StationKey:
    """The key in the file, made if there is none; its public key is kept beside it.

    Raises:
        BadProof: The file cannot be written or read, is open to others, or holds no such key.
    """
    if not path.exists():
        _write_new(path, Ed25519PrivateKey.generate())
    key = load_key(path)
    keep_public(path, key.public)
    return key


def load_key(path: Path) -> StationKey:
    """The key in the file.

    Raises:
        BadProof: There is none, others may read it, or it is no Ed25519 key.
    """
    try:
        mode = stat.S_IMODE(path.stat().st_mode)
        content = path.read_bytes()
    except FileNotFoundError as error:
        raise BadProof(f"there is no key in {path}. Next: vian init") from error
    except OSError as error:
        raise BadProof(f"the key in {path} cannot be read: {error.strerror}") from error
    if mode & 0o077:
        raise BadProof(f"{path} must be its owner's alone (mode 0600), got {mode:04o}. Next: chmod 600 {path}")
    try:
        private = load_pem_private_key(content, password=None)
    except (ValueError, TypeError) as error:
        raise BadProof(
            f"{path} must hold an Ed25519 key as PEM without a password: {error}. Next: restore it from a copy"
        ) from error
    if not isinstance(private, Ed25519PrivateKey):
        raise BadProof(f"{path} must hold an Ed25519 key, got {type(private).__name__}. Next: restore it from a copy")
    return StationKey(private)


def keep_public(path: Path, public_key: bytes) -> Path:
    """Keep a public key in the folder beside the station's key; where it lies."""
    return _keep(path.parent / FOLDER, public_key)


def copy_public(source: Path, target: Path) -> list[str]:
    """Copy the public keys that lie beside one key, those of others too, beside another; ids of its own that are new.

    Raises:
        BadProof: A file there is no public key, or a key cannot be written.
    """
    own, known = known_keys(source), known_keys(target)
    for public_key in own.values():
        keep_public(target, public_key)
    for public_key in keys_of_others(source).values():
        _keep(target.parent / FOLDER / OTHERS, public_key)
    return sorted(own.keys() - known.keys())


def _keep(folder: Path, public_key: bytes) -> Path:
    kept = folder / f"{key_id(public_key)}.pem"
    pem = Ed25519PublicKey.from_public_bytes(public_key).public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not kept.exists():
            kept.write_bytes(pem)
    except OSError as error:
        raise BadProof(f"the public key cannot be kept in {kept}: {error.strerror}") from error
    return kept


def known_keys(path: Path) -> dict[str, bytes]:
    """The station's own public keys, kept beside its key in `path`: raw, by key id.

    Raises:
        BadProof: A file there is no public key, or bears another's name.
    """
    return dict(map(_kept, sorted((path.parent / FOLDER).glob("*.pem"))))


def keys_of_others(path: Path) -> dict[str, bytes]:
    """Public keys of other stations that were put beside the station's own: raw, by key id.

    Raises:
        BadProof: A file there is no public key, or bears another's name.
    """
    return dict(map(_kept, sorted((path.parent / FOLDER / OTHERS).glob("*.pem"))))


def _kept(kept: Path) -> tuple[str, bytes]:
    try:
        public = load_pem_public_key(kept.read_bytes())
    except (ValueError, OSError) as error:
        raise BadProof(f"{kept} is no public key: {error}. Next: remove it, or restore it from a copy") from error
    if not isinstance(public, Ed25519PublicKey) or key_id(public.public_bytes_raw()) != kept.stem:
        raise BadProof(f"{kept} does not hold the key that its name says. Next: restore it from a copy")
    return kept.stem, public.public_bytes_raw()


def _write_new(path: Path, private: Ed25519PrivateKey) -> None:
    """Write a key to a file that is not there yet; whole or not at all, and never open to others."""
    pem = private.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, MODE)
        with os.fdopen(descriptor, "wb") as file:
            file.write(pem)
            file.flush()
            os.fsync(file.fileno())
        try:
            os.link(partial, path)  # unlike a rename, leaves a key alone that another made meanwhile
        except FileExistsError:
            pass
        finally:
            partial.unlink()
    except OSError as error:
        raise BadProof(f"the key cannot be written to {path}: {error.strerror}") from error
