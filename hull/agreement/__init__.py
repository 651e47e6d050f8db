"""What the cameras of a session say about each other: silhouettes and views that (dis)agree."""
