import re
from collections.abc import Callable
from importlib.metadata import PackagePath
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NoReturn

import pytest

from events import StreamName
from store import Log, LogUnavailable, Projector, Signer, load_key, make_key
from tests.vian.samples import append, points, reopened
from vian import doctor
from vian.clock import utc_now
from vian.doctor import examine
from vian.findings import Verdict
from vian.settings import load_settings


def findings(open_existing: Callable[[], Log], **given: Any) -> dict[str, tuple[Verdict, str]]:
    settings = load_settings(**given)
    found = examine(settings, open_existing, is_embedded=settings.dsn is None)
    return {each.check: (each.verdict, each.text) for each in found}


def never() -> NoReturn:
    raise AssertionError("there is no log to open")


def test_without_a_log_nothing_stands_in_the_way(tmp_path: Path) -> None:
    found = findings(never, data_dir=tmp_path / "new" / "log")
    assert {verdict for verdict, _ in found.values()} == {Verdict.OK, Verdict.NOTE}
    assert found["log"] == (Verdict.NOTE, f"no log in {tmp_path}/new/log yet; vian demo or vian extract makes one")
    assert list(tmp_path.glob("new*")) == [], "looking changes nothing"


def test_a_log_is_described_and_its_lag(log: Log) -> None:
    append(log, points(3))
    found = findings(lambda: reopened(log), dsn=log.dsn)
    assert found["log"] == (Verdict.OK, "1 streams, 1 segments, epoch 1")
    verdict, text = found["row tables"]
    assert verdict is Verdict.NOTE
    assert re.fullmatch(
        r"1 segments behind the log \(since 20.* UTC\)\. Next: vian project, or keep vian serve running", text
    )
    Projector(log).catch_up()
    assert findings(lambda: reopened(log), dsn=log.dsn)["row tables"] == (Verdict.OK, "0 segments behind the log")
    assert "--dsn" in found["psql"][1]


def test_the_key_is_a_finding(tmp_path: Path) -> None:
    assert findings(never, data_dir=tmp_path)["key"] == (
        Verdict.NOTE,
        "there is no key: nothing is signed. Next, if it shall be: vian init",
    )
    key = make_key(tmp_path / "station.key")
    assert findings(never, data_dir=tmp_path)["key"] == (Verdict.OK, f"{key.id} in {tmp_path}/station.key")
    (tmp_path / "station.key").chmod(0o644)
    verdict, text = findings(never, data_dir=tmp_path)["key"]
    assert verdict is Verdict.BAD
    assert f"Next: chmod 600 {tmp_path}/station.key" in text


def test_a_log_that_was_signed_by_a_key_that_is_not_here_wants_it_back(log: Log, tmp_path: Path) -> None:
    old, here = tmp_path / "old" / "station.key", tmp_path / "here" / "station.key"
    make_key(old)
    append(log, points(1))
    given = {"dsn": log.dsn, "key_file": here}
    assert findings(lambda: reopened(log), **given)["key"][1].endswith("if it shall be: vian init")
    Signer(log, "brno", lambda: load_key(old), utc_now).sign()
    verdict, text = findings(lambda: reopened(log), **given)["key"]
    assert verdict is Verdict.NOTE
    assert "one of station brno signed this log before: nothing is signed any more. Next: bring" in text
    assert f"bring {here} back" in text
    assert f"bring its public key back into {here.parent}/public-keys, then vian init" in text
    append(log, points(1), StreamName.of("plzen", "gate", "track_point"))
    assert "vian init" in findings(lambda: reopened(log), **given)["key"][1], "it is central's: others sign there"
    assert "bring" not in findings(lambda: reopened(log), **given)["key"][1]


def test_a_database_that_is_away_is_a_finding(log: Log) -> None:
    def away() -> NoReturn:
        raise LogUnavailable("the database is away. Next: start it")

    found = findings(away, dsn=log.dsn)
    assert found["log"] == (Verdict.BAD, "the database is away. Next: start it")
    assert found["packages"][0] is Verdict.OK


def test_a_place_that_cannot_be_written_is_bad(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    found = findings(never, data_dir=tmp_path / "file")
    assert found["data directory"][0] is Verdict.BAD
    assert "Next: give another with --data-dir" in found["data directory"][1]


def test_a_full_disk_is_bad(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor.shutil, "disk_usage", lambda _: SimpleNamespace(free=3 * 2**20))
    verdict, text = findings(never, data_dir=tmp_path)["disk"]
    assert (verdict, text) == (Verdict.BAD, "3 MiB free. Next: free some, or move the log with --data-dir")


def test_the_settings_file_is_named(tmp_path: Path) -> None:
    assert findings(never, data_dir=tmp_path)["settings"][1] == "defaults and environment"
    Path("vian.toml").write_text("port = 5\n")
    assert findings(never, data_dir=tmp_path)["settings"][1] == "from vian.toml"


def test_a_package_from_elsewhere_is_bad(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    find_spec = doctor.importlib.util.find_spec

    def found_elsewhere(name: str) -> Any:
        return SimpleNamespace(origin=str(tmp_path / "events" / "__init__.py")) if name == "events" else find_spec(name)

    monkeypatch.setattr(doctor.importlib.util, "find_spec", found_elsewhere)
    verdict, text = findings(never, data_dir=tmp_path)["packages"]
    assert verdict is Verdict.BAD
    assert f"took the place of: events ({tmp_path}/events/__init__.py)" in text


def test_a_file_that_was_overwritten_is_bad(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "events").mkdir()
    (tmp_path / "events" / "model.py").write_text("another distribution's")
    recorded = PackagePath("events/model.py")
    recorded.hash = SimpleNamespace(mode="sha256", value="x" * 43)  # type: ignore[assignment]
    recorded.dist = SimpleNamespace(locate_file=lambda path: tmp_path / path)  # type: ignore[assignment]
    monkeypatch.setattr(doctor, "distribution", lambda _: SimpleNamespace(files=[recorded]))
    verdict, text = findings(never, data_dir=tmp_path)["packages"]
    assert verdict is Verdict.BAD
    assert "took the place of: events/model.py" in text
