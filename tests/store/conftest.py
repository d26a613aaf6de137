"""Fixtures of the log's tests."""

import shutil
from collections.abc import Iterator
from itertools import count
from pathlib import Path

import pytest

_numbers = count(1)


@pytest.fixture
def data_dir(public_folder: Path) -> Iterator[Path]:
    """A place for a data directory, that does not exist yet."""
    folder = public_folder / f"data-{next(_numbers)}"
    yield folder
    if folder.is_dir():
        shutil.rmtree(folder)
    folder.unlink(missing_ok=True)
