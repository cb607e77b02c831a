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
    "Camera": "geometry.camera",
    "Capture": "data.capture",
    "CaptureError": "data.capture",
    "Gaussians": "rendering.gaussians",
    "HumanGSConfig": "network.config",
    "Motion": "data.motion",
    "PRESETS": "network.presets",
    "Rendering": "rendering.splatting",
    "SplatConfig": "rendering.splatting",
    "animate": "avatar.animate",
    "apply_humangs": "network.humangs",
    "decimate": "body.decimation",
    "init_humangs": "network.humangs",
    "interpolate_attributes": "rendering.mesh.rasterizer",
    "load_body": "body.library",
    "load_capture": "data.capture",
    "load_motion": "data.motion",
    "load_weights": "network.weights",
    "orbit": "geometry.camera",
    "plan_buffers": "rendering.splatting",
    "pose_body": "body.model",
    "rasterize_mesh": "rendering.mesh.rasterizer",
    "reconstruct": "avatar.reconstruct",
    "reconstruct_batch": "avatar.reconstruct",
    "reconstruct_views": "avatar.reconstruct",
    "render": "rendering.splatting",
    "render_views": "rendering.splatting",
    "save_capture": "data.capture",
    "save_weights": "network.weights",
    "shape_body": "body.model",
    "skin": "avatar.animate",
    "write_ply": "avatar.export",
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
