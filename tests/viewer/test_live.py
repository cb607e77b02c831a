"""The live viewer: what it follows, and, where a browser is at hand, that the browser shows the newest Gaussians."""

import json
import os
import threading
import urllib.request
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from small import small_avatar

from experiments import chromium
from humangs_jax.core.pytree import replace
from humangs_jax.data.capture import Capture
from humangs_jax.viewer import page as live
from humangs_jax.viewer.page import page_html


class Shown(live.LiveView):
    """Records what a view is told."""

    def __init__(self):
        self.avatars, self.said = [], []

    def show(self, avatar, status=None):
        self.avatars.append(avatar)

    def say(self, status):
        self.said.append(status)


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
    (tmp_path / live.RUN_WEIGHTS).write_bytes(b"1")
    shown = live.show_newest(view, tmp_path, photos, None)
    shown = live.show_newest(view, tmp_path, photos, shown)
    assert calls == [(tmp_path / live.RUN_WEIGHTS, "config", photos)] and view.avatars == [avatar]
    (tmp_path / live.RUN_WEIGHTS).write_bytes(b"22")
    live.show_newest(view, tmp_path, photos, shown)
    assert len(calls) == 2


@pytest.mark.parametrize(
    ("name", "capture", "message"),
    [
        ("", None, "no config.json: expected the folder of a training run, or an avatar file"),
        ("runs/none", None, "no such run"),
        ("none.ply", None, "no such run"),
        ("none/avatar.npz", None, "no such run"),
        ("avatar.npz", "demo_capture", "capture demo_capture: only for the folder of a training run"),
    ],
)
def test_what_cannot_be_followed_is_named(tmp_path, name, capture, message):
    with pytest.raises((ValueError, OSError), match=message):
        live.follow(tmp_path / name, capture)


def test_the_network_writes_where_the_viewer_looks():
    loop = Path(live.__file__).parents[1] / "training" / "loop.py"
    assert f'save_weights(out / "{live.RUN_WEIGHTS}"' in loop.read_text()


@pytest.fixture
def person():
    """A person, large and opaque enough to be seen: Gaussians on a ball."""
    avatar = small_avatar()
    rng = np.random.default_rng(0)
    directions = rng.normal(size=avatar.gaussians.means.shape)
    means = 0.5 * directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    gaussians = replace(
        avatar.gaussians,
        means=jnp.asarray(means, jnp.float32),
        scales=jnp.full(means.shape, 0.08),
        opacities=jnp.full(len(means), 0.9),
        colors=jnp.tile(jnp.asarray([0.9, 0.1, 0.1]), (len(means), 1)),
    )
    ends = np.asarray([[0, -0.6, 0], [0, 0.6, 0]], np.float32)
    vertices = np.concatenate([ends, np.zeros((len(avatar.rest_vertices) - 2, 3), np.float32)])
    return replace(avatar, gaussians=gaussians, rest_vertices=jnp.asarray(vertices))


def test_the_server_answers_with_the_newest_avatar_and_refuses_a_taken_port(person):
    def read(path):
        with urllib.request.urlopen(view.url + path, timeout=30) as answer:
            return answer.read().decode()

    with live.LiveView() as view:
        assert "fetch" in read("") and json.loads(read("state")) == {"shown": 0, "status": "Waiting for the first avatar ..."}
        view.show(person, "first")
        assert read("avatar?1") == page_html(person)
        assert json.loads(read("state")) == {"shown": 1, "status": "first"}
        with pytest.raises(ValueError, match=r"^port "):
            live.LiveView(port=view.server.server_address[1])


@pytest.mark.slow
@pytest.mark.skipif(chromium.missing() is not None, reason=str(chromium.missing()))
def test_a_browser_sees_the_person_and_the_next_one(person):
    blue = replace(person, gaussians=replace(person.gaussians, colors=person.gaussians.colors[:, ::-1]))

    def share(browser, channel):
        """Share of the window where a color is much brighter than the two others."""
        image = browser.screenshot()
        others = np.delete(image, channel, axis=-1).max(axis=-1)
        return float((image[..., channel] - others > 0.4).mean())

    def wait_for(browser, channel):
        for _ in range(60):
            if share(browser, channel) > 0.02:
                return True
            threading.Event().wait(1)
        return False

    inside = "const page = document.getElementById('page').contentWindow.humangs; "
    with live.LiveView() as view, chromium.Chromium(900, 600) as browser:
        view.show(person)
        browser.driver.get(view.url)
        assert wait_for(browser, 0)
        near = browser.run(inside + "const kept = page.state(); kept.orbit.distance *= 0.8; page.restore(kept); return kept")
        view.show(blue)
        assert wait_for(browser, 2) and share(browser, 0) < 0.01
        assert browser.run(inside + "return page.state()")["orbit"] == near["orbit"]  # as people had turned it
        assert browser.problems() == []
