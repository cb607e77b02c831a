"""What evaluations share before they start: options, the network, and what their rows depend on."""

import argparse
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Any

from experiments.evaluation.results import file_digest

COUNTS = (1, 2, 3, 4, 6, 12)
"""Numbers of photos that are evenly spaced among the ring's 12 cameras."""


def add_people_options(parser: argparse.ArgumentParser, subjects: int) -> None:
    """Options of every evaluation: people, weights, and files of results."""
    parser.add_argument("--subjects", type=int, default=subjects, help="how many people")
    parser.add_argument("--held-out", type=int, default=8, help="views to compare with, in the pose of the photos")
    parser.add_argument("--poses", type=int, default=2, help="unseen poses")
    parser.add_argument("--pose-views", type=int, default=4, help="views to compare with, of each unseen pose")
    parser.add_argument("--size", type=int, default=256, help="side of the photos in pixels")
    parser.add_argument("--first", type=int, default=0, help="index of the first subject within the split")
    parser.add_argument("--weights", type=Path, help="weights file; the shipped ones if not given")
    parser.add_argument("--split", choices=("validation", "test"), default="test", help="seeds of the people")
    parser.add_argument(
        "--tokens",
        choices=("all", "foreground"),
        help="patches that the network looks at; as it was trained if not given",
    )
    parser.add_argument("--crop", action="store_true", help="photos are cut to the person first")
    parser.add_argument("--loosest-of", type=int, metavar="N", help="of N people, those in the loosest clothes")
    parser.add_argument(
        "--skinning-reach",
        type=float,
        metavar="METRES",
        help="other reach of the skinning between the legs than the weights'; 0: each Gaussian by its own vertex alone",
    )
    parser.add_argument("--json", type=Path, help="numbers are written here; rows already there are kept")
    parser.add_argument("--page", "--docs", type=Path, help="page whose table is written")
    parser.add_argument("--lpips-backbone", type=Path, help="weights of the network under LPIPS")
    parser.add_argument("--lpips-heads", type=Path, help="heads of LPIPS, where the backbone's file does not have them")
    parser.add_argument("--lpips-net", choices=("vgg", "alex", "squeeze"), default="vgg", help="which network that is")


def check_people_options(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> None:
    """Ends with a message that names the option if one is out of range."""
    if (
        min(arguments.subjects, arguments.held_out, arguments.pose_views) < 1
        or min(arguments.first, arguments.poses) < 0
    ):
        parser.error("--subjects, --held-out and --pose-views must be at least 1, --first and --poses at least 0")
    if arguments.loosest_of is not None and arguments.loosest_of < arguments.subjects:
        parser.error(f"--loosest-of must be at least --subjects, {arguments.subjects}")
    if arguments.skinning_reach is not None and arguments.skinning_reach < 0:
        parser.error("--skinning-reach must be at least 0")


def seeds_asked_for(arguments: argparse.Namespace, body: Any) -> list[int]:
    """Seeds of the people, in the order of their numbers. body: the shipped one, on which their clothes are made."""
    import numpy as np

    from experiments.evaluation.subjects import looseness
    from humangs_jax.people.seeds import seeds_of
    from humangs_jax.people.subject import make_subject

    seeds = list(seeds_of(arguments.split, arguments.first, arguments.loosest_of or arguments.subjects))
    if arguments.loosest_of is None:
        return seeds
    loose = [looseness(make_subject(seed, body), body) for seed in seeds]
    return [seeds[i] for i in sorted(np.argsort(loose)[-arguments.subjects :])]


def load_lpips(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> Any:
    """The weights of LPIPS or None; ends with a message that names the file if it cannot be read."""
    from humangs_jax.losses.loss_networks import load_loss_networks

    files = (arguments.lpips_backbone, arguments.lpips_heads, arguments.lpips_net)
    try:
        return load_loss_networks(None, *files).lpips
    except (ValueError, OSError) as error:
        parser.error(str(error))


def shipped_digest(asset: str) -> str:
    """SHA-256 of a file of the package."""
    with resources.as_file(resources.files("humangs_jax").joinpath(asset)) as path:
        return file_digest(path)


def load_network(arguments: argparse.Namespace) -> tuple[Any, Any, str]:
    """Variables, configuration, and SHA-256 of the weights file."""
    from humangs_jax.network.weights import SHIPPED, load_weights

    with resources.as_file(resources.files("humangs_jax").joinpath(SHIPPED)) as shipped:
        path = arguments.weights or shipped
        variables, config = load_weights(path)
        digest = file_digest(path)
    if (reach := arguments.skinning_reach) is not None:
        config = replace(config, conventions=replace(config.conventions, skinning_reach=reach or None))
    return variables, config.with_runtime(tokens=arguments.tokens, crop=arguments.crop), digest


def settings_of(arguments: argparse.Namespace, digest: str, tokens: str, lpips: Any) -> dict[str, Any]:
    """What the rows of a person depend on; rows of other settings are not taken for theirs."""
    from experiments.evaluation.subjects import RING
    from humangs_jax.people.seeds import GENERATOR_VERSION

    given = {name: getattr(arguments, name) for name in ("loosest_of", "skinning_reach")}
    given["crop"] = arguments.crop or None
    return {name: value for name, value in given.items() if value is not None} | {
        "weights": digest,
        "tokens": tokens,
        "split": arguments.split,
        "image_size": arguments.size,
        "held_out": arguments.held_out,
        "poses": arguments.poses,
        "pose_views": arguments.pose_views,
        "ring": RING,
        "generator": GENERATOR_VERSION,
        "lpips_net": arguments.lpips_net if lpips else None,
        "lpips_weights": file_digest(arguments.lpips_backbone) if lpips else None,
    }
