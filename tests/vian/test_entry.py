import subprocess
import sys

INTERRUPTED_WHILE_IMPORTING = """
import sys
class Interrupting:
    def find_spec(self, name, path=None, target=None):
        if name == "vian.cli":
            raise KeyboardInterrupt
sys.meta_path.insert(0, Interrupting())
from vian.entry import main
main()
"""
INTERRUPTED_IN_A_CALLBACK = """
import os, signal, sys, weakref
class Interrupting:
    def find_spec(self, name, path=None, target=None):
        if name == "vian.cli":
            watched = Interrupting()
            watching = weakref.ref(watched, lambda _: os.kill(os.getpid(), signal.SIGINT))
            del watched
sys.meta_path.insert(0, Interrupting())
from vian.entry import main
main()
"""
INTERRUPTED_AT_THE_END = """
import atexit, os, signal
atexit.register(lambda: os.kill(os.getpid(), signal.SIGINT))
from vian.entry import main
main()
"""


def run(program: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", program, *arguments], capture_output=True, text=True, timeout=200)


def test_an_interrupt_before_the_command_is_there_is_an_interrupt_like_another() -> None:
    ran = run(INTERRUPTED_WHILE_IMPORTING, "--version")
    assert (ran.returncode, ran.stderr) == (130, "error: interrupted before anything was done\n")


def test_an_interrupt_that_fell_into_a_callback_is_not_lost() -> None:
    ran = run(INTERRUPTED_IN_A_CALLBACK, "--version")
    assert (ran.returncode, ran.stderr) == (130, "error: interrupted before anything was done\n")


def test_an_interrupt_after_all_is_done_changes_nothing() -> None:
    ran = run(INTERRUPTED_AT_THE_END, "--version")
    assert (ran.returncode, ran.stderr) == (0, "")
    assert ran.stdout.startswith("vian ")
