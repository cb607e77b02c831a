"""The Python code of README.md and of the pages runs as it stands, on small inputs."""

import dataclasses
import json
import pickle
import re
import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from bvh_files import CMU, write_bvh
from command_line import save_tiny_avatar

import humangs_jax as hg
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.body.model import shape_body
from humangs_jax.data.capture import save_capture

ROOT = Path(__file__).parents[2]
LEAST_PSNR = 25.7
"""Least PSNR of a rendered input photo, dB; it was 26.0 when this was written."""
README_WORDS = 700
"""Most words of README.md with code, table and citation: it is read in three minutes."""
MODULES = {
    "hg": hg,
    "jax": jax,
    "jnp": jnp,
    "np": np,
    "dataclasses": dataclasses,
}

WHOLE = ("docs/how_it_works.md", "docs/splatting.md", "docs/ablations.md")
"""Pages whose code needs no names from elsewhere."""
ON_FILES = ("docs/capture_format.md",)
"""Pages whose code runs quickly on an avatar of three Gaussians."""
ON_A_PERSON = (
    *(
        "docs/data.md",
        "docs/evaluation.md",
        "docs/export.md",
        "docs/fitting.md",
        "docs/performance.md",
    ),
    *(
        "docs/motions.md",
        "docs/refinement.md",
        "docs/tradeoff.md",
        "docs/video.md",
        "docs/viewer.md",
    ),
)
"""Pages whose code runs on the shipped person at 256 pixels."""
LEFT_OUT = {
    "docs/change.md": "trains on people that it names, and on a source of the reader's",
    "docs/datasets.md": "reads data sets, and a body, of others",
    "docs/loss_networks.md": "reads weights of others",
    "docs/scaling.md": "needs ray",
    "docs/your_photos.md": "takes photos of a person",
}
SMALLER = {
    "docs/data.md": {
        "range(200)": "range(2)",
        "texture_size=512, processes=8": "texture_size=256, processes=1",
        "input_counts=(1, 2, 4, 6), target_count=3": "input_counts=(2,), target_count=1",
        "input_size=256, target_size=256": "input_size=32, target_size=32",
        "batch_size=8": "batch_size=4",
        "OnTheFlyConfig())": "OnTheFlyConfig(input_size=32, target_size=32))",
    },
    "docs/refinement.md": {"seconds=15.0": "seconds=1.0"},
    "docs/tradeoff.md": {"frame_ms=33.0": "frame_ms=60_000.0"},
    "docs/video.md": {"width=540, height=720": "width=54, height=72"},
}
"""Texts that are replaced in the code of a page, so that it runs at a size for tests."""


def blocks(page):
    return re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(), re.DOTALL)


def run(page, names=None):
    """Runs all blocks of Python of a page and returns the names that they leave.

    `names` are defined before.
    """
    names = dict(names or {})
    small = SMALLER.get(page, {})
    assert all(any(text in block for block in blocks(page)) for text in small), "of an earlier text"
    for block in blocks(page):
        for text, smaller in small.items():
            block = block.replace(text, smaller)
        exec(compile(block, page, "exec"), names)
    return names


@pytest.mark.parametrize("whole", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_the_blocks_of_the_readme_run(whole, monkeypatch, tmp_path, body):
    """The code runs unchanged, or on small photos with three Gaussians instead of the network's."""
    if not whole:
        load = hg.load_capture
        save_tiny_avatar(tmp_path / "tiny.npz", np.asarray(shape_body(body, jnp.zeros(0)).joints))
        monkeypatch.setattr(hg, "load_capture", lambda path: load(path).resized(64))
        monkeypatch.setattr(
            hg, "reconstruct", lambda variables, config, capture: Avatar.load(tmp_path / "tiny.npz")
        )
        monkeypatch.setattr(hg, "refine", lambda avatar, capture, steps: avatar)
    names = run("README.md")
    image, capture = np.asarray(names["image"]), names["capture"]
    assert image.shape == capture.images[0].shape and image.dtype == np.float32
    error = image - np.asarray(capture.images[0])
    if whole:
        assert -10 * np.log10(np.mean(error**2)) > LEAST_PSNR
        assert float(np.abs(names["gradient"].colors).max()) > 0
    assert len(names["gaussians"].means) == len(names["avatar"].gaussians.means)
    assert names["ablation"] != names["config"]


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text().split()) <= README_WORDS


def test_every_page_with_python_is_run():
    pages = {
        f"docs/{path.name}" for path in (ROOT / "docs").glob("*.md") if blocks(f"docs/{path.name}")
    }
    assert pages == {*WHOLE, *ON_FILES, *ON_A_PERSON, *LEFT_OUT}


@pytest.fixture
def files(tmp_path, monkeypatch, body):
    """Returns the working folder, with the motions that pages name."""
    rest = np.asarray(shape_body(body, jnp.zeros(0)).joints)
    still = np.zeros((3, 55, 3))
    (tmp_path / "dance.bvh").write_text(write_bvh(rest, np.zeros((3, len(rest), 3)), CMU))
    np.savez(tmp_path / "dance.npz", rotations=still, translations=still[:, 0], fps=30.0)
    np.savez(
        tmp_path / "amass.npz",
        poses=still.reshape(3, -1),
        trans=still[:, 0] + [0, 0, 1],
        mocap_framerate=120,
    )
    person = {
        "pose_world": np.zeros((3, 72)),
        "trans_world": still[:, 0],
        "betas": np.zeros(10),
        "frame_ids": np.arange(3),
    }
    (tmp_path / "wham_output.pkl").write_bytes(pickle.dumps({0: person, 1: person}))
    save_tiny_avatar(tmp_path / "tiny.npz", rest)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def check_described_capture(text):
    """Checks the capture that a page's code wrote: the keys and the camera that the page shows."""
    capture, file = hg.load_capture("me"), Path("me/capture.json")
    assert capture.view_count == 4 and capture.body.name == "makehuman"
    written, content = (
        json.loads(file.read_text()),
        json.loads(re.search(r"```json\n(.*?)```", text, re.DOTALL)[1]),
    )
    assert set(content) == set(written) and set(content["views"][0]) == set(written["views"][0])
    for key in ("image", "mask"):
        shutil.copyfile(f"me/{written['views'][0][key]}", f"me/{content['views'][0][key]}")
    file.write_text(json.dumps(content))
    np.testing.assert_array_equal(
        hg.load_capture("me").cameras.cam_from_world[0], capture.cameras.cam_from_world[0]
    )
    # 2.6 m in front, 0.9 m above the ground
    np.testing.assert_allclose(capture.cameras.center[0], [0, 0.9, 2.6], atol=1e-6)


@pytest.mark.parametrize("page", ON_FILES)
def test_the_blocks_of_a_page_on_files_run(page, files):
    run(page, MODULES | {"avatar": Avatar.load("tiny.npz")})
    check_described_capture((ROOT / page).read_text())


@pytest.mark.slow
@pytest.mark.parametrize("page", WHOLE)
def test_the_blocks_of_a_page_run(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run(page)


@pytest.fixture(scope="module")
def person():
    """Returns the names that pages use without defining them: person, network, avatar."""
    variables, config = hg.load_weights()
    capture = hg.load_capture("demo_capture").resized(256)
    avatar = hg.reconstruct(variables, config, capture)
    gaussians = hg.animate(avatar, capture.pose(0))
    given = {
        "variables": variables,
        "config": config,
        "capture": capture,
        "avatar": avatar,
        "gaussians": gaussians,
        "pose": capture.pose(0),
    }
    loss_and_gradient = jax.value_and_grad(lambda g: jnp.sum(g.colors**2))
    sharding = jax.sharding.SingleDeviceSharding(jax.devices()[0])
    given |= {
        "cameras": capture.cameras,
        "body": capture.body,
        "motion": hg.load_motion(),
        "key": jax.random.key(0),
    }
    return given | {
        "loss_and_gradient": loss_and_gradient,
        "sharding": sharding,
        "start": 0,
        "stop": 1,
    }


@pytest.mark.slow
@pytest.mark.parametrize("page", ON_A_PERSON)
def test_the_blocks_of_a_page_on_a_person_run(page, person, files):
    if page == "docs/data.md":
        from humangs_jax.synthetic.bank import build_bank
        from humangs_jax.synthetic.writer import Layout, write_set

        write_set(files / "people", 2, Layout(128, views=4), "train", 0, workers=1)
        person = person | {
            "bank": build_bank(range(2), person["body"], "train", texture_size=256, processes=1)
        }
    if page == "docs/evaluation.md":
        shutil.copyfile(
            ROOT / "humangs_jax/assets/weights.safetensors", files / "weights.safetensors"
        )
        for name, capture in (("me", "demo_capture"), ("me/held_out", "demo_capture/held_out")):
            save_capture(files / "people" / name, hg.load_capture(capture))
    names = run(page, MODULES | person)
    if page == "docs/motions.md":
        assert len(names["motion"].translations) == 3
    if page == "docs/export.md":
        assert {path.name for path in files.iterdir()} >= {"person.spz", "dance.glb"}
