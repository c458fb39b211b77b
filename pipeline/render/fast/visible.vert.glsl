#version 430
// What is behind the ground is not seen: it is cut off. What lies on it (within 1e-4) is.
uniform mat4 clip_from_world;
uniform vec2 ground;  // height; +1 seen from above, -1 from below, 0 without one
in vec3 position;
out gl_PerVertex { vec4 gl_Position; float gl_ClipDistance[1]; };
void main() {
    gl_Position = clip_from_world * vec4(position, 1.0);
    gl_ClipDistance[0] = ground.y == 0.0 ? 1.0 : (position.z - ground.x) * ground.y + 1e-4;
}
