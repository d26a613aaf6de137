"""Bound rules fed with rows: the general matcher, and lanes of many rules over a compiled kernel."""
