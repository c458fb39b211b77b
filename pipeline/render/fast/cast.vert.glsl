#version 430
// The object's shadows on the ground, one instance a direction. Every instance has a depth of its own, nearer than
// those before it: by the depth test a texel counts each direction once, however many faces shade it.
const int DIRECTIONS = 44;
uniform vec4 toward[DIRECTIONS];
uniform vec4 shares[DIRECTIONS];  // of the smooth light, of the first and of the second key light
uniform int used[DIRECTIONS];
uniform float height;
uniform float reach;              // half the side of the square of ground
in vec3 position;
flat out vec4 share;
void main() {
    int i = used[gl_InstanceID];
    share = shares[i];
    vec2 foot = position.xy - toward[i].xy * (max(position.z - height, 0.0) / toward[i].z);
    gl_Position = vec4(foot / reach, 0.9 - 1.8 * (float(gl_InstanceID) + 0.5) / float(DIRECTIONS), 1.0);
}
