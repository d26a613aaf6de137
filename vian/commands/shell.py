"""`vian shell`: SQL over the log, one statement after the other; also `echo "SELECT ...;" | vian shell`.

On a terminal it has a history and a prompt; behind a pipe it reads statements as they come. A statement
ends with `;` and may take many lines. Each is answered by itself, over what the log holds then.
"""

import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import duckdb
import platformdirs
import typer
from rich.console import Console

from store import Log
from vian import options
from vian.commands.query import Format, presentable, write
from vian.errors import exit_code, expected, told
from vian.options import check_known, opened, settings_for, time_of
from vian.output import Output
from vian.querying import Scope, query, tables

PROMPT, CONTINUED = "vian> ", "  ..> "
_HISTORY_LINES = 1_000
_END = re.compile(rb";")
_HELP = """\
A statement is DuckDB SQL, MATCH_RECOGNIZE too, and ends with ; on this line or a later one.
.tables          the tables that there are
.format FORMAT   how answers are written: table, csv or json
.help            this text
.quit            leave; so does Ctrl-D. Ctrl-C drops the statement that was begun"""


class Printed(StrEnum):
    """How the shell writes answers."""

    TABLE = "table"
    CSV = "csv"
    JSON = "json"


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command(epilog="Example: vian shell --format csv")(shell)


def shell(
    format_: Annotated[
        Printed, typer.Option("--format", help="Form of the answers: table, csv or json.")
    ] = Printed.TABLE,
    since: options.Since = None,
    until: options.Until = None,
    source: options.Sources = None,
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    as_json: options.Json = False,
) -> None:
    """Answer queries over the log until the input ends."""
    with opened(settings_for(data_dir, dsn), data_dir=data_dir) as log:
        check_known("source", source, {head.stream.source for head in log.streams()})
        scope = Scope(time_of("--since", since), time_of("--until", until), source)
        session = Session(log, scope, Format.JSON if as_json else Format(format_))
        if sys.stdin.isatty():
            with history(platformdirs.user_state_path("vian") / "shell_history", session.note):
                session.talk(input)
            return
        session.read(sys.stdin)
    raise typer.Exit(session.code)


@dataclass(slots=True)
class Session:
    """What the shell keeps between two lines.

    Attributes:
        log: What is asked.
        scope: The part of it that queries see.
        format: How answers are written.
        begun: A statement whose end has not come yet.
        code: 0, or the exit code of the first error.
        err: Where errors go.
    """

    log: Log
    scope: Scope
    format: Format
    begun: str = ""
    code: int = 0
    err: Console = field(default_factory=lambda: Console(stderr=True, soft_wrap=True, highlight=False))

    def talk(self, ask: Callable[[str], str]) -> None:
        """Read lines from a person until Ctrl-D or .quit."""
        self.note("Ask in SQL and end with ;  .help says more.")
        while True:
            try:
                goes_on = self.line(ask(CONTINUED if self.begun else PROMPT))
            except EOFError:
                self.err.print()
                return
            except KeyboardInterrupt:
                self.begun = ""
                self.err.print()
                continue
            if not goes_on:
                return

    def read(self, lines: Iterator[str]) -> None:
        """Read all lines; what stands after the last `;` is a statement too."""
        for line in lines:
            if not self.line(line.rstrip("\n")):
                return
        if self.begun.strip():
            self.answer(self.begun)

    def line(self, line: str) -> bool:
        """Take one line; whether to go on."""
        if not self.begun and line.lstrip().startswith("."):
            return self.command(line.split())
        *whole, self.begun = statements(f"{self.begun}{line}\n")
        if not self.begun.strip():
            self.begun = ""
        for statement in whole:
            self.answer(statement)
        return True

    def answer(self, sql: str) -> None:
        """Print the answer to one statement, or what is wrong with it."""
        try:
            write(presentable(query(self.log, sql, self.scope)), self.format, None, self.output())
        except expected() as error:
            self.complain(told(error), exit_code(error))

    def command(self, words: list[str]) -> bool:
        """Do what a line that begins with a dot asks for; whether to go on."""
        match words:
            case [".quit" | ".exit"]:
                return False
            case [".tables"]:
                self.output().table("", ("table",), [(name,) for name in tables(self.log)])
            case [".help"]:
                self.output().line(_HELP)
            case [".format", form] if form in list(Printed):
                self.format = Format(form)
            case [".format", *_]:
                self.complain(f".format wants one of {', '.join(Printed)}, got {' '.join(words[1:]) or 'nothing'}", 2)
            case _:
                self.complain(f"{words[0]} is no command here; wanted .tables, .format, .help or .quit", 2)
        return True

    def output(self) -> Output:
        """Where answers go."""
        return Output(is_json=self.format is Format.JSON)

    def note(self, text: str) -> None:
        """Tell people something that is no answer."""
        self.err.print(text, markup=False, style="dim")

    def complain(self, text: str, code: int) -> None:
        """Tell of an error, and remember that there was one."""
        self.code = self.code or code
        self.err.print(f"error: {text}", markup=False)


def statements(text: str) -> list[str]:
    """The statements in the text that have their end, and last what stands after them."""
    octets = text.encode()
    ends = [start + 1 for start, kind in duckdb.tokenize(text) if kind == duckdb.token_type.operator
            and _END.match(octets, start)]  # fmt: skip
    edges = zip([0, *ends], [*ends, len(octets)], strict=True)
    return [octets[start:end].decode() for start, end in edges]


@contextmanager
def history(file: Path, tell: Callable[[str], None]) -> Iterator[None]:
    """Lines typed before, for the length of the block; none where there is no readline or no file to keep them."""
    try:
        import readline
    except ImportError:  # Windows has none
        yield
        return
    readline.set_history_length(_HISTORY_LINES)
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.touch()
        readline.read_history_file(file)
    except OSError as error:
        tell(f"no history, since {file} cannot be used: {error.strerror}")
        yield
        return
    try:
        yield
    finally:
        readline.write_history_file(file)
