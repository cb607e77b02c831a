"""Training: state, step, sharding, checkpoints, log, validation, loop, diagnosis."""
