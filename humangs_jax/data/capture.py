"""A capture: photos of one person, their calibrated cameras, and the body pose of each frame; a
folder on disk.

    me/capture.json       {"format": "humangs-capture", "version": 1, "body": "body.npz",
                          "views": [...]}
    me/body.npz           body (name or file of the model), betas (s,), rotations (m, j, 3),
                          translations (m, 3), perhaps shape_names (s,) and displacement (n, 3)
    me/images/*.png ...   one photo per view, all of one size; the same for masks

docs/capture_format.md describes the format in full. Whatever is wrong in a folder is a
`CaptureError`: one line that names the file, the field if a value is wrong, and what was expected.
In memory the images have a white background wherever masks are known.
"""

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np

from humangs_jax.body.model import BodyModel, BodyPose
from humangs_jax.core.array_types import Bool, Float, Int
from humangs_jax.core.arrays import from_host
from humangs_jax.core.checks import UNIT, checked_arguments
from humangs_jax.core.pytree import short_repr
from humangs_jax.core.records import Batch, check_record
from humangs_jax.data.capture_checks import (
    CaptureError,
    body_parameters,
    check_names,
    check_place,
    checked_camera,
    checked_frame,
    in_unit_range,
    numbers,
)
from humangs_jax.data.masks import masks_at_edges
from humangs_jax.data.photos import (
    Photos,
    capture_folder,
    check_background,
    check_keys,
    cut_out,
    read_description,
    read_photos,
    write_description,
)
from humangs_jax.geometry.camera import Camera, require_pinhole, stack_cameras
from humangs_jax.io.arrays import checksum, file_checksum, read_npz, write_npz
from humangs_jax.io.atomic import replace_folder
from humangs_jax.io.images import image_row, png_bytes, resized, write_png
from humangs_jax.io.reading import FileError, check_limit, reading

DEFAULT_BODY = "makehuman"
"""The name of the body that comes with the package. Any other `body` in body.npz is the path of a
model file.
"""
BODY_KEYS = {"body", "betas", "rotations", "translations"}


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Capture:
    """A capture in memory. Its arrays are numpy's; cameras, body and poses are pytrees of JAX.
    `capture_from_arrays` makes a checked capture.
    """

    images: Annotated[Float[np.ndarray, "v h w 3"], UNIT]
    """The photos, (v, h, w, 3), in [0, 1]. The background is white if there are masks."""
    masks: Annotated[Float[np.ndarray, "v h w"] | None, UNIT]
    """The coverage by the person, (v, h, w), in [0, 1]; None: there are no masks."""
    cameras: Annotated[Camera, Batch("v")]
    """A batch of v cameras, metres."""
    frames: Int[np.ndarray, " v"]
    """The frame that each view shows, (v,), an index into `poses`."""
    body: BodyModel
    """The model that the parameters belong to."""
    betas: Float[np.ndarray, " s"]
    """The person's shape coefficients, (s,); fewer than the body has are allowed."""
    poses: Annotated[BodyPose, Batch("m")]
    """A batch of m poses."""
    names: tuple[str, ...]
    """The names of the views, which are used as file names."""
    body_file: str = DEFAULT_BODY
    """Where the model comes from, "makehuman" or a path."""
    displacement: Float[np.ndarray, "n 3"] | None = None
    """Displacement of the vertices of the shaped body in the T-pose, (n, 3), metres, as in SMPL+D.
    Joints stay where they are. A displacement belongs to one shape, so code that changes `betas`
    removes the displacement. None: `reconstruct` may find a displacement by the masks.
    """
    calibrated: bool = True
    """Whether the cameras were calibrated; if not, they were found from the person, and are
    centimetres off.
    """
    gains: Float[np.ndarray, "v 3"] | None = None
    """The factors of red, green and blue by which `data.exposure.equalize_exposure` has multiplied
    each view, (v, 3); None: the colors are as they were photographed.
    """
    unknown: Bool[np.ndarray, "v h w"] | None = None
    """Where somebody or something in front may hide the person, (v, h, w); masks are 0 there.
    Nothing is concluded from these pixels. None: nowhere.
    """

    __repr__ = short_repr

    def _repr_png_(self) -> bytes:
        """Returns the photos side by side as a PNG, for notebooks."""
        return png_bytes(image_row(self.images))

    @property
    def view_count(self) -> int:
        return len(self.images)

    @property
    def frame_count(self) -> int:
        return len(self.poses.translation)

    def check(self, owner: str) -> None:
        """Check a capture that may have been made by hand.

        Each view needs a photo, a camera and a frame. Either all views have a mask, or none has.
        The poses need as many joints as the body. Numbers have to be finite and in range.

        Raises: ValueError, one line that begins with `owner`.
        """
        if self.view_count == 0:
            raise ValueError(f"{owner}: 0 views; at least one photo is needed")
        require_pinhole(owner, self.cameras)
        sizes = {"n": len(self.body.template), "j": len(self.body.parents)}
        check_record(self, owner, {"m": self.frame_count, **sizes})
        if not 0 <= np.min(self.frames) <= np.max(self.frames) < self.frame_count:
            expected = f"expected 0 to {self.frame_count - 1}, got {self.frames}"
            raise ValueError(f"{owner}: frames: {expected}")

    def pose(self, frame: int) -> BodyPose:
        """Returns the pose of one frame. The pose of a view is `pose(capture.frames[view])`.

        Raises: IndexError for a frame that does not exist.
        """
        return self.poses[frame]

    def select(self, views: Sequence[int] | Int[np.ndarray, " any"]) -> "Capture":
        """Returns the capture with only these views, in this order; the poses stay."""
        views = np.asarray(views, int)
        return dataclasses.replace(
            self,
            images=self.images[views],
            masks=None if self.masks is None else self.masks[views],
            unknown=None if self.unknown is None else self.unknown[views],
            cameras=self.cameras[views],
            frames=self.frames[views],
            names=tuple(self.names[i] for i in views),
            gains=None if self.gains is None else self.gains[views],
        )

    def resized(self, longest: int) -> "Capture":
        """Returns the capture with photos whose longest side has `longest` pixels."""
        height, width = self.images.shape[1:3]
        size = [max(1, round(side * longest / max(height, width))) for side in (width, height)]

        def resize(images):
            return np.stack([resized(image, *size) for image in images])

        masks = None
        if self.masks is not None:
            masks = resize(self.masks)
        unknown = None
        if self.unknown is not None:
            unknown = resize(self.unknown.astype(np.float32)) > 0
        return dataclasses.replace(
            self,
            images=resize(self.images),
            masks=masks,
            unknown=unknown,
            cameras=self.cameras.resized(*size),
        )


@checked_arguments
def capture_from_arrays(
    images: Any,
    K: Any,
    cam_from_world: Any,
    rotations: Any,
    translations: Any,
    *,
    betas: Any = (),
    shape_names: Sequence[str] | None = None,
    masks: Any | None = None,
    frames: Any | None = None,
    names: Sequence[str] | None = None,
    background: str = "photo",
    fit_masks: bool = False,
    body: BodyModel | None = None,
    body_file: str | Path = DEFAULT_BODY,
    displacement: Any | None = None,
    calibrated: bool = True,
    unknown: Any | None = None,
    source: str = "arrays",
) -> Capture:
    """Returns a checked capture made of arrays.

    Args:
        images: (v, h, w, 3) in [0, 1].
        K: (v, 3, 3), or (3, 3) for all; pixels.
        cam_from_world: (v, 4, 4), OpenCV, metres.
        rotations: (m, j, 3) axis-angle in the body's joint order, radians.
        translations: (m, 3) metres.
        betas: (s,) shape coefficients.
        shape_names: (s,) names of the body's shape directions that betas belong to. None: betas
            belong to the body's directions that are no expressions, see
            `capture_checks.shape_coefficients`.
        masks: (v, h, w) in [0, 1], or None.
        frames: (v,) which of the m poses each view shows; may be left out when m is 1.
        names: (v,) names of the views, which are file names without suffix. None: "000", "001" and
            so on.
        background: "photo": the images show their background, and the masks put the person on
            white. "white": the images are on white already.
        fit_masks: whether masks that are too large or too small are first moved to the edges in the
            photos. Only with the background "photo".
        body: the model. None: the model in `body_file`.
        body_file: where the model comes from. Default: the shipped body.
        displacement: (n, 3) metres, of the vertices of the shaped body in the T-pose, or None.
        calibrated: False if the cameras were found from the person. Refining the capture by its
            masks may move such cameras farther than calibrated ones.
        unknown: (v, h, w), true where somebody or something in front may hide the person, or None.
            The capture's masks are 0 there, and nothing is concluded from these pixels. Needs
            masks.
        source: what errors call the arrays.

    Returns:
        The capture.

    Raises:
        CaptureError: one line that names the array and what was expected: a shape, finite numbers,
            a range.

    Examples:
        >>> pose = (rotations, translations)
        >>> capture = hg.capture_from_arrays(photos, K, cam_from_world, *pose, masks=masks)
    """
    # photos, masks and cameras
    images = numbers(images, source, "images")
    if images.ndim != 4 or images.shape[-1] != 3 or 0 in images.shape:
        raise CaptureError(source, "images", f"expected shape (views, h, w, 3), got {images.shape}")
    images = in_unit_range(images, source, "images")
    v, height, width, _ = images.shape
    if masks is not None:
        masks = in_unit_range(numbers(masks, source, "masks", (v, height, width)), source, "masks")
    K = numbers(K, source, "K")
    if K.shape == (3, 3):
        K = np.broadcast_to(K, (v, 3, 3))
    K = numbers(K, source, "K", (v, 3, 3))
    cam_from_world = numbers(cam_from_world, source, "cam_from_world", (v, 4, 4))
    cameras = [
        checked_camera(K[i], cam_from_world[i], width, height, source, f"view {i}")
        for i in range(v)
    ]
    # the person: shape and poses
    if body is None:
        body = _load_model(source, str(body_file))
    parameters = body_parameters(
        body, betas, rotations, translations, source, shape_names, displacement
    )
    rotations = parameters[1]
    # which of the poses each view shows
    if frames is None:
        if len(rotations) > 1:
            raise CaptureError(
                source,
                "frames",
                f"expected a frame for each view, since there are {len(rotations)} poses",
            )
        frames = np.zeros(v, int)
    numbers(frames, source, "frames", (v,))
    frames = [
        checked_frame(x.item(), len(rotations), source, f"frames[{i}]")
        for i, x in enumerate(np.asarray(frames))
    ]
    if names is None:
        names = tuple(f"{i:03d}" for i in range(v))
    else:
        names = tuple(names)
    check_names(names, v, source)
    check_background(background, source)
    # photos on white, as the network knows them
    if masks is not None and background == "photo":
        if fit_masks:
            masks = np.stack([mask for mask, _ in masks_at_edges(list(images), list(masks))])
        images = np.stack([cut_out(*pair) for pair in zip(images, masks, strict=True)])
    # what may be hidden counts as background, so that nothing is concluded from it
    if unknown is not None:
        if masks is None:
            raise CaptureError(source, "unknown", "expected masks, too")
        unknown = numbers(unknown, source, "unknown", (v, height, width)) > 0
        images = np.where(unknown[..., None], np.float32(1), images)
        masks = np.where(unknown, np.float32(0), masks)
    frames = np.asarray(frames, np.int32)
    photos = Photos(images, masks, stack_cameras(cameras), frames, names, calibrated, unknown)
    return _assemble(photos, body, body_file, *parameters)


@checked_arguments
def load_capture(
    path: str | Path,
    *,
    body: BodyModel | None = None,
    views: Sequence[int] | Int[np.ndarray, " any"] | None = None,
    fit_masks: bool = False,
) -> Capture:
    """Read and check a capture folder.

    Args:
        path: the folder that holds capture.json. If there is no folder "demo_capture", this name
            stands for the capture that comes with the package, and "demo_capture/held_out" for its
            held-out views.
        body: a model to use in place of the one that body.npz names.
        views: read these views only, in this order; the photos of others are not opened.
        fit_masks: move masks that are too large or too small to the edges in the photos, and log by
            how much. See `data.photos.read_photos` for the masks that are never moved.

    Returns:
        The capture in memory. Photos with masks are on white.

    Raises:
        CaptureError: for whatever is wrong in the folder. The error is one line that names the
            file, and the field if a value is wrong.

    Examples:
        >>> capture = hg.load_capture("demo_capture")
        >>> photos, camera = capture.images, capture.cameras[0]
    """
    folder = capture_folder(path)
    with reading(folder / "capture.json", "capture", CaptureError):
        # the description, the parameters of the body, then the photos that both agree on
        description = read_description(folder / "capture.json")
        parameter_file = folder / description["body"]
        body_file, parameters = read_parameters(parameter_file)
        if body is None:
            body = _load_model(parameter_file, body_file, folder)
        checked = body_parameters(body, **parameters, file=parameter_file)
        frames = len(checked[1])
        check_limit("frames", frames, f"frames in {parameter_file}")
        photos = read_photos(folder, description, views, frames, fit_masks)
        if body_file != DEFAULT_BODY:
            body_file = str(folder / body_file)
        return _assemble(photos, body, body_file, *checked)


def capture_checksum(path: str | Path) -> str:
    """Returns a SHA-256, in hexadecimal, of all files that a capture is read from: capture.json,
    body.npz, the model file if there is one, photos, masks, and images that mark unknown pixels.

    If one of these files changes, the checksum changes.

    Raises: CaptureError if capture.json or body.npz is wrong, or a file cannot be read. Other files
    are not checked.
    """
    folder = capture_folder(path)
    with reading(folder / "capture.json", "capture", CaptureError):
        description = read_description(folder / "capture.json")
        parameter_file = folder / description["body"]
        body_file, _ = read_parameters(parameter_file)
        files = [folder / "capture.json", parameter_file]
        if body_file != DEFAULT_BODY:
            files.append(folder / body_file)
        for view in description["views"]:
            kinds = [kind for kind in ("image", "mask", "unknown") if kind in view]
            files += [folder / view[kind] for kind in kinds]
        return checksum({}, *(file_checksum(file) for file in files))


@checked_arguments
def save_capture(path: str | Path, capture: Capture, *, overwrite: bool = False) -> None:
    """Write a capture folder: PNG images and masks, capture.json and body.npz. If writing fails,
    the folder stays as it was.

    If the body is not the default one, body.npz has the relative path of its model file. The model
    file is not copied.

    Args:
        path: the folder to write.
        capture: what to write.
        overwrite: replace a capture folder, as a whole, sub-folders included.

    Raises:
        CaptureError: if the capture is not valid, or if `path` cannot be replaced. For example, it
            is a file, a folder that holds something but no capture.json, or, without `overwrite`, a
            folder that holds a capture.
        OSError: if the folder cannot be written.

    Examples:
        >>> hg.save_capture("me", capture)
    """
    path = Path(path)
    _check_before_writing(capture)
    check_place(path, overwrite)
    replace_folder(path, lambda folder: _write_folder(folder, capture, path), mark="capture.json")


def _assemble(
    photos: Photos,
    body: BodyModel,
    body_file: str | Path,
    betas: np.ndarray,
    rotations: np.ndarray,
    translations: np.ndarray,
    displacement: np.ndarray | None,
) -> Capture:
    return Capture(
        **vars(photos),
        body=body,
        betas=betas,
        poses=jax.vmap(BodyPose)(from_host(rotations), from_host(translations)),
        body_file=str(body_file),
        displacement=displacement,
    )


def _load_model(file: object, name: str, folder: Path | None = None) -> BodyModel:
    model_file = Path(name) if folder is None else folder / name
    if name != DEFAULT_BODY and not model_file.is_file():
        raise CaptureError(
            file,
            "body",
            f"no model file at {model_file}: expected {DEFAULT_BODY!r} or the path of one",
        )
    from humangs_jax.body.library import load_body

    if name == DEFAULT_BODY:
        return load_body()
    try:
        return load_body(model_file)
    except Exception as error:
        raise CaptureError(
            file, "body", f"{model_file} cannot be used as a body: {error}"
        ) from error


def read_parameters(file: Path) -> tuple[str, dict[str, Any]]:
    """Returns the name of the model in a body.npz, and the other values of the file as arguments of
    `body_parameters`. `body_parameters` checks these values.

    Raises: CaptureError.
    """
    try:
        values, pickled = read_npz(file)
    except FileNotFoundError:
        raise CaptureError(
            file, "", "no such file (capture.json: body names it); `humangs fit` makes one"
        ) from None
    except FileError as error:
        raise CaptureError("", "", error) from error
    if pickled:
        raise CaptureError(file, pickled[0], "expected numbers, got a pickled object")
    # what the file must hold whatever its body is
    check_keys(values, BODY_KEYS | {"shape_names", "displacement"}, BODY_KEYS, file)
    name = values["body"]
    if name.shape != () or name.dtype.kind not in "US" or not str(name.item()):
        problem = f"expected the string {DEFAULT_BODY!r} or the path of a model file, got {name!r}"
        raise CaptureError(file, "body", problem)
    parameters: dict[str, Any] = {
        key: values[key] for key in ("betas", "rotations", "translations")
    }
    # what only some files hold
    parameters["displacement"] = values.get("displacement")
    names = values.get("shape_names")
    if names is not None:
        if names.ndim != 1 or names.dtype.kind not in "US":
            raise CaptureError(
                file, "shape_names", f"expected one name for each of betas, got shape {names.shape}"
            )
        parameters["shape_names"] = names.astype(str).tolist()
    return str(name.astype(str)), parameters


# Writing
# --------------------------------------------------------------------------------------------------


def _check_before_writing(capture: Capture) -> None:
    """Check a `Capture` that may have been made by hand. What reading would refuse is refused here,
    too.

    Raises: CaptureError.
    """
    # what the annotations say
    try:
        capture.check("capture")
    except ValueError as error:
        raise CaptureError("", "", error) from error

    # cameras of the size of the photos, with rigid poses
    cameras, size = capture.cameras, capture.images.shape[2:0:-1]
    if (cameras.width, cameras.height) != size:
        expected = f"expected the image size {size[0]} x {size[1]}"
        got = f"{cameras.width} x {cameras.height}"
        raise CaptureError("capture", "cameras", f"{expected}, got {got}")
    K, cam_from_world = np.asarray(cameras.K), np.asarray(cameras.cam_from_world)
    for i in range(capture.view_count):
        checked_camera(K[i], cam_from_world[i], *size, "capture", f"view {i}")

    # numbers of a size that people have, coefficients that the body has, names that files can have
    body, poses = capture.body, capture.poses
    values = capture.betas, poses.rotations, poses.translation
    names = body.shape_names[: len(capture.betas)] or None
    body_parameters(body, *values, "capture", names, capture.displacement)
    check_names(capture.names, capture.view_count, "capture")
    if capture.unknown is not None and capture.masks is None:
        raise CaptureError("capture", "unknown", "expected masks, too")


def _write_folder(folder: Path, capture: Capture, target: Path) -> None:
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
        if capture.unknown is not None and capture.unknown[i].any():
            view["unknown"] = f"unknown/{name}.png"
            (folder / "unknown").mkdir(exist_ok=True)
            write_png(folder / view["unknown"], capture.unknown[i].astype(np.float32))
        view["frame"] = int(capture.frames[i])
        view["K"] = np.asarray(capture.cameras.K, float)[i].tolist()
        view["cam_from_world"] = np.asarray(capture.cameras.cam_from_world, float)[i].tolist()
        views.append(view)
    background = "photo" if capture.masks is None else "white"
    write_npz(folder / "body.npz", capture_parameters(target, capture), compressed=False)
    write_description(folder, views, background, capture.calibrated)


def capture_parameters(folder: Path, capture: Capture) -> dict[str, np.ndarray]:
    """Returns the arrays of a capture's body.npz by their keys, see `parameter_arrays`."""
    poses = capture.poses
    arrays = parameter_arrays(
        folder, capture.body, capture.body_file, capture.betas, poses.rotations, poses.translation
    )
    if capture.displacement is not None:
        arrays["displacement"] = np.asarray(capture.displacement, np.float32)
    return arrays


def parameter_arrays(
    folder: Path,
    body: BodyModel,
    body_file: str | Path,
    betas: Any,
    rotations: Any,
    translations: Any,
) -> dict[str, np.ndarray]:
    """Returns the arrays of a body.npz by their keys. folder: the folder of the capture that the
    file will be in. A model file is named by its path relative to this folder.
    """
    if body_file != DEFAULT_BODY:
        body_file = Path(os.path.relpath(Path(body_file).resolve(), folder.resolve())).as_posix()
    numbers = {"betas": betas, "rotations": rotations, "translations": translations}
    arrays = {"body": np.asarray(body_file)} | {
        name: np.asarray(x, np.float32) for name, x in numbers.items()
    }
    if body.shape_names:
        arrays["shape_names"] = np.asarray(body.shape_names[: len(betas)], str)
    return arrays
