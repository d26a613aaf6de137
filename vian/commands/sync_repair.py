"""`vian sync repair`: bring back damaged or pruned segments from central; at central, ask the stations for them."""

from collections.abc import Iterator, Sequence
from typing import Annotated, Any

import typer

from events import StreamName
from store import Log
from sync.keeping.repair import Repaired
from vian import options
from vian.errors import WorldFailed, WrongUsage
from vian.options import opened, settings_for
from vian.output import Output, counted
from vian.repairing import SEQUENCE_MAX, bring_back, note_lost, repair_damages
from vian.settings import Settings


def repair(
    stream: Annotated[
        str | None,
        typer.Option("--stream", help="Bring back payloads of this stream that left the disk: station/source/type."),
    ] = None,
    first: Annotated[int | None, typer.Option("--from", min=1, help="With --stream: first sequence.")] = None,
    last: Annotated[int | None, typer.Option("--to", min=1, help="With --stream: last sequence.")] = None,
    epoch: Annotated[
        int | None, typer.Option("--epoch", min=0, help="With --stream: which life of it.", show_default="its newest")
    ] = None,
    is_lost: Annotated[
        bool,
        typer.Option("--lost", help="On central: note that what is gone here and at its station is in no backup."),
    ] = False,
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    station: options.Station = None,
    as_json: options.Json = False,
) -> None:
    """Put back what is damaged, from central; at central, ask the stations. Only bytes that the hashes demand."""
    if stream is None and not first == last == epoch is None:
        raise WrongUsage("--from, --to and --epoch are of a stream. Next: give --stream STATION/SOURCE/TYPE too")
    settings = settings_for(data_dir, dsn, station=station)
    output = Output(is_json=as_json)
    with opened(settings, data_dir=data_dir) as log:
        if is_lost:
            _note_lost(log, settings, stream, epoch, first or 1, last or SEQUENCE_MAX, output)
            return
        attempts = _repaired(log, settings, stream, epoch, first or 1, last or SEQUENCE_MAX)
        # Where the payload alone could not be put back, the whole segment was tried: that is what counts.
        done = sorted({each.damage.position: each for each in attempts}.values(), key=_place)
    output.table(
        "", ("stream", "epoch", "from", "to", "position", "segments", "was", "failure"), map(_row, _spans(done))
    )
    repaired = sum(each.segments for each in done)
    put_back = f"{counted(repaired, 'segment')} {'was' if repaired == 1 else 'were'} put back"
    output.note(put_back if done else "nothing is damaged or gone there")
    if failed := sum(each.failure is not None for each in done):
        raise WorldFailed(f"{failed} were not put back. Next: vian verify --full names what is still damaged")


def _note_lost(
    log: Log, settings: Settings, stream: str | None, epoch: int | None, first: int, last: int, output: Output
) -> None:
    wanted = None if stream is None else StreamName.parse(stream)
    noted = note_lost(log, settings, wanted, epoch, first, last)
    output.table(
        "",
        ("stream", "epoch", "from", "to"),
        [(str(each.stream), each.epoch, each.first_sequence, each.last_sequence) for each in noted],
    )
    output.note(f"{len(noted)} ranges are noted as lost" if noted else "nothing is gone here and at its station")


def _place(each: Repaired) -> tuple[StreamName, int, int]:
    return each.damage.stream, each.damage.epoch, each.damage.first_sequence


def _spans(done: Sequence[Repaired]) -> Iterator[list[Repaired]]:
    """What was done, in stretches of a stream that follow one another and came out alike."""
    span: list[Repaired] = []
    for each in done:
        if span and not _follows(span[-1], each):
            yield span
            span = []
        span.append(each)
    if span:
        yield span


def _follows(before: Repaired, each: Repaired) -> bool:
    one, two = before.damage, each.damage
    is_alike = (one.stream, one.epoch, one.reason, before.failure) == (two.stream, two.epoch, two.reason, each.failure)
    return is_alike and one.last_sequence is not None and two.first_sequence == one.last_sequence + 1


def _row(span: Sequence[Repaired]) -> tuple[Any, ...]:
    first, last = span[0].damage, span[-1].damage
    segments = sum(each.segments for each in span)
    return (
        str(first.stream),
        first.epoch,
        first.first_sequence,
        last.last_sequence,
        first.position,
        segments,
        first.reason,
        span[0].failure,
    )


def _repaired(
    log: Log, settings: Settings, stream: str | None, epoch: int | None, first: int, last: int
) -> Iterator[Repaired]:
    if stream is None:
        yield from repair_damages(log, settings)
    else:
        yield from bring_back(log, settings, StreamName.parse(stream), epoch, first, last)
