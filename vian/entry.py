"""The command's first and last moments: Ctrl-C counts from the start, and not any more once all is done.

Contract: nothing is imported before the handler stands, since importing the rest takes a second.
"""

import sys

INTERRUPTED = 130


def main() -> None:
    """Run the command `vian` and leave with its exit code."""
    import signal

    # Services are ended with SIGTERM: it shall end a command like Ctrl-C, so that an embedded PostgreSQL stops too.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        from vian.interrupts import keep_interrupts

        keep_interrupts()
        from vian.cli import app
    except KeyboardInterrupt:
        sys.stderr.write("error: interrupted before anything was done\n")
        sys.exit(INTERRUPTED)
    try:
        app()
    finally:
        # What is left is to stop servers and go; a signal now would only hide how the command ended.
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)
