"""Command lines in Markdown and notebooks: what README, docs and notebooks tell people to type."""

import json
import re
import shlex
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
PAGES = [
    ROOT / "README.md",
    *sorted((ROOT / "docs").glob("*.md")),
    ROOT / "humangs_jax/assets/weights.md",
    *sorted((ROOT / "notebooks").glob("*.ipynb")),
]
FENCE = re.compile(
    r"^(?P<fence>```+|~~~+)[ \t]*(?P<kind>[\w+-]*)[^\n]*\n(?P<text>.*?)^(?P=fence)[ \t]*$", re.DOTALL | re.MULTILINE
)
SPAN = re.compile(r"(?<!`)`(?P<text>[^`]+)`(?!`)")
SHELLS = ("", "sh", "bash", "shell", "console", "text", "zsh")
ENDS, BAR = {"&&", "||", "|", ";", "&"}, "\N{BROKEN BAR}"
LAUNCHERS = ("srun", "env", "time", "nice", "nohup", "sudo", "exec")
PROGRAM = re.compile(r"(?:.*/)?(humangs|python3?)$")


class Command(NamedTuple):
    """words: without prompt, program before it, placeholders as they stand. whole: nothing is missing; so are those of blocks and
    those that begin an item of a list.
    """

    page: str
    words: tuple[str, ...]
    whole: bool

    def __str__(self):
        return f"{self.page}: {' '.join(self.words)}"


def commands_of(path):
    """All commands of a page or notebook, each once, in its order."""
    text = path.read_text()
    if path.suffix != ".ipynb":
        return commands_in(text, path.name)
    found = []
    for cell in json.loads(text)["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            found += commands_in(source, path.name)
        elif cell["cell_type"] == "code":
            lines = "\n".join(line.lstrip()[1:] for line in source.splitlines() if line.lstrip().startswith("!"))
            found += [Command(path.name, words, True) for words in split_shell(lines)]
    return list(dict.fromkeys(found))


def commands_in(text, page):
    """Of a Markdown text: those of its shell blocks, and those in its code spans."""
    found = []
    for block in FENCE.finditer(text):
        if block["kind"].lower() in SHELLS:
            found += [Command(page, words, True) for words in split_shell(block["text"])]
    prose = FENCE.sub("", text)
    for span in SPAN.finditer(prose):
        item = prose[: span.start()].endswith(("\n- ", "\n* "))
        found += [Command(page, words, item) for words in split_shell(" ".join(span["text"].split()))]
    return list(dict.fromkeys(found))


def split_shell(text):
    """The commands of `humangs` and `python` in lines of a shell: continued lines, comments, prompts, `a && b`, `X=1 a`, what a
    launcher (srun) starts, and what stands in quotes after one (ssh --command "a").
    """
    text = re.sub(r"\\\n[ \t]*", " ", text)
    found = []
    for line in text.splitlines():
        line = re.sub(r"^\s*(?:\$|>|%)\s+", "", line)
        line = re.sub(r"(?<=\S)\|(?=\S)", BAR, line)  # one of several values, and no pipe
        lexer = shlex.shlex(line, posix=True, punctuation_chars="&|;")
        lexer.whitespace_split, lexer.commenters = True, "#"
        try:
            words = [*(word.replace(BAR, "|") for word in lexer), ";"]
        except ValueError:  # an apostrophe: prose
            continue
        start = 0
        for i, word in enumerate(words):
            if word in ENDS:
                found += of_one(words[start:i])
                start = i + 1
    return found


def of_one(words):
    """The command among the words of one line of a shell: none, one, or those in a quoted argument."""
    for i, word in enumerate(words):
        if match := PROGRAM.fullmatch(word):
            return [(match[1].replace("python3", "python"), *words[i + 1 :])]
        if word not in LAUNCHERS and not re.match(r"\w+=", word):
            break
    return [command for word in words if " " in word for command in split_shell(word)]


def filled(words):
    """Optional parts as if they were given, the first of several values, 1 for what is in capitals or is a variable."""
    kept = []
    for word in words:
        word = word.replace("[", "").replace("]", "")
        if re.fullmatch(r"[\w.+-]+(\|[\w.+-]+)+", word):
            word = word.split("|")[0]
        word = re.sub(r"\$\{?\w+\}?", "1", word)
        word = re.sub(r"(?<![\w.])[A-Z][A-Z_]*(?![\w.])", "1", word)
        if word and word not in ("...", "…"):
            kept.append(word)
    return kept
