"""The log's connections: how a log is opened, and what happens when they die, are held or are interrupted."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import pytest

from events import StreamName
from store import BadRequest, Log, LogUnavailable, open_log
from store import log as log_module
from tests.store.samples import GATE, append, on_both, query


@on_both
def test_connections_that_died_with_the_server_are_replaced_at_once(log: Log) -> None:
    with ExitStack() as held:
        for _ in range(log_module.CONNECTIONS_MAX):
            held.enter_context(log.connection())
    query(
        log,
        "select pg_terminate_backend(pid, 10000) from pg_stat_activity "
        "where datname = current_database() and pid <> pg_backend_pid()",
    )
    assert log.head() == 0


def test_a_query_whose_connection_dies_under_it_is_an_outage(log: Log) -> None:
    def lose_the_connection() -> None:
        with log.connection() as connection:
            query(log, "select pg_terminate_backend(%s, 10000)", connection.info.backend_pid)
            connection.execute("select 1")

    with pytest.raises(LogUnavailable, match="is away"):
        lose_the_connection()


def test_an_interrupt_in_the_middle_of_a_command_leaves_a_log_that_works(
    log: Log, caplog: pytest.LogCaptureFixture
) -> None:
    def be_interrupted() -> None:
        with log.connection() as connection:
            connection.pgconn.send_query(b"select pg_sleep(60)")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        be_interrupted()
    assert [record for record in caplog.records if record.name == "psycopg"] == []
    assert log.head() == 0


def test_more_users_than_connections_wait_for_their_turn(log: Log) -> None:
    append(log, GATE, 1)
    with ThreadPoolExecutor(3 * log_module.CONNECTIONS_MAX) as pool:
        heads = list(pool.map(lambda _: log.head(), range(200)))
    assert set(heads) == {1}


def test_a_log_whose_connections_are_all_held_says_so(
    make_log: Callable[[], Log], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(log_module, "_CONNECT_SECONDS", 2.0)
    monkeypatch.setattr(log_module, "_PATIENCE_SECONDS", 0.1)
    monkeypatch.setattr(log_module, "CONNECTIONS_MAX", 1)
    log = make_log()
    with log.connection(), pytest.raises(LogUnavailable, match=r"all 1 connections to .* were busy for 2 s"):
        log.head()
    assert log.head() == 0


def test_an_action_is_tried_again_once_after_an_outage(log: Log) -> None:
    outcomes = iter([LogUnavailable("away"), None])

    def action() -> str:
        if (outcome := next(outcomes)) is not None:
            raise outcome
        return "done"

    assert log.with_retry(action) == "done"


@pytest.mark.parametrize("given", [{}, {"data_dir": Path("x"), "dsn": "postgresql://h/d"}])
def test_a_log_is_opened_by_folder_or_by_address(given: dict[str, object]) -> None:
    with pytest.raises(BadRequest, match="takes either data_dir or dsn, got " + ("both" if given else "neither")):
        open_log(**given)  # type: ignore[arg-type]


def test_a_log_is_its_own_context(log: Log) -> None:
    with open_log(dsn=log.dsn) as second:
        append(second, StreamName.of("brno", "roof", "track_point"), 1)
    assert log.head() == 1
    with pytest.raises(LogUnavailable, match="closed"):
        second.head()
