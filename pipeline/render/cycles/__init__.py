"""Photoreal pictures by Blender's path tracer Cycles, which runs in a process, and where need be an environment, of its
own: `CyclesRenderer`."""
