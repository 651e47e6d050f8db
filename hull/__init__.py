"""From a recording to contacts between real things and CAD."""
