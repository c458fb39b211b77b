"""A demonstration input that needs no download: procedural objects, filmed by a moving camera into real video files.

`shapes.py` makes objects of a dozen families in random proportions, `scene.py` sets each in a room, `film.py` moves the
camera and writes videos, masks and true cameras. Everything runs on the CPU with NumPy and OpenCV.
"""
