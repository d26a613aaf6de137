import pytest

from store import Log, LogUnavailable
from tests.conftest import Server
from tests.vian.samples import reopened
from vian.errors import WorldFailed
from vian.exclusive import exclusively


def test_what_one_holds_another_cannot(log: Log) -> None:
    with exclusively(log, "source gate"), reopened(log) as other:
        said = r"another command is at work on source gate\. Next: wait"
        with pytest.raises(WorldFailed, match=said), exclusively(other, "source gate", patience_s=0.1):
            pass
        with exclusively(other, "source yard", patience_s=0.1):
            pass


def test_it_is_free_again_after_the_block_and_after_an_error(log: Log) -> None:
    with pytest.raises(ZeroDivisionError), exclusively(log, "source gate"):
        raise ZeroDivisionError
    with exclusively(log, "source gate", patience_s=0.1):
        pass


def test_the_block_goes_on_when_the_database_drops_the_connection(log: Log, server: Server) -> None:
    with exclusively(log, "source gate"):
        server.execute("select pg_terminate_backend(pid, 10000) from pg_locks where locktype = 'advisory'")
    assert log.head() == 0


def test_a_database_that_is_away_is_told() -> None:
    class Away:
        dsn = "postgresql://nobody@127.0.0.1:1/none?connect_timeout=1"

        def head(self) -> int:
            return 0

        def with_retry(self, action: object) -> None:
            return None

    away: Log = Away()  # type: ignore[assignment]
    with pytest.raises(LogUnavailable, match="the database is away"), exclusively(away, "x"):
        pass
