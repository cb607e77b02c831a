"""Makes the page that shows an avatar: one HTML file for disk, localhost or a notebook.

The page needs no network, and its Content-Security-Policy forbids all connections. Its code is in
the files of page/ beside this module, which are joined into one file here. The avatar and its
motion are in the page as arrays, most of them of 16 bits, see `Packed`.
"""

import base64
import contextlib
import dataclasses
import gzip
import html
import json
import os
import re
import webbrowser
from collections.abc import Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from typing import Any

import numpy as np

from humangs_jax.avatar.attach_face import faced, shipped_network
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.export.gaussians import unit_quats
from humangs_jax.body.joints import PARENTS
from humangs_jax.body.library import load_body
from humangs_jax.body.model import BodyModel, RestBody
from humangs_jax.body.motion import Motion, grounded
from humangs_jax.core.array_types import Float, Int
from humangs_jax.core.checks import FINITE, check_values, checked_arguments
from humangs_jax.core.configuration import ArgumentError
from humangs_jax.core.progress import printable, say
from humangs_jax.core.records import record_values
from humangs_jax.data.views import gaussian_body
from humangs_jax.io.atomic import write_text
from humangs_jax.motion import load_motion
from humangs_jax.motion.rules import page_rules
from humangs_jax.rendering.gaussians import added_variance
from humangs_jax.rendering.splat_config import SPLAT_PRESETS
from humangs_jax.viewer.page_face import pack_face

VERSION = 1
WEIGHTS = 8
"""Number of skinning weights that are kept for each Gaussian. A vertex of the shipped body has at
most 6.
"""
STEPS = 65535
SMALLEST_SCALE = 1e-7
"""Smallest scale of a Gaussian, metres. It keeps the logarithm finite for flat Gaussians, and is
too small to be seen.
"""
_SMALLEST_RANGE = 1e-6
"""Least range of quantized values. It keeps the division finite where all values are equal."""
SHAPE_STEP = 1e-4
"""Smallest step of the offsets in `shape_directions`, metres."""


@dataclasses.dataclass
class Packed:
    """An avatar and a motion, as the page holds them.

    Each array of `data` is little-endian and begins at a multiple of 4 bytes. `low`, `high` and
    `step` are in the header. In an array "from low to high", 0 stands for `low` and 65535 for
    `high`.

    Gaussians: means uint16 (g, 3), from low to high, per axis, metres. scales uint16 (g, 3), log of
    metres, from low to high. quats int16 (g, 4), unit, wxyz, times 32767. opacities uint16 (g,),
    from 0 to 1. colors uint16 (g, 3), from low to high. harmonics uint16 (g, k, 3), from low to
    high; only if the Gaussians have some. weights uint16 (g, 8), skinning weights, the largest
    first; every row sums to 65535. weight_joints uint8 (g, 8), joints of the weights.

    Light, if the avatar has one: light_normals int8 (g, 3), times 127. light_shading uint16 (g,),
    from low to high.

    Skeleton, and motion if there is one: rest_joints float32 (j, 3), metres. rotations int16 (m, j,
    3), axis-angle in radians, divided by step. translations float32 (m, 3), metres.

    Shape, if the body is known: shape_directions int16 (s, n, 3), how vertices move per unit of a
    shape coefficient, in metres, divided by step. shape_joints float32 (s, j, 3), how joints move,
    metres.

    Face, if the avatar has one with fewer than 255 expressions: face_..., see
    `page_face.pack_face`. Hidden Gaussians of the face come last.
    """

    header: dict[str, Any]
    """What the page reads as JSON: counts, names, ranges, and the place of each array."""
    data: bytes
    """The arrays, one after the other."""


def pack(
    avatar: Avatar,
    motion: Motion | None = None,
    body: BodyModel | None = None,
    motion_name: str = "motion",
) -> Packed:
    """Packs an avatar and a motion for the page.

    motion: None for a page without motion. body: the model to which the avatar's vertices belong,
    for sliders of shape; None: there are no sliders. motion_name: name that the page shows.

    Raises: ValueError (one line) for numbers that are not finite or out of range, for an avatar
    without Gaussians or vertices, or with more than 256 joints, and for a motion of another number
    of joints. If there is a body, ValueError also if it does not explain the avatar's vertices, or
    if the number of Gaussians is no multiple of the number of vertices.
    """
    # a page with wrong numbers would show nothing and not say why
    check_values(
        "the page",
        record_values(avatar.gaussians, "gaussians")
        | record_values(avatar.light, "light")
        | record_values(avatar.face, "face")
        | _other_values(avatar, motion),
    )
    joints = len(avatar.parents)
    if joints > 256:
        raise ValueError(f"the page draws avatars of up to 256 joints, got {joints}")
    for what, count in (
        ("Gaussians", len(avatar.gaussians.means)),
        ("vertices", len(avatar.rest_vertices)),
    ):
        if not count:
            raise ValueError(f"the page: the avatar has no {what}")
    if motion is not None and motion.rotations.shape[1] != joints:
        raise ValueError(
            f"the motion has {motion.rotations.shape[1]} joints, the avatar has {joints}"
        )
    how = SPLAT_PRESETS[avatar.rendering]
    vertices = np.asarray(avatar.rest_vertices, np.float64)
    # the page draws by the same rules as the renderer, which it gets as numbers
    drawn = {
        name: getattr(how, name) for name in ("near", "alpha_min", "alpha_max", "jacobian_margin")
    }
    drawn["eps2d"] = added_variance(avatar.gaussians.pixel_footprint, how.eps2d)
    # metres; one for all Gaussians, whose photos were taken from similar distances; 0: none
    drawn["low_pass"] = 0.0
    if avatar.gaussians.pixel_footprint is not None:
        drawn["low_pass"] = float(np.median(avatar.gaussians.pixel_footprint))
    header: dict[str, Any] = {
        "version": VERSION,
        "parents": avatar.parents,
        "joint_names": avatar.joint_names,
        "skinning": avatar.skinning,
        "splatting": drawn,
        "rest_bounds": [vertices.min(0).tolist(), vertices.max(0).tolist()],
    }
    arrays: dict[str, np.ndarray] = {}
    # axis-angles fit 16 bits with the step of the largest
    if motion is not None:
        rotations = np.asarray(motion.rotations, np.float64)
        step = max(float(np.abs(rotations).max()), _SMALLEST_RANGE) / 32767
        arrays["rotations"] = np.rint(rotations / step).astype("<i2")
        arrays["translations"] = np.asarray(motion.translations, "<f4")
        header["motion"] = {
            "name": motion_name,
            "frames": len(rotations),
            "fps": float(motion.fps),
            "step": step,
        }
    if body is not None:
        _pack_shape(avatar, body, header, arrays)
    # hidden Gaussians join the others here, so they are counted and packed afterwards
    if avatar.face is not None and len(avatar.expression_names) < 255:
        avatar = pack_face(avatar, motion, header, arrays)
    header["count"] = len(avatar.gaussians.means)
    _pack_gaussians(avatar, header, arrays)
    return _joined(header, arrays)


def largest_weights(
    weights: Float[np.ndarray, "g j"],
) -> tuple[Int[np.ndarray, "g 8"], Int[np.ndarray, "g 8"]]:
    """Returns the joints and the values of the 8 largest weights of each row, both (g, 8), largest
    first.

    A value of 65535 is a weight of 1, and rows sum to 65535. Smaller weights are left out, and the
    others are scaled to make up for them. The largest one takes the error of rounding.
    """
    weights = np.pad(
        np.asarray(weights, np.float64), ((0, 0), (0, max(0, WEIGHTS - weights.shape[1])))
    )
    joints = np.argsort(-weights, axis=1, kind="stable")[:, :WEIGHTS]
    kept = np.take_along_axis(weights, joints, axis=1)
    kept /= kept.sum(1, keepdims=True)
    whole = np.rint(kept * STEPS).astype(np.int64)
    whole[:, 0] += STEPS - whole.sum(1)
    joints[whole == 0] = 0  # columns beyond the last joint among them
    return joints, whole


def _fitted_shape(avatar: Avatar, body: BodyModel) -> Float[np.ndarray, " s"] | None:
    """Returns the shape coefficients, (s,), with which the body has the avatar's vertices. Returns
    None if the root-mean-square error is a millimetre or more, or if the numbers of vertices or
    joints differ.
    """
    target = np.asarray(avatar.rest_vertices, np.float64)
    if body.template.shape != target.shape or len(body.parents) != len(avatar.parents):
        return None
    directions = np.asarray(body.shape_directions, np.float64).reshape(target.size, -1)
    offsets = (target - np.asarray(body.template, np.float64)).reshape(-1)
    betas = np.linalg.lstsq(directions, offsets, rcond=None)[0]
    error = np.sqrt(np.mean(np.square(directions @ betas - offsets)))
    return betas if error < 1e-3 else None


def _other_values(avatar: Avatar, motion: Motion | None) -> dict[str, tuple[Any, Any]]:
    """Returns arrays of the avatar and the motion that have to be finite, by name, each with the
    range `FINITE`. Arrays of the Gaussians and the light are not among them.
    """
    values = {
        name: (getattr(avatar, name), FINITE)
        for name in ("skinning_weights", "rest_vertices", "rest_joints")
    }
    if motion is not None:
        values |= {
            f"motion.{name}": (getattr(motion, name), FINITE)
            for name in ("rotations", "translations", "expressions")
        }
    return values


def _pack_gaussians(avatar: Avatar, header: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
    """Adds Gaussians, skinning and light to the header and to the arrays, in 16 bits or fewer. Adds
    the joints in the T-pose, too, in 32 bits.
    """
    g = avatar.gaussians
    means, quats, scales, opacities, colors = (
        np.asarray(x, np.float64) for x in (g.means, g.quats, g.scales, g.opacities, g.colors)
    )
    # sizes span orders of magnitude: their logarithms lose the same share everywhere
    logs = np.log(np.maximum(scales, SMALLEST_SCALE))
    header["means"], arrays["means"] = _quantized(means, means.min(0), means.max(0))
    header["scales"], arrays["scales"] = _quantized(logs, logs.min(), logs.max())
    # colors may leave [0, 1]
    header["colors"], arrays["colors"] = _quantized(
        colors, min(colors.min(), 0.0), max(colors.max(), 1.0)
    )
    if g.harmonics is not None:
        harmonics = np.asarray(g.harmonics, np.float64)
        header["harmonics"], arrays["harmonics"] = _quantized(
            harmonics, harmonics.min(), harmonics.max()
        )
    arrays["quats"] = np.rint(unit_quats(quats) * 32767).astype("<i2")
    arrays["opacities"] = np.rint(opacities * STEPS).astype("<u2")
    joints, weights = largest_weights(np.asarray(avatar.skinning_weights))
    arrays["weights"], arrays["weight_joints"] = weights.astype("<u2"), joints.astype("u1")
    arrays["rest_joints"] = np.asarray(avatar.rest_joints, "<f4")
    # light needs a normal and a shading for each Gaussian
    if avatar.light is not None:
        header["light"] = np.asarray(avatar.light.coefficients, np.float64).tolist()
        arrays["light_normals"] = np.rint(127 * np.asarray(avatar.light.normals)).astype("i1")
        shading = np.asarray(avatar.light.shading, np.float64)
        header["light_shading"], arrays["light_shading"] = _quantized(
            shading, shading.min(), shading.max()
        )


def _pack_shape(
    avatar: Avatar, body: BodyModel, header: dict[str, Any], arrays: dict[str, np.ndarray]
) -> None:
    """Adds to the header and to the arrays how each shape coefficient moves vertices and joints.

    Gaussians are stored vertex by vertex and move with their vertex.

    Raises: ValueError if the body does not explain the avatar's vertices, or if the number of
    Gaussians is no multiple of the number of vertices.
    """
    betas = _fitted_shape(avatar, body)
    vertices = len(avatar.rest_vertices)
    if betas is None or len(avatar.gaussians.means) % vertices:
        raise ValueError(f"the body '{body.name}' does not explain the avatar's vertices")
    directions = np.moveaxis(np.asarray(body.shape_directions, np.float64), -1, 0)
    step = max(SHAPE_STEP, float(np.abs(directions).max()) / 32767)
    arrays["shape_directions"] = np.rint(directions / step).astype("<i2")
    arrays["shape_joints"] = np.einsum(
        "jn,sna->sja", np.asarray(body.joint_regressor, np.float64), directions
    ).astype("<f4")
    names = body.shape_names or tuple(f"shape {i + 1}" for i in range(len(directions)))
    header["shape"] = {"names": names, "betas": betas.tolist(), "step": step}


def _quantized(
    values: np.ndarray, low: np.ndarray | float, high: np.ndarray | float
) -> tuple[dict[str, Any], np.ndarray]:
    low, high = np.asarray(low), np.maximum(high, np.asarray(low) + _SMALLEST_RANGE)
    whole = np.rint((values - low) / (high - low) * STEPS).astype("<u2")
    return {"low": low.tolist(), "high": high.tolist()}, whole


def _joined(header: dict[str, Any], arrays: dict[str, np.ndarray]) -> Packed:
    """Joins the arrays into bytes, and adds their types, shapes and offsets to the header."""
    header["arrays"], parts, offset = {}, [], 0
    for name, array in arrays.items():
        data = np.ascontiguousarray(array).tobytes()
        data += bytes(-len(data) % 4)
        header["arrays"][name] = {
            "type": array.dtype.str,
            "shape": list(array.shape),
            "offset": offset,
        }
        parts.append(data)
        offset += len(data)
    return Packed(header, b"".join(parts))


# The page
# --------------------------------------------------------------------------------------------------


SHADERS = ("whole.vert", "project.frag", "splat.vert", "splat.frag", "background.frag")
_MARK = re.compile(r"\{\{(\w+)\}\}")


def page_html(
    avatar: Avatar,
    motion: Motion | None = None,
    title: str = "avatar",
    motion_name: str | None = None,
) -> str:
    """Returns the page as text.

    motion: how the avatar moves. None: the walk that comes with the package, or no motion if the
    avatar has another number of joints than that walk. The page's motion has at most 60 frames per
    second, and the person stands on the floor. title, motion_name: names that the page shows.

    Raises: ValueError (one line) for an avatar or a motion that cannot be drawn, see `pack`.
    """
    name = motion_name or ("walk" if motion is None else "motion")
    if motion is None:
        walk = load_motion()
        motion = walk if walk.rotations.shape[1] == len(avatar.parents) else None
    if motion is not None and motion.rotations.shape[1] == len(avatar.parents):
        # the page interpolates between frames
        if motion.fps > 60.0:
            motion = motion.at_rate(60.0)
        motion = grounded(
            motion, RestBody(avatar.rest_vertices, avatar.rest_joints), avatar.parents
        )
    packed = pack(faced(avatar), motion, known_body(avatar), name)
    header = json.dumps(packed.header, separators=(",", ":"))
    parts = {
        "title": html.escape(printable(title)),
        "header": header.replace("<", "\\u003c"),  # a joint's name may not end the script
        "data": base64.b64encode(gzip.compress(packed.data, 9, mtime=0)).decode(),
    }
    return _MARK.sub(lambda mark: parts[mark[1]], _template())


@checked_arguments
def write_page(
    path: str | os.PathLike[str],
    avatar: Avatar,
    motion: Motion | None = None,
    title: str = "avatar",
    motion_name: str | None = None,
) -> int:
    """Writes the page to a file, and returns its size in bytes. If writing fails, the path stays as
    it was.

    Raises: as `page_html`; OSError.
    """
    text = page_html(avatar, motion, title, motion_name)
    write_text(path, text)
    return len(text.encode())


class NotebookPage:
    """The page that `show` returns. A notebook displays it, and `save` writes it to a file."""

    def __init__(self, text: str, height: int):
        self._text, self._height = text, height

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes the page as one file that any browser opens. Raises: OSError."""
        write_text(path, self._text)

    def _repr_html_(self) -> str:
        """Returns the HTML of an iframe that contains the whole page."""
        style = f"width:100%;height:{self._height}px;border:1px solid #ddd;border-radius:8px"
        return (
            f'<iframe srcdoc="{html.escape(self._text)}" style="{style}" allowfullscreen></iframe>'
        )


@checked_arguments
def show(avatar: Avatar, motion: Motion | None = None, height: int = 560) -> NotebookPage:
    """Shows a moving avatar in a notebook.

    Make it the last expression of a cell, or call `display(hg.show(avatar))`. The page becomes part
    of the notebook's file (about 1.2 MB for the demo person).

    Args:
        avatar: the avatar, of one person.
        motion: how the avatar moves. None: the shipped walk.
        height: height of the page, pixels.

    Returns:
        The page, which Jupyter displays.

    Raises:
        ValueError: as `page_html`.

    Examples:
        >>> hg.show(avatar, hg.load_motion("dance.bvh"))
    """
    return NotebookPage(page_html(avatar, motion), height)


def serve(text: str, port: int = 0, open_browser: bool = True) -> None:
    """Serves a page on this machine only, until Ctrl-C.

    text: the page. port: 0 for any free port. Raises: ArgumentError (one line) if the port cannot
    be used.
    """
    with page_server({"/": text}, port) as server:
        url = f"http://127.0.0.1:{server.server_address[1]}/"
        say(f"{url} shows the avatar; Ctrl-C ends.")
        if open_browser:
            webbrowser.open(url)
        with contextlib.suppress(KeyboardInterrupt):
            server.serve_forever()


def page_server(pages: Mapping[str, str], port: int = 0) -> ThreadingHTTPServer:
    """Makes a server of texts on 127.0.0.1. The caller has to start it.

    pages: texts by path. A request gets the text that the mapping has at that moment.

    Raises: as `serve`.
    """

    class Page(BaseHTTPRequestHandler):
        def do_GET(self):
            """Answers with the text of the path, or with 404 if there is none."""
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
            """Logs nothing."""

    try:
        server = ThreadingHTTPServer(("127.0.0.1", port), Page)
    except (OSError, OverflowError) as error:
        raise ArgumentError("port", f"{port}: {error}") from error
    server.daemon_threads = True
    return server


def known_body(avatar: Avatar) -> BodyModel | None:
    """Returns the shipped body, for sliders of shape: with its own mesh, or with the mesh for which
    the shipped weights make Gaussians, whichever the avatar has.

    Returns None if the avatar has another mesh or other joints, if no shape of the body has the
    avatar's vertices, or if `Avatar.gaussians_per_vertex` is None.
    """
    if avatar.parents != PARENTS:
        return None
    body = load_body()
    if len(avatar.rest_vertices) != len(body.template):
        body = gaussian_body(body, shipped_network())
    same = np.array_equal(body.faces, avatar.faces) and avatar.gaussians_per_vertex is not None
    if same and _fitted_shape(avatar, body) is not None:
        return body
    return None


def page_script(*names: str) -> str:
    """Returns the tables of `page_rules` as script, followed by some of the page's scripts.

    names: names of files in page/, without .js.
    """
    rules = json.dumps(page_rules(), separators=(",", ":")).replace("<", "\\u003c")
    return "\n".join([f"const RULES = {rules};", *(read_part(f"{name}.js") for name in names)])


def read_part(name: str) -> str:
    """Returns the text of a file in page/."""
    return (
        (resources.files("humangs_jax") / "viewer" / "page" / name)
        .read_text(encoding="utf-8")
        .strip()
    )


def _template() -> str:
    """Returns index.html with styles, shaders and scripts filled in.

    The places for title, header and data of the avatar are still marked.
    """
    scripts = (
        *("kinematics", "scene", "face", "camera", "splatting", "motion_files", "skeletons"),
        *("glb", "controls", "saving", "embedding", "main"),
    )
    parts = {
        "style": read_part("style.css"),
        "shaders": "\n".join(
            f'<script type="x-shader" id="{name}">\n{read_part(name)}\n</script>'
            for name in SHADERS
        ),
        "sorting": read_part("sorting.js"),  # runs twice: in the page, and as the text of a worker
        "scripts": page_script(*scripts),
    }
    return _MARK.sub(lambda mark: parts.get(mark[1], mark[0]), read_part("index.html"))
