"""Lets `python -m humangs_jax.cli` run the program."""

from humangs_jax.cli import main

if __name__ == "__main__":  # processes that make people import this module again
    main()
