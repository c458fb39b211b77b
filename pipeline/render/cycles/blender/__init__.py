"""What runs in Blender's interpreter: only bpy, NumPy and the standard library. Started by path, not imported."""
