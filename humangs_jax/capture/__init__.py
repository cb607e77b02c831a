"""From photos to a capture: `detection` (people of a photo by BlazePose, their faces and hands),
`keypoints` and `calibration` (readers of files), `fitting` (cameras from the person, the body from
keypoints and masks, the motion of a video).
"""
