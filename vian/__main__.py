"""`python -m vian` is the command `vian`."""

from vian.cli import main

main()
