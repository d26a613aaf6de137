"""Faults on purpose: a seeded campaign against a real log on a real disk. `make faults` runs it."""
