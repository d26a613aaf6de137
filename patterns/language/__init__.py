"""The text of rules and queries: tokens, the syntax tree, and what is said of a place in the text."""
