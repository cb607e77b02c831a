"""`BodyModel`, `shape_body`, `pose_body`; skinning, landmarks, the SMPL-X reader, the CC0 default
body.
"""
