"""From observations to lenses and poses: adjustments, their weights and their covariance."""
