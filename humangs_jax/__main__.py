"""Lets `python -m humangs_jax` run the `humangs` command, where scripts are not on the path."""

from humangs_jax.cli import main

if __name__ == "__main__":  # processes that make people import this module again
    main()
