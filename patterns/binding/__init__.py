"""From the syntax tree to a bound rule: names resolved, types checked, the pattern compiled."""
