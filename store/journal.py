"""The journal: drafts on the local disk while the database is away, in the order in which they came.

Contract: what `add` returned for is on the disk (SQLite, fully synchronous) and survives a kill or a power
cut; `drafts` gives it back oldest first; `remove` forgets what the log holds. One process at a time uses a
journal. Before drafts are sent, `place` writes down at which sequence each stands, so that sending them
again after a kill is recognised by the log and stores nothing twice.
"""

import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from events import Draft, Producer, StreamName
from events.segment import microseconds
from store.errors import LogUnavailable

_SCHEMA = """
create table if not exists drafts (
  id integer primary key autoincrement,
  stream text not null,
  epoch integer not null,
  expected integer,
  event_count integer not null,
  schema_version integer not null,
  time_min_us integer not null,
  time_max_us integer not null,
  producer text not null,
  producer_version text not null,
  configuration_hash blob not null,
  payload blob not null,
  payload_hash blob not null
) strict
"""
_COLUMNS = (
    "stream, epoch, expected, event_count, schema_version, time_min_us, time_max_us, producer, producer_version, "
    "configuration_hash, payload, payload_hash"
)
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


@dataclass(frozen=True, slots=True)
class Kept:
    """A draft in the journal."""

    id: int
    draft: Draft
    epoch: int
    """The life of the log in which its place was, or will be, written down."""
    expected: int | None
    """The sequence at which its stream stands before it; None while that is not known."""


class Journal:
    """Drafts on disk. Not for several threads at once."""

    def __init__(self, path: Path) -> None:
        """Open the journal, or make it.

        Raises:
            LogUnavailable: The file cannot be used, or another process uses it.
        """
        self.path = path
        with self._explained("opened"):
            path.parent.mkdir(parents=True, exist_ok=True)
            self._database = sqlite3.connect(path, isolation_level=None, timeout=0, check_same_thread=False)
            self._database.execute("pragma locking_mode = exclusive")
            self._database.execute("pragma synchronous = full")
            self._database.execute("begin exclusive")
            self._database.execute(_SCHEMA)
            self._database.execute("commit")
            self.drafts_kept: int = self._database.execute("select count(*) from drafts").fetchone()[0]

    def close(self) -> None:
        """Let go of the file."""
        self._database.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def size_bytes(self) -> int:
        """Bytes of the file that hold drafts."""
        names = ("page_count", "freelist_count", "page_size")
        pages, free, size = (self._database.execute(f"pragma {name}").fetchone()[0] for name in names)
        return int((pages - free) * size)

    def add(self, drafts: Sequence[Draft], expected: Sequence[int | None], epoch: int) -> None:
        """Keep the drafts behind those that are there; they are on the disk when this returns.

        Args:
            drafts: The drafts.
            expected: For each the sequence at which its stream stands before it, where that is known.
            epoch: The life of the log that this is about.

        Raises:
            LogUnavailable: The disk does not take them; none of them is kept.
        """
        with self._transaction("written"):
            self._database.executemany(
                f"insert into drafts ({_COLUMNS}) values ({', '.join('?' * 12)})",
                [_row(draft, epoch, sequence) for draft, sequence in zip(drafts, expected, strict=True)],
            )
        self.drafts_kept += len(drafts)

    def oldest(self, limit: int) -> list[Kept]:
        """At most `limit` drafts, oldest first."""
        with self._explained("read"):
            rows = self._database.execute(f"select id, {_COLUMNS} from drafts order by id limit ?", (limit,)).fetchall()
        return [_kept(row) for row in rows]

    def place(self, expected: Mapping[int, int], epoch: int) -> None:
        """Write down at which sequence, of which life, the drafts of these ids stand, before they are sent.

        Raises:
            LogUnavailable: The disk does not take it.
        """
        with self._transaction("written"):
            self._database.executemany(
                "update drafts set expected = ?, epoch = ? where id = ?",
                [(sequence, epoch, id_) for id_, sequence in expected.items()],
            )

    def remove(self, up_to: int) -> None:
        """Forget the drafts up to this id, which the log holds.

        Raises:
            LogUnavailable: The disk does not take it; they will be sent, and recognised, again.
        """
        with self._transaction("written"):
            removed = self._database.execute("delete from drafts where id <= ?", (up_to,)).rowcount
        self.drafts_kept -= removed

    @contextmanager
    def _transaction(self, what: str) -> Iterator[None]:
        with self._explained(what):
            self._database.execute("begin immediate")
            try:
                yield
                self._database.execute("commit")
            except BaseException:
                if self._database.in_transaction:
                    self._database.execute("rollback")
                raise

    @contextmanager
    def _explained(self, what: str) -> Iterator[None]:
        try:
            yield
        except (sqlite3.Error, OSError) as error:
            in_use = " (another process uses it)" if "locked" in str(error) else ""
            raise LogUnavailable(
                f"the journal {self.path} cannot be {what}: {error}{in_use}. "
                "Next: free space or give another file; what it holds stays"
            ) from error


def _row(draft: Draft, epoch: int, expected: int | None) -> tuple[object, ...]:
    by = draft.producer
    times = (microseconds(draft.time_min), microseconds(draft.time_max))
    said = (by.name, by.version, by.configuration_hash)
    counts = (draft.event_count, draft.schema_version)
    return (str(draft.stream), epoch, expected, *counts, *times, *said, draft.payload, draft.payload_hash)


def _kept(row: Sequence[Any]) -> Kept:
    id_, stream, epoch, expected, count, version, time_min, time_max, name, producer_version, config, *rest = row
    payload, digest = rest
    draft = Draft(
        stream=StreamName.parse(str(stream)),
        event_count=count,
        schema_version=version,
        time_min=_EPOCH + timedelta(microseconds=time_min),
        time_max=_EPOCH + timedelta(microseconds=time_max),
        producer=Producer(str(name), str(producer_version), config),
        payload=payload,
        payload_hash=digest,
    )
    return Kept(id_, draft, epoch, expected)
