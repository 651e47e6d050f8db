"""A rig that is only drawn: what it will see, and how far its answers will be off."""
