"""Freezes a new type: `python -m tests.events.golden` writes the payload of each `TYPE.vN.json` that has none yet.

The rows are written by hand. A payload that is there stays as it is: stored segments have its bytes.
"""

import json
from pathlib import Path

from events import SHIPPED, Catalogue, batch_of_type
from events.segment import encode_payload

for rows in sorted(Path(__file__).parent.glob("*.json")):
    name, version = rows.stem.split(".v")
    payload = rows.with_suffix(".bin")
    if not payload.exists():
        event_type = Catalogue(SHIPPED).find(name, int(version))
        said = [event_type.model_validate(row) for row in json.loads(rows.read_text())]
        payload.write_bytes(encode_payload(batch_of_type(event_type, said)))
