"""All names of `import humangs_jax as hg` exist, and none is imported before it is used."""

import re
import subprocess
import sys

import pytest

import humangs_jax as hg


@pytest.mark.parametrize("name", hg.__all__)
def test_every_public_name_exists(name):
    assert name in hg.__all__ and getattr(hg, name) is not None
    assert name in dir(hg)


def test_other_names_are_refused():
    with pytest.raises(AttributeError, match="no attribute 'rendr'"):
        hg.rendr  # noqa: B018


def test_importing_the_package_imports_nothing_heavy():
    code = (
        "import sys, humangs_jax; print([name for name in ('jax', 'numpy', 'flax') if name in"
        " sys.modules])"
    )
    assert (
        subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True
        ).stdout
        == "[]\n"
    )


def test_there_are_at_most_sixty():
    assert len(hg.__all__) - 1 <= 60


USER = """
import humangs_jax as hg
variables, config = hg.load_weights()
capture = hg.load_capture("photos")
avatar = hg.refine(hg.reconstruct(variables, config, capture), capture, steps=0)
gaussians = hg.animate(avatar, capture.pose(0))
splat = hg.plan_buffers(gaussians, capture.cameras[0])
image = hg.render(gaussians, capture.cameras[0], splat).rgb
class_token = "model.architecture.encoder.transformer.class_token"
ablation = hg.ablate("tiny", {"no token": {class_token: False}})
gain = ablation.rows[0].difference
"""
USED = (
    "load_weights",
    "load_capture",
    "reconstruct",
    "refine",
    "animate",
    "plan_buffers",
    "render",
)


def test_type_checkers_know_what_everything_is(tmp_path):
    names = [
        *re.findall(r"^(\w+)(?:, (\w+))? =", USER, re.MULTILINE),
        *((f"hg.{name}", "") for name in USED),
    ]
    shown = [f"reveal_type({name})" for pair in names for name in pair if name]
    (tmp_path / "user.py").write_text("\n".join([USER, *shown, "hg.render(avatar)"]))
    command = [
        sys.executable,
        "-m",
        "ty",
        "check",
        "--python",
        sys.prefix,
        "--output-format",
        "concise",
        "user.py",
    ]
    text = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True).stdout
    # numpy 2.5 calls the shape of an `np.ndarray` _AnyShape, older versions tuple[Any, ...]
    arrays_of_numpy = r"ndarray\[(_AnyShape|tuple\[Any, \.\.\.\]), dtype\[Any\]\]"
    revealed = re.findall(r"Revealed type: `(.*)`", text)
    types = [re.sub(arrays_of_numpy, "ndarray", each) for each in revealed]
    assert len(types) == len(shown), text
    vague = [each for each in types if re.search(r"Unknown|Any\b|object", each)]
    assert not vague, vague
    assert (
        "Array" in types and "float" in types and "Expected `Gaussians`, found `Avatar`" in text
    ), text
