"""The commands, one module a group. Each opens with what it does and ends with an example."""
