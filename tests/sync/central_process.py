"""A central server as a process of its own, to be killed: python -m tests.sync.central_process DSN PORT."""

import socket
import sys

import uvicorn

from events import load_catalogue
from store import Log
from tests.sync.conftest import central_app


def main(dsn: str, port: str) -> None:
    listening = socket.socket()
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    listening.bind(("127.0.0.1", int(port)))
    listening.listen(16)
    app = central_app(Log(dsn, load_catalogue()))
    sys.stdout.write(f"{listening.getsockname()[1]}\n")
    sys.stdout.flush()
    uvicorn.Server(uvicorn.Config(app, log_config=None, lifespan="off", ws="none")).run(sockets=[listening])


if __name__ == "__main__":
    main(*sys.argv[1:])
