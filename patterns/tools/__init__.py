"""What rule authors ask: what would have fired, why nothing did, what a rule costs."""
