"""The photo that an avatar has not seen."""

import dataclasses

import pytest

from humangs_jax.apps import start
from humangs_jax.apps.start import better_body, held_out_psnr
from humangs_jax.body.library import load_body
from humangs_jax.body.resolution import decimate
from humangs_jax.network.presets import tiny
from tests.refinement.refinement_cases import toy_avatar, toy_capture


@pytest.fixture(scope="module")
def body():
    return decimate(load_body(), 400)


def test_one_of_four_photos_is_kept_from_the_network_and_compared_with(body, monkeypatch):
    avatar, capture, given = toy_avatar(body, 0.0), toy_capture(body, toy_avatar(body, 0.0), views=4), []
    monkeypatch.setattr(start, "reconstruct", lambda _, __, others: given.append(others.names) or avatar)
    found = held_out_psnr({}, tiny(), capture, None)
    assert set(capture.names) - set(given[0]) == {found.name} and len(given[0]) == 4  # a copy in its place
    assert found.psnr > 25 and found.name in str(found)
    monkeypatch.setattr(start, "reconstruct", lambda *_: toy_avatar(body, 0.15))
    assert held_out_psnr({}, tiny(), capture, None).psnr < found.psnr - 3


def test_few_photos_and_photos_without_masks_hold_none_out(body):
    capture = toy_capture(body, toy_avatar(body, 0.0), views=4)
    assert held_out_psnr({}, tiny(), capture.select([0, 1, 2]), None) is None
    assert held_out_psnr({}, tiny(), dataclasses.replace(capture, masks=None), None) is None


def test_the_body_with_the_better_avatar_is_taken(body, monkeypatch):
    capture = toy_capture(body, toy_avatar(body, 0.0), views=4)
    other, wrong = dataclasses.replace(capture, body_file="other"), {}
    monkeypatch.setattr(start, "reconstruct", lambda _, __, photos: toy_avatar(body, wrong[photos.body_file]))
    for first, second, taken in ((0.15, 0.0, other), (0.0, 0.15, capture), (0.0, 0.0, capture)):
        wrong |= {capture.body_file: first, "other": second}
        found, estimate = better_body({}, tiny(), capture, other, None)
        assert found is taken and estimate.psnr > 25
    few = capture.select([0, 1])
    assert better_body({}, tiny(), few, other, None) == (few, None)
