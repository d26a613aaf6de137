"""What rules know of the world that a camera sees: geometry, places, ground planes, units."""
