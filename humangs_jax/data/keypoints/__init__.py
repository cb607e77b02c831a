"""2D keypoints of photos, read from the files that detectors write."""
