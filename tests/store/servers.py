"""What happens to servers."""

from pathlib import Path

import psutil


def postmaster(data_dir: Path) -> psutil.Process:
    """The server's first process."""
    return psutil.Process(int((data_dir / "pg" / "postmaster.pid").read_text().split()[0]))


def kill_server(data_dir: Path) -> None:
    """Kill the server and wait until all of its processes are gone, as in a container that is restarted."""
    server = postmaster(data_dir)
    family = [server, *server.children(recursive=True)]
    for process in family:
        process.kill()
    psutil.wait_procs([process for process in family if process.status() != psutil.STATUS_ZOMBIE], timeout=30)
