"""An avatar in the browser while it is being made: by a training run, or by a refinement. Needs viser (extra `viewer`).

    humangs view --live RUN_FOLDER           # the newest weights of a training run reconstruct someone
    humangs view --live refined.npz          # an avatar file, whenever it is replaced: `humangs refine --live` does so

    with LiveView() as view:                 # in Python
        hg.refine(avatar, capture, watch=view.show)

For an avatar that is finished, the page of `viewer.page` is the better viewer: it needs no server and draws what `hg.render`
draws. viser (https://viser.studio) has its own splatting in the browser, with 8 bits for colours and opacities.
"""

import contextlib
import importlib
import io
import socket
import threading
import time
import webbrowser
from pathlib import Path
from typing import Any

import jax
import numpy as np

from humangs_jax.avatar.animate import skin
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.frames import a_pose_of, rest_pose_of
from humangs_jax.avatar.reconstruct import reconstruct
from humangs_jax.body.model import BodyPose
from humangs_jax.core.array_types import Array, Float
from humangs_jax.core.progress import say
from humangs_jax.data.capture import Capture, load_capture
from humangs_jax.data.motion import Motion, load_motion
from humangs_jax.data.photos import DEMO_CAPTURE
from humangs_jax.network.weights import load_weights
from humangs_jax.rendering.gaussians import Gaussians, covariances

WEIGHTS = "weights.safetensors"
"""What a training run writes with every checkpoint."""
LOOK_AGAIN = 1.0
"""Seconds between two looks at the file that is followed."""
UNIT = 0.1
"""Metres of a length of 1 in viser's scene. It stores covariances in half precision, whose small numbers are rounded: those of a
millimetre in m^2 to 6 %, in dm^2 to 0.05 %."""
POSES = ("T-pose", "A-pose", "motion")


class LiveView:
    """A viser server on 127.0.0.1 that shows one avatar; a context manager.

    Arguments: motion: what the slider of frames goes through; None: the shipped walk. port: 0 for any free one.
    Raises: ModuleNotFoundError, one line, without viser; OSError if the port is taken.
    """

    def __init__(self, motion: Motion | None = None, port: int = 0):
        viser = _viser()
        self.motion, self.avatar, self.lock = load_motion() if motion is None else motion, None, threading.Lock()
        with contextlib.redirect_stdout(io.StringIO()):  # it says where it is; so do we
            self.server = viser.ViserServer(host="127.0.0.1", port=_free_port(port), label="humangs", verbose=False)
        self.url = f"http://127.0.0.1:{self.server.get_port()}/"
        self.server.scene.set_up_direction("+y")
        self.server.gui.configure_theme(show_logo=False, show_share_button=False)
        self.status = self.server.gui.add_markdown("Waiting for the first avatar ...")
        self.pose = self.server.gui.add_dropdown("pose", POSES)
        last = len(self.motion.translations) - 1
        self.frame = self.server.gui.add_slider("frame", min=0, max=max(last, 1), step=1, initial_value=0)
        for control in (self.pose, self.frame):
            control.on_update(lambda _: self._draw())
        self.splats: Any = None

    def __enter__(self) -> "LiveView":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop the server."""
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    def show(self, avatar: Avatar, status: str | None = None) -> None:
        """Show an avatar in place of the last one, and a line above the controls. May be called from any thread."""
        with self.lock:
            if self.avatar is None:
                self._aim(avatar)
            self.avatar = avatar
        self.say(
            f"{len(avatar.gaussians.means):,} Gaussians, {time.strftime('%H:%M:%S')}" if status is None else status
        )
        self._draw()

    def say(self, status: str) -> None:
        """Show a line above the controls."""
        self.status.content = status

    def _aim(self, avatar):
        """The first camera: in front of the person."""
        vertices = np.asarray(avatar.rest_vertices)
        middle, height = 0.5 * (vertices.min(0) + vertices.max(0)), float(np.ptp(vertices[:, 1]))
        camera = self.server.initial_camera
        camera.fov = np.radians(40)
        camera.look_at = tuple(middle / UNIT)
        camera.position = tuple((middle + np.asarray([0, 0.1, 1.7]) * height) / UNIT)

    def _draw(self):
        with self.lock:
            if self.avatar is None:
                return
            gaussians, covariance = _posed(self.avatar, self._chosen_pose(self.avatar))
            arrays = {
                "centers": np.asarray(gaussians.means) / UNIT,
                "covariances": np.asarray(covariance) / UNIT**2,
                "rgbs": np.clip(np.asarray(gaussians.colors), 0, 1),
                "opacities": np.clip(np.asarray(gaussians.opacities), 0, 1)[:, None],
            }
            if self.splats is None:
                self.splats = self.server.scene.add_gaussian_splats("/avatar", **arrays)
            else:
                self.splats.set_gaussians(**arrays)

    def _chosen_pose(self, avatar) -> BodyPose:
        if self.pose.value == "A-pose":
            return a_pose_of(avatar)
        motion, frame = self.motion, min(int(self.frame.value), len(self.motion.translations) - 1)
        if self.pose.value == "motion" and motion.rotations.shape[1] == len(avatar.parents):
            # from where the T-pose stands, at which the camera looks
            return BodyPose(motion.rotations[frame], motion.translations[frame] - motion.translations[0])
        return rest_pose_of(avatar)


def follow(
    path: str | Path,
    capture: str | Path | None = None,
    motion: Motion | None = None,
    port: int = 0,
    open_browser: bool = True,
) -> None:
    """Show what a training run or a refinement makes, until Ctrl-C.

    Arguments: path: the folder of a run of `humangs train`, or an avatar file, which need not exist yet. capture: of the person
    that a run's network reconstructs; None for the shipped one.

    Raises: ModuleNotFoundError without viser; ValueError or OSError, one line, for what cannot be followed.
    """
    path, photos = Path(path), None
    if path.is_dir():
        if not (path / "config.json").is_file():
            raise ValueError(f"{path}: no config.json: expected the folder of a training run, or an avatar file")
        photos = load_capture(DEMO_CAPTURE if capture is None else capture)
    elif path.suffix != ".npz" or not path.parent.is_dir():
        raise FileNotFoundError(f"{path}: no such run: expected the folder of a training run, or an avatar file (.npz)")
    elif capture is not None:
        raise ValueError(f"--capture {capture}: only for the folder of a training run; {path} is an avatar file")
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


@jax.jit
def _posed(avatar: Avatar, pose: BodyPose) -> tuple[Gaussians, Float[Array, "g 3 3"]]:
    gaussians = skin(avatar, pose)
    return gaussians, covariances(gaussians)


def _viser() -> Any:
    try:
        return importlib.import_module("viser")  # optional, and then unknown to type checkers
    except ModuleNotFoundError as error:
        if error.name != "viser":
            raise
        raise ModuleNotFoundError("viser is not installed: pip install 'humangs_jax[viewer]'", name="viser") from None


def _free_port(port: int) -> int:
    """This port, or any free one for 0. Raises: OSError, one line, if it is taken (viser would take the next one)."""
    try:
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(("127.0.0.1", port))
            return int(probe.getsockname()[1])
    except (OSError, OverflowError) as error:
        raise OSError(f"--port {port}: {error}") from error
