"""How many random cases the tests of laws try: 2,000 in all in a common run, more where the environment asks for it."""

import os
from typing import Any

from hypothesis import settings

TOTAL = int(os.environ.get("VIAN_PATTERN_EXAMPLES", "2000"))


def examples(share: float) -> Any:
    """The settings of a test that takes this share of the cases; a failure prints what repeats it."""
    return settings(max_examples=max(1, round(TOTAL * share)), deadline=None, print_blob=True)
