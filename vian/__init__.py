"""The composition root: settings, wiring, command line, HTTP, and the demo.

Only this package builds things and hands them to each other; the others take what they need.
"""
