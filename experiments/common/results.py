"""For scripts that are no experiments of the harness yet."""

import argparse
from pathlib import Path

from experiments import results
from experiments.results import *  # noqa: F403
from experiments.results import publish, write_json


def add_outputs(parser: argparse.ArgumentParser, name: str) -> None:
    """The options of `write_outputs`."""
    parser.add_argument("--json", type=Path, help="write the numbers here")
    parser.add_argument("--page", type=Path, help=f"page whose table {name} is written")


def write_outputs(arguments: argparse.Namespace, name: str, text: str, numbers: object) -> None:
    """Prints a section; writes the numbers and the page's section of that name where asked."""
    print(text)
    if arguments.json:
        write_json(arguments.json, numbers)
    if arguments.page:
        publish(arguments.page, name, text, numbers)


def check_section(page: Path, name: str) -> None:
    """For long work to ask before it begins."""
    results.page_of(name)
