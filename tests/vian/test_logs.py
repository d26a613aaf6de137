import json
import logging

import pytest
import structlog

from vian import logs


def test_logs_of_both_roads_are_one_json_object_a_line(capsys: pytest.CaptureFixture[str]) -> None:
    logs.configure(as_json=True)
    structlog.get_logger().warning("waits", part="rules", error="žluť")
    logging.getLogger("store.projector").warning("no rows for position %d", 5)
    out, err = capsys.readouterr()
    first, second = (json.loads(line) for line in err.splitlines())
    assert (first["event"], first["part"], first["error"], first["level"]) == ("waits", "rules", "žluť", "warning")
    assert (second["event"], second["level"]) == ("no rows for position 5", "warning")
    assert first["timestamp"].endswith("Z")
    assert out == ""


def test_an_error_is_logged_with_its_traceback(capsys: pytest.CaptureFixture[str]) -> None:
    logs.configure(as_json=True)
    try:
        raise ZeroDivisionError
    except ZeroDivisionError:
        logging.getLogger("vian").exception("stopped")
    (line,) = capsys.readouterr().err.splitlines()
    assert "ZeroDivisionError" in json.loads(line)["exception"]


def test_people_get_plain_lines_and_only_what_matters(capsys: pytest.CaptureFixture[str]) -> None:
    logs.configure(as_json=False, level=logging.WARNING)
    structlog.get_logger().info("hidden")
    logging.getLogger("psycopg.pool").warning("hidden too")
    structlog.get_logger().warning("shown", part="sync")
    (line,) = capsys.readouterr().err.splitlines()
    assert "shown" in line
    assert "part=sync" in line
    assert "\x1b" not in line
