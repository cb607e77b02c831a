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
"""What the text of a test has that looks at the core and a wing, or a command, together."""


class HiddenWings:
    """Refuses to import a wing."""

    def find_spec(self, name, path=None, target=None):
        package, _, inside = name.partition(".")
        if package == "humangs_jax" and inside.split(".")[0] in WINGS:
            raise ModuleNotFoundError(f"{name} is hidden by --core-alone")
