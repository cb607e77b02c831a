"""Runs a checkpoint of the published network on stored inputs, and compares every stage with the
stored numbers.

A blended transform is no rotation. The quaternion that the release makes of it jumps where two of
its four candidates tie. Rounding decides there, in the release and in this package. So where our
candidates tie to within the bound, the one that is nearer to the stored quaternion counts.
"""

from pathlib import Path
from typing import Any, Literal

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from experiments.harness import Run, entry
from experiments.results import markdown_table
from humangs_jax.core.pytree import replace
from humangs_jax.geometry import quaternion
from humangs_jax.geometry.camera import Camera
from humangs_jax.io.arrays import read_npz
from humangs_jax.io.reading import read_json
from humangs_jax.network.config import HumanGSConfig, paper_parts
from humangs_jax.network.conversion import load_checkpoint
from humangs_jax.network.encoder import encoder_pixels, sample_triplane
from humangs_jax.network.humangs import intermediates, part_variables
from humangs_jax.network.maps import Convolution
from humangs_jax.network.parts import HumanGSInputs
from humangs_jax.network.vertex_decoder import corrected_skinning_weights
from humangs_jax.rendering.gaussians import skin_gaussians

BOUNDS = {"float32": 2e-5, "float64": 1e-6, "bfloat16": 5e-2}
STAGES = {
    "rays": ("out_ray_d",),
    "pose features": ("out_pose_feature",),
    "tokens": ("mid_tokens",),
    "first block": ("mid_block_0",),
    "encoder": ("mid_encoder_out",),
    "feature map": ("mid_feature_map_stride4",),
    "decoder input": ("mid_decoder_input",),
    "raw heads": ("mid_raw_geometry", "mid_raw_appearance"),
    "canonical Gaussians": tuple(
        f"asset_{name}"
        for name in ("means3D", "rotations", "scales", "colors", "opacity", "lbs_weights")
    ),
    "skinned Gaussians": ("posed_means3D", "posed_rotations"),
}
INPUTS = {  # name: axes
    "in_image": "b v 3 h w",
    "in_c2w": "b v 4 4",
    "in_fxfycxcy": "b v 4",
    "in_smpl_canonical_vertices": "b v n 3",
    "in_smpl_posed_vertices": "b v n 3",
    "in_position_map": "b v h w 3",
    "in_depth_map": "b v 1 h w",
    "in_joint_transforms": "b j 4 4",
    "in_lbs_weights": "n j",
}
PER_VIEW = ("mid_tokens", "mid_feature_map_stride4")
"""Stages whose first axis is subjects times views."""
TIES, TIE_LEVELS = "candidates of posed_rotations", "their q_abs"
"""Names of what `compute_stages` returns beside the stages, see `nearest_candidates`."""
MAP_STRIDE, WEIGHTS_STRIDE = 4, 5
"""Steps between the pixels of the feature map, and between the Gaussians whose skinning weights are
stored.
"""


def load_arrays(path: Path) -> dict[str, Any]:
    """Reads the arrays of a file.

    Raises: ValueError if an input is missing, is not finite or has a shape that does not fit those
        of the others, or if there is no stage.
    """
    arrays = read_npz(path)[0]
    sizes: dict[str, int] = {}
    for name, axes in INPUTS.items():
        if name not in arrays:
            raise ValueError(f"{path}: array {name!r} is missing")
        shape, axes = arrays[name].shape, axes.split()
        # an axis is a number, or a letter that has the same size in all arrays
        wanted = []
        for axis, length in zip(axes, shape, strict=False):
            wanted.append(int(axis) if axis.isdigit() else sizes.setdefault(axis, length))
        if len(shape) != len(axes) or list(shape) != wanted or 0 in shape:
            raise ValueError(
                f"{path}: {name} has shape {shape}, expected ({', '.join(axes)}) with {sizes}"
            )
        if not np.isfinite(arrays[name]).all():
            raise ValueError(f"{path}: {name} holds numbers that are not finite")
    if all(name.startswith("in_") for name in arrays):
        raise ValueError(f"{path}: holds no stage to compare with")
    return arrays


def read_release_config(path: Path) -> dict[str, Any]:
    """Reads the settings of a release's configuration, as {"part.name": value}.

    Raises: ValueError if the file has no JSON object, or asks for what this package does not have.
    """
    content = read_json(path)
    if not isinstance(content, dict) or not isinstance(content.get("model"), dict):
        raise ValueError(f"{path}: expected an object with 'model'")
    parts = content["model"] | {"training": content.get("training")}
    found = {
        f"{part}.{name}": x
        for part, values in parts.items()
        if isinstance(values, dict)
        for name, x in values.items()
    }
    if found.get("training.use_canonical_maps"):
        raise ValueError(
            f"{path}: training.use_canonical_maps: the variant with canonical target maps is not"
            " supported"
        )
    height = found.get("training.target_height")
    if height not in (None, 1.8):
        raise ValueError(f"{path}: training.target_height must be 1.8, got {height!r}")
    return found


def complete_config(
    config: HumanGSConfig, release: dict[str, Any], dtype: str, image_size: int
) -> HumanGSConfig:
    """Returns the configuration of a checkpoint, completed by that of the release.

    Raises: ValueError where the two do not agree.
    """
    # what both have must agree
    encoder, _, decoder = paper_parts(config.architecture)
    transformer = encoder.transformer
    found = {
        "neural_texture.resolution": encoder.texture.resolution,
        "neural_texture.dim": encoder.texture.channels,
        "image_tokenizer.patch_size": encoder.patch_size,
        "transformer.d": transformer.width,
        "transformer.d_head": transformer.head_width,
        "transformer.n_layer": transformer.layers,
        "transformer.use_qk_norm": transformer.qk_norm,
        "transformer.use_cls_token": transformer.class_token,
        "transformer.use_upsampler": encoder.upsampler is not None,
        "vertex_decoder.hidden_dim": decoder.hidden,
        "vertex_decoder.learnable_lbs_weights": decoder.skinning_joints is not None,
    }
    for name, value in found.items():
        if release.get(name) not in (None, value):
            raise ValueError(
                f"model.{name} is {release[name]!r} in the configuration, but {value!r} in the"
                " checkpoint"
            )

    # only the release tells the kinds of Gaussians and the pooling
    tight = release.get("vertex_decoder.num_tight_gaussians")
    free = release.get("vertex_decoder.num_free_gaussians")
    if tight is not None and free is not None:
        if tight + free != decoder.gaussians_per_vertex:
            raise ValueError(
                f"model.vertex_decoder: {tight} tight and {free} free Gaussians in the"
                f" configuration, but {decoder.gaussians_per_vertex} a vertex in the checkpoint"
            )
        decoder = decoder.clone(tight=tight, free=free)
    pool = "visible" if release.get("transformer.project_all_vertices") is False else "all"
    config = config.with_parts(decoder=decoder).with_conventions(image_size=image_size, pool=pool)
    # float64 comes from the inputs
    runtime_dtype = "bfloat16" if dtype == "bfloat16" else "float32"
    return config.with_runtime(dtype=runtime_dtype)


def subject_inputs(arrays: dict[str, Any], index: int, dtype: Any) -> Any:
    """Returns the network's inputs of one subject, its skinning weights (n, j) and its joint
    transforms (j, 4, 4).
    """

    def own(name):
        return jnp.asarray(arrays[name][index], dtype)

    images = jnp.moveaxis(own("in_image"), 1, -1)
    height, width = images.shape[1:3]
    fx, fy, cx, cy = np.moveaxis(arrays["in_fxfycxcy"][index].astype(np.float64), -1, 0)
    K = np.zeros((*fx.shape, 3, 3))
    K[:, 0, 0], K[:, 1, 1], K[:, 0, 2], K[:, 1, 2], K[:, 2, 2] = fx, fy, cx, cy, 1
    one = Camera(jnp.eye(3, dtype=dtype), jnp.eye(4, dtype=dtype), width, height)
    cam_from_world = np.linalg.inv(arrays["in_c2w"][index].astype(np.float64))
    cameras = replace(
        one, K=jnp.asarray(K, dtype), cam_from_world=jnp.asarray(cam_from_world, dtype)
    )
    inputs = HumanGSInputs(
        images=images,
        cameras=cameras,
        posed_vertices=own("in_smpl_posed_vertices"),
        canonical_vertices=own("in_smpl_canonical_vertices")[0],
        position_maps=own("in_position_map"),
        depth_maps=own("in_depth_map")[:, 0],
        foreground=jnp.ones(images.shape[:3], bool),
    )
    return inputs, jnp.asarray(arrays["in_lbs_weights"], dtype), own("in_joint_transforms")


def compute_stages(
    variables: Any, inputs: Any, config: Any, skinning_weights: Any, joint_transforms: Any
) -> dict:
    """Returns every stage of one subject, by the name and in the layout of its array.

    TIES (g, 4, 4) and TIE_LEVELS (g, 4) are all candidates of the posed rotations, see
    `nearest_candidates`. The function can be compiled with a static `config`.
    """

    def channels_first(x):
        return jnp.moveaxis(x, -1, 1)

    encoder, reader, decoder = paper_parts(config.architecture)
    stages = intermediates(variables, inputs, config)
    features, outputs = stages["reader"], stages["decoder"]
    gaussians, maps = outputs.gaussians, stages["encoder"].maps
    # the network does the last convolution only where vertices read it; here it is done everywhere
    if encoder.upsampler is not None:
        convolution = Convolution(
            int(reader.output_width or 0), nn.initializers.zeros, config.runtime.compute_dtype
        )
        maps = convolution.apply(part_variables(variables, "reader"), maps)
    pixels = encoder_pixels(inputs, config.forward_context())
    texture = variables["params"]["encoder"]["tokenizer"]["texture"]

    def heads(name):
        return stages[f"decoder.{name}_out"].reshape(
            len(features.local), decoder.gaussians_per_vertex, -1
        )

    # the decoder reads the features of a vertex and the global token
    entering = [features.local]
    token = features.global_token
    if token is not None:
        entering.append(jnp.broadcast_to(token, (len(features.local), *token.shape)))

    # skinned Gaussians, with all candidates of their rotations
    weights = corrected_skinning_weights(
        skinning_weights, outputs.skinning_offsets, decoder.gaussians_per_vertex
    )
    transforms = jnp.einsum("gj,jab->gab", weights, joint_transforms)
    posed = skin_gaussians(gaussians, transforms, config.conventions.skinning)
    rotations = quaternion.to_matrix(quaternion.normalize(gaussians.quats))
    candidates, q_abs = quaternion.candidates_from_matrix(transforms[:, :3, :3] @ rotations)
    return {
        "out_ray_d": channels_first(pixels[..., 6:9]),
        "out_pose_feature": channels_first(sample_triplane(texture, pixels[..., 9:])),
        "mid_tokens": (
            stages["encoder.tokenizer"].reshape(len(inputs.images), -1, encoder.transformer.width)
        ),
        "mid_block_0": stages["encoder.transformer.block_0"],
        "mid_encoder_out": stages["encoder.transformer.norm"],
        "mid_feature_map_stride4": channels_first(maps)[:, :, ::MAP_STRIDE, ::MAP_STRIDE],
        "mid_decoder_input": jnp.concatenate(entering, axis=-1),
        "mid_raw_geometry": heads("geometry"),
        "mid_raw_appearance": heads("appearance"),
        "asset_means3D": gaussians.means,
        "asset_rotations": gaussians.quats,
        "asset_scales": gaussians.scales,
        "asset_colors": gaussians.colors,
        "asset_opacity": gaussians.opacities[:, None],
        "asset_lbs_weights": weights[::WEIGHTS_STRIDE],
        "posed_means3D": posed.means,
        "posed_rotations": posed.quats,
        TIES: candidates,
        TIE_LEVELS: q_abs,
    }


def nearest_candidates(found: dict[str, Any], reference: Any, bound: float) -> Any:
    """Returns our posed rotations (g, 4). Where candidates tie to within `bound`, the one that is
    nearest to the reference is taken.
    """
    ours = np.asarray(found["posed_rotations"], np.float64)
    if TIES not in found or ours.shape != reference.shape:
        return ours
    readings = np.asarray(found[TIES], np.float64)
    levels = np.asarray(found[TIE_LEVELS], np.float64)
    tied = levels >= levels.max(-1, keepdims=True) - bound
    distances = [np.abs(readings - sign * reference[..., None, :]).max(-1) for sign in (1, -1)]
    best = np.argmin(np.where(tied, np.minimum(*distances), np.inf), axis=-1)
    nearest = np.take_along_axis(readings, best[..., None, None], axis=-2)[..., 0, :]
    return np.where(tied.sum(-1, keepdims=True) > 1, nearest, ours)


def relative_errors(
    found: dict[str, Any], expected: dict[str, Any], bound: float = 0.0
) -> dict[str, float | None]:
    """Returns the largest error of each expected stage, as a share of its largest magnitude.

    The error is None where a stage was not found, has another shape or is not finite. Candidates of
    posed rotations tie to within `bound`.
    """
    errors: dict[str, float | None] = {}
    for name, reference in expected.items():
        ours = np.asarray(found.get(name, np.nan), np.float64)
        reference = np.asarray(reference, np.float64)
        finite = np.isfinite(ours).all() and np.isfinite(reference).all()
        if ours.shape != reference.shape or not finite:
            errors[name] = None
            continue
        if name == "posed_rotations":
            ours = nearest_candidates(found, reference, bound)
            ours = ours * np.where(np.sum(ours * reference, axis=-1, keepdims=True) < 0, -1, 1)
        error, largest = np.abs(ours - reference).max(initial=0), np.abs(reference).max(initial=0)
        errors[name] = float(error / largest) if largest > 0 else float(error)
    return errors


def check(checkpoint: Path, dtype: str) -> dict[str, Any]:
    """Runs a checkpoint and compares all stages.

    Returns {"dtype", "bound", "stages": {array: relative error, or None if it was not compared},
    "passed"}. For float64 `jax_enable_x64` must be set.
    """
    found, expected = run_checkpoint(checkpoint, dtype)
    bound = BOUNDS[dtype]
    stages = {name: x for name, x in expected.items() if not name.startswith("in_")}
    errors = relative_errors(found, stages, bound)
    passed = all(error is not None and error <= bound for error in errors.values())
    return {"dtype": dtype, "bound": bound, "stages": errors, "passed": passed}


def run_checkpoint(checkpoint: Path, dtype: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Returns what `compute_stages` gives for all subjects, and the arrays of the file."""
    config, arrays = (checkpoint.with_suffix(suffix) for suffix in (".json", ".npz"))
    release, expected = read_release_config(config), load_arrays(arrays)
    # the width of a head is only needed where the checkpoint does not tell it
    width = None
    if release.get("transformer.use_qk_norm") is False:
        width = release.get("transformer.d_head")
    converted = load_checkpoint(checkpoint, head_width=width)
    settings = complete_config(converted.config, release, dtype, expected["in_image"].shape[-2])
    if expected["in_lbs_weights"].shape != converted.skinning_weights.shape:
        raise ValueError(
            f"{arrays}: in_lbs_weights has shape {expected['in_lbs_weights'].shape}, the"
            f" checkpoint's {converted.skinning_weights.shape}"
        )

    # with bfloat16 only products are in fewer bits, see `network.runtime`
    working = jnp.float64 if dtype == "float64" else jnp.float32
    variables = jax.tree.map(lambda x: jnp.asarray(x, working), converted.variables)
    compute = jax.jit(compute_stages, static_argnames="config")
    # GPUs and TPUs multiply float32 in fewer bits otherwise
    with jax.default_matmul_precision("highest"):
        subjects = []
        for index in range(len(expected["in_image"])):
            inputs, weights, transforms = subject_inputs(expected, index, working)
            stages = compute(variables, inputs, settings, weights, transforms)
            subjects.append(jax.tree.map(np.asarray, stages))

    found = {}
    for name in subjects[0]:
        join = np.concatenate if name in PER_VIEW else np.stack
        found[name] = join([subject[name] for subject in subjects])
    return found, expected


@entry
def parity(
    run: Run,
    checkpoints: tuple[Path, ...],
    dtypes: tuple[Literal["float32", "float64", "bfloat16"], ...] = ("float32",),
) -> int:
    """Runs checkpoints of the published network on stored inputs, and shows the largest error of
    every stage, relative to its largest magnitude.

    A checkpoint is STEM.pt in the released format, or its state dict STEM.safetensors. Beside it
    are two files. STEM.json is the release's configuration, which has what shapes do not tell
    (pooling, width of a head). STEM.npz has b subjects of v views:

        in_image (b,v,3,h,w) in [0,1], in_c2w (b,v,4,4), in_fxfycxcy (b,v,4),
        in_smpl_canonical_vertices and in_smpl_posed_vertices (b,v,n,3), in_joint_transforms
        (b,j,4,4), in_lbs_weights (n,j), metric; in_position_map (b,v,h,w,3) and in_depth_map
        (b,v,1,h,w) in normalised units; out_ray_d (b,v,3,h,w), out_pose_feature (b,v,c,h,w),
        mid_tokens (b*v,p,d), mid_block_0 and mid_encoder_out (b,l,d), mid_feature_map_stride4
        (b*v,d,h',w'), mid_decoder_input (b,n,c), mid_raw_geometry (b,n,k,10), mid_raw_appearance
        (b,n,k,4), asset_{means3D,rotations,scales,colors,opacity} (b,n*k,.), asset_lbs_weights
        (every fifth of n*k), posed_means3D, posed_rotations (b,n*k,.; the sign of a quaternion is
        free)

    The exit status is 1 if an error exceeds 2e-5 (float32), 1e-6 (float64) or 5e-2 (bfloat16), or
    if an array of a stage (any that is not in_*) could not be compared. Takes seconds for small
    networks.

    Tables: parity_stages

    Options:
    dtypes: types to compute in
    """
    # errors of each type and checkpoint
    columns = {}
    for dtype in dtypes:
        with jax.enable_x64(dtype == "float64"):
            for path in checkpoints:
                columns[f"{dtype}, {path.stem}"] = check(path, dtype)

    # a line for each array, in the order of the stages
    found = list(dict.fromkeys(name for column in columns.values() for name in column["stages"]))
    rows = [(stage, name) for stage, names in STAGES.items() for name in names if name in found]
    rows += [("unknown stage", name) for name in found if name not in {name for _, name in rows}]
    table = [
        [stage, f"`{name}`", *(_shown(each, name) for each in columns.values())]
        for stage, name in rows
    ]
    text = markdown_table(["stage", "array", *columns], table, "ll" + "r" * len(columns))
    run.show(text, columns, "parity_stages")
    return int(not all(column["passed"] for column in columns.values()))


def _shown(column: dict[str, Any], name: str) -> str:
    """Formats the error of an array."""
    error = column["stages"].get(name)
    if error is None:
        return "NOT COMPARED"
    if error <= column["bound"]:
        return f"{error:.1e}"
    return f"{error:.1e} TOO LARGE"
