"""Options of numba that make the kernel faster: asked for where numba takes them, done without where it does not."""

from collections.abc import Iterator
from typing import Any

import pytest
from numba.core.registry import cpu_target

from patterns.engine import jit


@pytest.fixture
def another_numba(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A numba that has dropped `_nrt`, and says so as it says of any option that it does not know."""
    real = cpu_target.options.parse_as_flags

    def strict(flags: Any, options: dict[str, Any]) -> Any:
        if "_nrt" in options:
            raise KeyError("Unrecognized options: {'_nrt'}. Known options are ...")
        return real(flags, options)

    jit.takes.cache_clear()
    monkeypatch.setattr(cpu_target.options, "parse_as_flags", strict)
    yield
    monkeypatch.undo()
    jit.takes.cache_clear()


def _successor(number: int) -> int:
    return number + 1


def test_the_numba_that_is_pinned_takes_the_options() -> None:
    jit.takes.cache_clear()
    assert jit.takes("_nrt")
    assert jit.takes("forceinline")
    assert not jit.takes("no_such_option")


@pytest.mark.usefixtures("another_numba")
def test_functions_are_compiled_where_numba_has_dropped_one() -> None:
    assert not jit.takes("_nrt")
    assert jit.compiled(_successor)(1) == 2
    assert jit.inlined(_successor)(2) == 3
