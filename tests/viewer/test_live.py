"""The live viewer: what it follows, and, where viser and a browser are at hand, that the browser shows Gaussians."""

import importlib.util
import os
import threading
import urllib.request
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from viewer_cases import small_avatar

from experiments.common import chromium
from humangs_jax.avatar.animate import skin
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.frames import rest_pose_of
from humangs_jax.avatar.light import Light
from humangs_jax.core.pytree import replace
from humangs_jax.data.capture import Capture
from humangs_jax.rendering.gaussians import covariances
from humangs_jax.viewer import live

needs_viser = pytest.mark.skipif(importlib.util.find_spec("viser") is None, reason="needs viser (extra viewer)")


class Shown(live.LiveView):
    """Records what a view is told."""

    def __init__(self):
        self.avatars, self.said = [], []

    def show(self, avatar, status=None):
        self.avatars.append(avatar)

    def say(self, status):
        self.said.append(status)


def test_without_viser_one_line_says_what_to_install(monkeypatch):
    def missing(name):
        raise ModuleNotFoundError(f"No module named {name!r}", name=name)

    monkeypatch.setattr(live.importlib, "import_module", missing)
    with pytest.raises(ModuleNotFoundError, match=r"^viser is not installed: pip install 'humangs_jax\[viewer\]'$"):
        live.LiveView()


def test_an_avatar_file_is_shown_whenever_it_is_replaced(tmp_path):
    view, path, avatar = Shown(), tmp_path / "refined.npz", small_avatar()
    shown = live.show_newest(view, path, None, None)
    assert shown is None and view.said == [f"Waiting for {path} ..."]
    avatar.save(path)
    shown = live.show_newest(view, path, None, shown)
    assert live.show_newest(view, path, None, shown) == shown and len(view.avatars) == 1
    replace(avatar, rest_joints=avatar.rest_joints + 1).save(path)
    shown = live.show_newest(view, path, None, shown)
    assert len(view.avatars) == 2
    np.testing.assert_allclose(view.avatars[1].rest_joints, view.avatars[0].rest_joints + 1)
    path.write_bytes(path.read_bytes()[:-100])
    os.utime(path, (0, 0))
    live.show_newest(view, path, None, shown)
    assert len(view.avatars) == 2 and "refined.npz" in view.said[-1] and "\n" not in view.said[-1]


def test_the_weights_of_a_run_reconstruct_someone(tmp_path, monkeypatch):
    avatar, photos, calls = small_avatar(), object.__new__(Capture), []
    monkeypatch.setattr(live, "load_weights", lambda file: (file, "config"))
    monkeypatch.setattr(live, "reconstruct", lambda *arguments: calls.append(arguments) or avatar)
    view = Shown()
    (tmp_path / live.WEIGHTS).write_bytes(b"1")
    shown = live.show_newest(view, tmp_path, photos, None)
    shown = live.show_newest(view, tmp_path, photos, shown)
    assert calls == [(tmp_path / live.WEIGHTS, "config", photos)] and view.avatars == [avatar]
    (tmp_path / live.WEIGHTS).write_bytes(b"22")
    live.show_newest(view, tmp_path, photos, shown)
    assert len(calls) == 2


@pytest.mark.parametrize(
    ("name", "capture", "message"),
    [
        ("", None, "no config.json: expected the folder of a training run, or an avatar file"),
        ("runs/none", None, "no such run"),
        ("none.ply", None, "no such run"),
        ("none/avatar.npz", None, "no such run"),
        ("avatar.npz", "demo_capture", "--capture demo_capture: only for the folder of a training run"),
    ],
)
def test_what_cannot_be_followed_is_named(tmp_path, name, capture, message):
    with pytest.raises((ValueError, OSError), match=message):
        live.follow(tmp_path / name, capture)


def test_the_network_writes_where_the_viewer_looks():
    loop = Path(live.__file__).parents[1] / "training" / "loop.py"
    assert f'save_weights(out / "{live.WEIGHTS}"' in loop.read_text()


@pytest.fixture
def person():
    """A person, large and opaque enough to be seen: Gaussians on a ball."""
    avatar = small_avatar()
    rng = np.random.default_rng(0)
    directions = rng.normal(size=avatar.gaussians.means.shape)
    means = 0.5 * directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    gaussians = replace(
        avatar.gaussians,
        means=means.astype(np.float32),
        scales=np.full_like(means, 0.08, np.float32),
        opacities=np.full(len(means), 0.9, np.float32),
        colors=np.tile(np.asarray([0.9, 0.1, 0.1], np.float32), (len(means), 1)),
    )
    ends = np.asarray([[0, -0.6, 0], [0, 0.6, 0]], np.float32)
    vertices = np.concatenate([ends, np.zeros((len(avatar.rest_vertices) - 2, 3), np.float32)])
    return replace(avatar, gaussians=gaussians, rest_vertices=vertices)


@needs_viser
@pytest.mark.slow
def test_the_server_takes_a_free_port_and_refuses_a_taken_one(person):
    with live.LiveView() as view:
        view.show(person)
        with urllib.request.urlopen(view.url, timeout=30) as answer:
            assert answer.status == 200 and b"<html" in answer.read()[:500].lower()
        port = view.server.get_port()
        centres = np.asarray(view.splats.centers) * live.UNIT
        np.testing.assert_allclose(centres, person.gaussians.means, atol=1e-5)
        ours = np.asarray(covariances(person.gaussians))
        np.testing.assert_allclose(np.asarray(view.splats.covariances) * live.UNIT**2, ours, rtol=1e-3, atol=1e-8)
        lit = jax.tree.map(jnp.asarray, person)
        light = Light(0.1 * jnp.arange(8.0), 2 * lit.gaussians.means, lit.gaussians.opacities)
        lit = replace(lit, light=light)
        view.show(lit)
        expected = skin(lit, rest_pose_of(lit)).colors
        assert jnp.abs(expected - person.gaussians.colors).max() > 0.1
        np.testing.assert_allclose(view.splats.rgbs, 255 * jnp.clip(expected, 0, 1), atol=1)
        with pytest.raises(OSError, match=f"--port {port}: "):
            live.LiveView(port=port)


@needs_viser
@pytest.mark.slow
@pytest.mark.skipif(chromium.missing() is not None, reason=str(chromium.missing()))
def test_a_browser_sees_the_person_and_the_next_one(person):
    blue = replace(person, gaussians=replace(person.gaussians, colors=person.gaussians.colors[:, ::-1]))

    def share(browser, channel):
        """Share of the window where a colour is much brighter than the two others."""
        image = browser.screenshot()
        others = np.delete(image, channel, axis=-1).max(axis=-1)
        return float((image[..., channel] - others > 0.4).mean())

    def wait_for(browser, channel):
        for _ in range(60):
            if share(browser, channel) > 0.02:
                return True
            threading.Event().wait(1)
        return False

    with live.LiveView() as view, chromium.Chromium(900, 600) as browser:
        view.show(person)
        browser.driver.get(view.url)
        assert wait_for(browser, 0)
        view.show(blue)
        assert wait_for(browser, 2) and share(browser, 0) < 0.01
        assert isinstance(view.avatar, Avatar)
