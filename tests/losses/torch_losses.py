"""Writes data/torch_losses.npz: the loss networks' results in torch, float64.

    python tests/losses/torch_losses.py

It needs torch; the tests do not. Layers are listed one by one, as torchvision and lpips stack them.
Weights and images are those of `loss_cases`.
"""

from pathlib import Path

import numpy as np
import torch
from loss_cases import image_pair, made_up_heads, made_up_state
from torch import nn

DATA = Path(__file__).parent / "data"
SIZES = {"vgg": (37, 32), "alex": (37, 43), "squeeze": (40, 33), "perceptual": (37, 32)}


class Fire(nn.Module):
    def __init__(self, inputs, squeezed, expanded):
        super().__init__()
        self.squeeze = nn.Conv2d(inputs, squeezed, 1)
        self.expand1x1 = nn.Conv2d(squeezed, expanded, 1)
        self.expand3x3 = nn.Conv2d(squeezed, expanded, 3, padding=1)

    def forward(self, x):
        x = torch.relu(self.squeeze(x))
        return torch.cat([torch.relu(self.expand1x1(x)), torch.relu(self.expand3x3(x))], 1)


def vgg(widths, pool):
    layers, inputs = [], 3
    for width in widths:
        if width == "pool":
            layers.append(pool(2, 2))
        else:
            layers += [nn.Conv2d(inputs, width, 3, padding=1), nn.ReLU()]
            inputs = width
    return nn.Sequential(*layers)


def backbone(name):
    """Returns (layers, numbers of layers after which features are taken)."""
    p = "pool"
    if name == "vgg19":
        widths = [64, 64, p, 128, 128, p, *[256] * 4, p, *[512] * 4, p, *[512] * 4, p]
        return vgg(widths, nn.AvgPool2d), (4, 9, 14, 23, 32)
    if name == "vgg":
        widths = [64, 64, p, 128, 128, p, *[256] * 3, p, *[512] * 3, p, *[512] * 3, p]
        return vgg(widths, nn.MaxPool2d), (4, 9, 16, 23, 30)
    if name == "alex":
        convolutions = [
            (3, 64, 11, 4, 2),
            p,
            (64, 192, 5, 1, 2),
            p,
            (192, 384, 3, 1, 1),
            (384, 256, 3, 1, 1),
        ]
        layers = []
        for layer in [*convolutions, (256, 256, 3, 1, 1)]:
            layers += [nn.MaxPool2d(3, 2)] if layer == p else [nn.Conv2d(*layer), nn.ReLU()]
        return nn.Sequential(*layers), (2, 5, 8, 10, 12)
    fires = [(64, 16, 64), (128, 16, 64), p, (128, 32, 128), (256, 32, 128), p]
    fires += [(256, 48, 192), (384, 48, 192), (384, 64, 256), (512, 64, 256)]
    layers = [nn.Conv2d(3, 64, 3, 2), nn.ReLU(), nn.MaxPool2d(3, 2, ceil_mode=True)]
    layers += [
        nn.MaxPool2d(3, 2, ceil_mode=True) if layer == p else Fire(*layer) for layer in fires
    ]
    return nn.Sequential(*layers), (2, 5, 8, 10, 11, 12, 13)


def features(name, image):
    layers, cuts = backbone(name)
    layers.double()
    used = {key: torch.from_numpy(x) for key, x in made_up_state(name).items()}
    missing, unexpected = layers.load_state_dict(used, strict=False)
    assert not unexpected and all(int(key.split(".")[0]) >= cuts[-1] for key in missing)
    found = []
    for start, end in zip((0, *cuts), cuts, strict=False):
        image = layers[start:end](image)
        found.append(image)
    return found


def colors(*values):
    return torch.tensor(values, dtype=torch.float64).view(1, 3, 1, 1)


def lpips(net, predicted, target):
    shift, scale = colors(-0.030, -0.088, -0.188), colors(0.458, 0.448, 0.450)
    scaled = lambda x: (2 * x - 1 - shift) / scale
    unit = lambda x: x / (x.square().sum(1, keepdim=True).sqrt() + 1e-10)
    pairs = zip(features(net, scaled(predicted)), features(net, scaled(target)), strict=True)
    weights = [torch.from_numpy(head) for head in made_up_heads(net)]
    return torch.stack(
        [
            nn.functional.conv2d((unit(x) - unit(y)) ** 2, w).mean()
            for (x, y), w in zip(pairs, weights, strict=True)
        ]
    )


def perceptual(predicted, target):
    mean = colors(123.68, 116.779, 103.939)
    pairs = zip(
        features("vgg19", 255 * predicted - mean),
        features("vgg19", 255 * target - mean),
        strict=True,
    )
    errors = [(255 * (predicted - target)).abs().mean(), *((x - y).abs().mean() for x, y in pairs)]
    return (
        torch.stack(
            [error / by for error, by in zip(errors, (1, 2.6, 4.8, 3.7, 5.6, 0.15), strict=True)]
        )
        / 255
    )


if __name__ == "__main__":
    arrays = {}
    for name, size in SIZES.items():
        images = [torch.from_numpy(x.transpose(2, 0, 1)[None].copy()) for x in image_pair(*size)]
        images[0].requires_grad_()
        parts = perceptual(*images) if name == "perceptual" else lpips(name, *images)
        parts.sum().backward()
        gradient = images[0].grad[0].numpy().transpose(1, 2, 0)
        assert np.isfinite(gradient).all()
        arrays |= {
            f"{name}_parts": parts.detach().numpy(),
            f"{name}_gradient": gradient.astype(np.float32),
        }
        print(name, *parts.detach().numpy(), abs(gradient).max())
    np.savez_compressed(DATA / "torch_losses.npz", **arrays)
