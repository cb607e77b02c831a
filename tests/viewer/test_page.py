"""The page as a file, on localhost and in a notebook; the commands that make it.

What it draws: test_browser.py.
"""

import html
import json
import os
import re
import threading
import urllib.error
import urllib.request
from http.server import ThreadingHTTPServer
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from command_line import run
from small import small_avatar

from experiments import chromium
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.body.library import load_body
from humangs_jax.body.model import shape_body
from humangs_jax.core.pytree import replace
from humangs_jax.data.capture import Capture
from humangs_jax.data.motion import Motion, save_motion
from humangs_jax.rendering.gaussians import Gaussians
from humangs_jax.viewer import page


@pytest.fixture(scope="module")
def text():
    return page.page_html(small_avatar(), title="<me> & {{data}}")


def test_the_page_is_one_file_that_asks_nobody(text):
    assert "connect-src 'none'" in text and "default-src 'none'" in text
    assert re.findall(r'<\w[^>]*\b(?:src|href|action|data)="([^"]*)"', text) == [
        "data:,"
    ]  # the icon
    assert not re.search(
        r"https?:|@import|url\(|fetch\(|XMLHttpRequest|WebSocket|importScripts", text
    )


def test_every_part_is_in_its_place_and_none_ends_a_script_early(text):
    assert "{{" not in text.replace("{{data}}</", "")
    assert text.count("<title>&lt;me&gt; &amp; {{data}}</title>") == 1
    assert text.count("<script") == text.count("</script>") == 4 + len(page.SHADERS)
    header = json.loads(re.search(r'id="header">(.*?)</script>', text, re.S)[1])
    assert header["count"] == 24 and "motion" not in header  # the walk has 55 joints, this avatar 3


def test_the_files_that_comments_of_the_page_name_exist():
    package = Path(page.__file__).parents[1]
    ours, beside = r"humangs_jax/[\w/]+\.py", r"(?<![\w/.])\w+\.(?:js|html|css|frag|vert)\b"
    for part in (package / "viewer" / "page").iterdir():
        text = part.read_text()
        for name in re.findall(ours, text):
            assert (package.parent / name).is_file(), f"{part.name}: {name}"
        for name in re.findall(beside, " ".join(re.findall(r"// .*", text))):
            assert (part.parent / name).is_file(), f"{part.name}: {name}"


def test_a_joint_may_have_any_name():
    text = page.page_html(replace(small_avatar(), joint_names=("</script><b>", "b", "c")))
    assert "</script><b>" not in text


def test_shape_sliders_come_with_the_shipped_body_and_vertex_major_gaussians():
    """Also where those between the legs have weights of their own; not where refinement has added
    Gaussians.
    """
    body, each = load_body(), 3
    rest = shape_body(body, jnp.zeros(body.shape_directions.shape[-1]))
    means = jnp.repeat(rest.vertices, each, axis=0)
    count = len(means)
    gaussians = Gaussians(
        means,
        jnp.tile(jnp.asarray([1.0, 0, 0, 0]), (count, 1)),
        0.01 + 0 * means,
        means[:, 0] * 0 + 0.5,
        0 * means,
    )
    weights = np.repeat(np.asarray(body.skinning_weights), each, axis=0)
    names = (body.parents, body.joint_names)
    avatar = Avatar(gaussians, jnp.asarray(weights), rest.vertices, rest.joints, body.faces, *names)
    weights[::40] = 0.5 * np.eye(len(body.parents))[[1, 2]].sum(axis=0)
    between_the_legs = replace(avatar, skinning_weights=jnp.asarray(weights))
    for person in (avatar, between_the_legs):
        assert person.gaussians_per_vertex == each and page.known_body(person) is not None
    order = np.random.default_rng(0).permutation(count)
    for grown in (np.arange(count - 1), order, np.concatenate([np.arange(count), order])):
        person = avatar.select(grown)
        assert person.gaussians_per_vertex is None and page.known_body(person) is None


def test_fast_motions_are_thinned_out():
    motion = Motion(jnp.zeros((8, 3, 3)), jnp.zeros((8, 3)), fps=240.0)
    text = page.page_html(small_avatar(), motion, motion_name="run")
    about = json.loads(re.search(r'id="header">(.*?)</script>', text, re.S)[1])["motion"]
    assert (about["name"], about["frames"], about["fps"]) == ("run", 2, 60)


def test_notebooks_hold_the_whole_page():
    shown = page.show(small_avatar(), height=300)._repr_html_()
    assert html.unescape(re.search(r'srcdoc="([^"]*)"', shown)[1]) == page.page_html(small_avatar())
    assert "height:300px" in shown


def test_the_server_serves_the_page_to_this_machine_and_nothing_else():
    server = page.page_server({"/": "<p>é</p>"})
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        assert server.server_address[0] == "127.0.0.1"
        url = f"http://127.0.0.1:{server.server_address[1]}"
        with urllib.request.urlopen(url + "/?x") as answer:
            assert (
                answer.read().decode() == "<p>é</p>" and "utf-8" in answer.headers["Content-Type"]
            )
        with pytest.raises(urllib.error.HTTPError, match="404") as refused:
            urllib.request.urlopen(url + "/etc/passwd")
        refused.value.close()
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


@pytest.fixture
def avatar_file(tmp_path):
    small_avatar().save(tmp_path / "me.npz")
    return tmp_path / "me.npz"


def test_export_writes_page_and_ply(avatar_file, tmp_path, monkeypatch, capsys):
    written = tmp_path / "me.html", tmp_path / "me.ply"
    code, out, err = run(
        monkeypatch, capsys, "export", avatar_file, "--html", written[0], "--out", written[1]
    )
    assert (
        (code, err) == (0, "") and str(written[0]) in out and "MB" in out and str(written[1]) in out
    )
    assert out.splitlines()[-1] == f"next: humangs animate {avatar_file} --out video.mp4"
    assert (
        written[0].read_text() == page.page_html(small_avatar(), title="me") and written[1].exists()
    )


def test_a_page_plays_the_motion_it_is_given(avatar_file, tmp_path, monkeypatch, capsys):
    motion = Motion(jnp.zeros((2, 3, 3)), jnp.zeros((2, 3)))
    save_motion(tmp_path / "still.npz", motion)
    arguments = ("--html", tmp_path / "me.html", "--motion", tmp_path / "still.npz")
    assert run(monkeypatch, capsys, "export", avatar_file, *arguments)[0] == 0
    assert (tmp_path / "me.html").read_text() == page.page_html(
        small_avatar(), motion, "me", "still"
    )
    assert {path.name for path in tmp_path.iterdir()} == {"me.npz", "me.html", "still.npz"}


def test_view_opens_the_browser_and_ends_quietly(avatar_file, monkeypatch, capsys):
    opened = []

    def interrupted(server):
        raise KeyboardInterrupt

    monkeypatch.setattr(ThreadingHTTPServer, "serve_forever", interrupted)
    monkeypatch.setattr(page.webbrowser, "open", opened.append)
    code, out, err = run(monkeypatch, capsys, "view", avatar_file)
    assert (code, err) == (0, "") and len(opened) == 1 and opened[0] in out
    assert (
        run(monkeypatch, capsys, "view", avatar_file, "--no-browser")[0] == 0 and len(opened) == 1
    )


# Live: what is followed, and, where a browser is at hand, that it shows the newest Gaussians
# ---------------------------------


class Shown(page.LiveView):
    """Records what a view is told."""

    def __init__(self):
        self.avatars, self.said = [], []

    def show(self, avatar, status=None):
        self.avatars.append(avatar)

    def say(self, status):
        self.said.append(status)


def test_an_avatar_file_is_shown_whenever_it_is_replaced(tmp_path):
    view, path, avatar = Shown(), tmp_path / "refined.npz", small_avatar()
    shown = page.show_newest(view, path, None, None)
    assert shown is None and view.said == [f"Waiting for {path} ..."]
    avatar.save(path)
    shown = page.show_newest(view, path, None, shown)
    assert page.show_newest(view, path, None, shown) == shown and len(view.avatars) == 1
    replace(avatar, rest_joints=avatar.rest_joints + 1).save(path)
    shown = page.show_newest(view, path, None, shown)
    assert len(view.avatars) == 2
    np.testing.assert_allclose(view.avatars[1].rest_joints, view.avatars[0].rest_joints + 1)
    path.write_bytes(path.read_bytes()[:-100])
    os.utime(path, (0, 0))
    page.show_newest(view, path, None, shown)
    assert len(view.avatars) == 2 and "refined.npz" in view.said[-1] and "\n" not in view.said[-1]


def test_the_weights_of_a_run_reconstruct_someone(tmp_path, monkeypatch):
    avatar, photos, calls = small_avatar(), object.__new__(Capture), []
    monkeypatch.setattr(page, "load_weights", lambda file: (file, "config"))
    monkeypatch.setattr(page, "reconstruct", lambda *arguments: calls.append(arguments) or avatar)
    view = Shown()
    (tmp_path / page.RUN_WEIGHTS).write_bytes(b"1")
    shown = page.show_newest(view, tmp_path, photos, None)
    shown = page.show_newest(view, tmp_path, photos, shown)
    assert calls == [(tmp_path / page.RUN_WEIGHTS, "config", photos)] and view.avatars == [avatar]
    (tmp_path / page.RUN_WEIGHTS).write_bytes(b"22")
    page.show_newest(view, tmp_path, photos, shown)
    assert len(calls) == 2


@pytest.mark.parametrize(
    ("name", "capture", "message"),
    [
        ("", None, "no config.json: expected the folder of a training run, or an avatar file"),
        ("runs/none", None, "no such run"),
        ("none.ply", None, "no such run"),
        ("none/avatar.npz", None, "no such run"),
        (
            "avatar.npz",
            "demo_capture",
            "capture demo_capture: only for the folder of a training run",
        ),
    ],
)
def test_what_cannot_be_followed_is_named(tmp_path, name, capture, message):
    with pytest.raises((ValueError, OSError), match=message):
        page.follow(tmp_path / name, capture)


def test_the_network_writes_where_the_viewer_looks():
    loop = Path(page.__file__).parents[1] / "training" / "loop.py"
    assert f'save_weights(out / "{page.RUN_WEIGHTS}"' in loop.read_text()


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

    with page.LiveView() as view:
        assert "fetch" in read("") and json.loads(read("state")) == {
            "shown": 0,
            "status": "Waiting for the first avatar ...",
        }
        view.show(person, "first")
        assert read("avatar?1") == page.page_html(person)
        assert json.loads(read("state")) == {"shown": 1, "status": "first"}
        with pytest.raises(ValueError, match=r"^port "):
            page.LiveView(port=view.server.server_address[1])


@pytest.mark.slow
@pytest.mark.skipif(chromium.missing() is not None, reason=str(chromium.missing()))
def test_a_browser_sees_the_person_and_the_next_one(person):
    blue = replace(
        person, gaussians=replace(person.gaussians, colors=person.gaussians.colors[:, ::-1])
    )

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
    with page.LiveView() as view, chromium.Chromium(900, 600) as browser:
        view.show(person)
        browser.driver.get(view.url)
        assert wait_for(browser, 0)
        near = browser.run(
            inside
            + "const kept = page.state(); kept.orbit.distance *= 0.8; page.restore(kept); return"
            " kept"
        )
        view.show(blue)
        assert wait_for(browser, 2) and share(browser, 0) < 0.01
        assert (
            browser.run(inside + "return page.state()")["orbit"] == near["orbit"]
        )  # as people had turned it
        assert browser.problems() == []
