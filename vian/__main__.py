"""`python -m vian` is the command `vian`."""

from vian.entry import main

main()
