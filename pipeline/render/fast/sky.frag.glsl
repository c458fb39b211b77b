#version 430
#include "common.glsl"
const float BLUR = 0.8;  // of the level: texels are larger than pixels, and should look out of focus
layout(location = 0) out vec4 out_colour;
layout(location = 1) out float out_depth;
void main() {
    out_colour = vec4(shown(sky(normalize(ray_of(gl_FragCoord.xy)), BLUR)), 0.0);
    out_depth = 0.0;
}
