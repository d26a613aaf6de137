"""Alembic migrations of the log: `env` and `versions/`, their SQL objects in `sql/`, one a file.

A published migration, and a file in `sql/`, is never edited: a change is the next file, with the
next migration's number in its name.
"""
