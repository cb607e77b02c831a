"""Measures how good an avatar is where no photo was taken, with guesses from what the photos show
and without.
"""

import dataclasses
import functools
from typing import Any

import jax

from experiments.harness import Run, entry, means
from experiments.results import cells, markdown_table
from experiments.subjects import RING, People
from humangs_jax.avatar import reconstruct as reconstruction
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.unseen import with_guesses
from humangs_jax.data.capture import Capture
from humangs_jax.data.prepared import prepare_capture
from humangs_jax.data.views import to_network_views
from humangs_jax.evaluation.cases import predict_views
from humangs_jax.evaluation.means import mean_scores
from humangs_jax.evaluation.scores import PROTOCOLS, score_views
from humangs_jax.losses.loss_networks import load_lpips
from humangs_jax.network.config import HumanGSConfig
from humangs_jax.network.humangs import apply_humangs

CASES = {
    1: ("one, in front", (0,), (5, 6, 7)),
    2: ("two, 60 degrees apart", (0, 2), (6, 7, 8)),
    4: ("four, all around", (0, 3, 6, 9), (1, 5, 8, 10)),
}
"""{number of photos: (name, cameras of the photos, cameras of the views to compare with)}.

The views are on the other side, or between the photos. Cameras are numbered on a ring, 30 degrees
apart, from the front on.
"""
BEFORE, AFTER = "network alone", "guessed"
"""Names of the avatars without and with guesses."""
SHOWN = {"psnr": ("PSNR", 2), "psnr_fg": ("foreground", 2), "lpips_alex": ("LPIPS alex", 4)}
"""{score: its heading and digits in the table}."""


@entry
def unseen(
    run: Run,
    people: People = People(8, held_out=1, poses=0, pose_views=1),
    photos: tuple[int, ...] = tuple(CASES),
) -> None:
    """Compares avatars of few photos, with and without guesses, with views from the other side.

    Needs the extra `lpips`. Avatars of four photos from all around should lose nothing by guesses.
    The views are not those of --held-out.

    Options:
    photos: numbers of photos
    """
    start, lpips = people.start(), load_lpips("alex")
    protocol = dataclasses.replace(PROTOCOLS["humangs"], lpips=("alex",))

    # all cameras of the ring take a photo, of which some are inputs and some are compared with
    @functools.cache
    def person(seed):
        return start.subject(seed, (RING,)).photos

    def scores(avatar: Avatar, truth: Capture) -> dict[str, Any]:
        drawn = predict_views(avatar, truth)
        rows = score_views(drawn.images, truth, protocol, drawn.alpha, {"alex": lpips})
        mean = mean_scores(list(rows))
        return {name: mean[name] for name in SHOWN}

    def measure(seed: int, count: int) -> dict[str, Any]:
        given, others = (person(seed).select(list(views)) for views in CASES[count][1:])
        made = both_avatars(start.variables, start.config, given)
        return {name: scores(avatar, others) for name, avatar in made.items()}

    # people with the same number of photos follow each other, because they share a program
    cases = {
        f"{count} photos: {seed}": functools.partial(measure, seed, count)
        for count in photos
        for seed in start.seeds
    }
    found = run.rows(cases, start.settings)
    table, numbers, gains = [], {}, []
    for count in photos:
        case, rows = CASES[count][0], [found[f"{count} photos: {seed}"] for seed in start.seeds]
        mean = means(rows)
        table += [[case, state, *cells(mean[state], SHOWN)] for state in (BEFORE, AFTER)]
        gain = mean[AFTER]["lpips_alex"] / mean[BEFORE]["lpips_alex"] - 1
        better = sum(row[AFTER]["lpips_alex"] < row[BEFORE]["lpips_alex"] for row in rows)
        gains.append(f"{case}: LPIPS {100 * gain:+.0f} %, lower for {better} of {len(rows)}")
        numbers[str(count)] = {"means": mean, "lpips": gain, "better": better}
    header = ["photos", "avatar", *(heading for heading, _ in SHOWN.values())]
    shown = markdown_table(header, table, "ll" + "r" * len(SHOWN))
    seeds = f"{len(start.seeds)} people of the {start.settings['split']} seeds, {start.size} px"
    text = f"{seeds}. Guessed against the network alone: {'; '.join(gains)}.\n\n{shown}"
    run.show(text, {"settings": start.settings, "cases": numbers})


def both_avatars(variables: Any, config: HumanGSConfig, capture: Capture) -> dict[str, Avatar]:
    """Returns the avatars of a capture without and with guesses, from one pass of the network."""
    prepared = prepare_capture(capture, config)
    body, size, crop = prepared.body, config.image_size, config.runtime.crop
    assert body is not None  # prepared for this network
    views = to_network_views(prepared.capture, size, crop, prepared.displacement)
    inputs = reconstruction._prepare(body, views, config)
    sized = reconstruction.fit_buffers(inputs.foreground, inputs.view_count, config)
    outputs = _network(variables, sized, inputs)
    made = {BEFORE: outputs, AFTER: with_guesses(outputs, inputs, body, sized)}
    return {
        name: reconstruction.completed_avatar(each, body, views, sized)
        for name, each in made.items()
    }


_network = jax.jit(lambda v, c, i: apply_humangs(v, i, c)[0])
