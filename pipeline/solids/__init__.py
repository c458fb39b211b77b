"""Closed bodies in many forms: grids of points, outlines, triangle meshes. The demo's and the procedural objects' stock."""
