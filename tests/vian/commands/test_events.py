"""`vian events`: the catalogue."""

import json
from pathlib import Path

import pytest

from events import SHIPPED, Catalogue
from events.description import fields_of
from tests.vian.conftest import Run


def test_every_type_is_listed_with_its_versions(run: Run) -> None:
    ran = run("events")
    assert ran.code == 0
    for event_type in SHIPPED:
        assert f" {event_type.type_name} " in ran.out
    assert "2 (reads 1)" in ran.out
    assert "plate, candidates" in ran.out


@pytest.mark.parametrize("event_type", SHIPPED, ids=lambda each: each.type_name)
def test_a_type_is_told_field_by_field(run: Run, event_type: type) -> None:
    (told,) = [json.loads(line) for line in run("events", event_type.type_name, "--json").out.splitlines()]
    assert (told["type"], told["version"], told["subject"]) == (
        event_type.type_name,
        event_type.version,
        event_type.subject_field,
    )
    assert [each["field"] for each in told["fields"]] == [each.path for each in fields_of(event_type)]
    assert all(each["description"] for each in told["fields"])


def test_people_see_units_limits_and_marks(run: Run) -> None:
    out = run("events", "plate_read").out
    assert "subject: plate" in out
    for words in ("string, personal", "string, json, personal, null", "0 to 1", "left edge of the plate's box, px"):
        assert words in out
    assert "read as this version too: 1, 2" in run("events", "track_ended").out


def test_json_schema_of_one_type_says_what_the_door_asks(run: Run) -> None:
    schema = json.loads(run("events", "plate_read", "--json-schema").out)
    assert schema["$schema"] == "https://json-schema.org/draft/2020-12/schema"
    assert schema["x-vian"] == {"type": "plate_read", "version": 1, "subject": "plate"}
    fields = schema["properties"]
    assert fields["confidence"] == fields["confidence"] | {"type": "number", "minimum": 0, "maximum": 1}
    assert fields["frame"]["minimum"] == 0
    assert fields["time"] == fields["time"] | {"type": "string", "format": "date-time"}
    assert fields["plate"]["x-personal"] is True
    assert "x-personal" not in fields["country"]
    assert fields["country"]["anyOf"] == [{"type": "string"}, {"type": "null"}]
    assert set(schema["required"]) == set(fields)
    signature = json.loads(run("events", "checkpoint_signed", "--json-schema").out)["properties"]["signature"]
    assert signature["contentEncoding"] == "base16"


def test_json_schema_of_all_is_one_object_by_type(run: Run) -> None:
    schemas = json.loads(run("events", "--json-schema").out)
    assert set(schemas) == {event_type.type_name for event_type in SHIPPED}


def test_json_schemas_are_written_to_a_folder_one_file_a_version(run: Run, tmp_path: Path) -> None:
    folder = tmp_path / "new" / "schemas"
    ran = run("events", "--json-schema", "--output", folder, "--json")
    files = {path.name for path in folder.iterdir()}
    assert {Path(json.loads(line)["file"]).name for line in ran.out.splitlines()} == files
    catalogue = Catalogue.shipped()
    assert files == {f"{v.type_name}.v{v.version}.json" for t in SHIPPED for v in catalogue.versions(t.type_name)}
    old = json.loads((folder / "track_ended.v1.json").read_text())["properties"]
    new = json.loads((folder / "track_ended.v2.json").read_text())["properties"]
    assert set(new) - set(old) == {"displacement_px"}
    newest = json.loads((folder / "track_ended.v3.json").read_text())["properties"]
    assert set(newest) - set(new) == {"duration_s", "x1_mean", "y1_mean", "x2_mean", "y2_mean"}


@pytest.mark.parametrize(
    "arguments, code, message",
    [
        (["nope"], 2, "no event type 'nope'; known: activity_interval"),
        (["--output", "x"], 2, "--output needs --json-schema. Next: vian events --json-schema"),
        (["--json-schema", "--output", "/dev/null/x"], 1, "cannot be written to /dev/null/x: Not a directory. Next:"),
    ],
)
def test_a_mistake_has_its_exit_code_and_its_next_step(run: Run, arguments: list[str], code: int, message: str) -> None:
    ran = run("events", *arguments)
    assert (ran.code, ran.out) == (code, "")
    assert message in ran.words
