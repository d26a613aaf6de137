"""The composition root: settings, wiring, command line, HTTP, and the demo.

Only this package builds things and hands them to each other; the others take what they need.

    with vian.connect() as door:                        # in a notebook: the answers of `vian query`
        door.query("SELECT type, count(*) FROM events GROUP BY ALL")
"""

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from vian.notebook import Door


def connect(data_dir: str | Path | None = None, dsn: str | None = None) -> "Door":
    """The door to a log; see `vian.notebook`."""
    from vian import notebook  # the command imports this package before it can be interrupted, so it must be light

    return notebook.connect(data_dir, dsn)
