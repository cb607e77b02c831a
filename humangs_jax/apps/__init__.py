"""Demo, presets and budgets, the check of a capture, photos without a calibration."""
