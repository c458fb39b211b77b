"""Stage `depth`: a z-depth map for every registered frame."""
