"""What happens to servers."""

from contextlib import suppress
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


def end_servers(folder: Path) -> None:
    """Kill what serves data in the folder, or is about to: who was killed while it started a server left it behind."""
    while there := [process for process in psutil.process_iter() if _serves(process, str(folder))]:
        for process in there:
            with suppress(psutil.NoSuchProcess):
                process.kill()
        psutil.wait_procs(there, timeout=30)


def _serves(process: psutil.Process, folder: str) -> bool:
    with suppress(psutil.Error):
        is_postgres = process.name() in ("postgres", "pg_ctl") and process.status() != psutil.STATUS_ZOMBIE
        return is_postgres and (process.cwd().startswith(folder) or any(folder in word for word in process.cmdline()))
    return False
