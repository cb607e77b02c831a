"""2D keypoints of photographs, read from the files that detectors write."""
