#version 430
// KIND: 0 colours of parts and vertices, 1 one colour, 2 Voronoi cells, 3 as 0 with textures.
#include "common.glsl"
#include "hit.glsl"
layout(std430, binding = 2) readonly buffer Colours { uvec2 colours[]; };      // linear: four halves a vertex
layout(std430, binding = 3) readonly buffer Materials { vec4 materials[]; };  // linear colour, texture or -1

uniform sampler2D seen;
uniform sampler2DArray textures;
uniform sampler2DShadow atlas;
uniform vec3 forward;
uniform vec3 palette[MAX_COLOURS];
uniform int n_colours;
uniform float cells;
uniform uint seed;
uniform float roughness;
uniform int n_keys;
uniform vec4 across[DIRECTIONS];
uniform vec4 along[DIRECTIONS];
uniform vec4 toward[DIRECTIONS];
uniform vec4 tiles[DIRECTIONS];
uniform float weights[DIRECTIONS];
uniform float shadow_step;         // width of a shadow map's texel in the world

layout(location = 0) out vec4 out_colour;
layout(location = 1) out float out_depth;

// What a ray that leaves the object meets: the panorama, below the horizon the ground's mean radiance.
vec3 surroundings(vec3 d, float level) {
    if (has_ground == 1) d.z = max(d.z, 0.0) + 1e-3;
    return sky(normalize(d), level);
}

float lit(int i, vec4 p) {
    vec2 xy = vec2(dot(across[i], p), dot(along[i], p));
    vec2 uv = 0.5 + 0.5 * (xy * tiles[i].xy + tiles[i].zw);
    return textureLod(atlas, vec3(uv, 0.5 - 0.5 * dot(toward[i], p)), 0.0);
}

uvec3 scrambled(uvec3 v) {  // pcg3d: Jarzynski and Olano, JCGT 2020; integers, so the same everywhere
    v = v * 1664525u + 1013904223u;
    v.x += v.y * v.z; v.y += v.z * v.x; v.z += v.x * v.y;
    v ^= v >> 16u;
    v.x += v.y * v.z; v.y += v.z * v.x; v.z += v.x * v.y;
    return v;
}

vec3 voronoi(vec3 p) {
    p *= cells;
    vec3 base = floor(p);
    float best = 1e9;
    uint owner = 0u;
    for (int i = 0; i < 27; i++) {
        vec3 cell = base + vec3(i % 3 - 1, (i / 3) % 3 - 1, i / 9 - 1);
        uvec3 h = scrambled(uvec3(ivec3(cell) + 32768) + uvec3(seed, seed >> 10u, seed >> 20u));
        vec3 apart = cell + vec3(h >> 8u) * (1.0 / 16777216.0) - p;
        float d = dot(apart, apart);
        if (d < best) { best = d; owner = h.x ^ (h.y >> 3u); }
    }
    return palette[int(scrambled(uvec3(owner, seed, 7u)).x % uint(n_colours))];
}

vec2 uv_of(uvec4 face, vec3 s) {
    uint a = 2u * face.x, b = 2u * face.y, c = 2u * face.z;
    return s.x * vec2(vertices[a].w, vertices[a + 1u].w) + s.y * vec2(vertices[b].w, vertices[b + 1u].w) +
           s.z * vec2(vertices[c].w, vertices[c + 1u].w);
}

vec3 colour_of(uint vertex) {
    return vec3(unpackHalf2x16(colours[vertex].x), unpackHalf2x16(colours[vertex].y).x);
}

vec3 own_colour(Hit hit) {
    vec4 material = materials[hit.face.w];
    vec3 s = hit.share;
    vec3 mixed = s.x * colour_of(hit.face.x) + s.y * colour_of(hit.face.y) + s.z * colour_of(hit.face.z);
    vec3 colour = material.rgb * mixed;
#if KIND == 3
    vec3 A = vertices[2u * hit.face.x].xyz;
    vec3 e1 = vertices[2u * hit.face.y].xyz - A, e2 = vertices[2u * hit.face.z].xyz - A;
    vec3 n = cross(e1, e2);
    float z;
    vec2 uv = uv_of(hit.face, s);
    vec2 right = uv_of(hit.face, shares_at(ray_of(gl_FragCoord.xy + vec2(1.0, 0.0)), A - eye, e1, e2, n, z)) - uv;
    vec2 down = uv_of(hit.face, shares_at(ray_of(gl_FragCoord.xy + vec2(0.0, 1.0)), A - eye, e1, e2, n, z)) - uv;
    vec3 at = vec3(uv.x, 1.0 - uv.y, max(material.w, 0.0));
    vec3 texel = to_linear(textureGrad(textures, at, vec2(right.x, -right.y), vec2(down.x, -down.y)).rgb);
    colour *= material.w >= 0.0 ? texel : vec3(1.0);
#endif
    return colour;
}

vec3 base_colour(Hit hit) {
#if KIND == 1
    return palette[0];
#elif KIND == 2
    return voronoi(hit.point);
#else
    return own_colour(hit);
#endif
}

void main() {
    vec3 ray = ray_of(gl_FragCoord.xy);
    Hit hit = hit_of(int(texelFetch(seen, ivec2(gl_FragCoord.xy), 0).r) - 1, ray, forward);
    vec3 n = hit.smoothed;
    // Looked up a little above the surface, else it would shade itself
    vec4 p = vec4(hit.point + hit.normal * (1.6 * shadow_step), 1.0);
    vec3 diffuse = vec3(0.0);
    vec2 lit_by = vec2(1.0);
    for (int k = 0; k < n_keys; k++) {
        float facing = max(min(dot(n, key_directions[k]), 4.0 * dot(hit.normal, key_directions[k])), 0.0);
        float light = 0.0;
        for (int i = k * KEY_SAMPLES; i < (k + 1) * KEY_SAMPLES; i++) light += lit(i, p);
        lit_by[k] = light / float(KEY_SAMPLES);
        diffuse += keys[k] * (facing * lit_by[k]);
    }
    float whole = 1e-9, open = 1e-9;
    for (int i = KEYS * KEY_SAMPLES; i < DIRECTIONS; i++) {
        float share = weights[i] * max(dot(n, toward[i].xyz), 0.0);
        whole += share;
        open += share * lit(i, p);
    }
    float openness = open / whole;
    diffuse += smooth_light(n) * openness;
    vec3 view = -normalize(ray);
    vec3 outward = reflect(-view, n);
    float level = highlight_level(roughness), soft = 0.02 + 0.06 * level;
    float up = has_ground == 1 ? smoothstep(-soft, soft, outward.z) : 1.0;
    vec3 mirrored = mix(bounce, surroundings(outward, level), up);
    float share = reflected_share(roughness, clamp(dot(n, view), 0.0, 1.0)) * openness * unhidden(outward, lit_by);
    out_colour = vec4(shown(base_colour(hit) * diffuse + mirrored * share), 1.0);
    out_depth = hit.z;
}
