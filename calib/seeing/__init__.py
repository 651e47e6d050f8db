"""From pictures to observations: where each camera sees which point of a target."""
