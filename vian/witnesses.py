"""Countersignatures at the command line: which centrals' keys are known here, and what is told."""

from store import Log, key_id, known_keys
from sync.keeping.witnessing import Witnessed, witnessed
from vian.membership import load_membership
from vian.settings import Settings
from vian.signatures import key_path


def countersignatures(log: Log, settings: Settings, since: int) -> Witnessed:
    """What the log's countersignatures are worth, by the key of this station's central and by this machine's own.

    Args:
        log: The log.
        settings: Where the keys are.
        since: Up to this position they were looked at before.

    Raises:
        WrongUsage: What is known of central cannot be read.
        LogUnavailable: The database is away.
    """
    keys = known_keys(key_path(settings))
    membership = load_membership(settings, is_any=True)
    if membership is not None:
        keys[key_id(membership.central_key)] = membership.central_key
    return witnessed(log, keys, since)


def told(found: Witnessed) -> list[str]:
    """The same for people; nothing where there are none."""
    lines = []
    if found.signatures:
        lines.append(f"countersigned: {found.signatures} signatures of central, and the newest fits this log")
    if found.unknown:
        lines.append(
            f"countersigned: {found.unknown} signatures by keys that are not known here, as of a central of before; "
            "they prove nothing here"
        )
    return lines
