from collections.abc import Callable
from pathlib import Path

import pyarrow as pa
import pytest

from events import SHIPPED, Catalogue, EventType, InvalidEvent, TrackPoint, UnknownType, load_catalogue

Install = Callable[..., None]


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Install:
    """Installs a distribution whose entry points of `vian.events` lead into a module of this text."""

    def install(name: str, module: str, **points: str) -> None:
        information = tmp_path / f"{name}-1.0.dist-info"
        information.mkdir()
        (information / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        lines = [f"{point} = {name}:{thing}" for point, thing in points.items()]
        (information / "entry_points.txt").write_text("\n".join(["[vian.events]", *lines]))
        (tmp_path / f"{name}.py").write_text(module)
        monkeypatch.syspath_prepend(str(tmp_path))

    return install


def _defining(name: str, body: str = "    pass", version: int = 1) -> str:
    return f"from events import EventType\nclass T(EventType, type='{name}', version={version}):\n{body}\n"


class TrackPoint2(EventType, type="track_point", version=2, older=TrackPoint):
    """A later version."""

    @classmethod
    def upcast(cls, older: pa.RecordBatch) -> pa.RecordBatch:
        return older.select(["time"])


def test_the_shipped_catalogue_holds_every_shipped_type_once() -> None:
    catalogue = Catalogue.shipped()
    assert tuple(catalogue) == SHIPPED
    for event_type in SHIPPED:
        assert event_type.type_name in catalogue
        assert catalogue.find(event_type.type_name, event_type.version) is event_type
        assert catalogue.newest(event_type.type_name) is event_type


def test_the_newest_version_is_the_one_of_the_highest_number() -> None:
    catalogue = Catalogue([TrackPoint2, TrackPoint])
    assert catalogue.newest("track_point") is TrackPoint2
    assert catalogue.find("track_point", 1) is TrackPoint
    assert list(catalogue) == [TrackPoint2]


def test_an_unknown_type_is_refused_with_those_known() -> None:
    catalogue = Catalogue([TrackPoint, TrackPoint2])
    assert "door_opened" not in catalogue
    with pytest.raises(UnknownType, match=r"no event type 'door_opened'; known: track_point$"):
        catalogue.newest("door_opened")
    with pytest.raises(UnknownType, match="no event type") as caught:
        catalogue.find("x" * 10_000, 1)
    assert len(str(caught.value)) < 200


@pytest.mark.parametrize("version", [0, 3, 99])
def test_an_unknown_version_is_refused_with_those_known(version: int) -> None:
    with pytest.raises(
        UnknownType, match=rf"track_point version {version} is not known here, only 1, 2\. Next: upgrade"
    ):
        Catalogue([TrackPoint2, TrackPoint]).find("track_point", version)


def test_the_same_type_twice_is_one_and_another_of_its_name_is_refused() -> None:
    assert list(Catalogue([TrackPoint, TrackPoint])) == [TrackPoint]
    clash = type("Clash", (EventType,), {"__module__": "acme.types"}, type="track_point", version=1)
    with pytest.raises(UnknownType, match=r"track_point version 1 is defined twice: events\.motion and acme\.types"):
        Catalogue([TrackPoint, clash])


def test_a_type_without_columns_is_refused() -> None:
    odd = type("Odd", (EventType,), {"__annotations__": {"thing": dict}}, type="odd", version=1)
    with pytest.raises(InvalidEvent, match="field thing: no column type"):
        Catalogue([odd])


def test_a_plugged_type_joins_the_shipped_ones(installed: Install) -> None:
    installed("plug_good", _defining("door_opened"), door="T")
    catalogue = load_catalogue()
    assert tuple(catalogue)[: len(SHIPPED)] == SHIPPED
    assert catalogue.newest("door_opened").__module__ == "plug_good"


def test_a_plugged_newer_version_of_a_shipped_type_stands_beside_it(installed: Install) -> None:
    module = """
from events import EventType, TrackPoint
class T(EventType, type='track_point', version=2, older=TrackPoint):
    @classmethod
    def upcast(cls, older):
        return older.select(['time'])
"""
    installed("plug_newer", module, newer="T")
    catalogue = load_catalogue()
    assert catalogue.newest("track_point").version == 2
    assert catalogue.find("track_point", 1) is TrackPoint


def test_a_plugged_type_that_clashes_with_a_shipped_one_is_refused(installed: Install) -> None:
    installed("plug_clash", _defining("track_point"), clash="T")
    with pytest.raises(UnknownType, match=r"track_point version 1 is defined twice: events\.motion and plug_clash"):
        load_catalogue()


def test_two_plugged_types_that_clash_are_refused(installed: Install) -> None:
    installed("plug_one", _defining("door_opened"), door="T")
    installed("plug_two", _defining("door_opened"), door="T")
    with pytest.raises(UnknownType, match=r"door_opened version 1 is defined twice: plug_\w+ and plug_"):
        load_catalogue()


@pytest.mark.parametrize(
    "name, module, reason",
    [
        ("plug_taken", _defining("door_opened", "    station: str"), "envelope already has station"),
        ("plug_import", "import no_such_module_here", "No module named 'no_such_module_here'"),
        ("plug_absent", "U = 1", "has no attribute 'T'"),
        ("plug_raises", "raise RuntimeError('no licence')", "no licence"),
    ],
)
def test_a_plug_in_that_does_not_load_is_named_with_its_reason(
    installed: Install, name: str, module: str, reason: str
) -> None:
    installed(name, module, broken="T")
    with pytest.raises(UnknownType, match=rf"entry point broken of vian.events \({name}:T\) does not load: .*{reason}"):
        load_catalogue()


@pytest.mark.parametrize(
    "name, thing",
    [("plug_dict", "dict"), ("plug_text", "'text'"), ("plug_call", "len"), ("plug_base", "EventType")],
)
def test_a_plug_in_that_is_no_event_type_is_refused(installed: Install, name: str, thing: str) -> None:
    installed(name, f"from events import EventType\nT = {thing}", other="T")
    with pytest.raises(UnknownType, match=r"entry point other of vian\.events must be an EventType, got"):
        load_catalogue()
