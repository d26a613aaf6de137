"""Two processes that append to one stream at the same place at once: one wins, the other is told who stands where."""

import random
from pathlib import Path

from events import decode
from tests.faults.load import SHARED, Process, append_one, opened


def rounds_of_rivalry(data_dir: Path, seed: int, rounds: int) -> list[str]:
    """What was wrong in so many rounds; nothing if each had one clear winner."""
    choose = random.Random(seed)
    wrong = []
    with opened(data_dir) as log:
        for _ in range(rounds):
            head = log.stream_head(SHARED).sequence
            rivals = [Process(append_one, log.dsn, head) for _ in range(2)]
            try:
                for rival in rivals:
                    assert rival.said() == "ready"
                choose.shuffle(rivals)
                for rival in rivals:
                    rival.pipe.send("go")
                answers = sorted((rival.said() for rival in rivals), key=str)
            finally:
                for rival in rivals:
                    rival.close()
            if answers != [(head, head + 1), True]:
                wrong.append(f"at sequence {head} the rivals were told {answers}")
        stored = [n for s in log.read(SHARED) for n in decode(s, log.catalogue).data.column("frame").to_pylist()]
        if stored != list(range(1, rounds + 1)):
            wrong.append(f"the stream holds {stored}")
    return wrong
