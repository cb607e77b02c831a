"""The face in the page: what is packed; its script moves Gaussians as `hg.animate` does."""

import json
import shutil
import subprocess

import jax.numpy as jnp
import numpy as np
import pytest
from small import f32

from humangs_jax.avatar.animate import animate
from humangs_jax.avatar.attach_face import with_face
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.body.library import load_body
from humangs_jax.body.model import rest_pose, shape_body
from humangs_jax.body.motion import Motion
from humangs_jax.core.pytree import replace
from humangs_jax.motion.face_tracks import ARKIT
from humangs_jax.rendering.gaussians import Gaussians
from humangs_jax.viewer.page import pack, page_html, page_script

AWAY = 100.0


@pytest.fixture(scope="module")
def person():
    body = load_body()
    rest = shape_body(body, jnp.zeros(0))
    g = len(body.template)
    gaussians = Gaussians(
        means=rest.vertices,
        quats=jnp.tile(f32([1, 0, 0, 0]), (g, 1)),
        scales=jnp.full((g, 3), 0.004),
        opacities=jnp.full(g, 0.9),
        colors=jnp.full((g, 3), 0.5),
    )
    avatar = Avatar(
        gaussians, body.skinning_weights, rest.vertices, rest.joints, body.faces, body.parents,
        body.joint_names,
    )  # fmt: skip
    return body, with_face(avatar)


def unpacked(packed, name):
    entry = packed.header["arrays"][name]
    count = int(np.prod(entry["shape"]))
    array = np.frombuffer(packed.data, entry["type"], count, entry["offset"])
    return array.reshape(entry["shape"])


def test_the_page_holds_the_face_and_its_motion(person):
    _, avatar = person
    faces = np.zeros((3, 52), np.float32)
    faces[:, ARKIT.index("jawOpen")] = (0, 0.5, 1)
    motion = Motion(jnp.zeros((3, 55, 3)), jnp.zeros((3, 3)), 30.0, jnp.asarray(faces), ARKIT)
    packed = pack(avatar, motion)
    hidden = packed.header["face"]["hidden"]
    assert packed.header["count"] == len(avatar.gaussians.means) + hidden
    assert len(unpacked(packed, "colors")) == packed.header["count"]
    read = unpacked(packed, "motion_faces") * packed.header["motion"]["face_step"]
    np.testing.assert_allclose(read, faces, atol=1e-4)
    directions = unpacked(packed, "face_directions")[ARKIT.index("jawOpen")]
    directions = directions * packed.header["face"]["step"]
    moved = len(avatar.face.expressions.vertices)
    expected = avatar.face.expressions.directions[..., ARKIT.index("jawOpen")]
    np.testing.assert_allclose(directions[:moved], expected, atol=1e-5)


def test_avatars_of_other_bodies_have_no_face_in_the_page():
    from small import small_avatar

    assert "face" not in pack(small_avatar()).header
    assert '"face"' not in page_html(small_avatar()).split('id="header">')[1].split("</script>")[0]


def test_a_face_that_is_not_finite_is_refused_by_name(person):
    avatar = person[1]
    broken = replace(avatar.face, lips=avatar.face.lips.at[0, 0].set(np.nan))
    with pytest.raises(ValueError, match=r"face\.lips"):
        pack(replace(avatar, face=broken))


@pytest.mark.skipif(shutil.which("node") is None, reason="needs node")
@pytest.mark.parametrize(
    "shapes",
    [{}, {"jawOpen": 1.0}, {"eyeBlinkLeft": 1.0, "mouthSmileRight": 0.7}, {"eyeLookUpRight": 1.0}],
)
def test_the_script_moves_what_python_moves(person, shapes, tmp_path):
    body, avatar = person
    packed = pack(avatar)
    arrays = {}
    for name in packed.header["arrays"]:
        if name.startswith("face_"):
            arrays[name] = unpacked(packed, name).reshape(-1).tolist()
    names = avatar.expression_names
    expression = [shapes.get(name, 0.0) for name in names]
    means = np.concatenate([avatar.gaussians.means, avatar.face.hidden.means])
    # what the page has after loading
    scene = {
        "header": {"face": packed.header["face"]},
        "arrays": arrays,
        "count": len(means),
        "means": means.reshape(-1).tolist(),
        "shapedMeans": means.reshape(-1).tolist(),
        "rest": np.asarray(avatar.rest_joints).tolist(),
        "faceKey": None,
    }
    (tmp_path / "scene.json").write_text(json.dumps(scene))
    code = (
        page_script("kinematics", "face")
        + f"""
const scene = JSON.parse(require("fs").readFileSync({json.dumps(str(tmp_path / "scene.json"))}));
scene.means = Float32Array.from(scene.means);
scene.shapedMeans = Float32Array.from(scene.shapedMeans);
const changed = applyFace(scene, {json.dumps(expression)}), means = Array.from(scene.means);
console.log(JSON.stringify([changed, means, applyFace(scene, {json.dumps(expression)})]));
"""
    )
    (tmp_path / "page.js").write_text(code)
    output = subprocess.run(
        ["node", tmp_path / "page.js"], capture_output=True, text=True, check=True
    ).stdout
    changed, found, again = json.loads(output)
    assert changed and not again
    found = np.reshape(found, (-1, 3))
    pose = replace(rest_pose(body), expression=f32(expression))
    wanted = animate(avatar, pose)
    opacities = np.asarray(wanted.opacities) / np.concatenate(
        [avatar.gaussians.opacities, avatar.face.hidden.opacities]
    )
    # hidden Gaussians are moved away by the page and made transparent by Python
    shown = found[:, 1] > -AWAY
    assert not opacities[~shown].size or opacities[~shown].max() < 0.6
    assert opacities[shown].min() > 0.3
    np.testing.assert_allclose(found[shown], np.asarray(wanted.means)[shown], atol=2e-4)
