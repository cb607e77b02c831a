"""Fits scenes of a fixed number of Gaussians to posed photos."""
