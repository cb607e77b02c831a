"""Demonstration, presets and budgets, checks of captures, photos without a calibration."""
