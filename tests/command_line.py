"""Runs the command line in the process of the tests."""

import sys

import jax.numpy as jnp
import numpy as np

from humangs_jax import cli
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.body.joints import JOINT_NAMES, PARENTS
from humangs_jax.rendering.gaussians import Gaussians


def run(monkeypatch, capsys, *arguments):
    """Runs a command in this process; returns (exit code, stdout, stderr)."""
    monkeypatch.setattr(sys, "argv", ["humangs", *map(str, arguments)])
    try:
        cli.main()
        code = 0
    except SystemExit as exit_:
        code = exit_.code
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def save_tiny_avatar(path, joints=None):
    """Saves an avatar of three Gaussians with SMPL-X's joints, which by default lie on a line."""
    joints = np.cumsum(np.full((55, 3), 0.01), axis=0) if joints is None else joints
    gaussians = Gaussians(
        jnp.asarray([[0.0, 1.0, 0.0], [0.0, 0.0, 0.0], [0.2, 1.7, 0.0]]),
        jnp.asarray([[1.0, 0, 0, 0]] * 3),
        jnp.full((3, 3), 0.1),
        jnp.full(3, 0.9),
        jnp.full((3, 3), 0.5),
    )
    Avatar(
        gaussians,
        jnp.zeros((3, 55)).at[:, 0].set(1.0),
        gaussians.means,
        jnp.asarray(joints, jnp.float32),
        jnp.asarray([[0, 1, 2]]),
        parents=PARENTS,
        joint_names=JOINT_NAMES,
    ).save(path)
