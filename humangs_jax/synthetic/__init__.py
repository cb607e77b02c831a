"""Synthetic people, made from seeds."""
