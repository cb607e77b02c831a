"""Synthetic people in the layouts of real data sets: preprocessed, loaded, reconstructed and animated."""

import jax
import numpy as np
import pytest

from experiments.data import made_up
from humangs_jax.apps.check import check_capture
from humangs_jax.avatar.animate import animate
from humangs_jax.avatar.reconstruct import reconstruct
from humangs_jax.data.datasets.bodies import FileBody
from humangs_jax.data.datasets.opening import open_people
from humangs_jax.data.preprocess.run import preprocess
from humangs_jax.data.preprocess.scenes import Settings
from humangs_jax.network.humangs import init_humangs
from humangs_jax.network.presets import tiny

TIGHT_IOU = 0.9
"""Least mean overlap of the posed body and the silhouette of a person in tight clothes."""
SIZE = 256
SETTINGS = {
    "thuman": Settings("thuman", size=SIZE, views=6, factors=(1.75, 1.75), supersample=2, train=1, test=0),
    "avatarrex": Settings("avatarrex", size=SIZE),
    "thuman4": Settings("thuman4", size=SIZE, every=1),
}
OPTIONS = {
    "thuman": {"seeds": made_up.SEEDS[:1], "texture_size": 512},
    "avatarrex": {"frames": 2, "cameras": 3, "size": (300, 408)},
    "thuman4": {"frames": 2, "cameras": 3, "size": (332, 288)},
}


@pytest.mark.slow
@pytest.mark.parametrize("layout", SETTINGS)
def test_a_person_goes_all_the_way(layout, tmp_path):
    source = made_up.WRITERS[layout](tmp_path / "raw", **OPTIONS[layout])
    body = FileBody.load(tmp_path / "raw" / "body.npz")
    report = preprocess(source, tmp_path / "scenes", body.file, SETTINGS[layout], progress=False)
    assert report.scenes == 1 and not report.skipped
    (person,) = open_people(tmp_path / "scenes", body)
    subject = person.subject
    assert len(subject) == (5 if layout == "thuman4" else 6)  # there a photo is missing
    capture = subject.capture(range(len(subject)), body, SIZE)
    checked = check_capture(capture, tmp_path / "check.png")
    overlap = [view.iou for view in checked.views]
    assert np.mean(overlap) > TIGHT_IOU and max(view.outside for view in checked.views) < 0.01, overlap
    config = tiny().with_execution(token_capacity=64)
    avatar = reconstruct(init_humangs(jax.random.key(0), config), config, capture.select([0, 1]))
    last = capture.pose(capture.frame_count - 1)
    moved = animate(avatar, last)
    middle = np.asarray(moved.means).mean(axis=0)
    assert np.isfinite(np.asarray(moved.means)).all()
    assert np.linalg.norm(middle - np.asarray(last.translation)) < 1  # an untrained network, in its place
