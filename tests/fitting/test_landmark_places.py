"""Keypoints that lie where a detector sees them, and not where annotators would put them."""

import numpy as np
import pytest
from fit_people import default_body, observe

from humangs_jax.body.landmarks import landmark_model
from humangs_jax.core.pytree import replace
from humangs_jax.data.keypoints.sets import MEDIAPIPE_33
from humangs_jax.fitting.landmark_fit import FitConfig, fit_landmarks

NEAR_MM, BIASED = 15.0, 1.5
"""Mean joint error of a fit that knows the places, in one frame with noise (10 mm measured), and how many times larger it is
without them (2.2 measured)."""


@pytest.mark.slow
def test_a_fit_that_knows_the_places_recovers_the_body_and_one_that_does_not_is_biased():
    knowing = landmark_model(default_body(), MEDIAPIPE_33.names, MEDIAPIPE_33.places)
    plain = landmark_model(default_body(), MEDIAPIPE_33.names)
    joints, _, seen = observe(("standing",), noise=1.0, model=knowing)
    common = np.asarray(plain.known, np.float32)
    seen = replace(seen, confidences=seen.confidences * common)  # without the points of the face that only places have
    errors = {}
    for name, model in (("knowing", knowing), ("plain", plain)):
        fit = fit_landmarks(model, seen, FitConfig())
        errors[name] = 1000 * np.linalg.norm(np.asarray(fit.joints) - joints, axis=-1).mean()
    assert errors["knowing"] < NEAR_MM
    assert errors["plain"] > BIASED * errors["knowing"]
