"""A web page that makes an avatar from photos, for a Space of Hugging Face; no part of the package.

The commands of humangs run in processes, so that people who come at the same time wait for each
other and a fault ends one of them alone.
"""

import html
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path

import gradio as gr

FEWEST, MOST = 3, 12
"""Photos."""
KEPT_SECONDS = 3600
"""How long photos and avatars stay on the machine."""
PAGE_HEIGHT = 640
"""Pixels, of the page that shows the avatar."""
ABOUT = """# An avatar from a few photos

Four to eight photos of one moment, from around the person, the whole body in each. Only of people
who have agreed. It takes some minutes; the page shows the log meanwhile.
"""

Shown = tuple[str, str, str | None]
"""The log, the page with the avatar, and the file of the avatar."""


def run(*words: object) -> Iterator[str]:
    """The log of a command of humangs so far, each time that it grows.

    Raises: RuntimeError with the last line, if the command fails.
    """
    command = [sys.executable, "-m", "humangs_jax", *map(str, words)]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace"
    )
    assert process.stdout is not None
    log = ""
    for line in process.stdout:
        log += line.rpartition("\r")[2]
        yield log
    if process.wait():
        raise RuntimeError(log.strip().splitlines()[-1] if log.strip() else "no message")


def new_folder() -> Path:
    """A folder that is deleted with all that is in it after `KEPT_SECONDS`."""
    folder = Path(tempfile.mkdtemp(prefix="humangs_"))
    timer = threading.Timer(KEPT_SECONDS, shutil.rmtree, [folder], {"ignore_errors": True})
    timer.daemon = True
    timer.start()
    return folder


def page_of(file: Path) -> str:
    """A page of the viewer inside of this one."""
    text = html.escape(file.read_text(encoding="utf-8"), quote=True)
    style = f"width: 100%; height: {PAGE_HEIGHT}px; border: 0"
    return f'<iframe srcdoc="{text}" style="{style}"></iframe>'


def avatar_of_photos(photos: list[str] | None, height: float) -> Iterator[Shown]:
    """Makes the avatar of the person in uploaded photos. height: of the person, metres."""
    if not photos or not FEWEST <= len(photos) <= MOST:
        raise gr.Error(f"expected {FEWEST} to {MOST} photos, got {len(photos or ())}")
    folder = new_folder()
    (folder / "photos").mkdir()
    for photo in photos:
        shutil.copy(photo, folder / "photos")
    out = folder / "me"
    yield from made(
        out, ("start", folder / "photos", "--out", out, "--height", height, "--no-browser")
    )


def avatar_of_demo() -> Iterator[Shown]:
    """Makes the avatar of the synthetic person that comes with the package, without refinement."""
    out = new_folder() / "demo"
    yield from made(out, ("demo", "--out", out, "--refine", "0"))


def made(out: Path, words: tuple[object, ...]) -> Iterator[Shown]:
    """What the page shows while a command makes `out`, and at its end."""
    log = ""
    try:
        for log in run(*words):
            yield log, "", None
    except RuntimeError as error:
        raise gr.Error(str(error)) from error
    yield log, page_of(out / "avatar.html"), str(out / "avatar.npz")


def page() -> gr.Blocks:
    """The whole page."""
    with gr.Blocks(title="humangs_jax", delete_cache=(KEPT_SECONDS, KEPT_SECONDS)) as blocks:
        gr.Markdown(ABOUT)
        with gr.Row():
            photos = gr.File(label="photos", file_count="multiple", file_types=["image"])
            with gr.Column():
                height = gr.Slider(0.8, 2.2, value=1.75, step=0.01, label="height of the person, m")
                start = gr.Button("Make an avatar", variant="primary")
                demo = gr.Button("Try a synthetic person")
        shown = [
            gr.Textbox(label="log", lines=6, max_lines=12),
            gr.HTML(label="avatar"),
            gr.File(label="avatar.npz, for `humangs view`, `animate` and `export`"),
        ]
        # both are heavy: one at a time on this machine
        start.click(avatar_of_photos, [photos, height], shown, concurrency_id="avatar")
        demo.click(avatar_of_demo, None, shown, concurrency_id="avatar")
    return blocks


if __name__ == "__main__":
    page().queue(default_concurrency_limit=1).launch()
