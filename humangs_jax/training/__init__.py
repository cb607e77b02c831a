"""State, step, sharding, checkpoints, log, validation, loop, diagnosis."""
