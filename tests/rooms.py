"""The rooms of the package: the core, and the wings that it does not import."""

import re

CORE = (
    *("core", "geometry", "io", "body", "rendering", "network", "losses", "scenes"),
    *("data", "avatar", "refinement", "evaluation", "training"),
)
"""Rooms of the core; their tests run with the wings hidden."""
WINGS = ("capture", "motion", "synthetic", "viewer")
"""Rooms that the core does not import."""
NEEDS_WINGS = re.compile(
    rf"humangs_jax\.({'|'.join((*WINGS, 'apps', 'cli'))})\b"
    r"|from experiments|command_line|motion_cases"
)
"""Matches text of a test that looks at a wing or a command, so that it needs the wings."""


class HiddenWings:
    """An import hook that refuses to import a wing."""

    def find_spec(self, name, path=None, target=None):
        package, _, inside = name.partition(".")
        if package == "humangs_jax" and inside.split(".")[0] in WINGS:
            raise ModuleNotFoundError(f"{name} is hidden by --core-alone")
