"""Writes poses of our skeleton as GLB files of a skinned skeleton in motion."""

import numpy as np
from bvh_files import INDEX
from scipy.spatial.transform import Rotation

from humangs_jax.body.joints import JOINT_NAMES, PARENTS
from humangs_jax.io.mesh import GlbWriter


def write_glb(
    path,
    rest,
    poses,
    moves,
    names,
    bind=None,
    fps=24.0,
    above=None,
    interpolation="LINEAR",
    more=(),
    titles=(),
    **more_of_file,
):
    """Writes a skinned skeleton in motion.

    Args:
        path: the file.
        rest: joints (55, 3) of the rest pose.
        poses: axis-angle rotations (m, 55, 3).
        moves: places (m, 3) of the pelvis.
        names: the file's name for each of our joints; joints without a name are left out.
        fps: frames in a second.
        above: a node that the skeleton hangs on; its matrix may have other units and another up.
        interpolation: of the keys, as glTF names it.
        more: poses of further animations.
        titles: names of the animations.
        **more_of_file: further entries of the document.
    """
    writer, joints = GlbWriter(), [name for name in JOINT_NAMES if name in names]
    place = {name: i for i, name in enumerate(joints)}
    nodes, channels, samplers = [], [], []
    times = writer.array("SCALAR", np.arange(len(poses)) / fps, bounds=True)

    def animate(node, path_, values):
        # tangents before and after each value, 0: the values themselves are hit
        if interpolation == "CUBICSPLINE":
            values = np.stack(
                [np.zeros_like(values), values, np.zeros_like(values)], axis=1
            ).reshape(-1, values.shape[1])
        kind = {3: "VEC3", 4: "VEC4"}[values.shape[1]]
        samplers.append(
            {"input": times, "output": writer.array(kind, values), "interpolation": interpolation}
        )
        channels.append({"sampler": len(samplers) - 1, "target": {"node": node, "path": path_}})

    inverse = []
    # nodes lie at the joints of the rest pose; the skin undoes it and the node above
    outer = np.eye(4) if above is None else np.reshape(above["matrix"], (4, 4)).T
    for name in joints:
        j, p = INDEX[name], PARENTS[INDEX[name]]
        nodes.append(
            {"name": names[name], "translation": (rest[j] - (rest[p] if p >= 0 else 0)).tolist()}
        )
        children = [place[other] for other in joints if PARENTS[INDEX[other]] == j]
        if children:
            nodes[-1]["children"] = children
        matrix = np.eye(4)
        matrix[:3, 3] = rest[j]
        inverse.append(np.linalg.inv(outer @ matrix).T.reshape(-1))
    roots = [0]
    if above is not None:
        nodes.append(above | {"children": [0]})
        roots = [len(nodes) - 1]
    skin = {
        "joints": list(range(len(joints))),
        "inverseBindMatrices": writer.array("MAT4", np.stack(inverse)),
    }
    document = {"scene": 0, "scenes": [{"nodes": roots}], "nodes": nodes, "skins": [skin]}
    animations = []
    # one animation for each series of poses
    for i, each in enumerate((poses, *more)):
        channels, samplers = [], []
        for name in joints:
            animate(place[name], "rotation", Rotation.from_rotvec(each[:, INDEX[name]]).as_quat())
        animate(0, "translation", moves)
        animations.append(
            {"channels": channels, "samplers": samplers} | ({"name": titles[i]} if titles else {})
        )
    writer.write(path, document | {"animations": animations} | more_of_file)
