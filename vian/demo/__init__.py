"""The demo: one event's whole life on real video, and a report that shows it."""
