"""An avatar in the files that other people's programs open (docs/export.md). `export` decides by the suffix.

`world`: the one conversion of conventions. Gaussians: `ply`, `splat`, `spz`, `gltf`. The body as a mesh: `mesh`, with its skin
and motion `mesh_gltf`, in one pose `obj`.
"""

from humangs_jax.avatar.export.files import export, frame_range
from humangs_jax.avatar.export.gltf import write_glb
from humangs_jax.avatar.export.mesh import BodyMesh, body_mesh
from humangs_jax.avatar.export.mesh_gltf import write_mesh_glb
from humangs_jax.avatar.export.obj import write_obj
from humangs_jax.avatar.export.ply import write_ply
from humangs_jax.avatar.export.splat import write_splat
from humangs_jax.avatar.export.spz import write_spz
from humangs_jax.avatar.export.world import SH_C0, Up, grounded_gaussians, turned, up_turn

__all__ = [
    "SH_C0",
    "BodyMesh",
    "Up",
    "body_mesh",
    "export",
    "frame_range",
    "grounded_gaussians",
    "turned",
    "up_turn",
    "write_glb",
    "write_mesh_glb",
    "write_obj",
    "write_ply",
    "write_splat",
    "write_spz",
]
