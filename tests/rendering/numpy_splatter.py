"""Gaussian splatting in float64 numpy, a reference for small images.

It is written from the formulas and shares no code with the package; `NEAR` and similar constants
are repeated as numbers. It holds everything for every Gaussian on every pixel.

EWA projection (Zwicker et al. 2001): cov2d = J W Sigma W^T J^T + eps2d I. With the singular value
decomposition M = U S V^T of M = J W R diag(s), (2, 3), the quadratic form is sum_i (u_i . d)^2 /
(S_i^2 + eps2d). This is accurate for needles of any length, and another formula than the renderer's
(Cholesky) and the reference's (cross products).
"""

import numpy as np

NEAR, EPS2D, ALPHA_MIN, ALPHA_MAX, STOP, LARGEST = 0.01, 0.3, 1 / 255, 0.999, 1e-4, 1e9


def splat(means, quats, scales, opacities, colors, K, cam_from_world, background, width, height):
    """Returns (rgb (h, w, 3), alpha (h, w)) of g Gaussians.

    All arguments are float64; quaternions wxyz may have any norm.
    """
    in_camera = means @ cam_from_world[:3, :3].T + cam_from_world[:3, 3]
    drawn = in_camera[:, 2] > NEAR
    X, Y, Z = np.where(drawn[:, None], in_camera, [0.0, 0.0, 1.0]).T
    focal = np.array([K[0, 0], K[1, 1]])
    zero = np.zeros_like(Z)
    jacobian = np.stack(
        [np.stack([1 / Z, zero, -X / Z**2], -1), np.stack([zero, 1 / Z, -Y / Z**2], -1)], 1
    )
    M = focal[:, None] * jacobian @ cam_from_world[:3, :3] @ rotations(quats) * scales[:, None, :]
    drawn &= (np.abs(M) < LARGEST).all((1, 2))
    U, S, _ = np.linalg.svd(np.where(drawn[:, None, None], M, 0.0), full_matrices=False)

    centers = focal * np.stack([X, Y], -1) / Z[:, None] + K[:2, 2]
    rows, columns = np.mgrid[:height, :width] + 0.5
    d = np.stack([columns.ravel(), rows.ravel()], -1) - centers[:, None]  # (g, p, 2)
    power = np.sum((d @ U) ** 2 / (S**2 + EPS2D)[:, None], -1)
    raw = opacities[:, None] * np.exp(-0.5 * power)
    alpha = np.where(drawn[:, None] & (raw >= ALPHA_MIN), np.minimum(raw, ALPHA_MAX), 0.0)

    order = np.argsort(Z, kind="stable")
    alpha, colors = alpha[order], colors[order]
    after = np.cumprod(1 - alpha, axis=0)
    before = np.concatenate([np.ones((1, alpha.shape[1])), after])[:-1]
    weights = np.where(after > STOP, alpha * before, 0.0)
    opacity = weights.sum(0)
    rgb = weights.T @ colors + (1 - opacity)[:, None] * background
    return rgb.reshape(height, width, 3), opacity.reshape(height, width)


def rotations(quats):
    """Returns rotation matrices (g, 3, 3) of quaternions; a zero quaternion turns nothing.

    v + 2 w (q x v) + 2 q x (q x v) is applied to the axes.
    """
    norms = np.linalg.norm(quats, axis=1, keepdims=True)
    w, q = np.split(
        np.where(norms > 0, quats / np.where(norms > 0, norms, 1), [1.0, 0, 0, 0]), [1], axis=1
    )
    axes = np.eye(3)[None]
    turned = np.cross(q[:, None], axes)
    return (axes + 2 * w[..., None] * turned + 2 * np.cross(q[:, None], turned)).swapaxes(1, 2)
