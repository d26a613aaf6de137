import os
import sqlite3
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path

import pytest

from events import Producer, StreamName, batch_of, encode
from store.errors import LogUnavailable
from store.journal import Journal
from tests.store.samples import GATE, NOON, YARD, draft, point


@pytest.fixture
def journal(tmp_path: Path) -> Iterator[Journal]:
    opened = Journal(tmp_path / "made" / "journal.sqlite")
    yield opened
    opened.close()


def reopened(journal: Journal) -> Journal:
    journal.close()
    return Journal(journal.path)


def test_what_was_added_comes_back_whole_and_in_order(journal: Journal) -> None:
    odd = encode(
        StreamName.of("brno", "gate", "track_point"),
        batch_of([point(1, time=NOON + timedelta(microseconds=1))]),
        Producer("détecteur 検出", "1 β", bytes(32)),
    )
    journal.add([draft(GATE, 1, 3), odd], [0, None], 1)
    journal.add([draft(YARD, 1, 2)], [7], 1)
    again = reopened(journal)
    kept = again.oldest(10)
    assert [(each.draft, each.expected) for each in kept] == [
        (draft(GATE, 1, 3), 0),
        (odd, None),
        (draft(YARD, 1, 2), 7),
    ]
    assert again.drafts_kept == 3
    assert [each.draft for each in again.oldest(2)] == [draft(GATE, 1, 3), odd]
    again.close()


def test_what_is_removed_is_gone_and_the_rest_stays(journal: Journal) -> None:
    journal.add([draft(GATE, n, n) for n in range(1, 6)], [None] * 5, 1)
    journal.remove(journal.oldest(2)[-1].id)
    assert journal.drafts_kept == 3
    again = reopened(journal)
    assert [each.draft for each in again.oldest(9)] == [draft(GATE, n, n) for n in range(3, 6)]
    again.close()


def test_a_place_is_written_down(journal: Journal) -> None:
    journal.add([draft(GATE, 1, 1), draft(GATE, 2, 2)], [None, None], 1)
    _, second = journal.oldest(2)
    journal.place({second.id: 41}, 2)
    with reopened(journal) as again:
        assert [(each.epoch, each.expected) for each in again.oldest(2)] == [(1, None), (2, 41)]


def test_its_size_shrinks_when_it_is_emptied(journal: Journal) -> None:
    before = journal.size_bytes
    journal.add([draft(GATE, 1, 5000)], [0], 1)
    grown = journal.size_bytes
    assert grown > before + 10_000
    journal.remove(journal.oldest(1)[0].id)
    assert journal.size_bytes < before + 10_000


def test_two_at_once_are_refused(journal: Journal) -> None:
    with pytest.raises(LogUnavailable, match=r"cannot be opened: .*another process uses it.*Next: "):
        Journal(journal.path)


def test_a_file_that_is_no_journal_is_refused_and_kept(tmp_path: Path) -> None:
    path = tmp_path / "notes.txt"
    path.write_text("not a database, but a text that is long enough to be read as one\n" * 20)
    before = path.read_bytes()
    with pytest.raises(LogUnavailable, match=r"notes\.txt cannot be opened: file is not a database"):
        Journal(path)
    assert path.read_bytes() == before


def test_a_write_that_fails_keeps_what_was_there(journal: Journal, monkeypatch: pytest.MonkeyPatch) -> None:
    journal.add([draft(GATE, 1, 1)], [0], 1)
    # A real disk that is full is in test_outages.py; here SQLite's own limit stands for it.
    journal._database.execute(f"pragma max_page_count = {journal.size_bytes // 4096 + 2}")
    with pytest.raises(LogUnavailable, match="cannot be written: database or disk is full"):
        journal.add([draft(GATE, 2, 2), draft(YARD, 1, 9000)], [1, 0], 1)
    assert [each.draft for each in journal.oldest(9)] == [draft(GATE, 1, 1)]
    assert journal.drafts_kept == 1


def test_it_is_fully_synchronous(journal: Journal) -> None:
    assert journal._database.execute("pragma synchronous").fetchone() == (2,)


def test_a_process_that_dies_in_its_transaction_leaves_nothing_of_it(tmp_path: Path) -> None:
    path = tmp_path / "journal.sqlite"
    child = os.fork()
    if not child:
        dying = Journal(path)
        dying.add([draft(GATE, 1, 1)], [0], 1)
        dying._database.execute("begin immediate")
        dying._database.execute("delete from drafts")
        os._exit(0)
    os.waitpid(child, 0)
    journal = Journal(path)
    assert [each.draft for each in journal.oldest(9)] == [draft(GATE, 1, 1)]
    journal.close()
    assert sqlite3.connect(path).execute("select count(*) from drafts").fetchone() == (1,)
