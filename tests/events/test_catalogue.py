from collections.abc import Callable
from pathlib import Path

import pyarrow as pa
import pytest

from events import (
    SHIPPED,
    Catalogue,
    EventType,
    InvalidEvent,
    TrackPoint,
    UnknownType,
    UpcastFailed,
    batch_of,
    load_catalogue,
)
from tests.events.examples import NOON

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


# Versions: what is newest brings the older ones, and says how they become its own.


def _version(version: int, older: type[EventType] | None, upcast: Callable[..., object] | None) -> type[EventType]:
    made = {"__module__": "acme.doors", "__annotations__": {"width": float}}
    made |= {} if upcast is None else {"upcast": classmethod(upcast)}
    return type(f"Door{version}", (EventType,), made, type="door", version=version, older=older)


def _kept(cls: type[EventType], older: pa.RecordBatch) -> pa.RecordBatch:
    return older


DOOR = _version(1, None, None)
DOOR_2 = _version(2, DOOR, _kept)


def test_the_newest_version_brings_those_before_it() -> None:
    catalogue = Catalogue([_version(3, DOOR_2, _kept)])
    assert [each.version for each in catalogue.versions("door")] == [1, 2, 3]
    assert catalogue.find("door", 1) is DOOR
    assert [each.version for each in catalogue] == [3]


@pytest.mark.parametrize(
    "event_type, message",
    [
        (_version(2, None, _kept), r"door version 2 \(acme\.doors\) must name version 1 .* as `older`, got none"),
        (_version(3, DOOR, _kept), r"door version 3 .* must name version 2 .* as `older`, got door version 1"),
        (_version(2, TrackPoint, _kept), r"door version 2 .* must name version 1 .*, got track_point version 1"),
        (_version(3, _version(2, None, _kept), _kept), r"door version 2 .* must name version 1 .*, got none"),
        (_version(2, DOOR, None), r"door version 2 .* must define `upcast`, which makes events of version 1 its own"),
    ],
)
def test_a_version_that_leaves_an_older_one_unreadable_is_refused_by_name(
    event_type: type[EventType], message: str
) -> None:
    with pytest.raises(UnknownType, match=message):
        Catalogue([event_type])


def test_an_inherited_upcast_is_none_of_its_own() -> None:
    third = type("Door3", (DOOR_2,), {"__module__": "acme.doors"}, type="door", version=3, older=DOOR_2)
    with pytest.raises(UnknownType, match=r"door version 3 .* must define `upcast`"):
        Catalogue([third])


def test_a_plugged_version_without_its_older_one_is_refused(installed: Install) -> None:
    installed("plug_late", _defining("door_opened", version=2), late="T")
    with pytest.raises(UnknownType, match=r"door_opened version 2 \(plug_late\) must name version 1"):
        load_catalogue()


def _times_moved(cls: type[EventType], older: pa.RecordBatch) -> pa.RecordBatch:
    later = pa.compute.add(older.column("time"), pa.scalar(1, pa.duration("us")))
    return older.set_column(0, older.schema.field("time"), later)


@pytest.mark.parametrize(
    "upcast, message",
    [
        (lambda cls, older: older.select(["time"]), "fails: door: columns missing: width"),
        (lambda cls, older: older.column("height"), "fails: .*height"),
        (lambda cls, older: None, "fails: .*RecordBatch, got NoneType"),
        (lambda cls, older: 1 / 0, "fails: division by zero"),
        (lambda cls, older: older.slice(1), "must keep every event with its time"),
        (_times_moved, "must keep every event with its time"),
    ],
)
def test_an_upcaster_that_breaks_its_contract_is_told_with_its_steps(
    upcast: Callable[..., object], message: str
) -> None:
    broken = _version(2, DOOR, upcast)
    said = [DOOR(time=NOON, width=width) for width in (1.0, 2.0)]  # type: ignore[call-arg]
    with pytest.raises(UpcastFailed, match=rf"door: the upcast from version 1 to 2 of acme\.doors {message}"):
        Catalogue([broken]).upcast(batch_of(said))


def test_the_newest_version_is_not_touched() -> None:
    batch = batch_of([DOOR_2(time=NOON, width=1)])  # type: ignore[call-arg]
    assert Catalogue([DOOR_2]).upcast(batch) is batch


def test_only_a_type_that_the_catalogue_holds_is_registered() -> None:
    Catalogue([DOOR_2]).check_registered(DOOR)
    for stranger in (TrackPoint, _version(1, None, None), _version(3, DOOR_2, _kept)):
        with pytest.raises(UnknownType, match=f"'{stranger.type_name}' version {stranger.version} .* not registered"):
            Catalogue([DOOR_2]).check_registered(stranger)
