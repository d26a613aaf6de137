"""`vian init`, `vian sign`, `vian verify`: the station's key, its signatures, and whether all holds."""

from typing import TYPE_CHECKING, Annotated, Any

import typer

from events import CheckpointCountersigned, LossRecorded, station_name
from store import (
    BadProof,
    ChainBroken,
    Covered,
    Gap,
    Log,
    StoreError,
    Verification,
    Verified,
    key_id,
    keys_of_others,
    known_keys,
    make_key,
    verify,
)
from store.restoring import note_read_back
from vian import options
from vian.clock import utc_now
from vian.errors import WorldFailed, WrongUsage
from vian.options import opened, settings_for
from vian.output import Output
from vian.settings import Settings
from vian.signatures import VerifiedNote, has_key, key_path, own_station, rotate, signer_for, signing_station

if TYPE_CHECKING:
    from sync.keeping.witnessing import Witnessed


def register(app: typer.Typer) -> None:
    """Add the commands."""
    app.command(epilog="Example: vian init --station brno-2")(init)
    app.command(epilog="Example: vian sign")(sign)
    app.command(name="verify", epilog="Example: vian verify --data-dir /var/lib/vian")(verify_log)


def init(
    is_new_key: Annotated[
        bool, typer.Option("--new-key", help="Replace the key by a new one, which the old one names as its successor.")
    ] = False,
    key_file: options.KeyFile = None,
    station: options.Station = None,
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    as_json: options.Json = False,
) -> None:
    """Make this station's log and its key for signatures; what is there already stays as it is."""
    settings = settings_for(data_dir, dsn, station=station, key_file=key_file)
    path = key_path(settings)
    if is_new_key and not path.exists():
        raise WrongUsage(f"there is no key in {path} to replace. Next: vian init")
    with opened(settings, data_dir=data_dir, is_made=True) as log:
        name = signing_station(log, settings)
        if is_new_key:
            rotate(log, settings)
        key = make_key(path)
        position = log.head()
        notes = _next(log, settings) if is_new_key else []
    Output(is_json=as_json).result(
        {
            "station": name,
            "key_id": key.id,
            "public_key": key.public.hex(),
            "key_file": str(path),
            "position": position,
            "next": notes,
        },
        f"station:     {name}\nkey id:      {key.id}\npublic key:  {key.public.hex()}\n"
        f"key file:    {path} (yours alone: keep a copy apart, and the key id where others can find it)\n"
        f"log:         position {position}" + "".join(f"\nnext:        {note}" for note in notes),
    )


def _next(log: Log, settings: Settings) -> list[str]:
    """What to do now that the key is another."""
    from vian.rekeying import told_of_new_key  # of sync, which commands that verify need not wait for

    return told_of_new_key(log, settings)


def sign(
    key_file: options.KeyFile = None,
    station: options.Station = None,
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    as_json: options.Json = False,
) -> None:
    """Sign the log as it stands: where each stream is, in which order and when all was recorded."""
    settings = settings_for(data_dir, dsn, station=station, key_file=key_file)
    output = Output(is_json=as_json)
    if not has_key(settings):
        raise WorldFailed(f"there is no key in {key_path(settings)}. Next: vian init")
    with opened(settings, data_dir=data_dir) as log:
        signer = signer_for(log, settings)
        with output.progress("positions", log.head()) as bar:
            while not signer.step():
                bar.at(signer.position)
            signed = signer.sign()
    if signed is None:
        output.result({"signed": False, "position": signer.position}, "nothing new to sign")
        return
    statement = signed.statement
    streams = len({(head.stream, head.epoch) for head in statement.heads})
    output.result(
        {
            "signed": True,
            "station": statement.station,
            "checkpoint": signed.sequence,
            "position": statement.position,
            "streams": streams,
            "key_id": key_id(statement.public_key),
            "time": statement.time,
        },
        f"signed: checkpoint {signed.sequence} of station {statement.station}, {streams} streams up to "
        f"position {statement.position}, with key {key_id(statement.public_key)}",
    )


def verify_log(
    is_full: Annotated[
        bool, typer.Option("--full", help="Read the whole log again, not only what came since the last time.")
    ] = False,
    key_file: options.KeyFile = None,
    station: options.Station = None,
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    as_json: options.Json = False,
) -> None:
    """Recompute every hash from the stored bytes and check every signature; exit code 1 and the first bad positions."""
    settings = settings_for(data_dir, dsn, station=station, key_file=key_file)
    output = Output(is_json=as_json)
    path = key_path(settings)
    with opened(settings, data_dir=data_dir) as log, output.progress("positions", log.head()) as bar:
        note = VerifiedNote(log, settings)
        found = verify(
            log,
            on_segment=lambda segment: bar.at(segment.position),
            before=None if is_full else _before(note, output),
            station=own_station(log, settings),
            trusted=known_keys(path) | keys_of_others(path),
            save=lambda verified: _note(note, verified, output),
        )
        countersigned = _countersigned(log, settings, found)
        gone = _gone(log, settings)
        faults = [*found.broken, *(countersigned.broken if countersigned else ())]
        if not faults:
            _note_read_back(log, found, output)
        enrolled = set() if all(each.is_known for each in found.covered) else _enrolled(log, settings)
    if faults:
        for broken in faults:
            output.result(_broken(broken), f"broken: {broken}")
        raise WorldFailed(
            f"the log does not verify: {len(faults)} breaks. "
            "Next: keep this database as it is, and restore the streams named from central or a backup"
        )
    assert found.verified is not None, "a sound log can be gone on from"
    _note(note, found.verified, output)
    _tell_sound(found, found.verified, countersigned, enrolled, output)
    if not found.covered:
        output.note("no signature covers it. Next: vian init, then vian sign, or keep vian serve running")
    if gone:
        raise WorldFailed(f"every hash is right, but payloads are gone: {'; '.join(gone[:5])}")


def _tell_sound(
    found: Verification,
    verified: Verified,
    countersigned: "Witnessed | None",
    enrolled: set[str],
    output: Output,
) -> None:
    data, text = _sound(found, verified, enrolled), _told(found, verified, enrolled)
    if countersigned is not None:
        from vian.witnesses import told

        data |= {"countersigned": countersigned.signatures, "countersigned_by_unknown": countersigned.unknown}
        text = "\n".join([text, *told(countersigned)])
    output.result(data, text)


def _countersigned(log: Log, settings: Settings, found: Verification) -> "Witnessed | None":
    """What countersignatures since the last run are worth; None where the log has no such stream."""
    if not any(head.stream.type == CheckpointCountersigned.type_name for head in log.streams()):
        return None
    from vian.witnesses import countersignatures  # of sync, which a log that central never signed need not wait for

    return countersignatures(log, settings, found.since)


def _gone(log: Log, settings: Settings) -> list[str]:
    """What is gone at both sides of replication, for people."""
    if not any(head.stream.type == LossRecorded.type_name for head in log.streams()):
        return []
    from sync.keeping.gone import gone_in, told_at_central, told_at_station

    own = station_name(settings.station)
    return [
        told_at_station(each) if each.stream.station == own else told_at_central(each) for each in gone_in(log, own)
    ]


def _enrolled(log: Log, settings: Settings) -> set[str]:
    """Ids of the keys by which this central server knows its stations."""
    from sync.central.registry import Registry  # of sync, which a station that verifies need not wait for

    registry = Registry(log, station_name(settings.station), utc_now)
    return {each.key_id for each in registry.stations()}


def _note(note: VerifiedNote, verified: Verified, output: Output) -> None:
    try:
        note.save(verified)
    except BadProof as error:
        output.note(f"the next run begins where this one did: {error}")


def _note_read_back(log: Log, found: Verification, output: Output) -> None:
    try:
        note_read_back(log, found.position)
    except StoreError as error:
        output.note(f"that the restored log was read back cannot be recorded: {error}")


def _before(note: VerifiedNote, output: Output) -> Verified | None:
    try:
        return note.load()
    except BadProof as error:
        output.note(f"what was verified before does not count, the whole log is read: {error}")
        return None


def _broken(broken: ChainBroken) -> dict[str, Any]:
    return {
        "sound": False,
        "station": broken.stream.station,
        "stream": str(broken.stream),
        "position": broken.position,
        "first_sequence": broken.first_sequence,
        "reason": broken.reason,
    }


def _sound(found: Verification, verified: Verified, enrolled: set[str]) -> dict[str, Any]:
    return {
        "sound": True,
        "segments": verified.segments,
        "events": verified.events,
        "streams": found.streams,
        "position": found.position,
        "segments_read": found.segments,
        "segments_without_payload": found.hollow,
        "gaps": [
            {
                "stream": str(gap.stream),
                "epoch": gap.epoch,
                "first_sequence": gap.first,
                "last_sequence": gap.last,
            }
            for gap in found.gaps
        ],
        "signed": [
            {
                "station": each.station,
                "key_id": each.key_id,
                "is_key_known": each.is_known or each.key_id in enrolled,
                "checkpoints": each.checkpoints,
                "signed_at": each.signed_at,
                "position": each.position,
                "streams": each.streams,
                "events": each.events,
            }
            for each in found.covered
        ],
    }


def _told(found: Verification, verified: Verified, enrolled: set[str]) -> str:
    text = (
        f"sound: {verified.events} events in {verified.segments} segments of {found.streams} streams, up to position "
        f"{found.position}"
    )
    if found.since:
        text += f"; up to position {found.since} it was found sound before and not read again (--full does)"
    signed = (_signed(each, is_enrolled=each.key_id in enrolled) for each in found.covered)
    return "\n".join([text, *_hollow(found), *map(_gap, found.gaps), *signed])


def _gap(gap: Gap) -> str:
    return (
        f"not here: {gap.stream}, epoch {gap.epoch}, sequences {gap.first} to {gap.last}: the station began behind "
        "them, as its plan says, or sends them later"
    )


def _hollow(found: Verification) -> list[str]:
    """What is told of segments without payload."""
    if not found.hollow:
        return []
    text = f"{found.hollow} segments without payload: pruned or lost, as the log records"
    if found.unrecorded:
        text += f"; of {found.unrecorded} ranges the stations' records have not come yet"
    return [text]


def _signed(covered: Covered, *, is_enrolled: bool) -> str:
    order = (
        f"order and times of recording up to position {covered.position}"
        if covered.position is not None
        else "their order is not judged here, since what it signs are positions of the station's own log "
        f"(in that log: vian verify --station {covered.station})"
    )
    known = "not known here: compare it with what the station's vian init says"
    if covered.is_known or is_enrolled:
        known = "known here" if covered.is_known else "the one by which the station is enrolled here"
    return (
        f"signed: station {covered.station}, {covered.events} events of {covered.streams} streams, {order}; "
        f"{covered.checkpoints} checkpoints, the newest of {covered.signed_at:%Y-%m-%dT%H:%M:%SZ}; "
        f"key {covered.key_id} ({known})"
    )
