"""Functions compiled with numba, kept in its cache where there is a place for that.

Numba keeps what it compiled beside the source, or where that cannot be written in the user's cache folder, or where
NUMBA_CACHE_DIR says. Where it can write nowhere, functions are compiled anew in each process that calls them.

Two of the options make the code faster and change nothing that it does. `_nrt` is not documented, so it is asked for
only where this numba takes it; without it references are counted.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

from numba import njit


def compiled(function: Callable[..., Any]) -> Any:
    """The function, compiled; it allocates nothing, so that numba need count no references."""
    return _kept(function, **_taken(_nrt=False))


def inlined(function: Callable[..., Any]) -> Any:
    """The same as `compiled`, written out where it is called: a call would hand over a hundred words and more."""
    return _kept(function, **_taken(_nrt=False, forceinline=True))


def compiled_with_memory(function: Callable[..., Any]) -> Any:
    """The function, compiled; it may allocate."""
    return _kept(function)


def _taken(**options: Any) -> dict[str, Any]:
    """Those of the options that this numba takes."""
    return {name: value for name, value in options.items() if takes(name)}


@cache
def takes(option: str) -> bool:
    """Whether this numba takes an option; no, where that cannot be found out.

    Numba itself says so only when a function is compiled, by an error: here its own check is asked beforehand.
    """
    try:
        from numba.core.compiler import Flags
        from numba.core.registry import cpu_target

        cpu_target.options.parse_as_flags(Flags(), {"nopython": True, option: False})
    except Exception:  # another numba has these by other names, or refuses in its own way
        return False
    return True


def _kept(function: Callable[..., Any], **options: Any) -> Any:
    try:
        return njit(cache=True, **options)(function)
    except RuntimeError:  # numba found no folder to write to
        return njit(**options)(function)
