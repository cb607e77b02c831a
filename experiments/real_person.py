"""A real man from four photos of a moment: how well the body fills his masks, how like him the
avatar is where no photo was.
"""

import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments.harness import Run, entry
from experiments.real_capture import (
    FRAMES,
    PACKAGE,
    SIZE,
    VERSION,
    RealFrame,
    body_ious,
    drawn_psnrs,
    held_out,
    prepare,
)
from experiments.real_rooms import (
    as_fitted,
    camera_errors,
    draw_sheet,
    one_view_each,
    person_in_rooms,
    reference_cameras,
    seen_from,
    started,
    to_reference,
    video_sizes,
    without_calibration,
)
from experiments.results import cells, markdown_table
from experiments.subjects import shipped_digest
from humangs_jax.apps.start import better_body
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.reconstruct import reconstruct
from humangs_jax.body.library import load_body
from humangs_jax.capture.fitting.fit_capture import FittedCapture, fit_photos
from humangs_jax.capture.fitting.refine import refine_capture, usual_config
from humangs_jax.core.processes import enable_compile_cache
from humangs_jax.data.capture import Capture
from humangs_jax.data.photos import Photos, load_photos
from humangs_jax.evaluation.scores import mean_scores
from humangs_jax.network.weights import SHIPPED, load_weights
from humangs_jax.refinement.config import ITERATIONS, RefineConfig
from humangs_jax.refinement.refine import refine

PSNRS = {"psnr": ("held out", 1), "psnr_fg": ("foreground", 2), "alex": ("LPIPS alex", 3)}
CAMERAS = {"degrees": ("cameras: degrees", 1), "centimetres": ("cm", 1)}
SECONDS = {"first": ("first time, s", 0), "compiled": ("compiled, s", 0)}
SECONDS |= {
    "first_processor": ("processor: first, s", 0),
    "compiled_processor": ("compiled, s", 0),
    "load": ("load", 0),
}
IOUS = {"iou": ("IoU", 3), "iou_unseen": ("IoU, unseen", 3)}
TABLES = (
    (("calibrated", "uncalibrated", "poses", "moments"), IOUS | PSNRS | CAMERAS),
    (("rooms",), {"iou": IOUS["iou"]} | PSNRS | CAMERAS),
    (("start",), SECONDS),
)
"""First words of rows, and the columns of their scores: heading and digits."""
SEEDS = (4_000_100, 4_000_101, 4_000_102)
"""Of synthetic people."""
MIXES = 2
"""Of four moments."""


Cases = Iterator[tuple[str, str, Callable[[], dict[str, Any]]]]
"""(row, case, what measures its scores)."""


# The package's way
# --------------------------------------------------------------------------------------------------

ALL, MASKS = (0, 1, 2, 3), ("detected", "careful")


class Man:
    """What the package makes of the capture; each thing once. frames: by number, and what else is
    to be looked at by name.
    """

    def __init__(self, data: Path, frames: Sequence[int]) -> None:
        self.data, self.numbers = data, list(frames)
        self.frames: dict[int | str, RealFrame] = dict(prepare(data, frames))
        self.reference = reference_cameras(data)
        self.photos, self.fits, self.body = map(
            functools.cache, (self._photos, self._fits, self._body)
        )

    def _photos(self, name: int | str, masks: str) -> Photos:
        frame, place = self.frames[name], self.data / "captures" / f"{name}_{masks}"
        frame.save(place, getattr(frame, masks))
        return load_photos(place, fit_masks=True)

    def _fits(self, name: int | str, masks: str, views: tuple[int, ...]) -> FittedCapture:
        photos, keypoints, at = (
            self.photos(name, masks),
            self.frames[name].keypoints,
            np.asarray(views),
        )
        assert photos.masks is not None
        confidences = keypoints.confidences[at]
        keypoints = dataclasses.replace(
            keypoints, points=keypoints.points[at], confidences=confidences
        )
        cameras = jax.tree.map(lambda leaf: leaf[at], photos.cameras)
        names = tuple(photos.names[view] for view in views)
        chosen = Photos(photos.images[at], photos.masks[at], cameras, photos.frames[at], names)
        return fit_photos(chosen, keypoints, load_body())

    def _body(
        self, name: int | str, masks: str, way: str = "refine", views: tuple[int, ...] = ALL
    ) -> Capture:
        """A capture of some views with its body, as `humangs start` finds it."""
        if way == "fit":
            return self.fits(name, masks, views).capture
        fitted, moments = self.fits(name, masks, views), self.frames[name].moments
        fixed = not fitted.camera_errors if moments is None else moments
        known = {"fixed_cameras": fixed, "calibrated": moments is None}
        configs = [usual_config(fitted=True, tight=tight, **known) for tight in (False, True)]
        refined = [
            refine_capture(fitted.capture, keypoints=fitted.record.keypoints, config=config)
            for config in configs
        ]
        loose, tight = (each.capture for each in refined)
        return better_body(
            *load_weights(), loose, tight, RefineConfig(iterations=ITERATIONS, steps=0)
        )[0]


def avatar_of(capture: Capture) -> Avatar:
    """By the network, and iterations of the learned update."""
    return refine(
        reconstruct(*load_weights(), capture), capture, RefineConfig(iterations=ITERATIONS, steps=0)
    )


# Rows
# --------------------------------------------------------------------------------------------------


def calibrated(man: Man) -> Cases:
    """The published calibration and nothing else."""
    for masks, way, number in itertools.product(MASKS, ("refine", "fit"), man.numbers):
        yield (
            f"calibrated, {way}, {masks}",
            str(number),
            functools.partial(_calibrated, man, number, masks, way),
        )


def _calibrated(man, number, masks, way):
    frame, body = man.frames[number], man.body(number, masks, way)
    known, unseen = held_out(body, frame, avatar_of), []
    for view in ALL:
        used = tuple(other for other in ALL if other != view)
        blind = man.body(number, masks, way, used)
        camera = seen_from(blind.cameras, used, man.reference.of(frame), view)
        unseen += body_ious(
            dataclasses.replace(blind.select([0]), cameras=camera), frame.careful[[view]]
        )
    scores = mean_scores(known) | {"iou": float(np.mean(body_ious(body, frame.careful)))}
    scores |= {"iou_unseen": float(np.mean(unseen))} | _errors(
        body.cameras, man.reference.of(frame)
    )
    return scores | {"each_psnr_fg": [row["psnr_fg"] for row in known], "each_iou_unseen": unseen}


def poses(man: Man) -> Cases:
    """The avatar of one frame in the poses of the others."""
    first, *others = man.numbers
    for number in others:
        yield (
            f"poses, avatar of frame {first}",
            str(number),
            functools.partial(_posed, man, first, number),
        )


def _posed(man, first, number):
    frame, views = man.frames[number], man.body(number, "detected")
    truth = dataclasses.replace(views, images=frame.truth(), masks=frame.careful)
    return drawn_psnrs(avatar_of(man.body(first, "detected")), truth)


def uncalibrated(man: Man) -> Cases:
    """Nothing is given: cameras from the person, in photos with the lenses' distortion."""
    bent = prepare(man.data, man.numbers, straight=False)
    for masks, number in itertools.product(MASKS, man.numbers):
        yield (
            f"uncalibrated, {masks}",
            str(number),
            functools.partial(_uncalibrated, man, number, bent[number], masks),
        )


def _uncalibrated(man, number, frame, masks):
    name = f"{number}_bent"
    man.frames[name] = frame = without_calibration(frame, video_sizes(man.data))
    body, reference = man.body(name, masks), man.reference.of(frame)
    scores = mean_scores(held_out(body, frame, avatar_of)) | {
        "iou": float(np.mean(body_ious(body, frame.careful)))
    }
    return scores | _errors(frame.cameras, reference, "_start") | _errors(body.cameras, reference)


def _errors(own, reference, when=""):
    degrees, centimetres = camera_errors(own, reference)
    return {
        f"degrees{when}": float(degrees.mean()),
        f"centimetres{when}": float(centimetres.mean()),
        f"size{when}": 1 / to_reference(own, reference).scale,
        f"each_degrees{when}": degrees.tolist(),
        f"each_centimetres{when}": centimetres.tolist(),
    }


def moments(man: Man) -> Cases:
    """Nothing is given, and each camera's photo is of another moment."""
    bent = prepare(man.data, man.numbers, straight=False)
    for first in range(MIXES):
        chosen = [man.numbers[(first + view) % len(man.numbers)] for view in ALL]
        frames = [bent[number] for number in chosen]
        yield "moments", "+".join(map(str, chosen)), functools.partial(_moments, man, frames, first)


def _moments(man, frames, first):
    frame = without_calibration(one_view_each(frames), video_sizes(man.data))
    man.frames[f"moments_{first}"] = frame
    ious = body_ious(man.body(f"moments_{first}", "detected"), frame.careful)
    return {
        "iou": float(np.mean(ious)),
        "each_iou": ious,
        "taken_for_moments": float(frame.moments is True),
    }


def rooms(man: Man) -> Cases:
    """Synthetic people in rooms: what true cameras, masks and poses give, and what photos alone
    give.
    """
    for seed in SEEDS:
        person = functools.cache(functools.partial(person_in_rooms, seed, man.data))
        for way in ("true", "true cameras", "photos alone"):
            yield f"rooms, {way}", str(seed), functools.partial(_in_room, man, seed, person, way)


def _in_room(man, seed, person, way):
    frame, true, held = person()
    if way == "true":
        return drawn_psnrs(avatar_of(true), held)
    name = f"person_{seed}_{way.replace(' ', '_')}"
    if way == "photos alone":
        focal = np.asarray(true.cameras.K, float)[:, 0, 0]
        frame = without_calibration(frame, [(SIZE, SIZE)] * len(ALL), focal)
    man.frames[name] = frame
    body = man.body(name, "detected")
    scores = drawn_psnrs(avatar_of(body), as_fitted(held, true, body, way == "true cameras"))
    return (
        scores
        | {"iou": float(np.mean(body_ious(body, true.masks)))}
        | _errors(body.cameras, true.cameras)
    )


def start(man: Man) -> Cases:
    yield "start", str(man.numbers[0]), functools.partial(started, man.data, man.numbers[0])


ROWS = (calibrated, poses, uncalibrated, moments, rooms, start)


def section(rows: dict[str, dict[str, Any]]) -> str:
    """The tables of the page: the man, people in rooms, seconds; means over the cases of each
    row.
    """
    return "\n\n".join(filter(None, (_table(rows, kinds, columns) for kinds, columns in TABLES)))


def _table(rows, kinds, columns):
    lines = []
    for row, cases in rows.items():
        if row.split(",")[0] in kinds:
            means = mean_scores(
                {k: v for k, v in case.items() if isinstance(v, float)} for case in cases.values()
            )
            lines.append([row, len(cases), *cells(means, columns)])
    return (
        markdown_table(["row", "cases", *(heading for heading, _ in columns.values())], lines)
        if lines
        else ""
    )


@entry
def real_person(
    run: Run,
    data: Path,
    rows: tuple[str, ...] = tuple(each.__name__ for each in ROWS),
    frames: tuple[int, ...] = FRAMES,
    pictures: Path | None = None,
) -> None:
    """A real man from four photos of a moment: how well the body fills his masks, how like him the
    avatar is where no photo was.

    Needs the extra `photos` and `imageio-ffmpeg`. Everything is scored by careful masks, in squares
    of 512 pixels. Rows: calibrated, the published calibration: held out, cameras and body know all
    four photos, the avatar three; unseen, nothing knows the fourth photo; its
    camera is the one refined on all frames together. poses: the avatar of one frame in the
    poses of the others. uncalibrated: cameras from the person. moments: the same, of photos that
    each show another moment. rooms: synthetic people in photographed rooms. start: seconds of
    `humangs start` on photos of 12 megapixels.

    Options:
    data: unpacked `pose2sim`, with Pose2Sim/Demo_SinglePerson in it; what is made of it stays there
    rows: how their names begin, as "calibrated, refine"
    frames: of the videos, 0 to 99
    pictures: JPEG of the avatar from all sides, and walking
    """
    if not all(0 <= frame < 100 for frame in frames):
        raise ValueError("--frames: expected 0 to 99")
    if unknown := [
        row for row in rows if not row.startswith(names := tuple(each.__name__ for each in ROWS))
    ]:
        raise ValueError(f"--rows {unknown[0]}: expected beginnings of rows: {', '.join(names)}")
    enable_compile_cache()
    man = Man(data, frames)
    wanted = itertools.chain(
        *(each(man) for each in ROWS if any(row.startswith(each.__name__) for row in rows))
    )
    cases = {f"{row}: {case}": scores for row, case, scores in wanted if row.startswith(rows)}
    settings = {
        "capture": f"{PACKAGE} {VERSION}",
        "iterations": ITERATIONS,
        "weights": shipped_digest(SHIPPED),
    }
    results: dict[str, dict[str, Any]] = {}
    for name, scores in run.rows(cases, settings).items():
        row, _, case = name.partition(": ")
        results.setdefault(row, {})[case] = scores
    if pictures:
        body = man.body(man.numbers[0], "detected")
        draw_sheet(avatar_of(body), body, pictures)
    run.show(section(results), results)
