#version 430
#include "common.glsl"
uniform sampler2D albedo;
uniform sampler2D slopes;
uniform sampler2D blocked;  // shares of light that the object keeps from the ground
uniform vec2 place;
uniform float side;
uniform float ground_roughness;
uniform int has_bumps;
uniform float reach;

layout(location = 0) out vec4 out_colour;
layout(location = 1) out float out_depth;

void main() {
    vec3 ray = ray_of(gl_FragCoord.xy);
    float h = height - eye.z;
    float z = h / ray.z;
    if (!(z > 0.0 && z < 1e5)) discard;
    vec2 at = eye.xy + z * ray.xy;
    vec3 next = ray_of(gl_FragCoord.xy + vec2(1.0, 0.0)), below = ray_of(gl_FragCoord.xy + vec2(0.0, 1.0));
    vec2 flip = vec2(1.0, -1.0) / side;  // the picture's first row is its upper edge
    vec2 right = (eye.xy + h / next.z * next.xy - at) * flip;
    vec2 down = (eye.xy + h / below.z * below.xy - at) * flip;
    vec2 g = (at + place) * flip;
    vec3 base = textureGrad(albedo, g, right, down).rgb;
    base *= base;  // it holds square roots
    vec3 n = vec3(0.0, 0.0, 1.0);
    if (has_bumps == 1) n = normalize(vec3(-textureGrad(slopes, g, right, down).rg, 1.0));
    vec2 spot = at / reach;
    float rim = max(abs(spot.x), abs(spot.y));
    spot = 0.5 + 0.5 * spot;
    // The few directions that stand for the whole sky must not show one by one
    vec3 kept = vec3(textureLod(blocked, spot, 2.0).r, textureLod(blocked, spot, 0.0).gb);
    vec3 open = 1.0 - kept * (1.0 - smoothstep(0.8, 1.0, rim));
    vec3 diffuse = smooth_light(n) * open.r;
    diffuse += keys[0] * (max(dot(n, key_directions[0]), 0.0) * open.g);
    diffuse += keys[1] * (max(dot(n, key_directions[1]), 0.0) * open.b);
    vec3 view = -normalize(ray);
    if (h > 0.0) view.z = -view.z;
    vec3 mirrored = reflect(-view, n);
    mirrored.z = abs(mirrored.z);
    float share = reflected_share(ground_roughness, clamp(dot(n, view), 0.0, 1.0));
    vec3 glossy = sky(mirrored, highlight_level(ground_roughness));
    vec3 radiance = base * diffuse + glossy * (share * open.r * unhidden(mirrored, open.gb));
    // Far away it goes over into the panorama, as in haze
    float far = smoothstep(10.0, 60.0, length(at - eye.xy));
    radiance = mix(radiance, sky(normalize(ray), 2.0), far);
    out_colour = vec4(shown(radiance), 0.0);
    out_depth = z;
}
