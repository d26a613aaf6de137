"""Evidence: a directory that proves by itself what a log recorded.

`selection` says which events are wanted and why, `bundle` writes the directory, `verifier` checks it: the same
file lies in the directory as `verify.py` and needs nothing of ViAn.
"""
