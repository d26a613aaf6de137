"""What can be said of a rule before it runs."""
