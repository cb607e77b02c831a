"""`BodyModel`, `shape_body`, `pose_body`, skinning, landmarks, the reader of SMPL-X, and the CC0
default body.
"""
