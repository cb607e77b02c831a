"""The names of `import humangs_jax as hg`: all there, and none imported before it is used."""

import subprocess
import sys

import pytest

import humangs_jax as hg

NOTEBOOK = (
    "BodyPose",
    "Camera",
    "Gaussians",
    "SPLAT_PRESETS",
    "SubjectViews",
    "TrainConfig",
    "animate",
    "capture_from_arrays",
    "fit_landmarks",
    "gaussian_body",
    "interpolate_attributes",
    "load_body",
    "load_capture",
    "load_weights",
    "orbit",
    "plan_buffers",
    "prepare_inputs",
    "reconstruct",
    "render",
    "render_dense",
    "render_reference",
    "render_views",
    "rest_pose",
    "train",
)


@pytest.mark.parametrize("name", sorted({*hg.__all__, *NOTEBOOK}))
def test_every_public_name_exists(name):
    assert name in hg.__all__ and getattr(hg, name) is not None
    assert name in dir(hg)


def test_other_names_are_refused():
    with pytest.raises(AttributeError, match="no attribute 'rendr'"):
        hg.rendr  # noqa: B018


def test_importing_the_package_imports_nothing_heavy():
    code = "import sys, humangs_jax; print([name for name in ('jax', 'numpy', 'flax') if name in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"
