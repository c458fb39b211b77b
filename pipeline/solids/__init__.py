"""Closed bodies in many forms: grids of points, outlines, triangle meshes. Made-up objects are built of them."""
