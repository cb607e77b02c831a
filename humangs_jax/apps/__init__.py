"""What the command line runs: the demonstration, presets for a budget, checks of captures, and
avatars from photos or videos.
"""
