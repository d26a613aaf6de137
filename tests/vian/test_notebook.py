"""`vian.connect()`: the door for notebooks."""

from datetime import timedelta

import pytest

import vian
from store import Log
from tests.vian.samples import START, YARD, append, points
from vian.errors import WorldFailed, WrongUsage


def test_a_notebook_gets_the_answers_of_vian_query(log: Log) -> None:
    append(log, points(6))
    append(log, points(3), YARD)
    with vian.connect(dsn=log.dsn) as door:
        assert "track_point" in door.tables()
        sql = (
            "from track_point match_recognize (partition by source order by frame measures count(*) as n pattern (a+))"
        )
        assert door.query(sql + " order by n").column("n").to_pylist() == [3, 6]
        assert door.query(sql, since=START + timedelta(seconds=4), sources=["gate"]).column("n").to_pylist() == [2]
        append(log, points(1, first_frame=6))
        assert door.query("select count(*) as n from track_point").to_pylist() == [{"n": 10}]
        with pytest.raises(WrongUsage, match="the query is not right"):
            door.query("selct")


def test_a_folder_without_a_log_is_told() -> None:
    with pytest.raises(WorldFailed, match="there is no log in"):
        vian.connect(data_dir="nowhere")
