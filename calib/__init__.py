"""Camera rigs: from pictures of a target to cameras that can be trusted."""
