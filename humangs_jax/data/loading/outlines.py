"""All of a capture but its pixels: what views are chosen by, and a check of every picture without decoding it."""

from pathlib import Path

import numpy as np

from humangs_jax.body.model import BodyModel
from humangs_jax.data.capture_checks import CaptureError, body_parameters, checked_camera, numbers
from humangs_jax.data.capture_reading import read_description, read_parameters, view_frame
from humangs_jax.data.loading.examples import StoredSubject


def read_outline(path: str | Path, body: BodyModel) -> StoredSubject:
    """A capture whose parameters belong to `body`, images and masks of no views but of the right size.

    Pictures are opened, their sizes compared; PNG files are checked by the checksums in them, others by decoding them.
    Raises: ValueError naming file and field; without masks a capture cannot be learned from.
    """
    folder = Path(path)
    file = folder / "capture.json"
    description = read_description(file)
    parameter_file = folder / description["body"]
    _, betas, rotations, translations = read_parameters(parameter_file)
    betas, rotations, translations = body_parameters(body, betas, rotations, translations, parameter_file)
    views = description["views"]
    size = None
    for view in views:
        shape, has_alpha = _check_picture(folder / view["image"])
        size = size or shape
        if shape != size:
            raise CaptureError(
                folder / view["image"], "size", f"{shape}, but the first view has {size}: expected one size"
            )
        if "mask" in view:
            masked, _ = _check_picture(folder / view["mask"])
            if masked != size:
                raise CaptureError(
                    folder / view["mask"], "size", f"{masked}, but its image has {size}: expected the same"
                )
        elif not has_alpha:
            raise CaptureError(folder, "", "no masks: training needs to know where the person is")
    assert size is not None  # a description has views
    width, height = size
    matrices = [
        [
            numbers(view[key], file, f"views[{i}].{key}", shape)
            for key, shape in (("K", (3, 3)), ("cam_from_world", (4, 4)))
        ]
        for i, view in enumerate(views)
    ]
    for i, pair in enumerate(matrices):
        checked_camera(*pair, width, height, file, f"views[{i}]")
    frames = [view_frame(view, len(rotations), file, f"views[{i}].frame") for i, view in enumerate(views)]
    K, cam_from_world = (np.stack(column) for column in zip(*matrices, strict=True))
    centers = -np.einsum("vji,vj->vi", cam_from_world[:, :3, :3], cam_from_world[:, :3, 3])
    offsets = centers - centers.mean(axis=0)
    shape_count = body.shape_directions.shape[-1]
    return StoredSubject(
        images=np.zeros((0, height, width, 3), np.uint8),
        masks=np.zeros((0, height, width), np.uint8),
        K=K,
        cam_from_world=cam_from_world,
        frames=np.asarray(frames, np.int32),
        azimuths=np.arctan2(offsets[:, 0], offsets[:, 2]),
        rotations=rotations,
        translations=translations,
        # coefficients that a capture leaves out are 0: one length for all, so that subjects stack
        betas=np.pad(betas, (0, shape_count - len(betas))),
    )


def _check_picture(file):
    """((width, height), whether there is an alpha channel)."""
    from PIL import Image

    try:
        with Image.open(file) as image:
            found = image.size, "A" in image.getbands() or "transparency" in image.info
            image.verify() if image.format == "PNG" else image.load()
    except FileNotFoundError:
        raise CaptureError(file, "", "no such image file (capture.json names it)") from None
    except (OSError, SyntaxError, ValueError, EOFError) as error:  # Pillow's ways to say "broken"
        raise CaptureError(file, "", f"not a readable image: {error}") from error
    return found
