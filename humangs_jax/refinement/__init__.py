"""Fits avatars to photos. `refine` has the API, `search` decides what a run tries, `learned` has
the iterations of the learned optimizer, `steps` has the steps of Adam, and `head` has the last
steps, on the head alone.
"""
