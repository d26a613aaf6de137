"""Questions over real HTTP: signed, granted, replayed, forged, and of a station that was shut out."""

from collections.abc import Callable, Iterator

import httpx
import psycopg
import pytest
from fastapi import FastAPI

from store import Log
from sync.central.access import Access
from sync.central.router import router
from sync.errors import NotAuthorised, Refused
from sync.protocol.questions import QUESTION_BYTES_MAX, Answer, FindQuestion, QueryQuestion
from sync.protocol.signing import RequestSigner
from sync.protocol.wire import PATH, parse
from sync.station.asking import Desk
from sync.station.client import Central, Greeting
from tests.sync.asking import CENTRAL, answering, audit, plate, project, tell
from tests.sync.conftest import BRNO, NOON, Serve
from tests.sync.test_access import CENTRAL_KEY, KEY, OSLO, OTHER_KEY, enrol

PLATES = FindQuestion(kind="plate", plate="*")
COUNT = QueryQuestion(sql="select count(*) as plates from plate_read")


@pytest.fixture
def access(central_log: Log) -> Access:
    return Access(central_log, CENTRAL, CENTRAL_KEY, now=lambda: NOON)


@pytest.fixture
def address(central_log: Log, access: Access, serve: Serve) -> str:
    """Address of a central server that has plates of two stations."""
    tell(central_log, "brno-2", [plate("1AB 2345")])
    tell(central_log, "oslo-1", [plate("2AB 2345"), plate("3AB 2345")])
    project(central_log)
    app = FastAPI()
    desk = answering(central_log, still_allowed=access.check_again)
    app.include_router(router(central_log, None, access=access, answers=desk))
    return serve(app)


class Asker:
    """A station in a session with central."""

    def __init__(self, address: str, access: Access, name: str = "brno-2") -> None:
        key = KEY if name == "brno-2" else OTHER_KEY
        self.signer = RequestSigner(key, name, CENTRAL_KEY.id, PATH)
        self.client = httpx.Client(base_url=address, auth=self.signer)
        self.signer.answer(access.challenge(name).challenge)
        hello = {"protocols": [2], "program": "t", "station": name, "epoch": 1, "time": NOON.isoformat()}
        self.signer.use(self.client.post(f"{PATH}/hello", json=hello).raise_for_status().json()["token"])

    def close(self) -> None:
        self.client.close()

    def ask(self, question: FindQuestion | QueryQuestion) -> httpx.Response:
        endpoint = "find" if isinstance(question, FindQuestion) else "query"
        return self.client.post(f"{PATH}/{endpoint}", content=question.encoded())


Begin = Callable[..., Asker]


def greeting() -> Greeting:
    return Greeting(BRNO, 1, NOON, heads=(), believed=None, checkpoint=None)


def test_a_desk_begins_a_session_and_begins_it_anew_where_central_lost_it(
    address: str, access: Access, central_log: Log
) -> None:
    enrol(access, operations=("find", "query"), reads=("*",))
    with httpx.Client(base_url=address) as client:
        desk = Desk(Central(client, RequestSigner(KEY, "brno-2", CENTRAL_KEY.id, PATH)), greeting)
        assert len(desk.find(PLATES).rows) == 3
        assert desk.query(COUNT).rows == ((3,),)
        with psycopg.connect(central_log.dsn, autocommit=True) as connection:
            connection.execute("delete from sync_tokens")
        assert desk.query(COUNT).rows == ((3,),)
        with pytest.raises(Refused, match=r"pg_sleep is not for questions \(line 1, column 8\)"):
            desk.query(QueryQuestion(sql="select pg_sleep(9)"))
        access.registry.revoke("brno-2")
        with pytest.raises(NotAuthorised, match="revoked"):
            desk.query(COUNT)


@pytest.fixture
def begin(address: str, access: Access) -> Iterator[Begin]:
    """Begins a session of a station."""
    begun: list[Asker] = []

    def start(name: str = "brno-2") -> Asker:
        begun.append(Asker(address, access, name))
        return begun[-1]

    yield start
    for each in begun:
        each.close()


def test_a_station_that_is_granted_it_is_answered(begin: Begin, access: Access, central_log: Log) -> None:
    enrol(access, operations=("find", "query"), reads=("oslo-1",))
    brno = begin()
    found = parse(Answer, brno.ask(PLATES).raise_for_status().content)
    assert {row["plate"] for row in found.records()} == {"2AB 2345", "3AB 2345"}
    assert parse(Answer, brno.ask(COUNT).raise_for_status().content).rows == ((2,),)
    assert [(event.asked_by, event.kind, event.outcome) for event in audit(central_log)] == [
        ("brno-2", "plate", "answered"),
        ("brno-2", "sql", "answered"),
    ]


def test_each_operation_is_granted_by_itself(begin: Begin, access: Access) -> None:
    enrol(access, operations=("replicate", "find"), reads=("brno-2",))
    enrol(access, OSLO, OTHER_KEY, operations=("query",), reads=("brno-2",))
    brno, oslo = begin(), begin("oslo-1")
    answers = [who.ask(question) for who in (brno, oslo) for question in (PLATES, COUNT)]
    assert [answer.status_code for answer in answers] == [200, 403, 403, 200]
    assert answers[1].json()["code"] == "not_granted"


def test_a_question_cannot_be_sent_again_or_changed_by_others(begin: Begin, access: Access, central_log: Log) -> None:
    enrol(access, operations=("find", "query"), reads=("brno-2",))
    brno = begin()
    sent = brno.ask(COUNT).raise_for_status().request
    with httpx.Client() as stranger:
        again = stranger.post(sent.url, content=sent.content, headers=sent.headers)
        other = stranger.post(sent.url, content=sent.content.replace(b"count", b"max  "), headers=sent.headers)
        bare = stranger.post(sent.url, content=sent.content)
    assert {again.status_code, other.status_code, bare.status_code} <= {401, 403, 409, 422}
    assert len(audit(central_log)) == 1


def test_a_station_that_was_shut_out_is_not_answered_any_more(begin: Begin, access: Access) -> None:
    enrol(access, operations=("find",), reads=("*",))
    brno = begin()
    brno.ask(PLATES).raise_for_status()
    access.registry.revoke("brno-2")
    assert brno.ask(PLATES).status_code in (401, 403)


def test_a_question_is_no_larger_than_a_question(begin: Begin, access: Access) -> None:
    enrol(access, operations=("find",), reads=("*",))
    brno = begin()
    large = brno.client.post(f"{PATH}/find", content=b" " * (QUESTION_BYTES_MAX + 1))
    assert (large.status_code, large.json()["code"]) == (413, "too_large")


def test_what_is_wrong_with_a_question_is_told(begin: Begin, access: Access) -> None:
    enrol(access, operations=("query",), reads=("*",))
    answer = begin().ask(QueryQuestion(sql="select pg_sleep(9)"))
    assert (answer.status_code, answer.json()["code"]) == (422, "bad_question")
    assert "pg_sleep is not for questions (line 1, column 8)" in answer.json()["got"]


def test_a_hello_for_a_question_names_no_cursors(access: Access, address: str) -> None:
    enrol(access)
    with httpx.Client(base_url=address) as client:
        link = Central(client, RequestSigner(KEY, "brno-2", CENTRAL_KEY.id, PATH))
        full = link.hello(Greeting(BRNO, 1, NOON, (), None, None))
        short = link.hello(Greeting(BRNO, 1, NOON, (), None, None, wants_cursors=False))

    assert len(full.cursors) == 1
    assert (short.cursors, short.are_cursors_known) == ((), False)
