"""People from seeds."""
