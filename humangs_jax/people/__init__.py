"""Seeded synthetic clothed people: written as capture folders, or drawn on the fly for training."""
