"""Wrong arguments of users give one line that says what was given and what is expected."""

import ast
import dataclasses
import re
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import humangs_jax as hg
from humangs_jax.avatar.export.splats import write_ply
from humangs_jax.body.library import load_body
from humangs_jax.body.model import shape_body
from humangs_jax.core.checks import (
    FINITE,
    NOT_NEGATIVE,
    POSITIVE,
    UNIT,
    check_values,
    checked_arguments,
)
from humangs_jax.core.configuration import Presets, check_fields
from humangs_jax.core.pytree import replace
from humangs_jax.geometry.camera import intrinsics_from_fov, stack_cameras
from humangs_jax.network.runtime import Runtime
from humangs_jax.rendering import splatting

COUNT = 7
GAUSSIANS = hg.Gaussians(
    jnp.zeros((COUNT, 3)),
    jnp.ones((COUNT, 4)),
    jnp.ones((COUNT, 3)),
    jnp.ones(COUNT),
    jnp.ones((COUNT, 3)),
)
CAMERA = hg.Camera(jnp.eye(3), jnp.eye(4), 8, 8)
POSE = hg.BodyPose(jnp.zeros((2, 3)), jnp.zeros(3))
AVATAR = hg.Avatar(
    GAUSSIANS,
    jnp.ones((COUNT, 2)) / 2,
    jnp.zeros((4, 3)),
    jnp.zeros((2, 3)),
    jnp.zeros((1, 3), int),
    (-1, 0),
    ("a", "b"),
)
AVATARS = jax.tree.map(lambda x: jnp.stack([x, x]), AVATAR)
CAPTURE = hg.capture_from_arrays(
    np.ones((1, 8, 8, 3)),
    np.eye(3)[None],
    np.eye(4)[None],
    np.zeros((1, 55, 3)),
    np.zeros((1, 3)),
    body=None,
)
CONFIG = hg.HumanGSConfig()


def cut(name, size):
    return replace(GAUSSIANS, **{name: getattr(GAUSSIANS, name)[:size]})


WRONG = {
    "avatar for Gaussians": (
        lambda: hg.render(AVATAR, CAMERA),
        "gaussians: expected Gaussians, got Avatar; animate",
    ),
    "a capture for a camera": (
        lambda: hg.render(GAUSSIANS, CAPTURE),
        "camera: expected Camera, got Capture; it has a batch",
    ),
    "a class": (
        lambda: hg.render(GAUSSIANS, hg.Camera),
        "camera: expected Camera, got the class Camera",
    ),
    "too few": (
        lambda: hg.render(GAUSSIANS),
        r"render\(gaussians, camera, ...\): missing .* 'camera'",
    ),
    "no preset": (
        lambda: hg.render(GAUSSIANS, CAMERA, "fst"),
        "no preset 'fst': expected one of exact, near_exact",
    ),
    "a field": (
        lambda: hg.render(GAUSSIANS, CAMERA, tile_size=4),
        r"it is a field of SplatConfig, config=SplatConfig\(tile",
    ),
    "a field of refinement": (
        lambda: hg.refine(AVATAR, CAPTURE, iterations=10),
        (
            r"^refine\(avatar, capture, ...\): no argument 'iterations': it is a field of"
            r" RefineConfig, config=RefineConfig"
        ),
    ),
    "an unknown name": (
        lambda: hg.render(GAUSSIANS, CAMERA, color=1),
        "no argument 'color'; its arguments are gaussians, ",
    ),
    "order of reconstruct": (
        lambda: hg.reconstruct(CAPTURE, {}, CONFIG),
        r"reconstruct\(variables, config, capture\): variables: expected Mapping, got Capture",
    ),
    "one for a batch": (
        lambda: hg.reconstruct_batch({}, CONFIG, CAPTURE),
        "captures: expected Sequence, got Capture; a list of captures",
    ),
    "a capture for a pose": (
        lambda: hg.animate(AVATAR, CAPTURE),
        "pose: expected BodyPose, got Capture; capture.pose",
    ),
    "a name of no preset": (
        lambda: hg.reconstruct_with("real", {}, CONFIG, CAPTURE),
        "settings 'real': expected Settings or",
    ),
    "no path": (
        lambda: write_ply(GAUSSIANS, "a.ply"),
        "path: expected str or PathLike, got Gaussians",
    ),
    "a batch of avatars": (
        lambda: hg.animate(AVATARS, POSE),
        r"avatar: expected one Avatar, got a batch \(2,\): take one",
    ),
    "a training of a network": (
        lambda: hg.train(CONFIG, None, [], "x"),
        "config: expected TrainConfig, got HumanGSConfig",
    ),
    "fewer colors": (
        lambda: hg.render(cut("colors", 3), CAMERA),
        r"gaussians.colors: expected shape \(7, 3\), got \(3, 3\)",
    ),
    "fewer in jit": (
        lambda: jax.jit(hg.render)(cut("scales", 3), CAMERA),
        r"scales: expected shape \(7, 3\)",
    ),
    "no intrinsics": (
        lambda: hg.render(GAUSSIANS, replace(CAMERA, K=jnp.eye(4))),
        r"camera.K: expected shape \(3, 3\)",
    ),
    "weights of others": (
        lambda: hg.skin(replace(AVATAR, skinning_weights=jnp.ones((COUNT, 5))), POSE),
        r"avatar.rest_joints: expected shape \(5, 3\), got \(2, 3\)",
    ),
    "a color": (
        lambda: hg.render(GAUSSIANS, CAMERA, background="blak"),
        "background 'blak': expected a color",
    ),
    "bytes": (
        lambda: hg.render(GAUSSIANS, CAMERA, background=(0, 0, 255)),
        r"background: expected 3 numbers in \[0, 1\]",
    ),
    "an array of bytes": (
        lambda: splatting._color(np.asarray([0, 0, 255]), np.dtype("float32")),
        r"background: expected 3 numbers in \[0, 1\]",
    ),
    "opacities of 3DGS": (
        lambda: hg.render(replace(GAUSSIANS, opacities=GAUSSIANS.opacities[:, None]), CAMERA),
        r"gaussians.opacities: expected shape \(7,\), got \(7, 1\)$",
    ),
    "colors of bytes": (
        lambda: hg.unconstrain(replace(GAUSSIANS, colors=jnp.zeros((COUNT, 3), jnp.uint8))),
        r"^unconstrain\(gaussians\): gaussians.colors: expected floating-point numbers, got uint8",
    ),
    "a list of means": (
        lambda: hg.render(replace(GAUSSIANS, means=np.zeros((COUNT, 3)).tolist()), CAMERA),
        r"gaussians.means: expected an array of shape \(g, 3\), got list; jnp.asarray makes one",
    ),
    "a plan of what is traced": (
        lambda: jax.jit(lambda g: hg.plan_buffers(g, CAMERA).max_pairs)(GAUSSIANS),
        (
            "^plan_buffers measures what a scene needs: call it outside of jit, vmap and grad,"
            " which know shapes only"
        ),
    ),
    "a file of what is traced": (
        lambda: jax.jit(lambda g: hg.save_gaussians("a.ply", g))(GAUSSIANS),
        "^save_gaussians writes a file: call it outside of jit",
    ),
    "an avatar that is traced": (
        lambda: jax.jit(lambda a: a.save("a.npz"))(AVATAR),
        "^Avatar.save writes a file: call it outs",
    ),
    "integers in an export": (
        lambda: hg.export("a.ply", replace(AVATAR, rest_vertices=jnp.zeros((4, 3), int))),
        r"avatar.rest_vertices: expected floating-point numbers, got int32",
    ),
    "degrees": (
        lambda: intrinsics_from_fov(40.0, 8, 8),
        r"vertical_fov 40: expected radians .*np.deg2rad\(40\)",
    ),
    "degrees of an orbit": (
        lambda: hg.orbit(jnp.zeros(3), 2.0, jnp.zeros(1), 30.0, jnp.eye(3), 8, 8),
        "elevations 30.0: expected radians",
    ),
    "one camera": (
        lambda: stack_cameras(CAMERA),
        r"stack_cameras\(cameras\): cameras: expected Sequence, got Camera; a list of cameras",
    ),
    "a list of coefficients": (
        lambda: shape_body(load_body(), [0.0]),
        (
            r"^shape_body\(body, betas\): betas: expected an array of shape \(s_used\), got list;"
            r" jnp.asarray makes one"
        ),
    ),
    "a batch of coefficients": (
        lambda: shape_body(load_body(), jnp.zeros((2, 3))),
        r"betas: expected an array of shape \(s_used\), got \(2, 3\)",
    ),
    "names for people": (
        lambda: hg.evaluate(iter([3])),
        "source: expected Cases, got a int among them",
    ),
    "as_trained": (
        lambda: hg.SPLAT_PRESETS["as_trained"],
        "no preset 'as_trained': .*SPLAT_PRESETS.avatar.rendering",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_arguments_are_named(name):
    call, words = WRONG[name]
    with pytest.raises((TypeError, ValueError, KeyError), match=words) as caught:
        call()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("config", "change", "words"),
    [
        (
            hg.Settings(),
            {"splat": "fst"},
            r"Settings\.splat: expected one of 'as_trained', .*, got 'fst'",
        ),
        (Runtime(), {"attention": "flash"}, r"Runtime\.attention: expected one of 'auto', 'xla', "),
        (Runtime(), {"crop": "yes"}, r"Runtime\.crop: expected bool, got 'yes'"),
        (hg.SplatConfig(), {"tile_size": 8.0}, r"SplatConfig\.tile_size: expected int, got 8.0"),
        (
            hg.RefineConfig(),
            {"steps": "10"},
            r"RefineConfig\.steps: expected one of int, None, got '10'",
        ),
        (
            CONFIG.conventions,
            {"tokens": "front"},
            r"Conventions\.tokens: expected one of 'all', 'foreground', got 'front'",
        ),
        (CONFIG, {"runtime": "fast"}, r"HumanGSConfig\.runtime: expected Runtime, got 'fast'"),
    ],
)
def test_wrong_fields_of_configurations_are_named(config, change, words):
    """The check at the end of `__init__` is called alone, because types are checked before it in
    tests.
    """
    with pytest.raises(ValueError, match=words):
        type(config).__post_init__(replace(config, **change))
    type(config).__post_init__(config)


@dataclasses.dataclass(frozen=True)
class Fields:
    number: float = 1.0
    count: int | None = None
    kind: Literal["a", "b"] | None = None
    names: tuple[str, ...] = ()


def test_numbers_of_any_library_are_numbers():
    for fields in (
        Fields(),
        Fields(1, 3, "b", ("x",)),
        Fields(np.float32(2), np.int64(3)),
        Fields(np.float64(2)),
    ):
        check_fields(Fields, vars(fields), "Fields")
    for fields in (
        Fields(True),
        Fields("1"),
        Fields(count=True),
        Fields(kind="c"),
        Fields(names=["x"]),
        Fields(None),
    ):
        with pytest.raises(ValueError, match=r"^Fields\.\w+: expected "):
            check_fields(Fields, vars(fields), "Fields")


@pytest.mark.slow
def test_what_is_natural_is_accepted():
    black = hg.render(GAUSSIANS, CAMERA, background=jnp.zeros(3)).rgb
    for name in ("black", "#000000", (0, 0, 0), [0.0, 0.0, 0.0], np.zeros(3, np.float32)):
        np.testing.assert_array_equal(hg.render(GAUSSIANS, CAMERA, background=name).rgb, black)
    fast = hg.render(GAUSSIANS, CAMERA, hg.SPLAT_PRESETS["fast"]).rgb
    np.testing.assert_array_equal(hg.render(GAUSSIANS, CAMERA, "fast").rgb, fast)
    # a configuration needs no static_argnums
    drawn = jax.jit(hg.render)(GAUSSIANS, CAMERA, hg.SPLAT_PRESETS["fast"])
    np.testing.assert_allclose(drawn.rgb, fast, atol=1e-6)


def test_decorated_functions_stay_what_they_are():
    @checked_arguments
    def written(path: str | Path, camera: hg.Camera | None = None, *, more: int = 3, **others):
        """About it."""
        return path, camera, more, others

    assert written.__doc__ == "About it." and written.__name__ == "written"
    assert written("a", None, more=4, other=5) == ("a", None, 4, {"other": 5})
    assert written(Path("a"), CAMERA, more="no class to check")[2] == "no class to check"
    with pytest.raises(
        TypeError, match=r"^written\(path, ...\): camera: expected Camera, got 'x'$"
    ):
        written("a", "x")


def test_presets_are_dicts():
    presets = Presets({"a": 1}, "; ask")
    assert presets == {"a": 1} and "b" not in presets and presets.get("b") is None
    with pytest.raises(KeyError, match="no preset 'b': expected one of a; ask"):
        presets["b"]


def test_errors_of_the_library_name_no_options():
    """Only the command line shows the name of an argument as an option."""
    package, named, options = Path(hg.__file__).parent, [], set()
    for path in package.rglob("*.py"):
        text, command = path.read_text(), path.parent.name == "cli"
        for node in ast.walk(ast.parse(text)) if command or re.search(r"--[a-z]", text) else ():
            if command and isinstance(node, ast.AnnAssign):
                options.add(ast.unparse(node.target).replace("_", "-"))
            elif not command and isinstance(node, ast.Raise):
                named += [
                    (path.name, option) for option in re.findall(r"--([a-z-]+)", ast.unparse(node))
                ]
    assert len(options) > 100 and not [
        (name, option) for name, option in named if option in options
    ]


def test_what_is_right_passes():
    arrays = {
        "means": (jnp.asarray([[-1e30, 0.0], [1e-30, 3.0]]), FINITE),
        "opacities": (jnp.asarray([0.0, 1.0]), UNIT),
        "photos": (np.asarray([0.0, 1.0], np.float32), UNIT),
        "labels": (jnp.arange(3), NOT_NEGATIVE),
        "focal": (np.float32(1e-30), POSITIVE),
        "absent": (None, UNIT),
        "empty": (jnp.zeros((0, 3)), POSITIVE),
    }
    check_values("draw", arrays)


@pytest.mark.parametrize("array_of", [np.asarray, jnp.asarray], ids=["numpy", "jax"])
@pytest.mark.parametrize(
    ("entries", "values", "words"),
    [
        (
            [[0, 1], [np.nan, np.inf]],
            FINITE,
            r"expected finite numbers, but 2 of 4 are not, the first at \[1, 0\]: nan",
        ),
        (
            [0, 1, -np.inf],
            NOT_NEGATIVE,
            r"expected finite numbers >= 0, but 1 of 3 are not, the first at \[2\]: -inf",
        ),
        (
            [0.5, 1.25, -1],
            UNIT,
            r"expected numbers in \[0, 1\], but 2 of 3 are not, the first at \[1\]: 1.25",
        ),
        (
            [1, 0],
            POSITIVE,
            r"expected finite numbers > 0, but 1 of 2 are not, the first at \[1\]: 0",
        ),
        (-3.0, NOT_NEGATIVE, r"expected finite numbers >= 0, but 1 of 1 are not, -3"),
    ],
)
def test_what_is_wrong_is_named(array_of, entries, values, words):
    right = (jnp.ones(3), FINITE)
    with pytest.raises(ValueError, match=f"^draw: colors: {words}$"):
        check_values(
            "draw",
            {
                "means": right,
                "colors": (array_of(np.asarray(entries, np.float32)), values),
                "w": right,
            },
        )


def test_traced_arrays_are_not_looked_at():
    def checked(x):
        check_values("draw", {"x": (x, UNIT), "constant": (np.asarray([np.nan]), FINITE)})
        return jnp.sum(x)

    wrong = jnp.asarray([np.nan, 2.0])
    assert np.isnan(jax.jit(checked)(wrong)) and np.isnan(jax.vmap(checked)(wrong[None])[0])
    assert jax.grad(checked)(wrong).tolist() == [1, 1]
    assert str(jax.make_jaxpr(checked)(wrong)) == str(jax.make_jaxpr(jnp.sum)(wrong))
    with pytest.raises(ValueError, match="x: expected numbers"):
        checked(wrong)
