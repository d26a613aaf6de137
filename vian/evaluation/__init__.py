"""How good what was extracted is, against truth: horizons, tracks and positions on the ground.

Truth and measures live here, never in `extractors`: what estimates must not know what it is measured by.
Nothing here reads or writes the log.
"""
