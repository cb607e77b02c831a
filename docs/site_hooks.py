"""What mkdocs does with our pages: help texts of the commands, and links to files that are not on
the site.
"""

import os
import posixpath
import re
import subprocess
import sys
import textwrap
from typing import Any

COMMANDS = "<!-- commands -->"
"""Where docs/cli.md gets the help of every command."""
UPWARDS = re.compile(r"\[([^\]]*)\]\(((?:\.\./)+[^)\s]+)\)")
"""A link that leaves the folder of its page."""


def on_page_markdown(markdown: str, page: Any, **_: object) -> str:
    """Called by mkdocs for the text of every page. Links that leave docs/ are right on a checkout,
    and lead nowhere on the site: they become names of files.
    """
    if COMMANDS in markdown:
        markdown = markdown.replace(COMMANDS, commands())
    folder = posixpath.dirname(page.file.src_uri)

    def shown(link: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(folder, link[2]))
        if not target.startswith("../"):
            return link[0]
        return _named(link[1], target.removeprefix("../"))

    return UPWARDS.sub(shown, markdown)


def _named(text: str, file: str) -> str:
    """Returns the text of a link with its file, once."""
    return f"`{file}`" if file.endswith(text.strip("`")) else f"{text} (`{file}`)"


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
