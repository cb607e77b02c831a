"""An avatar in the browser while it is being made: by a training run, or by a refinement.

    humangs view --live RUN_FOLDER           # the newest weights of a training run reconstruct someone
    humangs view --live refined.npz          # an avatar file, whenever it is replaced: `humangs refine --live` does so

    with LiveView() as view:                 # in Python
        hg.refine(avatar, capture, watch=view.show)

The browser asks for the state of the view every second, and loads the page of `viewer.page` again where it shows another avatar.
"""

import contextlib
import json
import threading
import time
import webbrowser
from pathlib import Path

from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.reconstruct import reconstruct
from humangs_jax.core.configuration import ArgumentError
from humangs_jax.core.progress import say
from humangs_jax.data.capture import Capture, load_capture
from humangs_jax.data.motion import Motion
from humangs_jax.data.photos import DEMO_CAPTURE
from humangs_jax.network.weights import load_weights
from humangs_jax.viewer.page import page_html, page_server, read_part

WEIGHTS = "weights.safetensors"
"""What a training run writes with every checkpoint."""
LOOK_AGAIN = 1.0
"""Seconds between two looks at the file that is followed."""


class LiveView:
    """The page of one avatar after the other on 127.0.0.1; a context manager.

    Arguments: motion: played by the page; None: the shipped walk. port: 0 for any free one. Raises: OSError if the port is taken.
    """

    def __init__(self, motion: Motion | None = None, port: int = 0):
        self.motion, self.shown = motion, 0
        self.pages = {"/": read_part("live.html")}
        self.say("Waiting for the first avatar ...")
        self.server = page_server(self.pages, port)
        self.url = f"http://127.0.0.1:{self.server.server_address[1]}/"
        threading.Thread(target=self.server.serve_forever, daemon=True).start()

    def __enter__(self) -> "LiveView":
        return self

    def __exit__(self, *_: object) -> None:
        self.server.shutdown()
        self.server.server_close()

    def show(self, avatar: Avatar, status: str | None = None) -> None:
        """Show an avatar in place of the last one, and a line above it. May be called from any thread."""
        self.pages["/avatar"] = page_html(avatar, self.motion)
        self.shown += 1
        self.say(f"{len(avatar.gaussians.means):,} Gaussians, {time.strftime('%H:%M:%S')}" if status is None else status)

    def say(self, status: str) -> None:
        """Show a line above the avatar."""
        self.pages["/state"] = json.dumps({"shown": self.shown, "status": status})


def follow(
    path: str | Path, capture: str | Path | None = None, motion: Motion | None = None, port: int = 0, open_browser: bool = True
) -> None:
    """Show what a training run or a refinement makes, until Ctrl-C.

    Arguments: path: the folder of a run of `humangs train`, or an avatar file, which need not exist yet. capture: of the person
    that a run's network reconstructs; None for the shipped one.

    Raises: ValueError or OSError, one line, for what cannot be followed.
    """
    path, photos = Path(path), None
    if path.is_dir():
        if not (path / "config.json").is_file():
            raise ValueError(f"{path}: no config.json: expected the folder of a training run, or an avatar file")
        photos = load_capture(DEMO_CAPTURE if capture is None else capture)
    elif path.suffix != ".npz" or not path.parent.is_dir():
        raise FileNotFoundError(f"{path}: no such run: expected the folder of a training run, or an avatar file (.npz)")
    elif capture is not None:
        raise ArgumentError("capture", f"{capture}: only for the folder of a training run; {path} is an avatar file")
    with LiveView(motion, port) as view, contextlib.suppress(KeyboardInterrupt):
        say(f"{view.url} shows {path} as it changes; Ctrl-C ends.")
        if open_browser:
            webbrowser.open(view.url)
        shown = None
        while True:
            shown = show_newest(view, path, photos, shown)
            time.sleep(LOOK_AGAIN)


def show_newest(view: LiveView, path: Path, photos: Capture | None, shown: tuple | None) -> tuple | None:
    """Show what lies at `path` if it is not the file that `shown` stands for; what stands for the file that is shown now.

    photos: of the person that the weights of the run in `path` reconstruct; None: `path` is an avatar file. A file that cannot be
    read is reported in the page, once.
    """
    file = path if photos is None else path / WEIGHTS
    try:
        found = file.stat()
    except FileNotFoundError:
        view.say(f"Waiting for {file} ...")
        return shown
    stamp = found.st_mtime_ns, found.st_size
    if stamp == shown:
        return shown
    try:
        view.say(f"Reading {file.name} ...")
        avatar = Avatar.load(file) if photos is None else reconstruct(*load_weights(file), photos)
        view.show(avatar, f"{file.name} of {time.strftime('%H:%M:%S', time.localtime(found.st_mtime))}")
    except (ValueError, OSError) as error:
        view.say(str(error))
    return stamp
