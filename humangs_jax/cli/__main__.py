"""`python -m humangs_jax.cli`."""

from humangs_jax.cli import main

main()
