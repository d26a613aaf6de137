"""Where the archive lies: a folder, or any file system that pyarrow or fsspec knows, as a URL.

Contract: a `Place` opens, writes, moves and deletes files below its root. What was written is on the disk when
`write` returns, where the file system is a local one; others promise it by closing the file.
"""

import hashlib
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO, cast

import pyarrow as pa
from pyarrow import fs

from store.errors import ArchiveUnavailable, BadRequest

_CHUNK = 1024 * 1024


class Place:
    """The root of an archive.

    Raises:
        BadRequest: The location cannot be understood, or is relative and there is no folder to start from.
        ArchiveUnavailable: The file system does not answer.
    """

    def __init__(self, location: str, data_dir: Path | None = None) -> None:
        self.location = location
        self._fs, self._root = _file_system(location, data_dir)

    @property
    def is_local(self) -> bool:
        """Whether it is a folder of this machine."""
        return isinstance(self._fs, fs.LocalFileSystem)

    @property
    def name(self) -> str:
        """Where it is, as people would say it."""
        return self._root if self.is_local else self.location

    def full(self, path: str) -> str:
        """The path as the file system knows it."""
        return str(PurePosixPath(self._root) / path)

    def require(self) -> None:
        """Nothing, if the archive's root is there.

        Raises:
            ArchiveUnavailable: It is not.
        """
        with self.reaching():
            is_there = self._fs.get_file_info(self._root).type != fs.FileType.NotFound
        if not is_there:
            raise ArchiveUnavailable(
                f"the archive of sealed files is not at {self.name}. Next: mount or bring back that folder; if its "
                "files lie elsewhere now: vian archive relocate --to URL"
            )

    def open(self, path: str) -> pa.NativeFile:
        """A file, for reading anywhere in it.

        Raises:
            FileNotFoundError: The archive is there, and the file is not.
            ArchiveUnavailable: The archive is not there.
        """
        try:
            return self._fs.open_input_file(self.full(path))
        except FileNotFoundError:
            self.require()
            raise
        except OSError as error:
            raise self._unavailable(error) from error

    def digest(self, path: str) -> tuple[bytes, int]:
        """SHA-256 and size of a file, read from its place and not from memory where that can be said.

        Raises:
            FileNotFoundError: The archive is there, and the file is not.
            ArchiveUnavailable: The archive is not there.
        """
        digest, size = hashlib.sha256(), 0
        with self.open(path) as file:
            while chunk := file.read(_CHUNK):
                digest.update(chunk)
                size += len(chunk)
        return digest.digest(), size

    def write(self, path: str, fill: Callable[[BinaryIO], None]) -> tuple[bytes, int]:
        """Write a file, and say SHA-256 and size of what was written.

        Args:
            path: Where; folders are made, and a file that is there is replaced.
            fill: Writes the content.

        Raises:
            ArchiveUnavailable: It cannot be written.
        """
        full = self.full(path)
        with self.reaching():
            folders = self._new_folders(full)
            self._fs.create_dir(str(PurePosixPath(full).parent), recursive=True)
            with self._fs.open_output_stream(full) as out:
                sink = _Hashed(out)
                fill(cast(BinaryIO, sink))
            if self.is_local:
                _settle(Path(full), folders)
        return sink.digest.digest(), sink.size

    def create(self, path: str) -> pa.NativeFile:
        """A file to write to; folders are made, and a file that is there is replaced.

        Raises:
            ArchiveUnavailable: It cannot be made.
        """
        with self.reaching():
            full = self.full(path)
            self._fs.create_dir(str(PurePosixPath(full).parent), recursive=True)
            return self._fs.open_output_stream(full)

    def move(self, path: str, to: str) -> None:
        """Give a file another name; one that has it is replaced.

        Raises:
            ArchiveUnavailable: It cannot be done.
        """
        with self.reaching():
            self._fs.move(self.full(path), self.full(to))

    def delete(self, path: str) -> None:
        """Delete a file; one that is not there is no matter.

        Raises:
            ArchiveUnavailable: The archive is not there.
        """
        with self.reaching():
            if self._fs.get_file_info(self.full(path)).type != fs.FileType.NotFound:
                self._fs.delete_file(self.full(path))

    def size(self, path: str) -> int | None:
        """Bytes of a file; None where there is none.

        Raises:
            ArchiveUnavailable: The file system does not answer.
        """
        with self.reaching():
            info = self._fs.get_file_info(self.full(path))
        return info.size if info.type == fs.FileType.File else None

    def has_files(self, folder: str) -> bool:
        """Whether a folder of the archive has anything in it.

        Raises:
            ArchiveUnavailable: The file system does not answer.
        """
        with self.reaching():
            return bool(self._fs.get_file_info(fs.FileSelector(self.full(folder), allow_not_found=True)))

    def _new_folders(self, full: str) -> list[Path]:
        """The folders whose contents change when a local file is made: its own, and those above that are not there."""
        if not self.is_local:
            return []
        above = Path(full).parents
        made = [folder for folder in above if not folder.exists()]
        return list(above[: len(made) + 1])

    @contextmanager
    def reaching(self) -> Iterator[None]:
        """What fails inside is told as the archive's failure.

        Raises:
            ArchiveUnavailable: Something failed that has to do with files.
        """
        try:
            yield
        except OSError as error:
            raise self._unavailable(error) from error

    def _unavailable(self, error: OSError) -> ArchiveUnavailable:
        return ArchiveUnavailable(
            f"the archive at {self.name} does not do its part: {error}. Next: look to that place (space, rights, "
            "network), then run the same command again"
        )


class _Hashed:
    """A sink that remembers the hash and the size of what went through."""

    closed = False

    def __init__(self, out: pa.NativeFile) -> None:
        self._out = out
        self.digest = hashlib.sha256()
        self.size = 0

    def write(self, data: Any) -> int:
        with memoryview(data) as view:
            self.digest.update(view)
            self._out.write(view)
            self.size += view.nbytes
            return view.nbytes

    def tell(self) -> int:
        return self.size

    def flush(self) -> None:
        self._out.flush()

    def close(self) -> None:
        """The file is closed by who opened it."""

    def readable(self) -> bool:
        return False

    def writable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return False


def _settle(path: Path, folders: Sequence[Path]) -> None:
    """Bring a file and its name onto the disk, and forget its bytes, so that reading it back reads the disk."""
    for each in (path, *folders):
        descriptor = os.open(each, os.O_RDONLY)
        try:
            os.fsync(descriptor)
            if each == path and hasattr(os, "posix_fadvise"):
                os.posix_fadvise(descriptor, 0, 0, os.POSIX_FADV_DONTNEED)
        finally:
            os.close(descriptor)


def _file_system(location: str, data_dir: Path | None) -> tuple[fs.FileSystem, str]:
    if "://" in location:
        return _from_url(location)
    path = Path(location).expanduser()
    if not path.is_absolute():
        if data_dir is None:
            raise BadRequest(
                f"this log was opened by its address, so there is no folder for its archive {location!r}. "
                "Next: give --to FOLDER or URL; if it is an embedded log: --data-dir DIR"
            )
        path = data_dir / path
    return fs.LocalFileSystem(), str(path)


def _from_url(url: str) -> tuple[fs.FileSystem, str]:
    try:
        found: tuple[fs.FileSystem, str] = fs.FileSystem.from_uri(url)
    except pa.ArrowInvalid:
        return _from_fsspec(url)
    except OSError as error:
        raise ArchiveUnavailable(f"the archive at {url} cannot be reached: {error}. Next: vian doctor") from error
    return found


def _from_fsspec(url: str) -> tuple[fs.FileSystem, str]:
    """What fsspec makes of a URL whose scheme pyarrow does not know."""
    import fsspec.core  # only those wait for it who use it

    try:
        found, root = fsspec.core.url_to_fs(url)
    except (ValueError, ImportError) as error:
        raise BadRequest(
            f"no file system for the archive's URL {url!r}: {error}. Wanted a folder, or a URL such as "
            "file:///archive or s3://bucket/archive. Next: correct it, or install the package that it needs"
        ) from error
    return fs.PyFileSystem(fs.FSSpecHandler(found)), root
