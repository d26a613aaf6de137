"""`vian shell`: statements behind a pipe and on a terminal, and errors that do not end it."""

import json
from collections.abc import Callable, Iterable
from pathlib import Path

import pytest

from store import Log
from tests.vian.conftest import Run
from tests.vian.samples import YARD, append, points
from vian.commands.query import Format
from vian.commands.shell import CONTINUED, PROMPT, Session, history, statements
from vian.querying import Scope

COUNT = "select count(*) as n from track_point"


@pytest.fixture
def filled(log: Log) -> Log:
    append(log, points(10))
    return log


@pytest.mark.parametrize(
    "text, wanted",
    [
        ("select 1;", ["select 1;", ""]),
        ("select 1; select 2;\nselect", ["select 1;", " select 2;", "\nselect"]),
        ("select 'a;b', \";\" -- ;\n;", ["select 'a;b', \";\" -- ;\n;", ""]),
        ("select $$;$$ /* ; */", ["select $$;$$ /* ; */"]),
        ("select 'é;';x", ["select 'é;';", "x"]),
        ("select 'not closed; ", ["select 'not closed; "]),
    ],
)
def test_a_statement_ends_at_its_semicolon(text: str, wanted: list[str]) -> None:
    assert statements(text) == wanted


def test_statements_behind_a_pipe_are_answered_one_by_one(filled: Log, run: Run) -> None:
    ran = run(
        "shell", "--dsn", filled.dsn, "--json", typed=f"{COUNT}\nwhere frame\n < 3; select 2 as n;\nselect 3 as n"
    )
    assert [json.loads(line) for line in ran.out.splitlines()] == [{"n": 3}, {"n": 2}, {"n": 3}]
    assert (ran.code, ran.err) == (0, "")


def test_an_error_does_not_end_it_and_is_the_exit_code(filled: Log, run: Run) -> None:
    ran = run("shell", "--dsn", filled.dsn, "--json", typed="selct 1;\n.nothing\n.format xml\nselect 2 as n;\n")
    assert (ran.code, json.loads(ran.out)) == (2, {"n": 2})
    assert "error: the query is not right: Parser Error" in ran.words
    assert ".nothing is no command here; wanted .tables, .format, .help or .quit" in ran.words
    assert ".format wants one of table, csv, json, got xml" in ran.words


def test_it_knows_its_tables_its_formats_and_how_to_leave(filled: Log, run: Run) -> None:
    ran = run("shell", "--dsn", filled.dsn, typed=".help\n.format csv\n.tables\nselect 1 as one;\n.quit\nselect 2;")
    assert ".format FORMAT" in ran.out
    assert "track_point" in ran.out
    assert ran.out.endswith('"one"\n1\n')


def test_it_sees_what_its_options_leave(filled: Log, run: Run) -> None:
    append(filled, points(1), YARD)
    ran = run("shell", "--dsn", filled.dsn, "--source", "yard", "--format", "csv", typed=f"{COUNT};")
    assert ran.out == '"n"\n1\n'
    assert run("shell", "--dsn", filled.dsn, "--source", "nobody").code == 2


def typing(lines: Iterable[str | type[BaseException]], prompts: list[str]) -> Callable[[str], str]:
    """Someone at a terminal, who ends with Ctrl-D."""
    coming = iter(lines)

    def ask(prompt: str) -> str:
        prompts.append(prompt)
        line = next(coming, EOFError)
        if isinstance(line, str):
            return line
        raise line

    return ask


def test_on_a_terminal_ctrl_c_drops_what_was_begun_and_ctrl_d_leaves(
    filled: Log, capsys: pytest.CaptureFixture[str]
) -> None:
    prompts: list[str] = []
    session = Session(filled, Scope(), Format.CSV)
    session.talk(typing(["select", KeyboardInterrupt, COUNT, ";", "", "select 2 as n;"], prompts))
    assert prompts == [PROMPT, CONTINUED, PROMPT, CONTINUED, PROMPT, PROMPT, PROMPT]
    assert capsys.readouterr().out == '"n"\n10\n"n"\n2\n'


def test_the_lines_typed_are_there_the_next_time(tmp_path: Path) -> None:
    readline = pytest.importorskip("readline")
    file = tmp_path / "state" / "history"
    readline.clear_history()
    with history(file, pytest.fail):
        readline.add_history("select 1;")
    readline.clear_history()
    with history(file, pytest.fail):
        assert readline.get_history_item(1) == "select 1;"
    readline.clear_history()


def test_a_history_that_cannot_be_kept_is_told(tmp_path: Path) -> None:
    told: list[str] = []
    (tmp_path / "file").write_text("")
    with history(tmp_path / "file" / "history", told.append):
        pass
    assert told
    assert "no history" in told[0]
