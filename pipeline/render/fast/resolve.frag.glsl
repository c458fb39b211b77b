#version 430
// The mean of a pixel's samples: the object's where they see it, else ground or sky, which are smooth.
#include "common.glsl"
uniform sampler2D object;       // supersample x supersample texels a pixel; alpha 0 where the object is not
uniform sampler2D behind;
uniform sampler2D seen_centre;
uniform int supersample;
layout(location = 0) out vec4 out_colour;
void main() {
    ivec2 at = ivec2(gl_FragCoord.xy);
    vec4 sum = vec4(0.0);
    for (int i = 0; i < supersample * supersample; i++)
        sum += texelFetch(object, at * supersample + ivec2(i % supersample, i / supersample), 0);
    float count = float(supersample * supersample);
    vec3 mean = (sum.rgb + (count - sum.a) * texelFetch(behind, at, 0).rgb) / count;
    out_colour = vec4(to_srgb(mean), texelFetch(seen_centre, at, 0).r > 0.0 ? 1.0 : 0.0);
}
