"""Array types with shapes, and the glossary of axis names that annotations share. Other names of
axes are local to a module.

======  ====================================================
axis    meaning
======  ====================================================
b       subjects in a batch
v       views (photos) of one subject
h w     image rows and columns, in pixels
c       channels
p       patches of an image
l       tokens of the transformer
d       feature width
n       vertices of the body
k       Gaussians per vertex
g       Gaussians (n * k after flattening, or any other set)
j       joints
f       faces
t       tiles of an image
s       shape coefficients of the body
m       frames of a motion
======  ====================================================

Functions are written for ONE example, and `jax.vmap` batches them. Annotations of pytree fields
have no batch axes.
"""

from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree, Shaped, UInt, UInt8

Key = PRNGKeyArray
Scalar = Float[Array, ""]
Vector3 = Float[Array, "3"]
Matrix3 = Float[Array, "3 3"]
Matrix4 = Float[Array, "4 4"]

__all__ = [
    "Array",
    "Bool",
    "Float",
    "Int",
    "Key",
    "Matrix3",
    "Matrix4",
    "PyTree",
    "Scalar",
    "Shaped",
    "UInt",
    "UInt8",
    "Vector3",
]
