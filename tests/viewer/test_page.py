"""The page as a file, on localhost and in a notebook; the commands that make it.

test_browser.py tests what it draws.
"""

import html
import json
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

from humangs_jax.avatar.avatar import Avatar
from humangs_jax.body.library import load_body
from humangs_jax.body.model import shape_body
from humangs_jax.body.motion import Motion
from humangs_jax.core.pytree import replace
from humangs_jax.motion import save_motion
from humangs_jax.rendering.gaussians import Gaussians
from humangs_jax.viewer import page


@pytest.fixture(scope="module")
def text():
    return page.page_html(small_avatar(), title="<me> & {{data}}")


def test_the_page_is_one_file_that_asks_nobody(text):
    assert "connect-src 'none'" in text and "default-src 'none'" in text
    # the icon
    assert re.findall(r'<\w[^>]*\b(?:src|href|action|data)="([^"]*)"', text) == ["data:,"]
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
    """They also come if Gaussians between the legs have other weights; not if refinement added
    some.
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
