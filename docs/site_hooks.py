"""What mkdocs does with our pages: help texts of the commands, and links to files that are not on
the site.
"""

import os
import re
import subprocess
import sys
import textwrap

COMMANDS = "<!-- commands -->"
"""Where docs/cli.md gets the help of every command."""
OUTSIDE = re.compile(r"\[([^\]]*)\]\((?:\.\./)+(?!images/|api/)([^)\s]+)\)")
"""A link that leaves docs/: right on a checkout, and nothing on the site."""


def on_page_markdown(markdown: str, **_: object) -> str:
    """Called by mkdocs for the text of every page."""
    if COMMANDS in markdown:
        markdown = markdown.replace(COMMANDS, commands())
    return OUTSIDE.sub(_named, markdown)


def _named(link: re.Match[str]) -> str:
    """The text of a link with its file, once."""
    return f"`{link[2]}`" if link[2].endswith(link[1].strip("`")) else f"{link[1]} (`{link[2]}`)"


def commands() -> str:
    """The overview and the help texts of all commands as one Markdown text."""
    from humangs_jax.cli import COMMANDS

    texts = [f"```text\n{help_of()}\n```"]
    return "\n\n".join(
        texts + [f"## humangs {name}\n\n```text\n{help_of(name)}\n```" for name in COMMANDS]
    )


def help_of(*command: str) -> str:
    """What `humangs COMMAND --help` prints, without colors."""
    run = [sys.executable, "-m", "humangs_jax.cli", *command, "--help"]
    environment = os.environ | {"NO_COLOR": "1", "TERM": "dumb", "COLUMNS": "86"}
    text = subprocess.run(
        run, capture_output=True, text=True, check=True, env=environment
    ).stdout.strip()
    return "\n".join(
        textwrap.fill(line, 86) if line[:1].isalpha() else line for line in text.split("\n")
    )
