"""The page that shows an avatar: one HTML file that needs no network, on disk, on localhost or in a notebook.

Its code lies beside this module in page/, as the browser runs it; here the files become one. The browser itself forbids the
page all connections (Content-Security-Policy).
"""

import base64
import contextlib
import gzip
import html
import json
import os
import re
import webbrowser
from collections.abc import Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources

import numpy as np

from humangs_jax.avatar.avatar import Avatar
from humangs_jax.body.joints import PARENTS
from humangs_jax.body.library import load_body
from humangs_jax.body.model import BodyModel, RestBody
from humangs_jax.core.checks import checked_arguments
from humangs_jax.core.configuration import ArgumentError, config_from_json
from humangs_jax.core.progress import printable, say
from humangs_jax.data.motion import Motion, grounded, load_motion
from humangs_jax.data.motion.rules import page_rules
from humangs_jax.data.views import gaussian_body
from humangs_jax.io.atomic import write_text
from humangs_jax.io.tensors import read_safetensors
from humangs_jax.network.config import Conventions, HumanGSConfig
from humangs_jax.network.weights import SHIPPED
from humangs_jax.viewer.packing import fitted_shape, pack

SCRIPTS = ("kinematics", "scene", "camera", "splatting", "motion_files", "skeletons", "controls", "main")
SHADERS = ("whole.vert", "project.frag", "splat.vert", "splat.frag", "background.frag")
LARGEST_FPS = 60.0
"""Motions of more frames per second are thinned out: the page interpolates between frames."""
_MARK = re.compile(r"\{\{(\w+)\}\}")


def page_html(
    avatar: Avatar, motion: Motion | None = None, title: str = "avatar", motion_name: str | None = None
) -> str:
    """The page as text.

    Arguments: motion: None for the walk that comes with the package (if the avatar has its joints). title, motion_name: shown
    in the page.

    Raises: ValueError, one line, for an avatar or a motion that cannot be drawn (see `packing.pack`).
    """
    name = motion_name or ("walk" if motion is None else "motion")
    if motion is None:
        walk = load_motion()
        motion = walk if walk.rotations.shape[1] == len(avatar.parents) else None
    if motion is not None and motion.rotations.shape[1] == len(avatar.parents):
        motion = motion.at_rate(LARGEST_FPS) if motion.fps > LARGEST_FPS else motion
        motion = grounded(motion, RestBody(avatar.rest_vertices, avatar.rest_joints), avatar.parents)
    packed = pack(avatar, motion, known_body(avatar), name)
    header = json.dumps(packed.header, separators=(",", ":"))
    parts = {
        "title": html.escape(printable(title)),
        "header": header.replace("<", "\\u003c"),  # a joint's name may not end the script
        "data": base64.b64encode(gzip.compress(packed.data, 9, mtime=0)).decode(),
    }
    return _MARK.sub(lambda mark: parts[mark[1]], _template())


@checked_arguments
def write_page(
    path: str | os.PathLike,
    avatar: Avatar,
    motion: Motion | None = None,
    title: str = "avatar",
    motion_name: str | None = None,
) -> int:
    """Write the page; it appears whole or not at all. Returns its size in bytes. Raises: as `page_html`; OSError."""
    text = page_html(avatar, motion, title, motion_name)
    write_text(path, text)
    return len(text.encode())


class NotebookPage:
    """What `show` returns: notebooks draw it, `save` writes it."""

    def __init__(self, text: str, height: int):
        self._text, self._height = text, height

    def save(self, path: str | os.PathLike) -> None:
        """Write the page as one file that any browser opens. Raises: OSError."""
        write_text(path, self._text)

    def _repr_html_(self) -> str:
        """An iframe that holds the whole page."""
        style = f"width:100%;height:{self._height}px;border:1px solid #ddd;border-radius:8px"
        return f'<iframe srcdoc="{html.escape(self._text)}" style="{style}" allowfullscreen></iframe>'


@checked_arguments
def show(avatar: Avatar, motion: Motion | None = None, height: int = 560) -> NotebookPage:
    """The avatar in a notebook, moving: the last expression of a cell, or `display(hg.show(avatar))`.

    Arguments: motion: None for the shipped walk. height: pixels. The page becomes a part of the notebook's file (some 1.2 MB).

    Raises: as `page_html`.
    """
    return NotebookPage(page_html(avatar, motion), height)


def serve(text: str, port: int = 0, open_browser: bool = True) -> None:
    """Serve a page on this machine only, until Ctrl-C.

    Arguments: port: 0 for any free one. Raises: OSError, one line, if the port is taken.
    """
    with page_server({"/": text}, port) as server:
        url = f"http://127.0.0.1:{server.server_address[1]}/"
        say(f"{url} shows the avatar; Ctrl-C ends.")
        if open_browser:
            webbrowser.open(url)
        with contextlib.suppress(KeyboardInterrupt):
            server.serve_forever()


def page_server(pages: Mapping[str, str], port: int = 0) -> ThreadingHTTPServer:
    """A server on 127.0.0.1, not yet running, of texts by path, as they are when they are asked for. Raises: as `serve`."""

    class Page(BaseHTTPRequestHandler):
        def do_GET(self):
            content = pages.get(self.path.split("?")[0].replace("/index.html", "/"))
            data = b"" if content is None else content.encode()
            self.send_response(404 if content is None else 200)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.send_header("Content-Length", str(len(data)))
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            with contextlib.suppress(ConnectionError):  # the browser was closed meanwhile
                self.wfile.write(data)

        def log_message(self, format, *args):
            """Nothing: few pages, one user."""

    try:
        server = ThreadingHTTPServer(("127.0.0.1", port), Page)
    except (OSError, OverflowError) as error:
        raise ArgumentError("port", f"{port}: {error}") from error
    server.daemon_threads = True
    return server


def known_body(avatar: Avatar) -> BodyModel | None:
    """The shipped body on the avatar's vertices, if the avatar is one of its people: what the sliders of shape need."""
    if avatar.parents != PARENTS:
        return None
    body = load_body()
    if len(avatar.rest_vertices) != len(body.template):
        body = gaussian_body(body, _shipped_network())
    same = np.array_equal(body.faces, avatar.faces) and avatar.gaussians_per_vertex is not None
    return body if same and fitted_shape(avatar, body) is not None else None


def _shipped_network() -> HumanGSConfig:
    """The network of the shipped weights, without reading their tensors; the default one if none are shipped."""
    with resources.as_file(resources.files("humangs_jax") / SHIPPED) as file:
        metadata = read_safetensors(file, lambda key: False)[2] if file.exists() else {}
    return HumanGSConfig(conventions=config_from_json(Conventions, metadata.get("conventions", "{}")))


def page_script(*names: str) -> str:
    """The text of some of the page's scripts, below the tables that they share with the readers of motions in Python."""
    rules = json.dumps(page_rules(), separators=(",", ":")).replace("<", "\\u003c")
    return "\n".join([f"const RULES = {rules};", *(read_part(f"{name}.js") for name in names)])


def read_part(name: str) -> str:
    """The text of a file in page/."""
    return (resources.files("humangs_jax") / "viewer" / "page" / name).read_text(encoding="utf-8").strip()


def _template() -> str:
    """index.html with styles, shaders and scripts in their places; the avatar's are still marked."""
    parts = {
        "style": read_part("style.css"),
        "shaders": "\n".join(f'<script type="x-shader" id="{name}">\n{read_part(name)}\n</script>' for name in SHADERS),
        "sorting": read_part("sorting.js"),  # runs twice: in the page, and as the text of a worker
        "scripts": page_script(*SCRIPTS),
    }
    return _MARK.sub(lambda mark: parts.get(mark[1], mark[0]), read_part("index.html"))
