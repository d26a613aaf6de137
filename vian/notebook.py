"""The log in a notebook: `vian.connect()`, the same answers as `vian query`.

Contract: a door holds the log open until it is closed; each query is answered by itself, over what the
log holds then.
"""

from contextlib import ExitStack
from datetime import datetime
from pathlib import Path
from types import TracebackType
from typing import Self

import pyarrow as pa

from store import Log
from vian.options import opened, settings_for
from vian.querying import Scope, query, tables


class Door:
    """An open log that answers SQL.

    Attributes:
        log: The log itself.
    """

    def __init__(self, log: Log, held: ExitStack) -> None:
        self.log = log
        self._held = held

    def query(
        self,
        sql: str,
        since: datetime | None = None,
        until: datetime | None = None,
        sources: list[str] | None = None,
    ) -> pa.Table:
        """The answer to DuckDB SQL, MATCH_RECOGNIZE too; each event type is a table.

        Args:
            sql: One statement that reads.
            since: Only events at or after this time.
            until: Only events before it.
            sources: Only these sources.

        Raises:
            WrongUsage: The SQL is not right; the message says what, and where.
        """
        return query(self.log, sql, Scope(since, until, sources))

    def tables(self) -> list[str]:
        """The tables that a query may name."""
        return tables(self.log)

    def close(self) -> None:
        """Give the log back."""
        self._held.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def connect(data_dir: str | Path | None = None, dsn: str | None = None) -> Door:
    """The door to a log; without arguments to the one that the settings name, as on the command line.

    Raises:
        WorldFailed: There is no log in the folder, or the database is away.
    """
    folder = None if data_dir is None else Path(data_dir)
    with ExitStack() as held:
        log = held.enter_context(opened(settings_for(folder, dsn), data_dir=folder))
        return Door(log, held.pop_all())
