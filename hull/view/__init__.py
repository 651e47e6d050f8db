"""Pictures of the hull and the CAD."""
