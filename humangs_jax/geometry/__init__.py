"""Quaternions (wxyz), axes, transforms, `Camera` with its lenses, Plücker rays, meshes."""
