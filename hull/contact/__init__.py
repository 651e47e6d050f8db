"""CAD objects, and their contacts with the hull."""
