"""CAD objects: their files, their closed surfaces, exact distances and winding numbers."""
