"""Whether a rig can be trusted: checks, comparisons, certificates."""
