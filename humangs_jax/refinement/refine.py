"""Fits the Gaussians of an avatar to its photos, by iterations of a learned update, then by Adam.

The learned update also moves Gaussians that no photo shows, and Adam leaves them where they are.
`refine` crops the photos, and keeps the best state that `search` finds until its time is over.
"""

import dataclasses
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np

from humangs_jax.avatar.animate import with_pixel_footprint_of
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.core.checks import checked_arguments
from humangs_jax.core.processes import Call
from humangs_jax.data.capture import Capture
from humangs_jax.data.prepared import PreparedCapture, prepare_capture
from humangs_jax.refinement.config import RefineConfig
from humangs_jax.refinement.head import Crops, head_crops, sharpened, shows_heads
from humangs_jax.refinement.objective import avatar_of
from humangs_jax.refinement.photos import crop_to_person
from humangs_jax.refinement.search import (
    Clock,
    align,
    avatar_comparison,
    calls_of_photos,
    comparison,
    compile_parts,
    prepare,
    search,
)


@dataclasses.dataclass(frozen=True, eq=False)
class Refinement:
    """What `refine_with_report` returns."""

    avatar: Avatar
    """The fitted avatar, or the one that was given if `kept` is False."""
    iterations: int
    """Iterations of the learned update in the best state of the search. 0 if it is better without
    them.
    """
    steps: int
    """Number of steps of the optimizer, trials included. Steps on the head alone are not included.
    """
    seconds: float
    """The time of the run without compilation, seconds."""
    compile_seconds: float
    """The time of compilation, seconds."""
    loss: tuple[float, float]
    """The mean loss of the avatar before the run, and of the avatar that is returned, over the
    photos that were fitted.
    """
    psnr: tuple[float, float]
    """The PSNR of these two avatars over the crops of the same photos, dB."""
    kept: bool
    """Whether the loss has become smaller. If not, the avatar is unchanged."""
    interrupted: bool = False
    """Whether Ctrl-C ended the run."""
    planned: int | None = None
    """Number of steps that were planned. If a run was limited by seconds, `refine` with the same
    configuration and `steps=planned` repeats it exactly. None: the run was cut short.
    """
    left_out: tuple[str, ...] = ()
    """Names of photos that contradict the others, and were not fitted."""
    head_steps: int = 0
    """Steps of the optimizer on the head alone; 0 if none were made, or if they were not kept."""
    moved: bool = False
    """Whether the photos were warped to the avatar, because the person has moved between them, or
    a pose or a camera is off. If so, `loss` and `psnr` compare with the warped photos.
    """

    def summary(self) -> str:
        """Returns the report as one line of text."""
        gain = f"{self.psnr[0]:.1f} -> {self.psnr[1]:.1f} dB on the photos"
        verdict = gain if self.kept else "no improvement: the avatar is unchanged"
        if self.left_out:
            verdict += f"; without {', '.join(self.left_out)}, which contradicts the others"
        if self.moved:
            verdict += "; the photos differ by pixels from one another, and were moved together"
        head = ""
        if self.head_steps:
            head = f", {self.head_steps} on the head,"
        ended = ", interrupted" if self.interrupted else ""
        took = (
            f"{self.iterations} iterations and {self.steps} steps{head} in {self.seconds:.1f} s "
            f"(compiled in {self.compile_seconds:.1f} s)"
        )
        again = ""
        if self.planned:
            again = f" (the same again: {self.planned}steps)"
        return f"refined by {took}{ended}: {verdict}{again}"


@checked_arguments
def refine(
    avatar: Avatar,
    capture: Capture | PreparedCapture,
    config: RefineConfig | None = None,
    *,
    seconds: float | None = None,
    steps: int | None = None,
    progress: bool = False,
    watch: Callable[[Avatar], None] | None = None,
) -> Avatar:
    """Fits an avatar to the photos of a capture. Returns the fitted avatar, or the avatar itself if
    the fit is no better.

    First come iterations of a learned optimizer, then steps of Adam. Steps on the head alone follow
    if the longer side of the photos has 512 pixels or more (see `RefineConfig.head_steps` for all
    conditions), unless the argument `steps` is above 0, or seconds limit the steps. Views whose
    mask does not show the person are left out, and exposure is made equal, as in `reconstruct`.
    Once the photos are prepared, Ctrl-C ends the run, and the best state until then is returned.
    `refine_with_report` also returns the steps, the seconds and the gain.

    Args:
        avatar: the avatar of the person in the photos, on the body of the capture.
        capture: photos with masks, in any poses, or the result of `prepare_capture`.
        config: the settings. None: `RefineConfig()`.
        seconds: limit in seconds. If `seconds` or `steps` is given, these two arguments replace
            both limits of the configuration. The seconds become a number of steps before the first
            step.
        steps: limit in steps. A run that only steps limit can be repeated exactly on the same
            machine. 0: only iterations and steps on the head.
        progress: show a bar.
        watch: is called with the current avatar after the iterations and at each of the checks. Its
            time counts.

    Returns:
        The refined avatar.

    Raises:
        ValueError: if the capture has no view, no masks, or no view that shows the person, if its
            poses have another number of joints than the avatar, or if the avatar has harmonics or
            deformations. Also if `seconds` or `steps` is out of range.

    Examples:
        >>> sharp = hg.refine(avatar, capture, seconds=15)
    """
    return refine_with_report(
        avatar, capture, config, seconds=seconds, steps=steps, progress=progress, watch=watch
    ).avatar


@checked_arguments
def refine_with_report(
    avatar: Avatar,
    capture: Capture | PreparedCapture,
    config: RefineConfig | None = None,
    *,
    seconds: float | None = None,
    steps: int | None = None,
    progress: bool = False,
    watch: Callable[[Avatar], None] | None = None,
) -> Refinement:
    """Fits an avatar as `refine` does, and returns it with the number of steps, the seconds and the
    gain.

    Arguments and errors are as in `refine`. A run with a given number of steps can be repeated
    exactly on the same machine. If the run was limited by seconds, see `Refinement.planned`.
    """
    config = config or RefineConfig()
    if seconds is not None or steps is not None:
        # the head is sharpened only without other steps, so that `planned` repeats a run of seconds
        head_steps = 0 if steps else config.head_steps
        config = dataclasses.replace(config, seconds=seconds, steps=steps, head_steps=head_steps)
    _check(avatar, capture.capture if isinstance(capture, PreparedCapture) else capture)
    photos = prepare_capture(capture)
    views = crop_to_person(photos, config.image_size)
    clock = Clock(config, progress)
    with clock.compiling():
        task, best, each = prepare(avatar, views, config, clock)
        crops = _crops(task.avatar, photos, config)
    compiler = ThreadPoolExecutor(1)
    if crops is not None:  # compiled beside the programs of the search
        own = dataclasses.replace(config, head_steps=0, iterations=1)
        compiler.submit(sharpened, task.avatar, best.state.trust, crops, own, Clock(own))
    interrupted = False
    try:
        with clock.compiling():
            best = compile_parts(task, best)
        task, each = align(task, best, each)
        for found in search(task, best, each):
            if found.kept:
                best = found
            if watch is not None:
                watch(avatar_of(found.state.parameters, task.avatar))
    except KeyboardInterrupt:
        interrupted = True

    # what the search found is returned only if it is better on the photos that were fitted
    before = jax.tree.map(lambda x: x[best.used], each).together()
    fitted = [task.photos[i] for i in best.used]
    found_there = comparison(task, best.state.parameters, fitted, best.state.splat).together()
    result, after, iterations, head_steps = avatar, before, 0, 0
    if found_there.loss < before.loss:
        result, after = avatar_of(best.state.parameters, task.avatar), found_there
        iterations = best.iterations

    # and so are the steps on the head, by the whole photos, too
    if crops is not None and not interrupted:
        try:
            with clock.compiling():
                compiler.shutdown()
                begin = with_pixel_footprint_of(result, views)
                if len(best.used) < len(task.photos):
                    crops = _crops(begin, photos.select(best.used), config)
            if crops is not None:
                sharp = sharpened(begin, best.state.trust, crops, config, clock)
                drawn = with_pixel_footprint_of(sharp, views)
                sharp_there = avatar_comparison(task, drawn, fitted, best.state.splat).together()
                if sharp_there.loss < after.loss:
                    result, after, head_steps = sharp, sharp_there, config.head_steps
        except KeyboardInterrupt:
            interrupted = True
    seconds = clock.stopped()
    return Refinement(
        result,
        iterations,
        clock.done,
        seconds,
        clock.compile_seconds,
        loss=(float(before.loss), float(after.loss)),
        psnr=(float(before.psnr), float(after.psnr)),
        kept=result is not avatar,
        interrupted=interrupted,
        planned=None if interrupted or clock.late else clock.planned,
        left_out=tuple(np.delete(photos.capture.names, best.used).tolist()),
        head_steps=head_steps,
        moved=task.moved,
    )


def calls_of_refine(
    avatar: Avatar, capture: Capture | PreparedCapture, config: RefineConfig
) -> Iterator[Call]:
    """Yields the programs of a refinement's iterations, so that they can be compiled before it
    begins. Programs of steps are not among them. Yields nothing if there are no iterations or if
    the capture has no masks. Raises: as `prepare_capture`.
    """
    photos = prepare_capture(capture)
    if config.iterations and photos.capture.masks is not None:
        yield from calls_of_photos(avatar, crop_to_person(photos, config.image_size))


def _crops(avatar: Avatar, photos: PreparedCapture, config: RefineConfig) -> Crops | None:
    """Returns crops of the heads in the photos, or None if no steps on the head are made."""
    unlimited = config.seconds is None or config.steps == 0
    if not (config.head_steps and unlimited and shows_heads(photos.capture, config)):
        return None
    return head_crops(avatar, photos, config)


def _check(avatar: Avatar, capture: Capture) -> None:
    if capture.view_count == 0:
        raise ValueError("refine: the capture has 0 views; at least one photo is needed")
    if capture.masks is None:
        raise ValueError(
            "refine: the capture has no masks; without them the background would be fitted, too"
        )
    joints = capture.poses.rotations.shape[1]
    if joints != len(avatar.parents):
        raise ValueError(
            f"refine: the capture's poses have {joints} joints, the avatar has"
            f" {len(avatar.parents)}"
        )
