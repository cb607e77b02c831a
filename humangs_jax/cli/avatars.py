"""The commands `humangs demo`, `reconstruct`, `refine` and `tune`, which make avatars from
photos.
"""

import dataclasses
import functools
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from tyro.conf import Positional

from humangs_jax.cli.options import (
    AVATAR,
    OutputPath,
    Preset,
    Side,
    UsageError,
    chosen_settings,
    first_refinement,
    off,
    refine_limits,
    require_place,
    shard_of,
)
from humangs_jax.cli.screen import bar, stage, suggest, tell, warn, wrote
from humangs_jax.core.configuration import Range, at_least
from humangs_jax.refinement.config import ITERATIONS, RefineConfig

if TYPE_CHECKING:
    from humangs_jax.avatar.avatar import Avatar
    from humangs_jax.data.prepared import PreparedCapture


@dataclasses.dataclass(frozen=True)
class Demo:
    """Try everything on the shipped person.

    Reconstructs and refines an avatar, renders held-out views, animates, and writes all files at
    the end.
    """

    examples: ClassVar[tuple[str, ...]] = (
        "humangs demo --out demo_out",
        "humangs demo --refine 0 --preset realtime",
    )
    out: Annotated[Path, OutputPath()] = Path("demo_out")
    """Folder for the images, the video, the avatar and report.json."""
    weights: Path | None = None
    """Network weights (.safetensors). Default: the shipped ones."""
    size: Side = 256
    """Side of the animation's frames in pixels."""
    refine: str | None = None
    """How long to fit the avatar to its photos: 15s (or 15), 100steps, or 0.

    Default: 15s, or as --preset says.
    """
    preset: Preset | None = None
    """Preset, from fast to accurate (docs: tradeoff), for photos, network, refinement and
    splatting. --refine overrides the refinement.
    """

    def run(self) -> None:
        refine = first_refinement("15s" if self.refine is None else self.refine)
        with stage("starting"):
            from humangs_jax.apps.demo import run_demo, summary

        settings = chosen_settings(self.preset, None)
        if settings is not None and self.refine is None:
            refine = settings.refinement
        report = run_demo(self.out, self.weights, self.size, refine, settings)
        wrote(self.out, summary(report))
        suggest("open", self.out / "avatar.html", "in a browser")
        suggest("humangs view", self.out / "avatar.npz")


@dataclasses.dataclass(frozen=True)
class Reconstruct:
    """Reconstruct avatars from capture folders.

    A capture is photos, cameras and body poses. Several captures, or a folder of them, become
    OUT/NAME.npz. Avatars that exist are kept, so after an interruption the same command goes on. If
    a capture was changed since its avatar was made, the avatar is named and nothing is made. A
    capture that fails does not stop the others. docs: capture_format.
    """

    examples: ClassVar[tuple[str, ...]] = (
        "humangs reconstruct me --refine 15s --out sharp.npz",
        "humangs reconstruct people --out avatars --shard 0/8",
    )
    captures: Positional[tuple[Path, ...]]
    """Folders with capture.json, or folders of such folders. "demo_capture" is the shipped one."""
    out: Path | None = None
    """The avatar file to write or replace (default: avatar.npz), or for several captures a folder
    (default: avatars).
    """
    views: Annotated[int | Literal["auto"] | None, at_least(1)] = None
    """How many photos to use: those that together show most of the body. auto: photos that add
    something. Default: all.
    """
    weights: Path | None = None
    """Network weights (.safetensors). Default: the shipped ones."""
    tokens: Literal["as_trained", "all", "foreground"] = "as_trained"
    """The patches that the network reads: all, or only those that show the person, which is several
    times faster (docs: performance).
    """
    dtype: Literal["as_trained", "float32", "bfloat16", "float16"] = "as_trained"
    """Number type of the encoder's matrix products. 16-bit types are faster on GPU and TPU."""
    refine: str | None = None
    """How long to fit the avatar to its photos: 15s (or 15), 100steps, or 0.

    Default, with masks: iterations and the head.
    """
    preset: Preset | None = None
    """Preset, from fast to accurate (docs: tradeoff), for photos, network and refinement, where the
    options above are not given.
    """
    config: Path | None = None
    """Like --preset, with the settings in a file of `humangs tune`."""
    batch: Annotated[int | None, at_least(1)] = None
    """Number of captures that the network reads at once. Default: 8."""
    shard: str = "0/1"
    """I/N: the I-th of N parts of the captures, counted from 0, for job arrays."""
    fit_masks: Annotated[
        bool, off("move masks that are too large or too small to the edges in the photos")
    ] = True
    """Move masks that are too large or too small to the edges in the photos."""
    check: Annotated[bool, off("check first whether photos, cameras and poses belong together")] = (
        True
    )
    """Check first whether photos, cameras and poses belong together."""

    def run(self) -> None:
        how = first_refinement(self.refine)
        part, parts = shard_of(self.shard)
        if not self.captures:
            raise UsageError("CAPTURES: expected at least one folder with capture.json")
        # one capture gives a file, several give a folder of files
        captures = _capture_folders(self.captures)
        several = tuple(captures.values()) != self.captures[:1]
        out = self.out or Path("avatars" if several else "avatar.npz")
        if several and out.suffix == ".npz":
            raise UsageError(f"--out {out}: expected a folder for the avatars of several captures")
        if parts > 1 and not several:
            raise UsageError(
                f"--shard {self.shard}: expected several captures, or a folder of them"
            )
        require_place(out, "--out", OutputPath() if several else AVATAR)
        with stage("starting"):
            from humangs_jax.avatar.reconstruct import BATCH, reconstruct_batch
            from humangs_jax.avatar.unseen import guess_line
            from humangs_jax.data.capture import capture_checksum
            from humangs_jax.network.weights import load_weights

            settings = chosen_settings(self.preset, self.config)
        # --refine and --views win over --preset and --config
        views = self.views
        if settings is not None and self.refine is None:
            how = settings.refinement
        if settings is not None and self.views is None:
            views = settings.views
        if several:
            captures = self._unmade(out, captures, part, parts)
        # captures are read when it is their turn
        sources: dict[str, str] = {}

        def prepared_capture(name: str, folder: Path) -> "PreparedCapture":
            if several:
                sources[name] = capture_checksum(folder)
            return self._read(folder, views)

        load = {
            name: functools.partial(prepared_capture, name, folder)
            for name, folder in captures.items()
        }
        # what is wrong with the only one is reported before the network is read
        if not several:
            (name, read), *_ = load.items()
            only = read()
            load = {name: lambda: only}
        with stage("loading the network"):
            variables, config = load_weights(self.weights)
        if settings is not None:
            config = settings.network(config)
        runtime = {"tokens": self.tokens, "dtype": self.dtype}
        config = config.with_runtime(
            **{name: value for name, value in runtime.items() if value != "as_trained"}
        )
        failed = []
        with stage("reconstructing"):
            made = reconstruct_batch(variables, config, [*load.values()], self.batch or BATCH)
            named = bar(
                zip(load, made, strict=True), total=len(load), shown=several, desc="reconstruct"
            )
            for name, (prepared, avatar, error) in named:
                # one of several that fails does not stop the others
                if error is not None and not several:
                    raise error
                if error is not None:
                    failed.append(name)
                    warn(f"{name}: {error}")
                    continue
                refinement = how
                if how is not None and prepared.capture.masks is None:
                    tell(f"{name}: no masks: the avatar is not refined")
                    refinement = None
                # in a set a file is a finished avatar: one that was interrupted is made again
                _refine_and_save(
                    avatar,
                    prepared,
                    out / f"{name}.npz" if several else out,
                    refinement,
                    unfinished=not several,
                    made_from=sources.get(name),
                )
                guess = guess_line(prepared.capture)
                if guess is not None:
                    tell(f"{name}: {guess}" if several else guess)
        if not several:
            suggest("humangs view", out)
        if failed:
            raise ValueError(f"{len(failed)} of {len(load)} captures failed: {', '.join(failed)}")

    def _unmade(
        self, out: Path, captures: dict[str, Path], part: int, parts: int
    ) -> dict[str, Path]:
        """Returns the captures of one part of a set that have no avatar yet.

        part, parts: index of the part, and number of parts.

        Raises: CaptureError if an avatar of this part was made from other contents than its capture
        has now, or if the set was made with other settings. FileError if an avatar cannot be read.
        """
        self._begin_set(out)
        done = {name for name in captures if (out / f"{name}.npz").exists()}
        if done:
            tell(f"{out}: {len(done)} of {len(captures)} avatars are there")
        captures = dict(list(captures.items())[part::parts])
        for name in done & captures.keys():
            _check_source(out / f"{name}.npz", captures.pop(name))
        return captures

    def _begin_set(self, out: Path) -> None:
        """Checks that the set in `out` was made with these settings and this version of the
        package, and records them if it is new. The fields `captures`, `out`, `batch`, `shard` and
        `check` do not count.

        Raises: CaptureError if it was made with others, or if `out` has a set of another kind.
        """
        from humangs_jax import __version__
        from humangs_jax.data.sets import AVATARS, SETTINGS, begin_set
        from humangs_jax.io.arrays import SHORT, file_checksum
        from humangs_jax.network.weights import shipped_checksum

        apart = ("captures", "out", "batch", "shard", "check")
        made_with = {name: str(value) for name, value in vars(self).items() if name not in apart}
        made_with["version"] = __version__
        if self.weights is None:
            made_with["weights"] += f" ({shipped_checksum()[:SHORT]})"
        for name in ("weights", "config"):  # other contents under the same name are other settings
            file = getattr(self, name)
            if file is not None and file.is_file():
                made_with[name] += f" ({file_checksum(file)[:SHORT]})"
        begin_set(out, AVATARS, {SETTINGS: made_with})

    def _read(self, folder: Path, views: int | str | None) -> "PreparedCapture":
        """Reads the views of a capture that the network is to use.

        Raises: as `_read_capture`; UsageError for --refine without masks.
        """
        prepared = _read_capture(folder, self.check, self.fit_masks, views)
        if self.refine not in (None, "0") and prepared.capture.masks is None:
            raise UsageError(f"--refine {self.refine}: needs masks, and {folder} has none")
        if prepared.chosen:
            tell(f"photos: {', '.join(prepared.capture.names)}")
        return prepared


@dataclasses.dataclass(frozen=True)
class Refine:
    """Fit an avatar to the photos of a capture.

    Iterations of the learned optimizer come first, then gradient descent. Ctrl-C ends it early, and
    the best avatar so far is written.
    """

    examples: ClassVar[tuple[str, ...]] = (
        "humangs refine avatar.npz me --refine 15s --out sharp.npz",
        "humangs refine avatar.npz me --refine 60s",
    )
    avatar: Positional[Path]
    """File written by `humangs reconstruct` from these photos."""
    capture: Positional[Path]
    """Folder with capture.json. It may have more or larger photos than the network saw."""
    out: Annotated[Path, AVATAR] = Path("refined.npz")
    """The avatar file to write or replace."""
    refine: str = "15s"
    """How long to refine, without compilation: 15s (or 15), 100steps, or 0steps for iterations and
    steps on the head only.
    """
    iterations: Annotated[int, Range(0, 16)] = ITERATIONS
    """Iterations of the learned optimizer before the steps."""
    image_size: Side | None = None
    """Reduce photos whose longer side exceeds this, pixels. Default: no photo is reduced."""
    fit_masks: Annotated[
        bool, off("move masks that are too large or too small to the edges in the photos")
    ] = True
    """Move masks that are too large or too small to the edges in the photos."""
    check: Annotated[bool, off("check first whether photos, cameras and poses belong together")] = (
        True
    )
    """Check first whether photos, cameras and poses belong together."""

    def run(self) -> None:
        limits = refine_limits(self.refine)
        if limits["steps"] == 0 and not self.iterations:
            raise UsageError("--iterations 0: expected 1 to 16, without steps")
        with stage("starting"):
            from humangs_jax.avatar.avatar import Avatar

            avatar = Avatar.load(self.avatar)
        prepared = _read_capture(self.capture, self.check, self.fit_masks)
        how = RefineConfig(iterations=self.iterations, image_size=self.image_size, **limits)
        _refine_and_save(avatar, prepared, self.out, how)
        suggest("humangs view", self.out)


def _capture_folders(given: tuple[Path, ...]) -> dict[str, Path]:
    """Returns the capture folders by name: given folders that are captures, and captures inside of
    other given folders. A given folder without captures is returned, too.

    Raises: UsageError if a folder is given twice, or if two captures have the same name.
    """
    folders = []
    for path in given:
        inside = []
        if not (path / "capture.json").is_file():
            inside = sorted(path.glob("*/capture.json"))
        folders += [file.parent for file in inside if not file.parent.name.startswith(".")] or [
            path
        ]

    # the avatars are named after the captures
    named: dict[str, Path] = {}
    for folder in folders:
        name = folder.absolute().name
        if name in named and named[name] == folder:
            raise UsageError(f"{folder}: given twice")
        if name in named:
            raise UsageError(f"{named[name]} and {folder}: expected captures of different names")
        named[name] = folder
    return named


def _check_source(avatar: Path, capture: Path) -> None:
    """Checks that an avatar was made from the present content of its capture.

    Raises: CaptureError, which names both, if it was not; FileError if the avatar cannot be read.
    """
    from humangs_jax.avatar.avatar import recorded_source
    from humangs_jax.data.capture import capture_checksum
    from humangs_jax.data.capture_checks import CaptureError

    if recorded_source(avatar) != capture_checksum(capture):
        problem = (
            f"made from other contents than {capture} has now: move it away, or choose another"
            " --out"
        )
        raise CaptureError(avatar, "made_from", problem)


def _read_capture(
    path: Path, check: bool, fit_masks: bool = True, views: int | str | None = None
) -> "PreparedCapture":
    """Reads the views of a capture that show the person, and warns about what looks wrong.

    check: whether to check photos, cameras and poses. fit_masks: whether to move masks to the edges
    in the photos, and to look for what is in front of the person. views: as --views of
    `reconstruct`. None: all views that show the person.

    Raises: as `load_capture`; ValueError if no view shows the person.
    """
    with stage("reading the capture"):
        from humangs_jax.data.capture import load_capture
        from humangs_jax.data.hidden import hidden_line, with_hidden_parts
        from humangs_jax.data.prepared import prepare_capture

        capture = load_capture(path, fit_masks=fit_masks)
    if fit_masks:
        with stage("looking for what is in front of the person"):
            seen = with_hidden_parts(capture)
        line = hidden_line(capture, seen)
        if line is not None:
            warn(line)
        capture = seen
    # where nobody is found, the check still says what is likely wrong
    prepared, nobody = None, None
    with stage("preparing the photos"):
        try:
            prepared = prepare_capture(capture, views=views)
        except ValueError as error:
            nobody = error
    if check:
        with stage("checking it"):
            from humangs_jax.apps.quick_check import likely_mistakes

            mistakes = likely_mistakes(capture if prepared is None else prepared.shown)
        for mistake in mistakes:
            warn(mistake)
        if mistakes and nobody is None:
            warn(f"go on at your own risk: `humangs check {path}` draws the body over each photo")
    if prepared is None:
        assert nobody is not None
        raise nobody
    return prepared


def _refine_and_save(
    avatar: "Avatar",
    prepared: "PreparedCapture",
    out: Path,
    how: "RefineConfig | None",
    unfinished: bool = True,
    made_from: str | None = None,
) -> None:
    """Refines an avatar with a progress bar, and writes it.

    how: None for no refinement. unfinished: whether the avatar is written even if its refinement
    was interrupted. made_from: checksum of the capture, which is recorded in the file.

    Raises: KeyboardInterrupt, at the end, if the refinement was interrupted.
    """
    if how is None:
        _save(avatar, out, f"from {prepared.capture.view_count} photos", made_from)
        return
    with stage("refining"):
        from humangs_jax.refinement.refine import refine_with_report

        refinement = refine_with_report(avatar, prepared, how, progress=True)
    if refinement.interrupted and not unfinished:
        tell(f"{out}: not written, its refinement was interrupted: the same command makes it again")
        raise KeyboardInterrupt
    done = f"from {prepared.capture.view_count} photos, {refinement.summary()}"
    _save(refinement.avatar, out, done, made_from)
    if refinement.interrupted:
        raise KeyboardInterrupt


def _save(avatar: "Avatar", out: Path, how: str, made_from: str | None) -> None:
    with stage("writing"):
        avatar.save(out, made_from=made_from)
    wrote(out, f"{len(avatar.gaussians.means):,} Gaussians {how}")


@dataclasses.dataclass(frozen=True)
class Tune:
    """Find the best preset within a budget of time or memory.

    Presets are timed on this machine with this person, without compilation. The result is for
    --config of `reconstruct`, `animate` and `render`. If no preset is within the budget, nothing is
    written and the exit code is 1. docs: tradeoff.
    """

    examples: ClassVar[tuple[str, ...]] = (
        "humangs tune me --frame-ms 33 --out realtime.json",
        "humangs tune me --reconstruct-ms 2000 --memory-mb 500",
    )
    capture: Positional[Path]
    """Folder with capture.json; "demo_capture" is the shipped one."""
    out: Annotated[Path, OutputPath((".json",))] = Path("tuned.json")
    """The settings to write."""
    reconstruct_ms: float | None = None
    """Longest time to make the avatar, with refinement, milliseconds."""
    frame_ms: float | None = None
    """Longest time of a frame, milliseconds. 33 is 30 frames per second."""
    memory_mb: float | None = None
    """Most memory that the work may add to the process, MiB."""
    size: Side = 512
    """Side of the frames in pixels."""
    weights: Path | None = None
    """Network weights (.safetensors). Default: the shipped ones."""

    def run(self) -> None:
        # without a limit there is nothing to choose by
        budgets: dict[str, Any] = {
            "reconstruct_ms": self.reconstruct_ms,
            "frame_ms": self.frame_ms,
            "memory_mb": self.memory_mb,
        }
        if all(value is None for value in budgets.values()):
            raise UsageError(
                "--reconstruct-ms, --frame-ms, --memory-mb: expected at least one of them"
            )
        for name, value in budgets.items():
            if value is not None and not value > 0:
                raise UsageError(f"--{name.replace('_', '-')} {value}: expected a positive number")
        with stage("starting"):
            from humangs_jax.apps.settings import save_settings, tune
            from humangs_jax.network.weights import load_weights

        # the photos are checked by `humangs check`, not here
        prepared = _read_capture(self.capture, check=False)
        with stage("loading the network"):
            variables, config = load_weights(self.weights)
        with stage("measuring"):
            tuned = tune(
                variables, config, prepared.shown, **budgets, size=self.size, progress=True
            )
        # the file keeps what was measured beside the settings
        costs = {name: dataclasses.asdict(cost) for name, cost in tuned.measured.items()}
        about = {
            "name": tuned.name,
            "budget": budgets,
            "frame_size": self.size,
            "measured": costs,
        }
        save_settings(self.out, tuned.settings, **about)
        tell(tuned)
        wrote(self.out, "settings")
        weights = ()
        if self.weights is not None:
            weights = "--weights", self.weights
        suggest("humangs reconstruct", self.capture, "--config", self.out, *weights)
