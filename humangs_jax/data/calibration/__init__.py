"""Cameras that other tools have calibrated, into a capture folder: docs/cameras.md. `importing.import_cameras` does it."""
