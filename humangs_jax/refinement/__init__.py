"""`refine` is the loop, `steps` the pure state and step, `search` what a run tries, `head` its last
steps, and `learned` the learned optimizer.
"""
