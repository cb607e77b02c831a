"""What a body and the keypoints that it was found from say about each other: errors by view and moment, limits, exchanges.

Errors are distances in pixels between a keypoint and the body's landmark in the same view. Everything is told, but a warning is
only what points to a mistake: that the views leave the fingers open is the fate of every fit to 17 points.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.body.landmarks import landmark_model, pose_landmarks
from humangs_jax.core.array_types import Bool, Float
from humangs_jax.data.capture import Capture
from humangs_jax.data.keypoints.keypoints import Keypoints
from humangs_jax.data.photos import Photos
from humangs_jax.fitting.findings import ViewFit, Violation, limit_violations, listed, open_joints, warnings
from humangs_jax.fitting.fit_record import FitRecord
from humangs_jax.fitting.landmark_fit import NOISE_RANGE, RAYLEIGH_MEDIAN
from humangs_jax.fitting.objective import keypoint_errors, landmark_certainty
from humangs_jax.fitting.observations import group_by_moment
from humangs_jax.fitting.swaps import Swap, find_exchanged_hands, find_swaps

OUTLIER = 5.0
"""Standard deviations of the noise beyond which a keypoint is an outlier; as many as the last stage of a fit cuts it off at."""
ROWS = 24
"""Views in the table; of more, those that fit worst."""


@dataclasses.dataclass(frozen=True, eq=False)
class Examination:
    """Of v views of m moments and k keypoints; `str()` is what the command line prints.

    views: one row each. moments: (m,) median error of each, pixels, NaN where no view has keypoints. noise: (m,) standard
    deviation of the keypoints, pixels. violations: of joint limits. swaps: what seems exchanged. undetermined: joints, or
    groups of joints, that the views leave open. seen: (v, k, 2) the body's landmarks, pixels. compared, outliers: (v, k).
    """

    views: tuple[ViewFit, ...]
    moments: Float[np.ndarray, " m"]
    noise: Float[np.ndarray, " m"]
    violations: tuple[Violation, ...]
    swaps: tuple[Swap, ...]
    undetermined: tuple[str, ...]
    warnings: tuple[str, ...]
    seen: Float[np.ndarray, "v k 2"]
    compared: Bool[np.ndarray, "v k"]
    outliers: Bool[np.ndarray, "v k"]

    @property
    def ok(self) -> bool:
        """Whether there is no warning."""
        return not self.warnings

    def __str__(self) -> str:
        """A table of the views, then what holds for all of them, then the warnings."""
        rows = self.views
        if len(rows) > ROWS:
            worst = np.argsort([-np.nan_to_num(view.median, nan=np.inf) for view in rows], kind="stable")[:ROWS]
            rows = tuple(rows[i] for i in sorted(worst))
        width = max(4, *(len(view.name) for view in rows))
        lines = [f"{'view':<{width}}  keypoints  median error  90 % below  outliers"]
        for view in rows:
            errors = f"{view.median:>9.1f} px  {view.high:>7.1f} px" if view.keypoints else f"{'-':>12}  {'-':>10}"
            lines.append(f"{view.name:<{width}}  {view.keypoints:>9}  {errors}  {view.outliers:>8.0%}")
        if len(self.views) > ROWS:
            lines.append(f"{'...':<{width}}  {len(self.views) - ROWS} more that fit better")
        known = np.flatnonzero(np.isfinite(self.moments))
        if len(self.moments) > 1 and len(known):
            worst = known[np.argmax(self.moments[known])]
            middle = np.median(self.moments[known])
            lines.append(
                f"moments: median error {middle:.1f} px, worst in moment {worst}: {self.moments[worst]:.1f} px"
            )
        if self.undetermined:
            lines.append(f"left open by the views, so as is usual: {', '.join(self.undetermined)}")
        return "\n".join([*lines, *(f"warning: {warning}" for warning in self.warnings)])


def examine(
    capture: Capture,
    keypoints: Keypoints,
    *,
    deviations: Float[np.ndarray, "m j"] | None = None,
    determined: Float[np.ndarray, "m j"] | None = None,
    noise: Float[np.ndarray, " m"] | None = None,
    mirrored: tuple[Swap, ...] = (),
) -> Examination:
    """Compare the body of a capture with keypoints of its views, in the order of the views.

    Arguments: deviations, determined: of joints, metres and shares, as `fit_uncertainty` gives them. noise: pixels, as the fit
    found it; from the median error if not given. mirrored: what `find_mirrored` found.

    Raises: ValueError if the number of views differs, or the body has none of the landmarks.
    """
    if len(keypoints.points) != capture.view_count:
        raise ValueError(f"keypoints of {len(keypoints.points)} views, but the capture has {capture.view_count}")
    photographs = Photos(capture.images, capture.masks, capture.cameras, capture.frames, capture.names)
    observations, views = group_by_moment(photographs, keypoints)
    expected, poses = np.asarray(observations.noise), jax.tree.map(lambda leaf: leaf[: len(views)], capture.poses)
    model = landmark_model(capture.body, keypoints.set.names)
    errors = np.asarray(_errors(model, jnp.asarray(capture.betas), poses, observations))
    compared = np.asarray(observations.confidences > 0) & np.asarray(model.known)
    lengths = np.where(compared, np.linalg.norm(errors, axis=-1), np.nan)
    moments = np.asarray([_quantile(own, 0.5) for own in lengths])
    noise = _noise(moments, expected) if noise is None else noise[: len(views)]
    outliers = compared & (lengths * landmark_certainty(model.names) > OUTLIER * noise[:, None, None])

    moment_of, slot_of = np.argwhere(views >= 0)[np.argsort(views[views >= 0])].T
    by_view = lambda values: values[moment_of, slot_of]
    numbers = zip(capture.names, moment_of.tolist(), by_view(lengths), by_view(outliers), strict=True)
    fits = tuple(_view_fit(*own) for own in numbers)
    violations = limit_violations(capture.body.joint_names, poses)
    known = [None if values is None else values[: len(views)] for values in (deviations, determined)]
    swaps = (*mirrored, *find_swaps(observations, keypoints.set, views, capture.names))
    swaps += find_exchanged_hands(keypoints, capture.names)
    return Examination(
        views=fits,
        moments=moments,
        noise=noise,
        violations=violations,
        swaps=swaps,
        undetermined=open_joints(capture.body.joint_names, compared.any((1, 2)), *known),
        warnings=warnings(fits, expected, violations, swaps),
        seen=by_view(errors + np.asarray(observations.points)),
        compared=by_view(compared),
        outliers=by_view(outliers),
    )


def examine_record(
    capture: Capture, record: FitRecord | None, keypoints: Keypoints | None = None
) -> tuple[Examination, Keypoints]:
    """Examine a capture by what its fit kept, or by other keypoints; returns the keypoints too, in the order of the views.

    Raises: ValueError if both are None, if the record is of other views or of fewer moments, or as `examine` does.
    """
    if keypoints is not None:
        return examine(capture, keypoints), keypoints
    if record is None:
        raise ValueError("neither keypoints nor the record of a fit to examine the body with")
    if missing := [name for name in capture.names if name not in record.names]:
        raise ValueError(f"the capture's fit knows no view {listed(missing)}: fit it again")
    rows = [record.names.index(name) for name in capture.names]
    points, confidences = (getattr(record.keypoints, name)[rows] for name in ("points", "confidences"))
    keypoints = dataclasses.replace(record.keypoints, points=points, confidences=confidences)
    if len(record.noise) <= capture.frames.max() or record.deviations.shape[1] != len(capture.body.joint_names):
        raise ValueError(
            f"the capture's fit is of {len(record.noise)} moments and {record.deviations.shape[1]} joints, but the capture has "
            f"{capture.frames.max() + 1} and {len(capture.body.joint_names)}: fit it again"
        )
    known = {name: getattr(record, name) for name in ("deviations", "determined", "noise")}
    return examine(capture, keypoints, **known), keypoints


@jax.jit
def _errors(model, betas, poses, observations):
    """(m, c, k, 2) landmarks less keypoints, pixels."""
    landmarks = jax.vmap(lambda pose: pose_landmarks(model, betas, pose)[0])(poses)
    return jax.vmap(keypoint_errors)(observations, landmarks)


def _noise(medians, expected):
    """(m,) as fits find it: from the median error, within bounds about what is expected."""
    found = np.where(np.isfinite(medians), medians / RAYLEIGH_MEDIAN, expected)
    return np.clip(found, NOISE_RANGE[0] * expected, NOISE_RANGE[1] * expected)


def _view_fit(name, moment, lengths, outliers):
    count = int(np.isfinite(lengths).sum())
    share = float(outliers.sum() / max(count, 1))
    return ViewFit(name, moment, count, _quantile(lengths, 0.5), _quantile(lengths, 0.9), share)


def _quantile(values, share):
    """Of those that are not NaN; NaN if all are."""
    known = values[np.isfinite(values)]
    return float(np.quantile(known, share)) if known.size else float("nan")
