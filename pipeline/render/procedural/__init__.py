"""CAD-like objects without a file: an infinite series, every number another object, the same in every process.

A stand-in for ABC, on which the paper trains, that nobody's licence binds.
"""

from pipeline.render.procedural.series import FACES, KINDS, procedural_object

__all__ = ["FACES", "KINDS", "procedural_object"]
