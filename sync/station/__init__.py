"""The station's side: a daemon that one can step by hand, and its link to central."""
