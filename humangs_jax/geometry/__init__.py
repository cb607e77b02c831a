"""Quaternions (wxyz), 3x3 SVD, transforms, `Camera` and its lenses, Plücker rays, meshes."""
