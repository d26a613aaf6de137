"""Rule files and templates: read, filled in, and their test cases run."""
