"""The `humangs` command line. Each command is a function below; tyro makes its options from the signature.

What the user got wrong (a capture, a file, an option) ends in one line on stderr and exit code 2; nothing is written then.
"""

import dataclasses
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import tyro

from humangs_jax.core.allocator import keep_freed_memory

Positional = tyro.conf.Positional


def demo(out: Path = Path("demo_out"), weights: Path | None = None, size: int = 256) -> None:
    """Reconstruct the person that ships with the package from four photos, look at them anew, animate them.

    Args:
        out: folder for the pictures, the video, the avatar and report.json.
        weights: network weights (.safetensors); the shipped ones if not given.
        size: side of the animation's frames in pixels.
    """
    from humangs_jax.apps.demo import run_demo

    run_demo(out, weights=weights, frame_size=size)


def reconstruct(
    capture: Positional[Path],
    out: Path = Path("avatar.npz"),
    weights: Path | None = None,
    tokens: Literal["as_trained", "all", "foreground"] = "as_trained",
    dtype: Literal["as_trained", "float32", "bfloat16"] = "as_trained",
) -> None:
    """Reconstruct an avatar from a capture folder (photos, cameras, body poses: docs/capture_format.md).

    Args:
        capture: folder with capture.json.
        out: the avatar file to write.
        weights: network weights (.safetensors); the shipped ones if not given.
        tokens: the patches of the photos that the network looks at: all, or those that the person touches, which is several
            times faster. For weights that were trained with the other setting it is an approximation (docs/performance.md).
        dtype: of the encoder's products; bfloat16 is faster on GPU and TPU.
    """
    from humangs_jax.avatar.reconstruct import reconstruct as run
    from humangs_jax.data.capture import load_capture
    from humangs_jax.network.weights import load_weights

    photos = load_capture(capture)
    _require_parent(out)
    variables, config = load_weights(weights)
    if tokens != "as_trained":
        config = dataclasses.replace(config, tokens=tokens)
    if dtype != "as_trained":
        config = dataclasses.replace(config, dtype=dtype)
    avatar = run(variables, config, photos)
    avatar.save(out)
    print(f"{out}: {len(avatar.gaussians.means):,} Gaussians from {len(photos.images)} photos")


def animate(
    avatar: Positional[Path],
    motion: Path | None = None,
    out: Path = Path("animation.mp4"),
    size: int = 512,
    azimuth: float = 20.0,
    turn: float = 0.0,
) -> None:
    """Animate an avatar with a motion of SMPL-X poses and write a video (.mp4 or .gif).

    Args:
        avatar: file written by `humangs reconstruct`.
        motion: .npz (ours, AMASS, AIST++, THuman4.0, AvatarReX) or LHM's .json; the shipped walk if not given.
        out: the video to write.
        size: side of the frames in pixels.
        azimuth: degrees; 0 looks at the avatar's front.
        turn: degrees the camera travels around the avatar during the motion.
    """
    from humangs_jax.avatar.avatar import Avatar
    from humangs_jax.avatar.frames import motion_frames
    from humangs_jax.avatar.video import write_video
    from humangs_jax.data.motion import load_motion

    _require_parent(out)
    _require_suffix(out, (".mp4", ".gif"))
    person, poses = Avatar.load(avatar), load_motion(motion)
    frames = motion_frames(person, poses, size, azimuth=azimuth, turn=turn)
    write_video(out, frames, poses.fps)
    print(f"{out}: {len(frames)} frames at {poses.fps:g} frames per second")


def render(
    avatar: Positional[Path],
    out: Path = Path("views"),
    views: int = 8,
    size: int = 512,
    capture: Path | None = None,
    exr: bool = False,
) -> None:
    """Draw an avatar in its T-pose from a circle of cameras, or in the poses and from the cameras of a capture.

    Args:
        avatar: file written by `humangs reconstruct`.
        out: folder for view_000.png and so on.
        views: number of cameras on the circle.
        size: side of the images in pixels (circle only).
        capture: take cameras and poses from this capture folder instead.
        exr: also write views.exr: float32 RGBA, depth Z and camera matrices, one part per view.
    """
    from humangs_jax.avatar.avatar import Avatar
    from humangs_jax.avatar.frames import capture_renderings, turntable_renderings, write_renderings
    from humangs_jax.data.capture import load_capture

    person = Avatar.load(avatar)
    if capture is not None:
        cameras, renderings = capture_renderings(person, load_capture(capture))
    else:
        cameras, renderings = turntable_renderings(person, views, size)
    written = write_renderings(out, cameras, renderings, exr=exr)
    print(f"{out}: {written} views")


def export(
    avatar: Positional[Path],
    out: Path = Path("avatar.ply"),
    motion: Path | None = None,
    frame: int = 0,
    rest: bool = False,
) -> None:
    """Export an avatar as a 3DGS .ply that Gaussian viewers open, in the T-pose or in one frame of a motion.

    Args:
        avatar: file written by `humangs reconstruct`.
        out: the .ply to write.
        motion: pose it by this motion.
        frame: which frame of the motion.
        rest: add the 45 zero f_rest fields that some importers (Unity) want.
    """
    from humangs_jax.avatar.animate import animate as pose_avatar
    from humangs_jax.avatar.avatar import Avatar
    from humangs_jax.avatar.export import write_ply
    from humangs_jax.data.motion import load_motion

    _require_parent(out)
    _require_suffix(out, (".ply",))
    person = Avatar.load(avatar)
    gaussians = person.gaussians
    if motion is not None:
        poses = load_motion(motion)
        if not 0 <= frame < len(poses.translations):
            raise ValueError(f"{motion}: frame {frame} asked for, but it has {len(poses.translations)} frames")
        gaussians = pose_avatar(person, poses.pose(frame))
    write_ply(out, gaussians, spherical_harmonics_rest=rest)
    print(f"{out}: {len(gaussians.means):,} Gaussians")


def synth(
    out: Path = Path("synthetic_people"),
    subjects: int = 8,
    split: Literal["train", "validation", "test", "demo"] = "train",
    first: int = 0,
    size: int = 512,
    views: int = 60,
    close_views: int = 12,
    poses: int = 1,
    held_out: int = 0,
    depth: bool = False,
    maps: bool = False,
    scans: bool = False,
    sequences: bool = False,
    frames: int = 60,
    for_training: bool = False,
    workers: int | None = None,
) -> None:
    """Make synthetic clothed people and write them as capture folders. Can be interrupted and resumed, or added to.

    Args:
        out: folder for one capture folder per subject and manifest.json.
        subjects: how many.
        split: the seeds of the splits never overlap.
        first: number of the first subject within the split.
        size: side of the photos in pixels: 128, 256, 512 (a set of 512 is read at all three).
        views: photos of each pose, around the person, 1.8 to 2.2 bounding radii away.
        close_views: further ones of each pose, 0.8 to 1.7 radii away, of parts of the person.
        poses: per subject.
        held_out: views of the first pose from yet other cameras, in the sub-folder held_out/.
        depth: also write 16-bit depth maps, depth/NAME.png (steps of 0.1 mm).
        maps: also write maps/NAME.exr: float32 colours, coverage, depth, positions in T-pose, the camera in the header.
        scans: also write scan/: the first pose as a textured mesh, OBJ and GLB.
        sequences: the poses are frames of a walk, a turn or a reach, which is written as motion.npz.
        frames: length of that motion, 30 a second.
        for_training: short for 2 poses x 12 views at 256 pixels and no others, enough for `humangs train`.
        workers: processes; as many as there are cores if not given.
    """
    from humangs_jax.people.writer import Layout, write_set

    counts = {"subjects": subjects, "size": size, "views": views, "poses": poses, "frames": frames}
    if wrong := [name for name, count in counts.items() if count < 1]:
        raise ValueError(f"--{wrong[0]} {counts[wrong[0]]}: expected at least 1")
    counts = {"first": first, "close-views": close_views, "held-out": held_out}
    if wrong := [name for name, count in counts.items() if count < 0]:
        raise ValueError(f"--{wrong[0]} {counts[wrong[0]]}: expected at least 0")
    if sequences and poses > frames:
        raise ValueError(f"--poses {poses}: a motion of --frames {frames} has no more of them")
    layout = Layout(
        size,
        poses,
        views,
        close_views,
        held_out,
        frames=frames if sequences else 0,
        depth=depth,
        maps=maps,
        scan_texture=2048 if scans else 0,
    )
    if for_training:
        layout = Layout(256, poses=2, views=12)
    if workers is None:
        workers = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    folders = write_set(out, subjects, layout, split, first, workers=workers)
    print(f"{out}: {len(folders)} people")


def check(
    capture: Positional[Path],
    out: Path = Path("check.png"),
    keypoints: Path | None = None,
    person: int | None = None,
) -> None:
    """Draw the posed body over each photo of a capture: wrong pose or camera conventions show at a glance.

    A capture that `humangs fit` made also shows its keypoints, how far off the body is, and what the views do not determine.

    Args:
        capture: folder with capture.json.
        out: the contact sheet to write; of the keypoints, NAME_fit.png beside it.
        keypoints: look at these keypoints instead of those that were fitted.
        person: which person of the keypoint file, from 0, where it has several in a view.
    """
    from humangs_jax.apps.check import check_capture
    from humangs_jax.data.capture import load_capture
    from humangs_jax.data.photographs import capture_folder
    from humangs_jax.fitting.files import FIT_FILE, read_fit_record

    photos = load_capture(capture)
    _require_parent(out)
    record_file = capture_folder(capture) / FIT_FILE
    record, found = None, None
    if keypoints is not None:
        from humangs_jax.fitting.commands import read_keypoints_of

        found = read_keypoints_of(photos, keypoints, person)
    elif record_file.exists():
        record = read_fit_record(record_file)
    print(check_capture(photos, out))
    if record is not None or found is not None:
        from humangs_jax.apps.fit_pictures import fit_sheet
        from humangs_jax.fitting.examination import examine_record

        examination, found = examine_record(photos, record, found)
        sheet = out.with_name(f"{out.stem}_fit{out.suffix}")
        fit_sheet(photos, found, examination, sheet)
        print(f"\n{examination.report}\n{sheet}: the keypoints over the photos")


def fit(
    capture: Positional[Path | None] = None,
    keypoints: Path | None = None,
    scan: Path | None = None,
    joints: Path | None = None,
    views: Path | None = None,
    height: float | None = None,
    bare: bool = False,
    refine: bool = False,
    photometric: bool = False,
    body: Path | None = None,
    person: int | None = None,
    smoothness: float = 0.0,
    out: Path | None = None,
    overwrite: bool = False,
) -> None:
    """Find the body of one's own photos: from keypoints of a detector, or inside of a scan; or refine what is there.

    humangs fit CAPTURE --keypoints FILE: shape and poses from photos with cameras (humangs import cameras) and 2D keypoints.
    humangs fit CAPTURE --refine: polish cameras and poses of a capture against its masks. humangs fit --scan MESH --out FOLDER.

    Args:
        capture: folder with capture.json; its body.npz need not exist.
        keypoints: of OpenPose, COCO, COCO-WholeBody, MMPose or AlphaPose, a file or folder (docs/fitting.md).
        scan: a mesh with a person in it, of any scale and orientation.
        joints: 3D landmarks of the scan by name (.json or .npz); without these and --views, the pose is searched.
        views: folder of pictures of the scan, which are drawn there; then, with --keypoints, those that the keypoints are of.
        height: of the person in the scan without shoes, metres, which gives the scan its unit.
        bare: the scan wears no clothes.
        refine: polish cameras and poses; with --keypoints, against these too. Never worse than the start.
        photometric: also compare photos and renderings of a reconstruction while refining.
        body: model file (SMPL-X .npz or .pkl); the shipped body if not given.
        person: which person of the keypoint file, from 0, where it has several in a view.
        smoothness: metres per frame squared that joints accelerate by, for sequences (0.005 at 30 frames a second); 0: frames are
            fitted one by one.
        out: folder for the result; the capture folder itself if not given.
        overwrite: replace what is there.
    """
    from humangs_jax.fitting.commands import fit_from_keypoints, fit_from_scan, refine_in_place

    if scan is not None:
        if capture is not None:
            raise ValueError("give either a CAPTURE folder or --scan MESH, not both")
        if refine or photometric or smoothness:
            raise ValueError("--refine, --photometric and --smoothness are for captures, not for --scan")
        given = {"joints": joints, "views": views, "keypoints": keypoints, "person": person, "height": height}
        fit_from_scan(scan, out, body=body, bare=bare, overwrite=overwrite, **given)
        return
    if capture is None:
        raise ValueError("give either a CAPTURE folder or --scan MESH")
    scans_only = {"--joints": joints, "--views": views, "--height": height, "--bare": bare or None}
    if wrong := [option for option, value in scans_only.items() if value is not None]:
        raise ValueError(f"{wrong[0]} is for --scan, not for captures")
    if photometric and not refine:
        raise ValueError("--photometric is a way to refine: add --refine")
    if refine:
        if body is not None or smoothness:
            raise ValueError("--body and --smoothness are for --keypoints; --refine keeps the capture's body")
        refine_in_place(capture, out, keypoints=keypoints, person=person, photometric=photometric, overwrite=overwrite)
        return
    if keypoints is None:
        raise ValueError("--keypoints FILE is missing (or --refine, to polish the body that a capture has)")
    if not smoothness >= 0:
        raise ValueError(f"--smoothness {smoothness}: expected at least 0")
    fit_from_keypoints(capture, keypoints, out, body=body, person=person, smoothness=smoothness, overwrite=overwrite)


def import_cameras(
    what: Positional[Literal["cameras"]],
    source: Positional[Path],
    images: Path,
    out: Path,
    masks: Path | None = None,
    scale: float | None = None,
    up: str | None = None,
    pixel_centers: Literal["integer", "half"] | None = None,
    overwrite: bool = False,
) -> None:
    """Make a capture folder from calibrated cameras: COLMAP text, OpenCV YAML or JSON, calibration_full.json, transforms.json.

    Then `humangs fit` finds the body. Conventions of every format: docs/cameras.md.

    Args:
        what: "cameras".
        source: file or folder with the calibration; its format is detected.
        images: folder of the photos.
        out: the capture folder to write.
        masks: folder of masks, named like the photos.
        scale: metres per unit of the source.
        up: axis of the source's world that points up, like --up=+z or --up=-y.
        pixel_centers: where the source has the centre of the first pixel: at 0 (integer) or 0.5 (half).
        overwrite: replace the capture folder.
    """
    from humangs_jax.data.calibration.importing import import_cameras as run

    print(run(source, images, out, masks=masks, scale=scale, up=up, pixel_centers=pixel_centers, overwrite=overwrite))


def train(
    data: Positional[Path | None] = None,
    out: Path = Path("runs/train"),
    config: str = "small",
    live: int = 0,
    validation: Path | None = None,
    steps: int | None = None,
    init_weights: Path | None = None,
    vgg19: Path | None = None,
    lpips_backbone: Path | None = None,
    lpips_heads: Path | None = None,
    lpips_net: Literal["vgg", "alex", "squeeze"] = "vgg",
    fsdp: int | None = None,
    distributed: bool = False,
    coordinator: str | None = None,
    processes: int | None = None,
    process: int | None = None,
    diagnose: bool = False,
) -> None:
    """Train a network on capture folders (`humangs synth --for-training`), on all devices. Continues a run that is in --out.

    Args:
        data: folder of capture folders.
        out: checkpoints, log, TensorBoard curves, validation pictures and weights.safetensors.
        config: small, paper, published or tiny, or a JSON file of settings like the config.json of a run.
        live: also (or without DATA only) train on so many synthetic people who are drawn anew for every step.
        validation: folder of capture folders of other people, looked at now and then.
        steps: length of the run; that of the configuration if not given.
        init_weights: start from these weights, and their network, instead of fresh ones.
        vgg19: weights of VGG-19 for the perceptual loss (docs/loss_networks.md); without, it is left out.
        lpips_backbone: weights of the network under LPIPS, for the loss and for validation; without, LPIPS is missing.
        lpips_heads: the linear heads of LPIPS, where the backbone's file does not have them.
        lpips_net: which network LPIPS is on.
        fsdp: how many devices share one copy of parameters and moments; all if not given.
        distributed: this is one of several processes (docs/scaling.md), as SLURM or a TPU pod tells, or as follows.
        coordinator: HOST:PORT of process 0.
        processes: how many there are.
        process: which this is.
        diagnose: train nothing, but repeat the first step of the run that failed (or the next one) and name the first stage
            whose numbers are not finite.
    """
    from humangs_jax.training.processes import join_processes

    if distributed or coordinator is not None:
        join_processes(coordinator, processes, process)
    from humangs_jax.body.library import load_body
    from humangs_jax.network.weights import load_weights
    from humangs_jax.objectives.loss_networks import load_loss_networks
    from humangs_jax.people.written import find_people
    from humangs_jax.training.diagnose import diagnose_run
    from humangs_jax.training.launch import fitting_losses, read_config, training_people
    from humangs_jax.training.loop import train as run

    networks = load_loss_networks(vgg19, lpips_backbone, lpips_heads, lpips_net)
    settings = fitting_losses(read_config(config), networks)
    if steps is not None:
        settings = dataclasses.replace(settings, steps=steps)
    variables = None
    if init_weights is not None:
        variables, model = load_weights(init_weights)
        settings = dataclasses.replace(settings, model=model)
    body = load_body()
    people = training_people(data, live, out, body)
    if diagnose:
        print(diagnose_run(out, body, people, networks=networks, variables=variables))
        return
    others = find_people(validation, None) if validation is not None else ()
    run(settings, body, people, out, validation=others, variables=variables, networks=networks, fsdp=fsdp)


def convert(
    checkpoint: Positional[Path],
    out: Path = Path("weights.safetensors"),
    losses: Path | None = None,
    head_width: int | None = None,
    pool: Literal["all", "visible"] = "all",
    dtype: Literal["float32", "float16"] = "float32",
) -> None:
    """Convert a checkpoint of the published network (.pt, read without torch, or .safetensors) into our weights.

    Sizes and parts of the network are read off the shapes; everything else is as in the preset `published`.

    Args:
        checkpoint: .pt with a state dict under 'model', or that state dict as .safetensors.
        out: the weights file to write.
        losses: also write the loss networks that the checkpoint carries (VGG-19, LPIPS), for training and evaluation.
        head_width: features per attention head, where no shape tells it (networks without q_norm and k_norm).
        pool: average a vertex's features over all views (as released) or over those that see it.
        dtype: to store; float16 halves the file.
    """
    from safetensors.numpy import save_file

    from humangs_jax.io.atomic import replace_file
    from humangs_jax.network.conversion import LOSS_PREFIX, describe, load_checkpoint
    from humangs_jax.network.weights import save_weights
    from humangs_jax.objectives.loss_networks import collect_loss_networks

    for option, path in (("--out", out), ("--losses", losses)):
        if path is None:
            continue
        _require_parent(path, option)
        _require_suffix(path, (".safetensors",), option)
        if path.exists() and checkpoint.exists() and path.samefile(checkpoint):
            raise ValueError(f"{option} {path} is the checkpoint itself")
    if losses is not None and losses.resolve() == out.resolve():
        raise ValueError(f"--losses {losses}: the same file as --out")
    networks, names = ({}, []) if losses is None else collect_loss_networks(checkpoint)
    converted = load_checkpoint(checkpoint, head_width)
    config = dataclasses.replace(converted.config, sampling=dataclasses.replace(converted.config.sampling, pool=pool))
    save_weights(out, converted.variables, config, dtype)
    print(f"{out}: {describe(converted)}")
    if losses is None:
        print(f"skipped {converted.skipped} tensors of the loss networks ({LOSS_PREFIX}*); --losses keeps them")
    else:
        replace_file(losses, lambda path: save_file(networks, path))
        print(f"{losses}: {' and '.join(names)}")


COMMANDS: dict[str, Callable[..., None]] = {
    "import": import_cameras,
    **{f.__name__: f for f in (fit, check, demo, reconstruct, animate, render, export, synth, train, convert)},
}


def _require_parent(path: Path, option: str = "--out") -> None:
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{option} {path}: the folder {path.parent} does not exist")


def _require_suffix(path: Path, suffixes: tuple[str, ...], option: str = "--out") -> None:
    if path.suffix.lower() not in suffixes:
        raise ValueError(f"{option} {path}: expected a name ending in {' or '.join(suffixes)}")


def main() -> None:
    """Entry point of the console script."""
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")  # no notes of XLA's between our lines
    keep_freed_memory()
    try:
        tyro.extras.subcommand_cli_from_dict(COMMANDS, prog="humangs", description=__doc_summary__)
    except (ValueError, OSError) as error:
        print(f"humangs: error: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("humangs: interrupted", file=sys.stderr)
        sys.exit(130)


__doc_summary__ = "Animatable 3D Gaussian humans from a few photos with body poses."

if __name__ == "__main__":
    main()
