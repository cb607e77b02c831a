"""Makes captures from photos. `detection` finds people in photos with BlazePose, and their faces
and hands. `keypoints` and `calibration` read files of other programs. `fitting` finds cameras from
the person, fits the body to keypoints and masks, and finds the motion in a video.
"""
