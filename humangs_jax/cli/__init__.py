"""The `humangs` command. Each subcommand is a frozen dataclass whose fields are its options; `run` does the work.

Modules here import nothing heavy, so that `--help` is fast: what a command needs is imported when it runs. Wrong input (a
capture, a file, an option) ends in one line on stderr and exit code 2, with nothing written.
"""

import os
import sys
from collections.abc import Callable
from typing import Protocol

import tyro

from humangs_jax.cli.avatars import Animate, Demo, Export, Reconstruct, Refine, Render, View
from humangs_jax.cli.captures import ImportCameras, Synth
from humangs_jax.cli.evaluate import Evaluate
from humangs_jax.cli.fit import Check, Fit
from humangs_jax.cli.preprocess import Preprocess
from humangs_jax.cli.training import Convert, Train
from humangs_jax.core.allocator import keep_freed_memory
from humangs_jax.core.compile_cache import enable_compile_cache


class Command(Protocol):
    """A subcommand with its options."""

    def run(self) -> None:
        """Do the work. Raises: ValueError or OSError for wrong input."""
        ...


COMMANDS: dict[str, Callable[..., Command]] = {
    "import": ImportCameras,
    "fit": Fit,
    "check": Check,
    "demo": Demo,
    "reconstruct": Reconstruct,
    "refine": Refine,
    "animate": Animate,
    "render": Render,
    "export": Export,
    "evaluate": Evaluate,
    "view": View,
    "synth": Synth,
    "preprocess": Preprocess,
    "train": Train,
    "convert": Convert,
}
DESCRIPTION = "Animatable 3D Gaussian humans from a few photos with body poses."


def main() -> None:
    """Entry point of the console script."""
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")  # XLA's notes would appear between our lines
    keep_freed_memory()
    enable_compile_cache()
    try:
        tyro.extras.subcommand_cli_from_dict(COMMANDS, prog="humangs", description=DESCRIPTION).run()
    except (ValueError, OSError) as error:
        print(f"humangs: error: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("humangs: interrupted", file=sys.stderr)
        sys.exit(130)
