"""From photos to a capture: `detection` (people of a photo by BlazePose), `keypoints` and
`calibration` (readers of files), `fitting` (cameras from the person, the body from keypoints and
masks).
"""
