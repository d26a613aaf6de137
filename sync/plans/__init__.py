"""What a station sends: plans, their filters, what a change would mean, and the streams that filters make."""
