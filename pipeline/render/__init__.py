"""Meshes to prepared sequences: pictures with exact masks, depth and cameras (the paper's renders, supplement)."""
