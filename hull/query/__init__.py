"""The volume query: which samples of a triangle lie inside the visual hull."""
