"""humangs_jax: animatable 3D Gaussian humans from a few photos, in functional JAX.

The names below are the public interface; each is imported when it is first used, so that `import humangs_jax` and
`humangs --help` cost nothing.
"""

import importlib

__version__ = "0.1.0"

_PUBLIC = {
    "Avatar": "avatar.avatar",
    "BodyModel": "body.model",
    "BodyPose": "body.model",
    "BufferOverflowError": "rendering.buffers",
    "Camera": "geometry.camera",
    "Capture": "data.capture",
    "CaptureError": "data.capture",
    "Execution": "network.execution",
    "Gaussians": "rendering.gaussians",
    "HumanGSConfig": "network.config",
    "Motion": "data.motion",
    "PRESETS": "apps.settings",
    "PROTOCOLS": "evaluation.protocol",
    "RefineConfig": "refinement.config",
    "Rendering": "rendering.drawing",
    "SPLAT_PRESETS": "rendering.splat_config",
    "Settings": "apps.settings",
    "Shot": "avatar.shot",
    "SplatConfig": "rendering.splat_config",
    "SubjectViews": "data.views",
    "TrainConfig": "training.config",
    "animate": "avatar.animate",
    "apply_humangs": "network.humangs",
    "capture_from_arrays": "data.capture",
    "decimate": "body.decimation",
    "enable_compile_cache": "core.compile_cache",
    "evaluate": "evaluation.run",
    "fit_landmarks": "fitting.landmark_fit",
    "gaussian_body": "data.views",
    "init_humangs": "network.humangs",
    "interpolate_attributes": "rendering.mesh.rasterizer",
    "intrinsics_from_fov": "geometry.camera",
    "landmark_model": "body.landmarks",
    "load_body": "body.library",
    "load_capture": "data.capture",
    "load_motion": "data.motion",
    "load_weights": "network.weights",
    "look_at": "geometry.camera",
    "motion_frames": "avatar.frames",
    "orbit": "geometry.camera",
    "plan_buffers": "rendering.buffers",
    "pose_body": "body.model",
    "prepare_inputs": "data.views",
    "rasterize_mesh": "rendering.mesh.rasterizer",
    "reconstruct": "avatar.reconstruct",
    "reconstruct_batch": "avatar.reconstruct",
    "reconstruct_views": "avatar.reconstruct",
    "reconstruct_with": "apps.settings",
    "refine": "refinement.refine",
    "refine_views": "refinement.refine",
    "refine_with_report": "refinement.refine",
    "render": "rendering.splatting",
    "render_dense": "rendering.reference",
    "render_reference": "rendering.reference",
    "render_views": "rendering.splatting",
    "replace": "core.pytree",
    "rest_pose": "body.model",
    "save_capture": "data.capture",
    "save_weights": "network.weights",
    "seen_from": "rendering.splatting",
    "select_views": "data.view_selection",
    "shape_body": "body.model",
    "show": "viewer.page",
    "skin": "avatar.animate",
    "stack_cameras": "geometry.camera",
    "stack_captures": "avatar.reconstruct",
    "train": "training.loop",
    "write_page": "viewer.page",
    "write_ply": "avatar.export",
    "write_video": "avatar.video",
}

__all__ = ["__version__", *_PUBLIC]


def __getattr__(name: str) -> object:
    if name not in _PUBLIC:
        raise AttributeError(f"module 'humangs_jax' has no attribute {name!r}")
    value = getattr(importlib.import_module(f"humangs_jax.{_PUBLIC[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
