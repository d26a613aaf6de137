"""The embedded server: directories that it must refuse, and what killed processes leave behind."""

import json
import os
import pwd
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from store import BadRequest, Log, LogUnavailable, WrongMajor, open_log, verify
from store.embedded import MAJOR, EmbeddedServer
from tests.contracts.writers import open_append_and_wait, started
from tests.store.samples import GATE, append
from tests.store.servers import kill_server

ROOT = Path(__file__).parents[2]


def is_running(data_dir: Path) -> bool:
    return (data_dir / "pg" / "postmaster.pid").exists()


def test_a_log_is_made_kept_and_stopped(data_dir: Path) -> None:
    with open_log(data_dir=data_dir) as log:
        append(log, GATE, 3)
        assert is_running(data_dir)
        assert log.server is not None
        assert (log.server.bin_path / "psql").exists()
    assert not is_running(data_dir)
    with open_log(data_dir=data_dir) as first, open_log(data_dir=data_dir) as second:
        assert (first.head(), second.head()) == (1, 1)
        second.close()
        assert first.head() == 1
    assert not is_running(data_dir)


def test_the_directory_of_another_major_is_refused_and_left_alone(data_dir: Path) -> None:
    pgdata = data_dir / "pg"
    pgdata.mkdir(parents=True)
    (pgdata / "PG_VERSION").write_text("15\n")
    with pytest.raises(
        WrongMajor, match=f"by PostgreSQL 15, this ViAn runs PostgreSQL {MAJOR}. Next: run its own Postg"
    ):
        open_log(data_dir=data_dir)
    assert [path.name for path in pgdata.iterdir()] == ["PG_VERSION"]


def test_a_directory_with_something_else_in_it_is_refused_and_left_alone(data_dir: Path) -> None:
    pgdata = data_dir / "pg"
    pgdata.mkdir(parents=True)
    (pgdata / "holiday.jpg").write_text("sea")
    with pytest.raises(LogUnavailable, match=r"is not empty .* Next: give another --data-dir"):
        open_log(data_dir=data_dir)
    assert [path.name for path in pgdata.iterdir()] == ["holiday.jpg"]


@pytest.mark.parametrize("place", ["", "pg", "pg.lock"])
def test_a_file_or_folder_in_the_way_is_named(data_dir: Path, place: str) -> None:
    in_the_way = data_dir / place
    if place == "pg.lock":
        in_the_way.mkdir(parents=True)
    else:
        in_the_way.parent.mkdir(parents=True, exist_ok=True)
        in_the_way.write_text("a file")
    with pytest.raises(LogUnavailable, match=r"cannot be used: (File exists|Not a directory|Is a directory)"):
        open_log(data_dir=data_dir)


ANOTHER_USER = """
import os, pwd, sys
from pathlib import Path
from store import LogUnavailable, open_log
from tests.store.samples import GATE, append

with open_log(data_dir=Path(sys.argv[1])) as log:  # as root, which also loads all that Python needs
    append(log, GATE, 2)
user = pwd.getpwnam(sys.argv[2])
os.setgroups([])
os.setgid(user.pw_gid)
os.setuid(user.pw_uid)
for data_dir in sys.argv[3:]:
    try:
        with open_log(data_dir=Path(data_dir)) as log:
            append(log, GATE, 2)
            print("head", log.head())
    except LogUnavailable as error:
        print(error)
"""


def test_another_user_is_told_what_is_closed_to_him_and_can_have_a_log_of_his_own(data_dir: Path) -> None:
    if os.geteuid() != 0:
        pytest.skip("only root can act as another user")
    user = next(name for name in ("nobody", "postgres") if name in {entry.pw_name for entry in pwd.getpwall()})
    ours, closed, theirs = (data_dir / name for name in ("ours", "closed", "theirs"))
    for folder in (ours, closed, theirs):
        folder.mkdir(parents=True)
    shutil.chown(theirs, user)
    directories = [closed / "log", ours, theirs / "log"]
    ran = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", ANOTHER_USER, ours, user, *directories],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.returncode == 0, ran.stderr
    next_step = "Next: give a folder that you may write to with --data-dir, or a database with --dsn"
    assert ran.stdout.splitlines() == [
        f"the data directory {closed / 'log'} cannot be used: Permission denied. {next_step}",
        f"the data directory {ours} cannot be used: Permission denied. {next_step}",
        "head 1",
    ]


def test_what_a_killed_initdb_left_is_cleared_away(data_dir: Path) -> None:
    left = data_dir / "pg.new-4711"
    left.mkdir(parents=True)
    (left / "PG_VERSION").write_text(f"{MAJOR}\n")
    (data_dir / "pg").mkdir()
    with open_log(data_dir=data_dir) as log:
        assert log.head() == 0
    assert not left.exists()


def test_an_initdb_that_fails_leaves_nothing_and_says_why(data_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from store import embedded

    def break_off(self: object) -> None:
        (self.pgdata / "half").write_text("made")  # type: ignore[attr-defined]
        raise subprocess.CalledProcessError(1, "initdb")

    monkeypatch.setattr(embedded.PostgresServer, "ensure_pgdata_inited", break_off)
    with pytest.raises(LogUnavailable, match=r"a new data directory cannot be made in .*MiB free on that disk"):
        open_log(data_dir=data_dir)
    assert [path.name for path in data_dir.iterdir()] == ["pg.lock"]


def test_killed_processes_are_forgotten_so_that_the_last_one_stops_the_server(data_dir: Path) -> None:
    with started(open_append_and_wait, str(data_dir), "gate") as writer:
        writer.wait_until_ready()
        writer.kill()
    assert is_running(data_dir)
    with open_log(data_dir=data_dir) as log:
        users = json.loads((data_dir / "pg" / ".handle_pids.json").read_text())
        assert users == [os.getpid()]
        assert log.head() == 1
    assert not is_running(data_dir)


def test_the_last_living_user_stops_the_server_though_another_was_killed_meanwhile(data_dir: Path) -> None:
    log = open_log(data_dir=data_dir)
    with started(open_append_and_wait, str(data_dir), "gate") as other:
        other.wait_until_ready()
        other.kill()
        log.close()
    assert not is_running(data_dir)


@pytest.mark.parametrize("torn", ["", "[12, ", "[99999999]"])
def test_a_torn_list_of_users_is_as_good_as_an_empty_one(data_dir: Path, torn: str) -> None:
    server = EmbeddedServer(data_dir)
    (data_dir / "pg" / ".handle_pids.json").write_text(torn)
    server.ensure_running()
    assert json.loads((data_dir / "pg" / ".handle_pids.json").read_text()) == [os.getpid()]
    server.close()
    assert not is_running(data_dir)


def test_a_pid_file_that_names_another_process_does_not_keep_the_server_down(data_dir: Path) -> None:
    pid_file = data_dir / "pg" / "postmaster.pid"
    with open_log(data_dir=data_dir) as log:
        append(log, GATE, 2)
        lines = pid_file.read_text().splitlines()
        kill_server(data_dir)
        for first_line in (str(os.getpid()), ""):
            for name in ("postmaster.pid", ".s.PGSQL.5432.lock"):
                (data_dir / "pg" / name).write_text("\n".join([first_line, *lines[1:]]) + "\n")
            log.revive()
            assert log.head() == 1
            kill_server(data_dir)
        log.revive()
        assert verify(log).is_sound


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_whoever_interrupts_a_start_leaves_no_server(data_dir: Path, number: int) -> None:
    with open_log(data_dir=data_dir):
        pass
    program = (
        "import pathlib, signal, threading, time, store; signal.signal(signal.SIGTERM, signal.default_int_handler); "
        "threading.Thread(target=threading.Event().wait, daemon=True).start(); "  # it may take the signal
        f"log = store.open_log(data_dir=pathlib.Path({str(data_dir)!r}))\n"
        "while True: time.sleep(0.05)"  # who is faster than the signal waits for it
    )
    process = psutil.Popen([sys.executable, "-c", program], cwd=ROOT, start_new_session=True, stderr=subprocess.PIPE)
    while not is_running(data_dir):
        assert process.poll() is None
    os.killpg(process.pid, number)  # as a terminal does: the whole group
    assert b"KeyboardInterrupt" in process.communicate()[1]
    assert not is_running(data_dir)


def test_two_processes_may_make_and_use_one_directory_at_once(data_dir: Path) -> None:
    with (
        started(open_append_and_wait, str(data_dir), "gate") as first,
        started(open_append_and_wait, str(data_dir), "yard") as second,
    ):
        for process in (first, second):
            process.wait_until_ready()
        first.go_on()
        first.wait_until_done()
        assert is_running(data_dir)
        second.go_on()
        second.wait_until_done()
    assert not is_running(data_dir)
    with open_log(data_dir=data_dir) as log:
        assert [head.stream.source for head in log.streams()] == ["gate", "yard"]
        assert log.head() == 2


def test_a_server_that_does_not_start_says_what_postgresql_said(data_dir: Path) -> None:
    open_log(data_dir=data_dir).close()
    with (data_dir / "pg" / "postgresql.conf").open("a") as settings:
        settings.write("no_such_setting = on\n")
    with pytest.raises(LogUnavailable, match=r"does not start .*configuration file.*Next: vian doctor --data-dir"):
        open_log(data_dir=data_dir)


def test_a_log_that_cannot_be_opened_stops_the_server_that_it_started(
    data_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from store import log as log_module

    def refuse(*_: object) -> None:
        raise LogUnavailable("no")

    monkeypatch.setattr(log_module, "migrate", refuse)
    with pytest.raises(LogUnavailable, match="no"):
        open_log(data_dir=data_dir)
    assert not is_running(data_dir)


def test_reviving_a_log_at_an_address_does_nothing(log: Log) -> None:
    log.revive()
    assert log.head() == 0


@pytest.mark.parametrize("name", ["my log", "a'b", 'a"b', "a&b", "a%b", "a$b", "a;b", "a\nb"])
def test_a_folder_whose_name_the_server_cannot_bear_is_refused_before_anything_is_made(
    public_folder: Path, name: str
) -> None:
    with pytest.raises(BadRequest, match=r"cannot live in .* Next: give another folder with --data-dir"):
        open_log(data_dir=public_folder / name)
    assert not (public_folder / name).exists()
