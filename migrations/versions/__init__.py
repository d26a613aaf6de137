"""One module is one migration."""
