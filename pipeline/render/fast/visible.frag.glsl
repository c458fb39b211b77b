#version 430
// Which face is seen: its number + 1, exact in a float up to 2^24. 0 is where none is.
layout(location = 0) out float face;
void main() { face = float(gl_PrimitiveID + 1); }
