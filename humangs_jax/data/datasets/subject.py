"""One person of a data set, and the body model that the person's parameters belong to.

A view is one photo: a camera at one frame. Opening a subject lists folders and reads calibration
and body parameters, so that a sequence of 5,000 frames opens in well under a second. Photos are put
on white, padded to a centred square and resized. Values of files are checked one by one
(`open_arrays`, `checked_numbers`). A fault is a `CaptureError` that names the file, and the key if
a value is wrong.
"""

import concurrent.futures
import dataclasses
import functools
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.body.library import HandBasis, load_body, load_hands
from humangs_jax.body.model import BodyModel, BodyPose, PosedBody, RestBody, pose_body, shape_body
from humangs_jax.core.array_types import Bool, Float, Int, UInt8
from humangs_jax.core.registry import imported
from humangs_jax.data.capture import DEFAULT_BODY, Capture, capture_from_arrays
from humangs_jax.data.capture_checks import CaptureError, file_numbers, shape_coefficients
from humangs_jax.data.formats import DATASETS
from humangs_jax.data.loading.examples import StoredSubject
from humangs_jax.io import arrays as array_files
from humangs_jax.io.images import resized, to_uint8

LARGEST_ANGLE = 4 * np.pi
"""The largest magnitude of a component of a rotation vector, radians. Fits go beyond 2 pi now and
then; degrees are far above.
"""
FARTHEST = 100.0
"""The largest distance of a camera from the origin, and the largest magnitude of a component of a
translation, metres. Millimetres are far above.
"""
LARGEST_COEFFICIENT = 30.0
"""The largest magnitude of a coefficient of shape or expression, standard deviations. It is usually
below 5.
"""

open_arrays = functools.partial(array_files.ArrayFile.open, error=CaptureError)
checked_numbers = functools.partial(file_numbers, some=True)

FIRST_HAND_JOINT = 25
"""The first finger joint in the order of SMPL-X; 30 finger joints begin there."""
RECOVERED_TOLERANCE = 3e-3
"""The arrays of a scene list count as made with a body model if they differ from the fitted model
by less than this, metres, root mean square over the vertices.
"""


@dataclasses.dataclass(frozen=True, eq=False)
class FileBody:
    """The body model that the parameters of a data set belong to, and the file that it was read
    from.
    """

    model: BodyModel
    """The body model."""
    file: str = DEFAULT_BODY
    """The path of its file, or the name of the shipped body."""

    @classmethod
    def load(cls, file: str | Path | None = None) -> "FileBody":
        """Read a model file; None: the body that comes with the package.

        Raises: as `load_body`.
        """
        return cls(load_body(file), DEFAULT_BODY if file is None else str(file))

    @functools.cached_property
    def hands(self) -> HandBasis:
        """Returns the mean and the components of the model's hand poses.

        Raises: CaptureError for the package's own body, which has none; as `load_hands`.
        """
        if self.file == DEFAULT_BODY:
            problem = (
                "these hand poses are relative to SMPL-X's mean hand: expected the path of an"
                " SMPL-X model for body"
            )
            raise CaptureError("body", DEFAULT_BODY, problem)
        return load_hands(self.file)

    @functools.cached_property
    def arrays(
        self,
    ) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3 s"], Float[np.ndarray, "j n"]]:
        """The template in metres, the shape directions and the joint regressor, float64."""
        model = self.model
        template = model.template
        directions = model.shape_directions
        regressor = model.joint_regressor
        template, directions, regressor = (
            np.asarray(x, np.float64) for x in (template, directions, regressor)
        )
        return template, directions, regressor

    def rest_joints(self, betas: Float[np.ndarray, " s"]) -> Float[np.ndarray, "j 3"]:
        """Returns the places of a person's joints in the T-pose, (j, 3), metres."""
        template, directions, regressor = self.arrays
        return regressor @ (template + directions[..., : len(betas)] @ betas)


class BodyParameters(NamedTuple):
    """The shape and the poses of a person."""

    betas: Float[np.ndarray, " s"]
    """Shape coefficients, (s,)."""
    rotations: Float[np.ndarray, "m j 3"]
    """Axis-angle rotations of the joints in each of the m poses, (m, j, 3), radians."""
    translations: Float[np.ndarray, "m 3"]
    """The translation of each pose, (m, 3), metres."""

    def poses(self, rows: Sequence[int]) -> "BodyParameters":
        """Returns the parameters with the poses of these rows alone."""
        index = np.asarray(rows, int)
        return BodyParameters(self.betas, self.rotations[index], self.translations[index])


@dataclasses.dataclass(frozen=True, eq=False)
class PosedPerson:
    """The body of a person in one pose. Lengths are in metres, or multiplied by the `scale` of
    `posed_people`.
    """

    rest: Float[np.ndarray, "n 3"]
    """The vertices in the T-pose, (n, 3)."""
    vertices: Float[np.ndarray, "n 3"]
    """The posed vertices, (n, 3)."""
    joints: Float[np.ndarray, "j 3"]
    """The posed joints, (j, 3)."""
    joint_transforms: Float[np.ndarray, "j 4 4"]
    """From rest to posed for each joint, (j, 4, 4), translation included."""


@jax.jit
def _posed(
    body: BodyModel, betas: Any, rotations: Any, translation: Any
) -> tuple[RestBody, PosedBody]:
    rest = shape_body(body, betas)
    return rest, pose_body(body, rest, BodyPose(rotations, translation))


def posed_people(
    body: BodyModel, parameters: BodyParameters, scale: float = 1.0
) -> Iterator[PosedPerson]:
    """Yields the body of a person in each pose, with all lengths, in metres, multiplied by
    `scale`.
    """
    for rotations, translation in zip(parameters.rotations, parameters.translations, strict=True):
        rest, posed = _posed(
            body, *(jnp.asarray(x, jnp.float32) for x in (parameters.betas, rotations, translation))
        )
        lengths = (
            scale * np.asarray(x, np.float64) for x in (rest.vertices, posed.vertices, posed.joints)
        )
        transforms = np.array(posed.joint_transforms, np.float64)
        transforms[:, :3, 3] *= scale
        yield PosedPerson(*lengths, transforms)


def coefficients(
    body: BodyModel,
    betas: Float[np.ndarray, " s"],
    expression: Float[np.ndarray, " e"],
    file: object,
) -> Float[np.ndarray, " all"]:
    """Returns coefficients for all directions of the body: shape, then expression. Coefficients
    that the file does not have are 0.

    Raises: CaptureError if a coefficient is not 0 and the body has no such direction, and for a
    body without directions of SMPL-X (shape_0 and so on).
    """
    if not any(name.startswith("shape_") for name in body.shape_names):
        problem = (
            f"of SMPL-X, and body '{body.name}' has other directions: expected the path of an"
            " SMPL-X model for body"
        )
        raise CaptureError(file, "betas", problem)
    names = [
        f"{kind}_{i}"
        for kind, values in (("shape", betas), ("expression", expression))
        for i in range(len(values))
    ]
    found = shape_coefficients(body, np.concatenate([betas, expression]), names, file)
    return np.pad(found, (0, body.shape_directions.shape[-1] - len(found)))


def turned(
    parameters: BodyParameters, matrix: Float[np.ndarray, "4 4"], pelvis: Float[np.ndarray, "3"]
) -> BodyParameters:
    """Returns the parameters of the same poses in a world that a rigid transform moved.

    matrix: the transform, (4, 4), metres. pelvis: the place of the pelvis in the person's T-pose,
    (3,), metres.
    """
    from scipy.spatial.transform import Rotation

    R, t = matrix[:3, :3], matrix[:3, 3]
    rotations = parameters.rotations.copy()
    rotations[:, 0] = (Rotation.from_matrix(R) * Rotation.from_rotvec(rotations[:, 0])).as_rotvec()
    # the root turns about the pelvis: x -> W (x - p) + p + transl
    translations = (parameters.translations + pelvis) @ R.T + t - pelvis
    return BodyParameters(parameters.betas, rotations, translations)


def recover_shape(
    body: FileBody, rest: Float[np.ndarray, "n 3"], file: object
) -> tuple[float, Float[np.ndarray, " s"]]:
    """Returns the scale and the shape coefficients of a T-pose `v_cano`, by least squares: rest =
    scale (template + directions betas).

    rest: the vertices of the T-pose, (n, 3), in units of the scene. All vertices are fitted first.
    If the fit is off by `RECOVERED_TOLERANCE` or more, the vertices of the hands are left out,
    because the published arrays have bent hands by accident.

    Raises: CaptureError if the arrays are not of this body.
    """
    template = body.arrays[0]
    if len(rest) != len(template):
        problem = (
            f"{len(rest)} vertices, but body '{body.model.name}' has {len(template)}: expected the"
            " model of the arrays"
        )
        raise CaptureError(file, "v_cano", problem)
    for solve, columns, kept in _shape_solvers(body):
        solution = solve @ rest[kept].reshape(-1)
        scale = float(solution[0])
        missed = (columns @ solution - rest[kept].reshape(-1)).reshape(-1, 3)
        error = float(np.sqrt((missed**2).sum(axis=1).mean())) / max(abs(scale), 1e-12)
        if scale > 0 and error < RECOVERED_TOLERANCE:
            return scale, solution[1:] / scale
    problem = (
        f"{1e3 * error:.3g} mm from body '{body.model.name}': expected the model that the arrays"
        " were made with"
    )
    raise CaptureError(file, "v_cano", problem)


@functools.lru_cache(maxsize=2)
def _shape_solvers(
    body: FileBody,
) -> tuple[
    tuple[Float[np.ndarray, "_u _r"], Float[np.ndarray, "_r _u"], Bool[np.ndarray, " n"]], ...
]:
    """Returns the two least-squares problems of `recover_shape`: with all vertices, and without the
    hands.

    Each is a tuple of three: the pseudo-inverse of the matrix, the matrix, and which vertices are
    used. The columns of the matrix are the template and the shape directions.
    """
    columns = np.concatenate([body.arrays[0][..., None], body.arrays[1]], axis=-1)
    of_hands = np.asarray(body.model.skinning_weights)[:, FIRST_HAND_JOINT:].sum(axis=1) > 1e-6
    solvers = []
    for kept in (np.ones(len(columns), bool), ~of_hands):
        used = columns[kept].reshape(-1, columns.shape[-1])
        solvers.append((np.linalg.pinv(used), used, kept))
    return tuple(solvers)


def recover_pose(
    body: FileBody,
    betas: Float[np.ndarray, " s"],
    scale: float,
    transforms: Float[np.ndarray, "j 4 4"],
    file: object,
) -> tuple[Float[np.ndarray, "j 3"], Float[np.ndarray, "3"]]:
    """Returns the rotations (axis-angle, radians) and the translation (metres) of a person.
    transforms: the `joint_transforms` of a file, (j, 4, 4). They take the T-pose to the pose. Their
    lengths are in units of the scene. scale: units of the scene per metre.

    Raises: CaptureError if the linear part of a transform is no rotation.
    """
    from scipy.spatial.transform import Rotation

    R = transforms[:, :3, :3]
    off = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max(axis=(1, 2))
    if off.max() > 1e-3 or (np.linalg.det(R) < 0).any():
        raise CaptureError(file, "joint_transforms", "expected rotations: R R^T = 1 and det R = 1")
    parents = np.asarray(body.model.parents)
    above = np.where((parents < 0)[:, None, None], np.eye(3), R[np.maximum(parents, 0)])
    rotations = Rotation.from_matrix(np.swapaxes(above, 1, 2) @ R).as_rotvec()
    pelvis = body.rest_joints(betas)[0]
    return rotations, transforms[0, :3, 3] / scale - pelvis + R[0] @ pelvis


# Subjects
# --------------------------------------------------------------------------------------------------

STORED_SIZE = 512
"""Side of the squares that photos of data sets become, pixels. Squares of 256 and 128 pixels can be
computed from them by averaging whole blocks.
"""
Photo = tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]]
"""An image on white, (h, w, 3), and its mask, (h, w), as bytes."""
THREADS = os.cpu_count() or 1
"""Largest number of threads that decode the photos of one request. Decoding JPEG files releases the
interpreter's lock.
"""


@dataclasses.dataclass(frozen=True, eq=False)
class Subject:
    """One person of a data set. Opening it reads no photo; `read` does."""

    name: str
    """The name in errors and manifests."""
    K: Float[np.ndarray, "v 3 3"]
    """The camera matrix of each photo before it is padded and resized, (v, 3, 3), pixels, with
    pixel centres at +0.5.
    """
    cam_from_world: Float[np.ndarray, "v 4 4"]
    """From the world to the camera, (v, 4, 4), metres, OpenCV axes."""
    sizes: Int[np.ndarray, "v 2"]
    """Width and height of each photo, (v, 2), pixels."""
    frames: Int[np.ndarray, " v"]
    """The pose that each view shows, (v,), counted from 0."""
    frame_count: int
    """The number of poses."""
    view_name: Callable[[int], str]
    """Returns the name of a view, such as "cam03_00000120"."""
    read: Callable[[int], tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"]]]
    """Takes the index of a view; returns the image on white, (h, w, 3), and the mask, (h, w), both
    in [0, 1].
    """
    parameters: Callable[[Sequence[int]], BodyParameters]
    """Takes the numbers of frames; returns the shape, and the poses of these frames."""
    missing: Mapping[str, int] = dataclasses.field(default_factory=dict)
    """The number of photos that are left out, by the reason."""

    def __len__(self) -> int:
        """Returns the number of views."""
        return len(self.frames)

    def squared_K(
        self, views: Sequence[int] | Int[np.ndarray, " any"], size: int
    ) -> Float[np.ndarray, "any 3 3"]:
        """Returns the camera matrices of views that are padded to squares and resized to `size`
        pixels.
        """
        width, height = self.sizes[views].T
        side = self.sizes[views].max(axis=1)
        K = self.K[views].copy()
        K[:, 0, 2] += (side - width) // 2
        K[:, 1, 2] += (side - height) // 2
        K[:, :2] *= (size / side)[:, None, None]
        return K

    def photo(self, view: int, size: int) -> Photo:
        """Read one view. Returns the image on white and the mask, padded to a centred square and
        resized to `size` pixels.

        Raises: ValueError naming the file or the view.
        """
        image, mask = self.read(view)
        width, height = self.sizes[view].tolist()
        if image.shape[:2] != (height, width) or mask.shape != (height, width):
            got = f"{image.shape[1]} x {image.shape[0]}, mask {mask.shape[1]} x {mask.shape[0]}"
            problem = f"photo {got}, but the calibration says {width} x {height}"
            raise CaptureError(self.name, self.view_name(view), problem)
        side = max(width, height)
        top, left = (side - height) // 2, (side - width) // 2
        pad = ((top, side - height - top), (left, side - width - left))
        image, mask = np.pad(image, (*pad, (0, 0)), constant_values=1.0), np.pad(mask, pad)
        if side != size:
            image, mask = resized(image, size, size), resized(mask, size, size)
        return to_uint8(image), to_uint8(mask)

    def tried(
        self, views: Sequence[int] | Int[np.ndarray, " any"], size: int
    ) -> list[Photo | Exception]:
        """Read several views in parallel, see `photo`. If a view cannot be read, the list has the
        error in place of the photo.
        """

        def photo(view: int) -> Photo | Exception:
            try:
                return self.photo(view, size)
            except (ValueError, OSError) as error:
                return error

        with concurrent.futures.ThreadPoolExecutor(min(THREADS, len(views))) as pool:
            return list(pool.map(photo, map(int, views)))

    def photos(
        self, views: Sequence[int] | Int[np.ndarray, " any"], size: int
    ) -> tuple[UInt8[np.ndarray, "any size size 3"], UInt8[np.ndarray, "any size size"]]:
        """Read several views in parallel, see `photo`. Returns their images and masks, stacked.

        Raises: as `photo`.
        """
        images, masks = [], []
        for photo in self.tried(views, size):
            if isinstance(photo, Exception):
                raise photo
            images.append(photo[0])
            masks.append(photo[1])
        return np.stack(images), np.stack(masks)

    def capture(
        self,
        views: Sequence[int] | Int[np.ndarray, " any"],
        body: FileBody,
        size: int = STORED_SIZE,
    ) -> Capture:
        """Returns some views as a `Capture`, which can be reconstructed and animated. The capture
        has the poses of the frames that these views show.

        Raises: ValueError naming the file or the subject, and the field or the view that is wrong.
        """
        views = np.asarray(views, int)
        images, masks = self.photos(views, size)
        seen, frames = np.unique(self.frames[views], return_inverse=True)
        betas, rotations, translations = self.parameters(seen.tolist())
        return capture_from_arrays(
            images / np.float32(255),
            self.squared_K(views, size),
            self.cam_from_world[views],
            rotations,
            translations,
            betas=betas,
            shape_names=body.model.shape_names[: len(betas)] or None,
            masks=masks / np.float32(255),
            frames=frames,
            names=[self.view_name(int(view)) for view in views],
            background="white",
            body=body.model,
            body_file=body.file,
            source=self.name,
        )


@dataclasses.dataclass(eq=False)
class Person:
    """A subject that is opened at its first use. It is a `loading.captures.StoredPerson`."""

    name: str
    """The name of the subject."""
    open: Callable[[], Subject]
    """Makes the `Subject`; raises ValueError if it cannot be used."""
    size: int = STORED_SIZE
    """The side of the stored squares, pixels."""

    @functools.cached_property
    def subject(self) -> Subject:
        """The subject, opened at the first use.

        Raises: ValueError naming the file, and the key if a value is wrong.
        """
        return self.open()

    def summary(self) -> StoredSubject:
        """Returns all of the subject but its pixels and poses."""
        subject, every = self.subject, np.arange(len(self.subject))
        betas, *poses = subject.parameters([])
        K = subject.squared_K(every, self.size)
        return StoredSubject.without_photos(
            (self.size, self.size), K, subject.cam_from_world, subject.frames, *poses, betas
        )

    def decode(
        self, views: Sequence[int]
    ) -> tuple[UInt8[np.ndarray, "any h w 3"], UInt8[np.ndarray, "any h w"]]:
        """Returns the images and masks of some views."""
        return self.subject.photos(views, self.size)

    def posed(self, subject: StoredSubject) -> StoredSubject:
        """Returns the subject with the poses that its views show, renumbered from 0.

        Raises: ValueError naming the file, and the key if a value is wrong.
        """
        seen, frames = np.unique(subject.frames, return_inverse=True)
        _, rotations, translations = self.subject.parameters(seen.tolist())
        rotations, translations = rotations.astype(np.float32), translations.astype(np.float32)
        return subject._replace(
            frames=frames.astype(np.int32), rotations=rotations, translations=translations
        )


def open_people(path: str | Path, body: FileBody, size: int | None = None) -> tuple[Person, ...]:
    """Returns the people of a data set that has photos, in any layout of `data.formats.DATASETS`.
    Each person is opened at the first use.

    Arguments: size: the side of the stored squares, pixels. None: for a scene list see
    `open_scene_list`, else `STORED_SIZE`.

    Raises: CaptureError if the folder has none of these layouts, or is a data set of scans, which
    have no photos; as `open_scene_list` for a scene list.
    """
    path = Path(path)
    for name, data_set in DATASETS.items():
        folders = imported(data_set.find)(path)
        if not folders:
            continue
        if data_set.scans:
            raise CaptureError(
                path, "", f"scans have no photos: make some with `humangs preprocess {name}`"
            )
        if data_set.lists:
            return data_set(path, body, size)

        def opened(folder, open_one=data_set):
            return functools.partial(open_one, folder, body)

        return tuple(Person(str(folder), opened(folder), size or STORED_SIZE) for folder in folders)
    known = ", ".join(each.about for each in DATASETS.where(lambda each: not each.lists).values())
    raise CaptureError(
        path, "", f"no captures, scene list or data set of {known} (docs/datasets.md)"
    )
