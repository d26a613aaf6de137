"""`vian evidence`: a directory that proves by itself what the log recorded."""

import getpass
import re
import socket
from datetime import datetime
from pathlib import Path
from typing import Annotated

import typer

from events import CheckpointSigned, StreamName
from store import BadProof, Log, load_key
from vian import options
from vian.clock import utc_now
from vian.errors import WorldFailed, WrongUsage
from vian.evidence import verifier
from vian.evidence.bundle import Exported, Source, export
from vian.evidence.selection import Selection, of_situation, of_stream
from vian.options import opened, settings_for, time_of
from vian.output import Output
from vian.settings import Settings
from vian.signatures import has_key, key_path, own_station, signer_for

app = typer.Typer(help="Evidence that anyone can verify without ViAn.", no_args_is_help=True)


@app.command(name="export", epilog="Example: vian evidence export --situation 3f9c2a71 --why 'case 12/2026'")
def export_evidence(
    situation: Annotated[
        str | None, typer.Option("--situation", help="All that this situation rests on; its identity or how it begins.")
    ] = None,
    stream: Annotated[
        str | None, typer.Option("--stream", help="Events of this stream instead: station/source/type.")
    ] = None,
    begin: Annotated[
        str | None, typer.Option("--from", help="From this sequence, or this time (ISO 8601, UTC).")
    ] = None,
    end: Annotated[
        str | None, typer.Option("--to", help="To this sequence, inclusive, or before this time (ISO 8601, UTC).")
    ] = None,
    epoch: Annotated[
        int | None,
        typer.Option(
            "--epoch",
            min=0,
            help="Only this life of the stream: a log that was restored has several.",
            show_default="all",
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="Directory to write.", show_default="evidence-... here")
    ] = None,
    by: Annotated[
        str | None, typer.Option("--by", help="Who exports it.", show_default="the user at this machine")
    ] = None,
    why: Annotated[str, typer.Option("--why", help="Why it is exported, such as a case number.")] = "",
    key_file: options.KeyFile = None,
    station: options.Station = None,
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    as_json: options.Json = False,
) -> None:
    """Write segments, signatures, decoded events, a manifest and a stand-alone verifier into one directory."""
    settings = settings_for(data_dir, dsn, station=station, key_file=key_file)
    output = Output(is_json=as_json)
    with opened(settings, data_dir=data_dir) as log:
        selection = _selection(log, situation, stream, begin, end, epoch)
        source = _source(log, settings, selection, by or f"{getpass.getuser()} at {socket.gethostname()}", why, output)
        with output.progress("streams", len(selection.wanted)) as bar:
            done = iter(range(len(selection.wanted)))
            exported = export(source, selection, out or _default_out(selection), lambda _: bar.at(next(done)))
    for each in selection.missing:
        output.note(f"not found in the log: {each}")
    verdict = verifier.verify(exported.path, lambda _: None)
    if isinstance(verdict, str):
        raise WorldFailed(f"{exported.path} does not verify: {verdict}. Next: vian verify --full")
    output.result(
        {
            "path": str(exported.path),
            "manifest_sha256": exported.manifest_sha256,
            "key_id": source.key.id if source.key else None,
            "is_signed": verdict == verifier.SOUND,
            "events": exported.events,
            "segments": exported.segments,
            "segments_withheld": exported.withheld,
            "files": exported.files,
            "bytes": exported.bytes,
        },
        _told(exported, source, is_signed=verdict == verifier.SOUND),
    )


@app.command(name="verify", epilog="Example: vian evidence verify evidence-3f9c2a71")
def verify_evidence(
    directory: Annotated[Path, typer.Argument(help="The directory of evidence.", callback=options.existing)],
    manifest: Annotated[
        str | None, typer.Option("--manifest", help="SHA-256 of the manifest, as told at the export.")
    ] = None,
    key: Annotated[str | None, typer.Option("--key", help="Key id that the station published.")] = None,
    as_json: options.Json = False,
) -> None:
    """Check a directory of evidence as its own verify.py does, by the copy that is installed here."""
    output = Output(is_json=as_json)
    given = [str(directory), *(("--manifest", manifest) if manifest else ()), *(("--key", key) if key else ())]
    found = verifier.arguments(given)
    if found is None or not directory.is_dir():
        raise WrongUsage(
            f"wanted a directory, --manifest of 64 and --key of 32 hexadecimal digits; got {' '.join(given)}"
        )
    lines: list[str] = []
    report = verifier.examine(found[0], lines.append if as_json else output.line, found[1], found[2])
    verdict = report.verdict()
    if as_json:
        output.result(
            {
                "intact": not report.bad,
                "faults": [{"file": path, "reason": reason} for path, reason in report.bad],
                "unsigned": report.unsigned,
                "signatures_unchecked": len(report.unchecked),
            }
        )
    if isinstance(verdict, str):
        raise WorldFailed(verdict)
    raise typer.Exit(verdict)


def _selection(
    log: Log, situation: str | None, stream: str | None, begin: str | None, end: str | None, epoch: int | None
) -> Selection:
    if (situation is None) == (stream is None):
        raise WrongUsage("give either --situation or --stream")
    if situation is not None:
        if (begin, end, epoch) != (None, None, None):
            raise WrongUsage("--from, --to and --epoch go with --stream; a situation names its own events")
        return of_situation(log, situation)
    assert stream is not None
    return of_stream(log, StreamName.parse(stream), _bound("--from", begin), _bound("--to", end), epoch)


def _bound(option: str, text: str | None) -> int | datetime | None:
    """A sequence or a time."""
    return int(text) if text is not None and re.fullmatch(r"\d{1,18}", text) else time_of(option, text)


def _source(log: Log, settings: Settings, selection: Selection, by: str, why: str, output: Output) -> Source:
    """Where it comes from, after the log was signed as it stands, if there is a key."""
    key = load_key(key_path(settings)) if has_key(settings) else None
    if key is None:
        output.note("there is no key: the export itself is not signed. Next, if it shall be: vian init")
    else:
        try:
            signer_for(log, settings).sign()
        except BadProof as error:
            output.note(f"exported as it was signed before: {error}")
    own = own_station(log, settings)
    return Source(log, own or _only_signer(log, selection), own is not None, key, by, why, utc_now())


def _only_signer(log: Log, selection: Selection) -> str | None:
    """The one station that recorded all that is wanted, if it signs; this is another station's log."""
    stations = {str(each.stream.station) for each in selection.wanted}
    signing = {str(each.stream.station) for each in log.streams() if each.stream.type == CheckpointSigned.type_name}
    return stations.pop() if len(stations) == 1 and stations <= signing else None


def _default_out(selection: Selection) -> Path:
    question = selection.question
    name = question["situation"][:12] if "situation" in question else question["stream"].replace("/", "-")
    return Path(f"evidence-{name}")


def _told(exported: Exported, source: Source, *, is_signed: bool) -> str:
    signature = f"signed throughout, by key {source.key.id}" if is_signed and source.key else "not signed throughout"
    return (
        f"{exported.path}: {exported.events} events in {exported.segments} segments, {exported.withheld} more without "
        f"their payload; {exported.files} files beside manifest and seal, {exported.bytes} bytes; {signature}\n"
        f"manifest SHA-256: {exported.manifest_sha256} (note it apart)\n"
        f"to check it: python3 {exported.path / 'verify.py'}"
    )
