"""Disks that fill."""

import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def small_disk(folder: Path, mib: int = 160) -> Iterator[Path | None]:
    """A file system of that size in memory; None where this user may not mount one."""
    folder.mkdir()
    mounted = os.geteuid() == 0 and shutil.which("mount") is not None
    if mounted:
        command = ["mount", "-t", "tmpfs", "-o", f"size={mib}m,mode=755", "tmpfs", str(folder)]
        mounted = subprocess.run(command, capture_output=True, check=False).returncode == 0
    try:
        yield folder if mounted else None
    finally:
        if mounted:
            subprocess.run(["umount", folder], check=True)
        folder.rmdir()


def fill(folder: Path, leave_mib: float) -> Path:
    """A file that takes up the room of the folder's disk but for so much."""
    ballast = folder / "ballast"
    size = shutil.disk_usage(folder).free - int(leave_mib * 2**20)
    with ballast.open("wb") as file:
        os.posix_fallocate(file.fileno(), 0, size)
    return ballast
