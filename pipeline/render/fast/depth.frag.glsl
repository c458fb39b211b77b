#version 430
uniform mat3 world_from_pixel;
uniform vec3 eye;
uniform vec3 forward;
uniform sampler2D seen_centre;
#include "hit.glsl"
layout(location = 0) out float out_depth;
void main() {
    vec3 ray = world_from_pixel * vec3(gl_FragCoord.xy, 1.0);
    out_depth = hit_of(int(texelFetch(seen_centre, ivec2(gl_FragCoord.xy), 0).r) - 1, ray, forward).z;
}
