"""Uses of the page in a browser: save, record, ask for help, embed; and browsers it cannot use."""

import base64
import io
import subprocess

import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image
from small import small_avatar

from experiments import chromium
from humangs_jax.body.motion import Motion
from humangs_jax.core.pytree import replace
from humangs_jax.io.images import DRAWN, MARK_KEY
from humangs_jax.viewer import page

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(chromium.missing() is not None, reason=str(chromium.missing())),
]

WIDTH, HEIGHT = 900, 600
PHONE = (390, 844)
JOINTS = ("pelvis", "left_collar", "left_elbow")
KEEPS_FILES = """
window.saved = [];
const addressOf = URL.createObjectURL.bind(URL);
URL.createObjectURL = (blob) => { window.saved.push({ blob }); return addressOf(blob); };
HTMLAnchorElement.prototype.click = function () { window.saved.at(-1).name = this.download; };
"""
"""Script that runs before the page and keeps files that the page saves."""
NO_WEBGL = "HTMLCanvasElement.prototype.getContext = () => null;"
NO_RECORDER = "delete window.MediaRecorder;"
OLD = "delete window.DecompressionStream;"
CONTROLS = ("panel", "transport", "show-help", "toggle-panel", "about")


def ball_person():
    """Returns a red ball a metre above the floor, whose place and cover can be seen."""
    avatar = small_avatar(per_vertex=32)
    directions = np.random.default_rng(0).normal(size=avatar.gaussians.means.shape)
    means = 0.4 * directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    gaussians = replace(
        avatar.gaussians,
        means=jnp.asarray(means, jnp.float32),
        scales=jnp.full(means.shape, 0.07),
        opacities=jnp.full(len(means), 0.95),
        colors=jnp.tile(jnp.asarray([0.9, 0.1, 0.1]), (len(means), 1)),
    )
    vertices = np.zeros((len(avatar.rest_vertices), 3), np.float32)
    vertices[:2, 1] = -0.6, 0.6
    rest_joints = jnp.zeros((3, 3))
    changes = {
        "rest_vertices": jnp.asarray(vertices),
        "rest_joints": rest_joints,
        "joint_names": JOINTS,
    }
    return replace(avatar, gaussians=gaussians, **changes)


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "ball.html"
    turning = np.zeros((48, 3, 3))
    turning[:, 0, 1] = np.linspace(0, 2, 48)
    page.write_page(
        path,
        ball_person(),
        Motion(jnp.asarray(turning), jnp.zeros((48, 3)), fps=24.0),
        title="ball",
    )
    return path


@pytest.fixture(scope="module")
def shared():
    with chromium.Chromium(WIDTH, HEIGHT) as browser:
        before_the_page(browser, KEEPS_FILES)
        yield browser


@pytest.fixture
def browser(shared, file):
    shared.resize(WIDTH, HEIGHT)
    shared.open(file)
    yield shared
    assert shared.problems() == []


def before_the_page(browser, script):
    browser.driver.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": script})


def saved(browser, button):
    """Returns name and content of the file that the page saves after a click."""
    name, content = browser.run(
        """saved.length = 0;
        document.getElementById(given[0]).click();
        while (!saved[0]?.name) await new Promise((resolve) => setTimeout(resolve, 20));
        const bytes = new Uint8Array(await saved[0].blob.arrayBuffer());
        const text = bytes.reduce((text, byte) => text + String.fromCharCode(byte), "");
        return [saved[0].name, btoa(text)];""",
        button,
    )
    return name, base64.b64decode(content)


def saved_image(browser, scale, transparent):
    browser.run(
        """document.getElementById("image-scale").value = given[0];
        document.getElementById("image-transparent").checked = given[1];""",
        scale,
        transparent,
    )
    name, content = saved(browser, "save-image")
    assert name == "ball.png"
    image = Image.open(io.BytesIO(content))
    assert image.info[MARK_KEY] == DRAWN
    return np.asarray(image.convert("RGBA"), float) / 255


def redness(image):
    return image[..., 0] - image[..., 1:3].max(axis=-1)


def middle_of_the_ball(image):
    """Returns (column, row) of the ball's middle, as shares of the image."""
    rows, columns = np.nonzero(redness(image) > 0.3)
    return (columns.min() + columns.max() + 1) / 2 / image.shape[1], (
        rows.min() + rows.max() + 1
    ) / 2 / image.shape[0]


def visible(browser, ids):
    return [
        name
        for name in ids
        if browser.run("return document.getElementById(given[0]).checkVisibility()", name)
    ]


def lower_the_resolution(browser):
    """Plays as on a slow machine until the page halves its resolution; returns its size."""
    return browser.run(
        """const canvas = document.getElementById("view");
        const slow = (time) => { while (performance.now() < time); };
        document.querySelector("[data-mode=motion]").click();
        if (!document.body.classList.contains("playing")) document.getElementById("play").click();
        for (let i = 0; i < 120 && canvas.width > 0.5 * innerWidth; i++) {
          slow(performance.now() + 60);
          await new Promise(requestAnimationFrame);
        }
        return [canvas.width, canvas.height];"""
    )


@pytest.mark.parametrize("playing", [True, False])
def test_an_image_has_the_size_of_the_page_though_it_plays_at_half_of_it(browser, playing):
    assert lower_the_resolution(browser) == [WIDTH / 2, HEIGHT / 2]
    if not playing:
        browser.run(
            "document.getElementById('play').click(); await new Promise((resolve) =>"
            " setTimeout(resolve, 600));"
        )
    assert saved_image(browser, 1, False).shape == (HEIGHT, WIDTH, 4)
    size = browser.run(
        "const canvas = document.getElementById('view'); return [canvas.width, canvas.height]"
    )
    assert size == ([WIDTH / 2, HEIGHT / 2] if playing else [WIDTH, HEIGHT])
    assert (
        browser.run("return document.getElementById('message').textContent")
        == f"ball.png: {WIDTH} × {HEIGHT} pixels"
    )


def test_images_may_be_twice_as_large_and_transparent_with_the_person_in_the_middle(browser):
    browser.run("await humangs.settle()")
    browser.run("document.getElementById('ground').click()")
    plain, large = saved_image(browser, 1, False), saved_image(browser, 2, False)
    browser.run("document.getElementById('ground').click()")
    cut_out = saved_image(browser, 2, True)
    assert large.shape == cut_out.shape == (2 * HEIGHT, 2 * WIDTH, 4)
    assert (plain[..., 3] == 1).all() and (large[..., 3] == 1).all()
    for image in (plain, large, cut_out):
        assert middle_of_the_ball(image)[0] == pytest.approx(0.5, abs=0.02)
    halved = large.reshape(HEIGHT, 2, WIDTH, 2, 4).mean(axis=(1, 3))
    assert np.abs(halved - plain).mean() < 0.01
    alpha = cut_out[..., 3]
    assert alpha[HEIGHT, WIDTH] > 0.9 and (alpha[:40] == 0).all() and (alpha[-40:] == 0).all()
    # the floor is left out; over the page's colour it is the opaque picture
    background = plain[5, 5, :3]
    over = alpha[..., None] * cut_out[..., :3] + (1 - alpha[..., None]) * background
    inside = redness(large) > 0.3
    np.testing.assert_allclose(over[inside], large[..., :3][inside], atol=0.02)


def frames_of(video):
    """Returns the frames (n, HEIGHT, WIDTH, 3) of a video; fails if they have another size."""
    import imageio_ffmpeg

    arguments = [
        "-i",
        str(video),
        "-fps_mode",
        "passthrough",
        "-f",
        "rawvideo",
        "-pix_fmt",
        "rgb24",
        "-",
    ]
    done = subprocess.run(
        [imageio_ffmpeg.get_ffmpeg_exe(), *arguments], capture_output=True, check=True
    )
    assert f", {WIDTH}x{HEIGHT}" in done.stderr.decode()
    return np.frombuffer(done.stdout, np.uint8).reshape(-1, HEIGHT, WIDTH, 3)


def test_a_video_shows_the_motion_without_controls(browser, tmp_path):
    browser.run(
        "document.getElementById('record-video').click(); await new Promise((resolve) =>"
        " setTimeout(resolve, 2500));"
    )
    assert visible(browser, CONTROLS) == [] and visible(browser, ["stop-video"]) == ["stop-video"]
    assert "playing" in browser.run("return document.body.className")
    name, content = saved(browser, "stop-video")
    assert name == "ball.webm"
    assert visible(browser, CONTROLS) == list(CONTROLS) and visible(browser, ["stop-video"]) == []
    (tmp_path / name).write_bytes(content)
    frames = frames_of(tmp_path / name)
    assert len(frames) > 1
    for frame in (frames[0], frames[-1]):
        column, row = middle_of_the_ball(frame / 255)
        assert (column, row) == pytest.approx((0.5, 0.5), abs=0.05)


def test_a_browser_without_a_recorder_has_no_button_for_it(file):
    with chromium.Chromium(WIDTH, HEIGHT) as browser:
        before_the_page(browser, NO_RECORDER)
        browser.open(file)
        assert visible(browser, ["save-image", "record-video"]) == ["save-image"]


@pytest.mark.parametrize(
    ("script", "reason"),
    [(NO_WEBGL, "WebGL 2 is missing."), (OLD, "DecompressionStream is missing.")],
)
def test_a_browser_that_cannot_show_it_says_which_can_and_has_no_controls(file, script, reason):
    with chromium.Chromium(WIDTH, HEIGHT) as browser:
        before_the_page(browser, script)
        with pytest.raises(RuntimeError, match=reason):
            browser.open(file)
        assert visible(browser, ("view", "message", *CONTROLS)) == []
        message = browser.run("return document.getElementById('unable').innerText")
        assert all(word in message for word in ("WebGL 2", "Chrome", "Firefox", "Safari", reason))


def test_so_does_one_that_runs_no_scripts(file):
    from selenium.webdriver.common.by import By
    from selenium.webdriver.support.ui import WebDriverWait

    with chromium.Chromium(WIDTH, HEIGHT) as browser:
        browser.driver.execute_cdp_cmd("Emulation.setScriptExecutionDisabled", {"value": True})
        browser.driver.get(file.as_uri())
        shown = lambda name: browser.driver.find_element(By.ID, name).is_displayed()
        WebDriverWait(browser.driver, 30).until(lambda driver: shown("unable"))
        assert not any(shown(name) for name in ("view", "message", *CONTROLS))


@pytest.mark.parametrize("size", [(WIDTH, HEIGHT), PHONE])
def test_a_click_opens_the_help(browser, size):
    from selenium.webdriver.common.by import By

    browser.resize(*size)
    button = browser.driver.find_element(By.ID, "show-help")
    assert button.is_displayed() and 0 <= button.location["x"] <= size[0] - button.size["width"]
    button.click()
    help_ = browser.driver.find_element(By.ID, "help")
    assert "two fingers" in help_.text
    help_.find_element(By.TAG_NAME, "button").click()
    assert not help_.is_displayed()


def wait_for(browser, condition):
    """Waits until a JavaScript expression is true.

    Raises:
        TimeoutException: after a minute.
    """
    from selenium.webdriver.support.ui import WebDriverWait

    WebDriverWait(browser.driver, 60).until(lambda driver: browser.run(f"return {condition}"))


NAME = "document.getElementById('motion-name').textContent"


def drop(browser, name, **arrays):
    content = io.BytesIO()
    np.savez(content, **arrays)
    browser.run(
        """const bytes = Uint8Array.from(atob(given[1]), (c) => c.charCodeAt(0));
        const data = new DataTransfer();
        data.items.add(new File([bytes], given[0]));
        window.dispatchEvent(new DragEvent("drop", { dataTransfer: data, cancelable: true }));""",
        name,
        base64.b64encode(content.getvalue()).decode(),
    )


@pytest.mark.parametrize("size", [(WIDTH, HEIGHT), PHONE])
def test_a_motion_without_a_rate_is_a_question_not_an_end(browser, size):
    from selenium.webdriver.common.by import By
    from selenium.webdriver.common.keys import Keys

    browser.resize(*size)
    still = {"rotations": np.zeros((9, 3, 3)), "translations": np.zeros((9, 3))}
    before = browser.run(f"return {NAME}")
    drop(browser, "still.npz", **still)
    wait_for(browser, "!document.getElementById('ask-rate').hidden")
    form = browser.driver.find_element(By.ID, "ask-rate")
    assert (
        form.is_displayed()
        and "still.npz" in form.text
        and "how many frames are a second?" in form.text
    )
    assert form.location["x"] >= 0 and form.location["x"] + form.size["width"] <= size[0]
    # without an answer the former motion stays
    browser.driver.find_element(By.ID, "leave-rate").click()
    assert not form.is_displayed() and browser.run(f"return {NAME}") == before
    drop(browser, "still.npz", **still)
    wait_for(browser, "!document.getElementById('ask-rate').hidden")
    # an answer is used; one frame needs none
    answer = browser.driver.find_element(By.ID, "rate-answer")
    answer.clear()
    answer.send_keys("12.5", Keys.ENTER)
    wait_for(browser, f"{NAME} === 'still.npz: 9 frames'")
    assert not form.is_displayed()
    shown = browser.run(
        "return ['fps', 'time'].map((id) => document.getElementById(id)).map((x) => x.value)"
    )
    assert shown[0] == "12.5" and shown[1].endswith("/ 0.6 s")
    drop(browser, "one.npz", **{key: values[:1] for key, values in still.items()}, fps=30)
    wait_for(browser, f"{NAME} === 'one.npz: 1 frame'")


# In another page
# --------------------------------------------------------------------------------------------------


@pytest.fixture
def embedded(shared, file, tmp_path):
    """Yields a function that opens a blue page with the page in it.

    It returns a function that runs a script in the inner page.
    """

    def open_(query, size=(WIDTH - 100, HEIGHT - 100)):
        outer = tmp_path / "outer.html"
        style = f"position:fixed;left:0;top:0;border:0;width:{size[0]}px;height:{size[1]}px"
        frame = f'<iframe src="{file.as_uri()}?{query}" style="{style}"></iframe>'
        outer.write_text(f'<!doctype html><body style="background:rgb(0,0,200)">{frame}</body>')
        shared.driver.switch_to.default_content()
        shared.driver.get(outer.as_uri())
        shared.driver.switch_to.frame(0)
        shared.run("await humangs.ready; await new Promise((resolve) => setTimeout(resolve, 400));")
        return shared

    shared.resize(WIDTH, HEIGHT)
    yield open_
    shared.driver.switch_to.default_content()
    assert shared.problems() == []


def test_a_page_that_embeds_it_shows_through_and_has_no_controls(embedded):
    browser = embedded("autoplay&panel=0&background=transparent")
    assert visible(browser, CONTROLS) == [] and browser.run("return humangs.view().playing")
    image = browser.screenshot()
    corner = image[60, 60]
    np.testing.assert_allclose(corner, [0, 0, 200 / 255], atol=0.01)
    ball = image[: HEIGHT - 100, : WIDTH - 100]
    assert middle_of_the_ball(ball) == pytest.approx((0.5, 0.5), abs=0.03)
    floor = ball[-10:]
    np.testing.assert_allclose(floor, np.broadcast_to([0, 0, 200 / 255], floor.shape), atol=0.01)


def test_an_address_may_ask_for_a_colour_a_pose_and_a_time(embedded):
    browser = embedded("autoplay=0&panel=0&background=00aa33&floor=0&time=0.5")
    view = browser.run("return humangs.view()")
    assert (
        not view["playing"]
        and view["mode"] == "motion"
        and view["frame"] == pytest.approx(0.5 * 24)
    )
    np.testing.assert_allclose(browser.screenshot()[30, 30], [0, 0xAA / 255, 0x33 / 255], atol=0.01)
    browser = embedded("pose=t")
    assert browser.run("return humangs.view().mode") == "rest"
    assert set(visible(browser, CONTROLS)) == set(CONTROLS) - {"transport"}


def test_an_option_that_is_wrong_is_named_and_others_are_ignored(embedded):
    browser = embedded("background=sky&time=-1&v=3&constructor=1")
    message = browser.run("return document.getElementById('message').textContent")
    assert (
        message
        == "background=sky: expected transparent, or six digits such as ffcc00; time=-1: expected"
        " seconds of the motion, such as 1.5"
    )
    assert browser.run("return humangs.view()")["frame"] < 48 and "#f6f5f2" in browser.run(
        "return document.querySelector('#swatches [aria-pressed=true]').title"
    )
