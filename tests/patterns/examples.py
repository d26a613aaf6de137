"""How many random cases the tests of laws try: over 2,000 in all in a common run, more where the environment asks.

They are new in each run; a failure prints the seed and the blob that repeat it.
"""

import os
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import settings

TOTAL = int(os.environ.get("VIAN_PATTERN_EXAMPLES", "2000"))
_TIMEOUT_S = 600 * max(1, TOTAL // 2000)
"""A busy machine takes several times as long, and a time-out among the cases reads like a failure of the last."""


def examples(share: float) -> Callable[[Any], Any]:
    """The settings of a test of a law, which takes this share of the cases; `-m law` chooses these tests."""
    chosen = settings(max_examples=max(1, round(TOTAL * share)))
    return lambda test: pytest.mark.law(pytest.mark.slow(pytest.mark.timeout(_TIMEOUT_S)(chosen(test))))
