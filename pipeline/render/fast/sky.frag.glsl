#version 430
#include "common.glsl"
layout(location = 0) out vec4 out_colour;
layout(location = 1) out float out_depth;
void main() {
    out_colour = vec4(shown(sky(normalize(ray_of(gl_FragCoord.xy)), 0.0)), 0.0);
    out_depth = 0.0;
}
