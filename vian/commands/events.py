"""`vian events`: the catalogue of event types, for people and as JSON Schema."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from events import Catalogue, EventType, UnknownType, load_catalogue
from events.description import fields_of, json_schema
from vian import options
from vian.errors import WorldFailed, WrongUsage
from vian.output import Output

_COLUMNS = ("field", "type", "allowed", "meaning, unit, frame")


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command(epilog="Example: vian events track_ended")(events)


def events(
    name: Annotated[
        str | None, typer.Argument(metavar="TYPE", help="Only this event type.", show_default="all")
    ] = None,
    as_schema: Annotated[
        bool, typer.Option("--json-schema", help="Print JSON Schema instead: of one type, or an object of all.")
    ] = False,
    output_dir: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="With --json-schema: write TYPE.vN.json, every version, into this folder."),
    ] = None,
    as_json: options.Json = False,
) -> None:
    """List the event types that are installed: versions, fields with units, what is allowed, what is personal."""
    catalogue = load_catalogue()
    types = list(catalogue) if name is None else [_named(catalogue, name)]
    output = Output(is_json=as_json)
    if output_dir is not None and not as_schema:
        raise WrongUsage("--output needs --json-schema. Next: vian events --json-schema --output FOLDER")
    if output_dir is not None:
        _write(catalogue, types, output_dir, output)
    elif as_schema:
        schemas = {str(each.type_name): json_schema(each) for each in types}
        output.line(json.dumps(schemas if name is None else schemas[name], indent=None if as_json else 2))
    elif as_json:
        for each in types:
            output.result(_described(catalogue, each))
    elif name is None:
        rows = [(each.type_name, _versions(catalogue, each), _personal(each), _about(each)) for each in types]
        output.table("", ("type", "version", "personal", "what happened"), rows)
        output.note("Next: vian events TYPE tells its fields")
    else:
        _tell(catalogue, types[0], output)


def _named(catalogue: Catalogue, name: str) -> type[EventType]:
    try:
        return catalogue.newest(name)
    except UnknownType as error:
        raise WrongUsage(f"{error}. Next: vian events lists them") from error


def _tell(catalogue: Catalogue, event_type: type[EventType], output: Output) -> None:
    output.line(f"{event_type.type_name} version {event_type.version}: {_about(event_type)}")
    output.line(f"subject: {event_type.subject_field or 'none'}")
    if older := catalogue.versions(event_type.type_name)[:-1]:
        output.line(f"read as this version too: {', '.join(str(each.version) for each in older)}")
    rows = [(each.path, each.marks, each.allowed, each.description) for each in fields_of(event_type)]
    output.table("", _COLUMNS, rows)


def _described(catalogue: Catalogue, event_type: type[EventType]) -> dict[str, Any]:
    return {
        "type": event_type.type_name,
        "version": event_type.version,
        "older_versions": [each.version for each in catalogue.versions(event_type.type_name)[:-1]],
        "subject": event_type.subject_field,
        "description": _about(event_type),
        "fields": [
            {
                "field": each.path,
                "type": each.kind,
                "null": each.is_nullable,
                "json": each.is_json,
                "personal": each.is_personal,
                "allowed": each.allowed or None,
                "description": each.description,
            }
            for each in fields_of(event_type)
        ],
    }


def _write(catalogue: Catalogue, types: Sequence[type[EventType]], folder: Path, output: Output) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for each in types:
            for version in catalogue.versions(each.type_name):
                file = folder / f"{version.type_name}.v{version.version}.json"
                file.write_text(json.dumps(json_schema(version), indent=2) + "\n", encoding="utf-8")
                output.result(
                    {"type": version.type_name, "version": version.version, "file": str(file)}, f"wrote {file}"
                )
    except OSError as error:
        raise WorldFailed(
            f"the schemas cannot be written to {folder}: {error.strerror}. Next: give another folder with --output"
        ) from error


def _versions(catalogue: Catalogue, event_type: type[EventType]) -> str:
    *older, newest = [str(each.version) for each in catalogue.versions(event_type.type_name)]
    return f"{newest} (reads {', '.join(older)})" if older else newest


def _personal(event_type: type[EventType]) -> str:
    return ", ".join(each.path for each in fields_of(event_type) if each.is_personal)


def _about(event_type: type[EventType]) -> str:
    return " ".join((event_type.__doc__ or "").split())
