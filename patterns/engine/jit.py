"""Functions compiled with numba, kept in its cache where there is a place for that.

Numba keeps what it compiled beside the source, or where that cannot be written in the user's cache folder, or where
NUMBA_CACHE_DIR says. Where it can write nowhere, functions are compiled anew in each process that calls them.
"""

from collections.abc import Callable
from typing import Any

from numba import njit


def compiled(function: Callable[..., Any]) -> Any:
    """The function, compiled; it allocates nothing, so that numba need count no references."""
    return _kept(function, _nrt=False)


def inlined(function: Callable[..., Any]) -> Any:
    """The same as `compiled`, written out where it is called: a call would hand over a hundred words and more."""
    return _kept(function, _nrt=False, forceinline=True)


def compiled_with_memory(function: Callable[..., Any]) -> Any:
    """The function, compiled; it may allocate."""
    return _kept(function)


def _kept(function: Callable[..., Any], **options: Any) -> Any:
    try:
        return njit(cache=True, **options)(function)
    except RuntimeError:  # numba found no folder to write to
        return njit(**options)(function)
