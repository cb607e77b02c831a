"""People of a photo: landmarks in pixels and metres, and masks, by BlazePose."""
