"""Training examples: sources of them, their order, and batches on the devices. `humangs_jax.data.loader` has the names."""
