#version 430
// All pixels whose ray is on one side of a plane through the eye, at the depth that is "nothing seen".
uniform vec3 kept;  // of pixel (x, y, 1): positive where it is drawn; (0, 0, 1): everywhere
uniform vec2 size;
out gl_PerVertex { vec4 gl_Position; float gl_ClipDistance[1]; };
void main() {
    vec2 corner = vec2(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0);
    gl_Position = vec4(corner, 1.0, 1.0);
    gl_ClipDistance[0] = dot(kept, vec3((0.5 + 0.5 * corner) * size, 1.0));
}
