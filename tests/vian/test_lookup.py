"""What a station finds by itself is what central would find in the same log."""

import re
from datetime import timedelta
from typing import Any

import pyarrow.compute as pc
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from events import Catalogue
from store import Log
from sync.central.lookup import like, plate_key
from sync.protocol.questions import FindQuestion
from tests.conftest import Server
from tests.sync.asking import find, plate, project, situation, tell
from tests.sync.conftest import NOON
from vian import lookup

TEXTS = ("1AB 23-45", "1ab2346", "2ČB%_1", "ÄÖ 1\\2", "", "1AB2345")
RULES = ("speeding", "wrong way", "speed_trap", "100%")

questions = st.one_of(
    st.builds(
        FindQuestion,
        kind=st.just("plate"),
        plate=st.one_of(
            st.sampled_from(("*", "1ab*", "?AB*", "*5", "2Č*", "%", "_", "\\", "1AB2345", "*%_*", "äö*")),
            st.text("1ABČ*?%_\\ -", min_size=1, max_size=6),
        ),
        station=st.sampled_from((None, "brno-2", "oslo-1")),
        source=st.sampled_from((None, "gate", "yard")),
        since=st.sampled_from((None, NOON, NOON + timedelta(minutes=2))),
        until=st.sampled_from((None, NOON, NOON + timedelta(minutes=3))),
        limit=st.sampled_from((1, 3, 100)),
    ),
    st.builds(
        FindQuestion,
        kind=st.just("situation"),
        rule=st.sampled_from((None, "speed*", "*way", "speed?trap", "speed_trap", "100%", "%")),
        severity=st.sampled_from((None, "info", "warning", "alarm")),
        limit=st.sampled_from((2, 100)),
    ),
)


@pytest.fixture(scope="module")
def both(servers: Any) -> Any:
    """A log with rows, for the whole module: nothing here changes what is asked of it."""
    server: Server = servers.get("embedded")
    name = server.create_database()
    with Log(server.dsn(name), Catalogue.shipped()) as log:
        for station in ("brno-2", "oslo-1"):
            for source in ("gate", "yard"):
                tell(log, station, [plate(text, minute, confidence=0.1) for minute, text in enumerate(TEXTS)], source)
            severities = ("info", "warning", "alarm", "alarm")
            tell(log, station, [situation(rule, 1, kind) for rule, kind in zip(RULES, severities, strict=True)])
        project(log)
        yield log
    server.drop_database(name)


@given(question=questions)
@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_station_finds_what_central_finds_in_the_same_log(both: Log, question: FindQuestion) -> None:
    wanted = find(both, **question.model_dump()).records()
    assert lookup.look_up(both, question, question.limit) == wanted


def test_the_newest_are_kept_however_many_there_are(log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lookup, "_KEPT_MIN", 3)
    for minute in range(10):
        tell(log, "brno-2", [plate(f"{(minute * 7) % 10}", (minute * 7) % 10)])
    question = FindQuestion(kind="plate", plate="*")
    assert [row["plate"] for row in lookup.look_up(log, question, 2)] == ["9", "8"]
    assert len(lookup.look_up(log, question, None)) == 10


@given(text=st.text("1aB%_\\*?", max_size=8), plate_text=st.text("1AB%_\\", max_size=8))
def test_a_star_is_any_letters_and_a_question_mark_one(text: str, plate_text: str) -> None:
    pattern = "".join({"*": ".*", "?": "."}.get(letter, re.escape(letter)) for letter in plate_key(text))
    assert pc.match_like(plate_key(plate_text), like(plate_key(text))).as_py() == bool(
        re.fullmatch(pattern, plate_key(plate_text), re.DOTALL)
    )
