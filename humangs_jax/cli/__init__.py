"""The `humangs` command. Each subcommand is a frozen dataclass whose fields are its options; `run` does the work.

Modules here import nothing heavy, so that `--help` is fast: what a command needs is imported when it runs.
"""

from humangs_jax.cli.main import main

__all__ = ["main"]
