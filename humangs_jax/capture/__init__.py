"""From photos to a capture: detection, keypoints, calibration, cameras of the person, fitting."""
