"""What was recorded: sessions, frames, backgrounds, silhouettes in the image."""
