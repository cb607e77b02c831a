"""Scripts that measure, check and build; see README.md."""
