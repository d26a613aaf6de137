"""What both sides keep and give back: countersigned checkpoints, pruning, losses, repair."""
