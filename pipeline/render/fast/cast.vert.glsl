#version 430
// The object's shadows on the ground, one instance a direction. Every instance has a depth of its own, nearer than
// those before it: by the depth test a texel counts each direction once, however many faces shade it.
uniform vec4 caster_toward[CASTERS];
uniform vec4 shares[CASTERS];  // of the smooth light, of the first and of the second key light
uniform float height;
uniform float reach;              // half the side of the square of ground
in vec3 position;
flat out vec4 share;
void main() {
    int i = gl_InstanceID;
    share = shares[i];
    vec2 foot = position.xy - caster_toward[i].xy * (max(position.z - height, 0.0) / caster_toward[i].z);
    gl_Position = vec4(foot / reach, 0.9 - 1.8 * (float(gl_InstanceID) + 0.5) / float(CASTERS), 1.0);
}
