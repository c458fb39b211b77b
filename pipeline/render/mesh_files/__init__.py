"""Readers of mesh files, one a format: a file's bytes to parts whose indices are in range.

They are our own because a mesh of a large collection may be anything: what a header claims is compared with the bytes
that follow before anything is allocated, a file that is cut off says so, and no file outside the mesh's folder is
opened. What is made of the parts then (finite, not degenerate, normals) is `pipeline.render.load`.
"""
