"""Frames in, events out.

An extractor takes frames (`extractors.video` reads them from a file) and yields batches of events. It
knows neither source, nor station, nor log: whoever calls it gives the events their stream. Nothing is
imported here, so that the decoding process starts with what it needs and no more.
"""
