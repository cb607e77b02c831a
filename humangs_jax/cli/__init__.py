"""The `humangs` command."""

from humangs_jax.cli.main import main

__all__ = ["main"]
