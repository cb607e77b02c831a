"""The frozen networks that losses may use, read from files that the user has: nothing of them ships with the package."""

import os

from humangs_jax.objectives.lpips import Lpips
from humangs_jax.objectives.perceptual import Vgg19
from humangs_jax.pytree import pytree_dataclass


@pytree_dataclass
class LossNetworks:
    """What there is of them; a pytree, to be handed to a training step as an argument."""

    perceptual: Vgg19 | None = None
    lpips: Lpips | None = None


def load_vgg19(path: str | os.PathLike) -> Vgg19:
    """The VGG-19 of the perceptual loss from a file."""
    raise NotImplementedError(f"{path}: reading loss networks is being written")


def load_lpips(net: str, backbone: str | os.PathLike, heads: str | os.PathLike | None = None) -> Lpips:
    """LPIPS from its backbone and its heads; without `heads`, they are in the same file."""
    raise NotImplementedError(f"{backbone}: reading loss networks is being written")


def load_loss_networks(
    vgg19: str | os.PathLike | None = None,
    lpips_backbone: str | os.PathLike | None = None,
    lpips_heads: str | os.PathLike | None = None,
    lpips_net: str = "vgg",
) -> LossNetworks:
    """The networks whose files are given; LPIPS needs its backbone."""
    return LossNetworks(
        None if vgg19 is None else load_vgg19(vgg19),
        None if lpips_backbone is None else load_lpips(lpips_net, lpips_backbone, lpips_heads),
    )
