"""Scenes of a fixed number of Gaussians, fitted to posed photos."""
