"""humangs_jax: animatable 3D Gaussian humans from a few photos, in functional JAX."""

__version__ = "0.1.0"
