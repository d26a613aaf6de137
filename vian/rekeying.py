"""What must be done once a station or central has a new key, so that the two believe each other again.

Contract: says it; does nothing. The old key's signatures stay good, and nothing that was sent is in doubt.
"""

from store import Log
from vian.admission import registry_for
from vian.membership import load_membership
from vian.settings import Settings


def told_of_new_key(log: Log, settings: Settings) -> list[str]:
    """What to do now, for people: at a station that is enrolled, and at a central with stations."""
    notes = []
    membership = load_membership(settings, is_any=True)
    if membership is not None:
        name, address = membership.station, membership.address
        notes.append(
            f"central at {address} takes no request signed with the new key: vian station invite {name} on central, "
            f"then vian station enrol CODE --central {address} here, and start vian serve or vian sync again"
        )
    stations = [each.name for each in registry_for(log, settings).stations() if each.revoked_at is None]
    if stations:
        named = ", ".join(stations[:5]) + (", ..." if len(stations) > 5 else "")
        notes.append(
            f"start vian serve again; {len(stations)} stations ({named}) go on sending, but do not believe what the "
            "new key countersigns, and prune nothing more, until each is enrolled again: vian station invite NAME "
            "here, then vian station enrol CODE there"
        )
    return notes
