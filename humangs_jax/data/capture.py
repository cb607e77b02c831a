"""A capture: photographs of one person, their calibrated cameras, and the body pose of each frame; a folder on disk.

    me/capture.json       {"format": "humangs-capture", "version": 1, "body": "body.npz", "views": [...]}
    me/body.npz           body (name or file of the model), betas (s,), rotations (m, j, 3), translations (m, 3)
    me/images/*.png ...   one photo per view, all of one size; masks likewise

docs/capture_format.md tells the format in full. Whatever is wrong in a folder is a `CaptureError`: one line that names
the file, the field and what was expected. In memory the images have a white background wherever masks are known.
"""

import dataclasses
import json
import os
import re
import shutil
import uuid
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.array_types import Float, Int
from humangs_jax.body.model import BodyModel, BodyPose
from humangs_jax.data.images import read_grey, read_image, write_png
from humangs_jax.data.npz import read_npz
from humangs_jax.geometry.camera import Camera, stack_cameras

FORMAT = "humangs-capture"
VERSION = 1
DEFAULT_BODY = "makehuman"
"""Name of the body that comes with the package; any other `body` in body.npz is the path of a model file."""
DEMO_CAPTURE = "demo_capture"
"""Name of the capture of a synthetic person that comes with the package."""
TOP_KEYS = {"format", "version", "body", "background", "views"}
VIEW_KEYS = {"image", "mask", "K", "cam_from_world", "frame"}
BODY_KEYS = {"body", "betas", "rotations", "translations"}
BACKGROUNDS = ("photo", "white")
COLOUR_SLACK = 1e-3
"""Resampled images overshoot [0, 1] a little; what exceeds it by more is not in this range at all (0..255, say)."""


class CaptureError(ValueError):
    """Something is wrong with a capture; the message is one line: file, field, and what was expected."""

    def __init__(self, file: object, field: str, problem: object):
        parts = [str(part) for part in (file, field, problem) if part]
        super().__init__(" ".join(": ".join(parts).split()))


@dataclasses.dataclass(frozen=True, eq=False)
class Capture:
    """A capture in memory (numpy on the host). `capture_from_arrays` makes a checked one.

    images: (v, h, w, 3) in [0, 1], white behind the masks. masks: (v, h, w) coverage in [0, 1], or None.
    cameras: a batch of v, metres. frames: (v,) the frame that each view shows, an index into `poses`.
    body: the model that the parameters belong to. betas: (s,) its shape, fewer than it has are allowed.
    poses: a batch of m. names: one per view, used as file names.
    body_file: where the model comes from, "makehuman" or a path.
    """

    images: Float[np.ndarray, "v h w 3"]
    masks: Float[np.ndarray, "v h w"] | None
    cameras: Camera
    frames: Int[np.ndarray, " v"]
    body: BodyModel
    betas: Float[np.ndarray, " s"]
    poses: BodyPose
    names: tuple[str, ...]
    body_file: str = DEFAULT_BODY

    @property
    def view_count(self) -> int:
        """Number of views."""
        return len(self.images)

    @property
    def frame_count(self) -> int:
        """Number of poses."""
        return len(self.poses.translation)

    def pose(self, frame: int) -> BodyPose:
        """The pose of one frame (not of one view: that is `pose(capture.frames[view])`)."""
        return jax.tree.map(lambda leaf: leaf[frame], self.poses)

    def select(self, views: Sequence[int] | Int[np.ndarray, " any"]) -> "Capture":
        """The capture with only these views, in this order; the poses stay."""
        views = np.asarray(views, int)
        return dataclasses.replace(
            self,
            images=self.images[views],
            masks=None if self.masks is None else self.masks[views],
            cameras=jax.tree.map(lambda leaf: leaf[views], self.cameras),
            frames=self.frames[views],
            names=tuple(self.names[i] for i in views),
        )


def capture_from_arrays(
    images: Any,
    K: Any,
    cam_from_world: Any,
    rotations: Any,
    translations: Any,
    *,
    betas: Any = (),
    masks: Any | None = None,
    frames: Any | None = None,
    names: Sequence[str] | None = None,
    background: str = "photo",
    body: BodyModel | None = None,
    body_file: str | Path = DEFAULT_BODY,
) -> Capture:
    """A checked capture from array-likes.

    Arguments:
        images: (v, h, w, 3) in [0, 1]. masks: (v, h, w) in [0, 1] or None.
        K: (v, 3, 3) or (3, 3) for all; pixels. cam_from_world: (v, 4, 4), OpenCV, metres.
        rotations: (m, j, 3) axis-angle in the body's joint order. translations: (m, 3) metres. betas: (s,).
        frames: (v,) which of the m poses each view shows; may be left out when m is 1.
        names: (v,) file names without suffix; "000", "001", ... if left out.
        background: "photo": the masks are used to put the images on white; "white": they are on white already.
        body: the model; None loads `body_file`, by default the body that comes with the package.

    Raises: CaptureError.
    """
    source = "arrays"
    images = _numbers(images, source, "images")
    if images.ndim != 4 or images.shape[-1] != 3 or 0 in images.shape:
        raise CaptureError(source, "images", f"expected shape (views, h, w, 3), got {images.shape}")
    _check_range(images, source, "images")
    v, height, width, _ = images.shape
    if masks is not None:
        masks = _numbers(masks, source, "masks", (v, height, width))
        _check_range(masks, source, "masks")
    K = _numbers(K, source, "K")
    K = _numbers(np.broadcast_to(K, (v, 3, 3)) if K.shape == (3, 3) else K, source, "K", (v, 3, 3))
    cam_from_world = _numbers(cam_from_world, source, "cam_from_world", (v, 4, 4))
    cameras = [_camera(K[i], cam_from_world[i], width, height, source, f"view {i}") for i in range(v)]
    body = _load_model(source, str(body_file)) if body is None else body
    betas, rotations, translations = _body_parameters(body, betas, rotations, translations, source)
    if frames is None:
        if len(rotations) > 1:
            raise CaptureError(
                source, "frames", f"expected a frame for each view, since there are {len(rotations)} poses"
            )
        frames = np.zeros(v, int)
    _numbers(frames, source, "frames", (v,))
    frames = [_frame(x.item(), len(rotations), source, f"frames[{i}]") for i, x in enumerate(np.asarray(frames))]
    names = tuple(f"{i:03d}" for i in range(v)) if names is None else tuple(names)
    _check_names(names, v, source)
    if background not in BACKGROUNDS:
        raise CaptureError(source, "background", f"expected one of {', '.join(BACKGROUNDS)}, got {background!r}")
    if masks is not None and background == "photo":
        images = _on_white(images, masks)
    return _assemble(images, masks, cameras, frames, body, betas, rotations, translations, names, body_file)


def load_capture(path: str | Path, *, body: BodyModel | None = None) -> Capture:
    """Read and check a capture folder.

    Arguments:
        path: the folder that holds capture.json. "demo_capture", where no such folder is, stands for the one that comes
            with the package (and "demo_capture/held_out" for its held-out views).
        body: a model to use in place of the one that body.npz names.

    Raises: CaptureError, one line naming file and field.
    """
    folder = Path(path)
    if not folder.exists() and folder.parts[:1] == (DEMO_CAPTURE,):
        folder = Path(str(resources.files("humangs_jax"))) / "assets" / folder
    file = folder / "capture.json"
    description = _read_description(file)
    parameter_file = folder / description["body"]
    body_file, betas, rotations, translations = _read_parameters(parameter_file)
    if body is None:
        body = _load_model(parameter_file, body_file, folder)
    betas, rotations, translations = _body_parameters(body, betas, rotations, translations, parameter_file)

    views = description["views"]
    with_mask = ["mask" in view for view in views]
    if any(with_mask) and not all(with_mask):
        raise CaptureError(
            file, f"views[{with_mask.index(False)}].mask", "missing, but other views have one: give all or none"
        )
    frames = [_view_frame(view, len(rotations), file, f"views[{i}].frame") for i, view in enumerate(views)]
    matrices = [
        [
            _numbers(view[key], file, f"views[{i}].{key}", shape)
            for key, shape in (("K", (3, 3)), ("cam_from_world", (4, 4)))
        ]
        for i, view in enumerate(views)
    ]
    on_white = description.get("background", "photo") == "white"
    images, masks = zip(*[_read_view(folder, view, on_white) for view in views], strict=True)
    height, width = images[0].shape[:2]
    for view, image, mask in zip(views, images, masks, strict=True):
        if image.shape != images[0].shape:
            size = f"{image.shape[1]} x {image.shape[0]}"
            raise CaptureError(
                folder / view["image"], "size", f"{size}, but the first view has {width} x {height}: expected one size"
            )
        if (mask is None) != (masks[0] is None):
            raise CaptureError(folder / view["image"], "alpha", "expected an alpha channel in all images or in none")
    cameras = [_camera(*matrices[i], width, height, file, f"views[{i}]") for i in range(len(views))]
    stacked_masks = None if masks[0] is None else np.stack(masks)
    names = _names_from_paths([view["image"] for view in views])
    if body_file != DEFAULT_BODY:
        body_file = str(folder / body_file)
    return _assemble(
        np.stack(images), stacked_masks, cameras, frames, body, betas, rotations, translations, names, body_file
    )


def save_capture(path: str | Path, capture: Capture, *, overwrite: bool = False) -> None:
    """Write a capture folder: 8-bit PNG images and masks, capture.json and body.npz; all of it or nothing.

    The model file of a body other than the default one is referred to by its relative path, never copied.

    Raises: CaptureError if the capture is not valid, or if `path` is a non-empty folder; with `overwrite` only if that
    folder is no capture. An overwritten folder is replaced as a whole, sub-folders included.
    """
    path = Path(path)
    _check_before_writing(capture)
    if path.is_file():
        raise CaptureError(path, "", "is a file: expected a folder name")
    occupied = path.is_dir() and any(path.iterdir())
    if occupied and not overwrite:
        raise CaptureError(path, "", "the folder is not empty: choose another one or ask to overwrite it")
    if occupied and not (path / "capture.json").is_file():
        raise CaptureError(path, "", "the folder holds no capture.json: refusing to overwrite what is no capture")
    target = path.resolve()
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = target.parent / f".{target.name}.{uuid.uuid4().hex[:8]}"
    try:
        _write_folder(temporary, capture, target)
        if target.is_dir():
            aside = temporary.with_name(temporary.name + ".old")
            target.rename(aside)
            try:
                temporary.rename(target)
            except OSError:
                aside.rename(target)
                raise
            shutil.rmtree(aside)
        else:
            temporary.rename(target)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _assemble(images, masks, cameras, frames, body, betas, rotations, translations, names, body_file):
    return Capture(
        images=images,
        masks=masks,
        cameras=stack_cameras(cameras),
        frames=np.asarray(frames, np.int32),
        body=body,
        betas=betas,
        poses=jax.vmap(BodyPose)(jnp.asarray(rotations), jnp.asarray(translations)),
        names=names,
        body_file=str(body_file),
    )


def _on_white(image, mask):
    return image * mask[..., None] + (1 - mask[..., None])


# Reading -------------------------------------------------------------------------------------------------------------


def _read_description(file):
    """capture.json with all keys and types checked, except the matrices."""
    try:
        description = json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise CaptureError(file, "", "no such file: a capture is a folder with a capture.json") from None
    except (OSError, UnicodeDecodeError) as error:
        raise CaptureError(file, "", f"cannot be read: {error}") from error
    except json.JSONDecodeError as error:
        raise CaptureError(file, f"line {error.lineno}", f"not valid JSON: {error.msg}") from error
    if not isinstance(description, dict):
        raise CaptureError(file, "", f"expected a JSON object, got {type(description).__name__}")
    if description.get("format") != FORMAT:
        raise CaptureError(file, "format", f"expected {FORMAT!r}, got {description.get('format')!r}")
    if description.get("version") != VERSION:
        raise CaptureError(file, "version", f"expected {VERSION}, got {description.get('version')!r}")
    _check_keys(description, TOP_KEYS, TOP_KEYS - {"background"}, file, "")
    if not isinstance(description["body"], str):
        raise CaptureError(file, "body", f"expected the name of an npz file, got {description['body']!r}")
    if description.get("background", "photo") not in BACKGROUNDS:
        raise CaptureError(
            file, "background", f"expected one of {', '.join(BACKGROUNDS)}, got {description['background']!r}"
        )
    views = description["views"]
    if not isinstance(views, list) or not views:
        raise CaptureError(file, "views", "expected a list of at least one view")
    for i, view in enumerate(views):
        if not isinstance(view, dict):
            raise CaptureError(file, f"views[{i}]", f"expected a JSON object, got {view!r}")
        _check_keys(view, VIEW_KEYS, VIEW_KEYS - {"mask", "frame"}, file, f"views[{i}].")
        for key in ("image", "mask"):
            if key in view and not (isinstance(view[key], str) and view[key]):
                raise CaptureError(file, f"views[{i}].{key}", f"expected the path of a file, got {view[key]!r}")
    return description


def _check_keys(mapping, known, required, file, prefix):
    """Unknown keys are errors: most are misspelt optional ones, which would otherwise be ignored in silence."""
    for key in mapping:
        if key not in known:
            raise CaptureError(file, f"{prefix}{key}", f"unknown key: expected only {', '.join(sorted(known))}")
    for key in sorted(required):
        if key not in mapping:
            raise CaptureError(file, f"{prefix}{key}", "missing")


def _read_parameters(file):
    """Model name, betas, rotations and translations of body.npz, unchecked but for their presence."""
    try:
        values, pickled = read_npz(file)
    except FileNotFoundError:
        raise CaptureError(file, "", "no such file (capture.json: body names it)") from None
    except OSError as error:
        raise CaptureError(file, "", error.strerror or error) from error
    if pickled:
        raise CaptureError(file, pickled[0], "expected numbers, got a pickled object")
    _check_keys(values, BODY_KEYS, BODY_KEYS, file, "")
    name = values["body"]
    if name.shape != () or name.dtype.kind not in "US" or not str(name.item()):
        raise CaptureError(
            file, "body", f"expected the string {DEFAULT_BODY!r} or the path of a model file, got {name!r}"
        )
    return str(name.astype(str)), values["betas"], values["rotations"], values["translations"]


def _load_model(file, name, folder=None):
    model_file = Path(name) if folder is None else folder / name
    if name != DEFAULT_BODY and not model_file.is_file():
        raise CaptureError(file, "body", f"no model file at {model_file}: expected {DEFAULT_BODY!r} or the path of one")
    from humangs_jax.body.library import load_body

    if name == DEFAULT_BODY:
        return load_body()
    try:
        return load_body(model_file)
    except Exception as error:
        raise CaptureError(file, "body", f"{model_file} cannot be used as a body: {error}") from error


def _read_view(folder, view, on_white):
    """Image on white where a mask or alpha is known, and the mask or None."""
    image, alpha = _read_file(read_image, folder / view["image"])
    if alpha is not None:
        image = _on_white(image, alpha)
    if "mask" not in view:
        return image, alpha
    file = folder / view["mask"]
    mask = _read_file(read_grey, file)
    if mask.shape != image.shape[:2]:
        sizes = f"{mask.shape[1]} x {mask.shape[0]}, but its image has {image.shape[1]} x {image.shape[0]}"
        raise CaptureError(file, "size", f"{sizes}: expected the same")
    if 0 < mask.max() < 1.5 / 255:
        raise CaptureError(file, "values", "0 and 1: expected 0 (background) to 255 (person)")
    # where alpha has composited the image already, the mask file only says what the person is
    return (image if on_white or alpha is not None else _on_white(image, mask)), mask


def _read_file(reader, file):
    try:
        return reader(file)
    except FileNotFoundError:
        raise CaptureError(file, "", "no such image file (capture.json names it)") from None
    except OSError as error:
        raise CaptureError(file, "", f"not a readable image: {error.strerror or error}") from error
    except ValueError as error:
        raise CaptureError(file, "", error) from error


def _view_frame(view, count, file, field):
    if "frame" not in view and count > 1:
        raise CaptureError(file, field, f"missing: body.npz has {count} poses, which one does the photo show?")
    return _frame(view.get("frame", 0), count, file, field)


def _names_from_paths(paths):
    """File names without folder and suffix; with their folders where that alone is ambiguous."""
    names = [Path(path).stem for path in paths]
    if len(set(names)) < len(names):
        names = ["_".join(Path(path).with_suffix("").parts) for path in paths]
    if len(set(names)) < len(names):
        names = [f"{i:03d}_{name}" for i, name in enumerate(names)]  # one photo used twice
    return tuple(re.sub(r"[^\w.-]", "_", name).lstrip(".") or f"{i:03d}" for i, name in enumerate(names))


# Checks --------------------------------------------------------------------------------------------------------------


def _numbers(value, file, field, shape=None):
    """Finite float32 numbers of a shape."""
    try:
        array = np.asarray(value)
        if array.dtype.kind not in "fiub":
            raise TypeError
        array = array.astype(np.float32)
    except (ValueError, TypeError):
        wanted = "numbers" if shape is None else f"{' x '.join(map(str, shape))} numbers"
        raise CaptureError(file, field, f"expected {wanted}") from None
    if shape is not None and array.shape != shape:
        raise CaptureError(file, field, f"expected shape {shape}, got {array.shape}")
    if not np.isfinite(array).all():
        where = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise CaptureError(file, field, f"expected finite numbers, got {array[where]} at index {list(where)}")
    return array


def _check_range(array, file, field):
    low, high = float(array.min()), float(array.max())
    if low < -COLOUR_SLACK or high > 1 + COLOUR_SLACK:
        raise CaptureError(file, field, f"expected values in [0, 1], got {low:.4g} to {high:.4g}")


def _camera(K, cam_from_world, width, height, file, prefix):
    try:
        return Camera.from_opencv(K, cam_from_world, width, height)
    except ValueError as error:
        raise CaptureError(file, prefix, error) from error


def _frame(frame, count, file, field):
    if isinstance(frame, bool) or not isinstance(frame, int):
        raise CaptureError(file, field, f"expected an integer, got {frame!r}")
    if not 0 <= frame < count:
        raise CaptureError(file, field, f"expected 0 to {count - 1} (there are {count} poses), got {frame}")
    return frame


def _body_parameters(body, betas, rotations, translations, file):
    """Checked float32 copies."""
    joints, shapes = len(body.parents), body.shape_directions.shape[-1]
    rotations = _numbers(rotations, file, "rotations")
    if rotations.ndim != 3 or rotations.shape[1:] != (joints, 3) or len(rotations) == 0:
        raise CaptureError(
            file, "rotations", f"expected shape (frames, {joints}, 3) for this body, got {rotations.shape}"
        )
    translations = _numbers(translations, file, "translations", (len(rotations), 3))
    betas = _numbers(betas, file, "betas")
    if betas.ndim != 1 or len(betas) > shapes:
        raise CaptureError(file, "betas", f"expected at most {shapes} numbers for this body, got shape {betas.shape}")
    return betas, rotations, translations


def _check_names(names, count, file):
    if len(names) != count or len(set(names)) < count:
        raise CaptureError(file, "names", f"expected {count} different names, got {list(names)}")
    for name in names:
        if not isinstance(name, str) or not re.fullmatch(r"[\w-][\w.-]*", name):
            raise CaptureError(file, "names", f"expected letters, digits, '.', '_' and '-' only, got {name!r}")


def _check_before_writing(capture):
    source, v = "capture", len(capture.images)
    _check_names(capture.names, v, source)
    for field in ("images", "masks"):
        if (array := getattr(capture, field)) is not None:
            _check_range(_numbers(array, source, field), source, field)
    K, poses = np.asarray(capture.cameras.K), capture.poses
    cam_from_world = np.asarray(capture.cameras.cam_from_world)
    if len(K) != v:
        raise CaptureError(source, "cameras", f"expected {v}, one per image, got {len(K)}")
    height, width = capture.images.shape[1:3]
    if (capture.cameras.width, capture.cameras.height) != (width, height):
        got = f"{capture.cameras.width} x {capture.cameras.height}"
        raise CaptureError(source, "cameras", f"expected the image size {width} x {height}, got {got}")
    for i in range(v):
        _camera(K[i], cam_from_world[i], width, height, source, f"view {i}")
    _body_parameters(capture.body, capture.betas, np.asarray(poses.rotations), np.asarray(poses.translation), source)
    for i, frame in enumerate(capture.frames):
        _frame(int(frame), capture.frame_count, source, f"frames[{i}]")


# Writing -------------------------------------------------------------------------------------------------------------


def _write_folder(folder, capture, target):
    (folder / "images").mkdir(parents=True)
    if capture.masks is not None:
        (folder / "masks").mkdir()
    views = []
    for i, name in enumerate(capture.names):
        view: dict[str, Any] = {"image": f"images/{name}.png"}
        write_png(folder / view["image"], capture.images[i])
        if capture.masks is not None:
            view["mask"] = f"masks/{name}.png"
            write_png(folder / view["mask"], capture.masks[i])
        view["frame"] = int(capture.frames[i])
        view["K"] = np.asarray(capture.cameras.K[i], float).tolist()
        view["cam_from_world"] = np.asarray(capture.cameras.cam_from_world[i], float).tolist()
        views.append(view)
    background = "photo" if capture.masks is None else "white"
    description = {"format": FORMAT, "version": VERSION, "body": "body.npz", "background": background, "views": views}
    body_file = capture.body_file
    if body_file != DEFAULT_BODY:
        body_file = Path(os.path.relpath(Path(body_file).resolve(), target)).as_posix()
    np.savez(
        folder / "body.npz",
        body=np.asarray(body_file),
        betas=np.asarray(capture.betas),
        rotations=np.asarray(capture.poses.rotations),
        translations=np.asarray(capture.poses.translation),
    )
    (folder / "capture.json").write_text(json.dumps(description, indent=1) + "\n", encoding="utf-8")
