"""Lists what `humangs start` will call. From these calls, threads compile programs while photos are
read, people are found and bodies are fitted (`core.processes.Ahead`).

A program depends on shapes, not on values. So a program can be compiled before the body is known:
the photos then get a body in the usual pose. A wrong guess only costs time.
"""

import dataclasses
import functools
from collections.abc import Iterator

import jax
import numpy as np

from humangs_jax.apps.check import calls_of_check
from humangs_jax.apps.start import READ
from humangs_jax.avatar.reconstruct import calls_of_reconstruct
from humangs_jax.body.library import load_body
from humangs_jax.body.model import BodyPose, without_expression
from humangs_jax.capture.fitting.fit_capture import calls_of_fit
from humangs_jax.capture.fitting.own_poses import CONFIG, with_own_poses
from humangs_jax.capture.fitting.silhouette_fit import (
    SilhouetteFit,
    cameras_are_unseen,
    usual_config,
)
from humangs_jax.capture.keypoints.keypoints import MEDIAPIPE_69, Keypoints
from humangs_jax.core.arrays import from_host
from humangs_jax.core.processes import Call
from humangs_jax.data.capture import Capture
from humangs_jax.data.exposure import calls_of_exposure
from humangs_jax.data.photos import Photos
from humangs_jax.network.weights import load_weights

shipped_weights = functools.cache(load_weights)
"""Loads the weights that come with the package. They are read once."""


def calls_of_found_people(photos: int) -> Iterator[Call]:
    """Yields the calls of the fit to the keypoints that the detector finds in photos. Assumes that
    all photos are of one moment, and that hands are found. photos: number of photos.
    """
    yield from calls_of_fit(load_body(), MEDIAPIPE_69, photos)


def calls_after_fit(photos: Photos, keypoints: Keypoints) -> Iterator[Call]:
    """Yields the calls that follow the fit to keypoints if photos have masks: the fit to the masks,
    the search for movement between the photos, the avatars that are compared, and the check.
    """
    capture = with_usual_body(photos)
    kind = keypoints.set
    keypoints = dataclasses.replace(
        keypoints, set=kind.adapted(kind.offsets, np.ones(len(kind.names)))
    )
    fixed = cameras_are_unseen(capture) or capture.calibrated
    config = usual_config(fitted=True, fixed_cameras=fixed, calibrated=capture.calibrated)
    yield from SilhouetteFit.of(capture, keypoints, config).calls()
    if capture.frame_count == 1 < capture.view_count:
        yield from SilhouetteFit.of(with_own_poses(capture), keypoints, CONFIG).calls()
    masked = dataclasses.replace(capture, masks=photos.masks, unknown=photos.unknown)
    read = masked.select(np.arange(min(masked.view_count, READ)))
    yield from calls_of_exposure(masked.select([0]))
    variables, config = shipped_weights()
    yield from calls_of_reconstruct(variables, config, read)
    yield from calls_of_check(read, config)


def with_usual_body(photos: Photos) -> Capture:
    """Returns photos as a capture without masks. Its body has zero rotations in every frame."""
    body = load_body()
    coefficients = without_expression(body).shape_directions.shape[-1]
    rotations = np.zeros((photos.frame_count, len(body.parents), 3), np.float32)
    poses = jax.vmap(BodyPose)(from_host(rotations), from_host(rotations[:, 0]))
    betas = np.zeros(coefficients, np.float32)
    capture = Capture(**vars(photos), body=body, betas=betas, poses=poses)
    return dataclasses.replace(capture, masks=None, unknown=None)
